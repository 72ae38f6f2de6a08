//! The gate in front of all services: a tower layer.

use std::{
    convert::Infallible,
    num::NonZeroU32,
    pin::Pin,
    sync::{Arc, OnceLock},
    task::{Context, Poll},
};

use futures::future::BoxFuture;
use governor::{DefaultDirectRateLimiter, Quota, RateLimiter};
use http::{Request, Response};
use prost::bytes::Bytes;
use tonic::{Code, Status, body::Body, metadata::MetadataMap};
use tower::{Layer, Service};
use tracing::Instrument;

use super::{
    Gate,
    limits::OpenStream,
    methods::{Audit, Method, Need, method},
};
use crate::{
    jobs::{Jobs, audit::AuditEntry, principal::Principal},
    service::{accept::Peer, call_name, call_span::CallSpan, status::refusal},
    telemetry::{Spans, trace::TraceContext},
};

/// Entries of refusals a second, lest strangers fill the disk, and how many may come at once: those of a minute.
const REFUSALS_PER_SEC: NonZeroU32 = NonZeroU32::new(10).unwrap();
const REFUSALS_AT_ONCE: NonZeroU32 = NonZeroU32::new(600).unwrap();

/// Who makes a call, and what it turns out to be about. Handlers find it in the request.
#[derive(Clone, Debug)]
pub(in crate::service) struct Call {
    /// Who.
    pub who: Arc<Principal>,
    /// Where in a trace it is, if anybody traces.
    pub trace: Option<TraceContext>,
    resource: Arc<OnceLock<String>>,
}

impl Call {
    fn of(who: Principal, trace: Option<TraceContext>) -> Self {
        Self { who: Arc::new(who), trace, resource: Arc::default() }
    }

    /// Says what the call is about, for the audit table.
    pub fn is_about(&self, resource: impl Into<String>) {
        // Said twice, the first holds.
        let _ = self.resource.set(resource.into());
    }

    /// What it is about.
    pub fn resource(&self) -> Option<&str> {
        self.resource.get().map(String::as_str)
    }
}

/// Puts the gate in front of a service.
#[derive(Clone, Debug)]
pub(in crate::service) struct GateLayer {
    gate: Arc<Gate>,
    jobs: Jobs,
    spans: Spans,
    refusals: Arc<DefaultDirectRateLimiter>,
}

impl GateLayer {
    pub fn new(gate: Arc<Gate>, jobs: Jobs, spans: Spans) -> Self {
        let quota = Quota::per_second(REFUSALS_PER_SEC).allow_burst(REFUSALS_AT_ONCE);
        Self { gate, jobs, spans, refusals: Arc::new(RateLimiter::direct(quota)) }
    }
}

impl<S> Layer<S> for GateLayer {
    type Service = Guarded<S>;

    fn layer(&self, inner: S) -> Guarded<S> {
        Guarded { gate: self.clone(), inner }
    }
}

/// A service behind the gate.
#[derive(Clone, Debug)]
pub(in crate::service) struct Guarded<S> {
    gate: GateLayer,
    inner: S,
}

impl<S> Service<Request<Body>> for Guarded<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>
        + Clone
        + Send
        + 'static,
    S::Future: Send,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, Result<Response<Body>, Infallible>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        // The one that was polled ready goes on; its clone waits for the next call.
        let inner = self.inner.clone();
        let inner = std::mem::replace(&mut self.inner, inner);
        Box::pin(pass(self.gate.clone(), inner, request))
    }
}

/// Names the call, and whatever is logged of it.
async fn pass<S>(
    gate: GateLayer,
    inner: S,
    mut request: Request<Body>,
) -> Result<Response<Body>, Infallible>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    let name = call_name::ensure(request.headers_mut());
    let method = request.uri().path().rsplit('/').next().unwrap_or_default();
    let method = method.get(..64).unwrap_or(method);
    let id = name.to_str().unwrap_or_default();
    let span = tracing::info_span!("request", id, method);
    let traced = CallSpan::begin(&gate.spans, &request, id);
    if let Some(traced) = &traced {
        request.extensions_mut().insert(traced.context());
    }
    let mut response = decide(gate, inner, request).instrument(span).await?;
    if let Some(traced) = traced {
        response = traced.follow(response);
    }
    response.headers_mut().insert(call_name::HEADER, name);
    Ok(response)
}

async fn decide<S>(
    gate: GateLayer,
    mut inner: S,
    mut request: Request<Body>,
) -> Result<Response<Body>, Infallible>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    let method = method(request.uri().path());
    if method.need == Need::Nothing {
        return inner.call(request).await;
    }
    let path = request.uri().path().to_owned();
    let peer = request.extensions().get::<Peer>().cloned().unwrap_or_default();
    let headers = MetadataMap::from_headers(request.headers().clone());
    let identified = gate.gate.identify(&peer, &headers).map_err(|refusal| (None, refusal));
    let admitted = identified.and_then(|who| {
        gate.gate.admit(method, who).map_err(|(who, refusal)| (Some(who), refusal))
    });
    let admitted = match admitted {
        Ok(admitted) => admitted,
        Err((who, refusal)) => {
            let status = refusal.status();
            gate.note(who.as_ref(), &peer, &path, "", status.code()).await;
            tokio::time::sleep(gate.gate.patience(&refusal, &peer)).await;
            let mut response = status.into_http();
            if let Some(who) = who.filter(|_| gate.spans.is_on()) {
                response.extensions_mut().insert(Call::of(who, None));
            }
            return Ok(response);
        }
    };
    let trace = request.extensions().get::<TraceContext>().copied();
    let call = Call::of(admitted.who, trace);
    request.extensions_mut().insert(call.clone());
    // The token has done its work.
    request.headers_mut().remove("authorization");
    let mut response = explained(inner.call(request).await?);
    let code = Status::from_header_map(response.headers()).map_or(Code::Ok, |s| s.code());
    gate.answered(method, &call, &peer, &path, code).await;
    if gate.spans.is_on() {
        response.extensions_mut().insert(call);
    }
    Ok(held(response, admitted.stream))
}

impl GateLayer {
    /// Writes about an answered call what its row of the table says.
    async fn answered(&self, method: &Method, call: &Call, peer: &Peer, path: &str, code: Code) {
        let resource = call.resource().unwrap_or_default();
        if method.audit == Audit::Yes {
            self.note(Some(&call.who), peer, path, resource, code).await;
        }
    }

    /// Writes an entry of the audit table, and a line of the log.
    async fn note(
        &self,
        who: Option<&Principal>,
        peer: &Peer,
        path: &str,
        resource: &str,
        code: Code,
    ) {
        // Strangers may choose the path.
        let path = path.get(..128).unwrap_or(path);
        let principal = who.map(|who| who.name.clone()).unwrap_or_default();
        let owner = who.map(|who| who.owner.clone()).unwrap_or_default();
        let outcome = code_name(code);
        metrics::counter!("lookalike_audited_calls_total", "outcome" => outcome).increment(1);
        let is_refusal = matches!(
            code,
            Code::Unauthenticated | Code::PermissionDenied | Code::ResourceExhausted
        );
        if is_refusal && self.refusals.check().is_err() {
            return;
        }
        let peer = peer.to_string();
        tracing::info!(target: "audit", principal, owner, peer, path, resource, outcome, "call");
        let method = path.rsplit('/').next().unwrap_or(path).to_owned();
        let resource = resource.to_owned();
        let entry =
            AuditEntry { principal, owner, peer, method, resource, outcome: outcome.into() };
        if let Err(error) = self.jobs.audit(entry).await {
            tracing::error!(%error, "the audit table cannot be written");
        }
    }
}

/// The code's name in gRPC's own spelling.
pub(in crate::service) fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

/// Codes of refusals that do not come from a handler but from below it, where messages are read: what they
/// become, a reason, and what to do.
const BELOW: [(Code, Code, &str, &str); 3] = [
    (Code::OutOfRange, Code::ResourceExhausted, "MESSAGE_TOO_LARGE", "send less at a time"),
    (
        Code::Internal,
        Code::InvalidArgument,
        "MALFORMED",
        "run client and server of the same version",
    ),
    (
        Code::Unimplemented,
        Code::Unimplemented,
        "UNSUPPORTED",
        "use what the server's reflection tells of",
    ),
];

/// The answer with an `ErrorInfo`, like any that comes from a handler.
fn explained(response: Response<Body>) -> Response<Body> {
    let status = Status::from_header_map(response.headers());
    let bare = status.filter(|status| status.code() != Code::Ok && status.details().is_empty());
    let Some(status) = bare else { return response };
    let Some((_, code, reason, remedy)) = BELOW.iter().find(|row| row.0 == status.code()) else {
        return response;
    };
    let text = format!("{}: {remedy}", status.message());
    refusal(*code, reason, &text, None).into_http()
}

/// Counts the stream as open until its answer has been sent.
fn held(response: Response<Body>, stream: Option<OpenStream>) -> Response<Body> {
    match stream {
        Some(stream) => response.map(|body| Body::new(Held { body, _stream: stream })),
        None => response,
    }
}

/// An answer that holds its place among the open streams.
struct Held {
    body: Body,
    _stream: OpenStream,
}

impl http_body::Body for Held {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}
