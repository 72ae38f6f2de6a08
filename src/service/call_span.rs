//! The span of a call: what traces tell of it. It begins where the gate takes the call and ends with the last byte
//! of the answer, or when the caller goes away.
//!
//! A caller that sends a `traceparent` finds the call in its own trace. Spans hold what the log holds, and no more:
//! names and numbers, no tokens, no messages.

use std::{
    pin::Pin,
    task::{Context, Poll},
    time::SystemTime,
};

use http::{Request, Response};
use prost::bytes::Bytes;
use tonic::{Code, Status, body::Body};

use super::{
    accept::Peer,
    auth::{Call, code_name},
};
use crate::telemetry::{
    Spans,
    trace::{Span, TRACEPARENT, TraceContext},
};

/// Codes that are the server's fault, as OpenTelemetry's conventions have it.
const FAULTS: [Code; 6] = [
    Code::Unknown,
    Code::DeadlineExceeded,
    Code::Unimplemented,
    Code::Internal,
    Code::Unavailable,
    Code::DataLoss,
];

/// A call under way. It is told of when it is dropped.
#[derive(Debug)]
pub(super) struct CallSpan {
    spans: Spans,
    span: Span,
    /// How it ended, once that is known.
    code: Option<Code>,
}

impl CallSpan {
    /// A call begins; `None` where nobody traces.
    pub fn begin(spans: &Spans, request: &Request<Body>, request_id: &str) -> Option<Self> {
        if !spans.is_on() {
            return None;
        }
        let parent = request.headers().get(TRACEPARENT).and_then(|value| value.to_str().ok());
        let parent = parent.and_then(TraceContext::parse);
        // Strangers may choose the path.
        let path = request.uri().path();
        let path = path.get(..128).unwrap_or(path).trim_start_matches('/');
        let now = SystemTime::now();
        let mut span = Span {
            at: TraceContext::below(parent),
            parent: parent.map(|parent| parent.span),
            is_call: true,
            name: path.into(),
            start: now,
            end: now,
            attributes: Vec::new(),
            error: None,
        };
        span.say("rpc.system", "grpc");
        if let Some((service, method)) = path.rsplit_once('/') {
            span.say("rpc.service", service);
            span.say("rpc.method", method);
        }
        span.say("lookalike.request_id", request_id);
        if let Some(peer) = request.extensions().get::<Peer>() {
            span.say("client.address", peer.to_string().as_str());
        }
        Some(Self { spans: spans.clone(), span, code: None })
    }

    /// Where in a trace the call is.
    pub fn context(&self) -> TraceContext {
        self.span.at
    }

    /// Goes with the answer to its end.
    pub fn follow(mut self, response: Response<Body>) -> Response<Body> {
        if let Some(call) = response.extensions().get::<Call>() {
            self.span.say("lookalike.principal", call.who.name.as_str());
            self.span.say("lookalike.owner", call.who.owner.as_str());
            if let Some(resource) = call.resource() {
                self.span.say("lookalike.resource", resource);
            }
        }
        // Only an answer that is nothing but a status has it here.
        self.code = Status::from_header_map(response.headers()).map(|status| status.code());
        response.map(|body| Body::new(Told { body, span: self }))
    }
}

impl Drop for CallSpan {
    fn drop(&mut self) {
        // Nobody has read the answer to its end.
        let code = self.code.unwrap_or(Code::Cancelled);
        let mut span = self.span.clone();
        span.end = SystemTime::now();
        span.say("rpc.grpc.status_code", code as u32);
        span.error = FAULTS.contains(&code).then(|| code_name(code).into());
        self.spans.send(span);
    }
}

/// An answer with the span of its call.
struct Told {
    body: Body,
    span: CallSpan,
}

impl http_body::Body for Told {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                let status = frame.trailers_ref().and_then(Status::from_header_map);
                self.span.code = status.map(|status| status.code()).or(self.span.code);
            }
            Poll::Ready(Some(Err(status))) => self.span.code = Some(status.code()),
            Poll::Ready(None) | Poll::Pending => {}
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}
