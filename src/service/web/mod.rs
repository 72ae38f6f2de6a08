//! HTTP/JSON and Server-Sent Events on the gRPC port: each route is a method of the public API.
//!
//! 1. A request becomes a call of the gRPC services behind the gate: who may do what, and what is counted and
//!    written about it, is decided there, before the body is read. Nothing is decided here.
//! 2. Routes are rows of `routes.rs`. JSON is the protos' own (proto-JSON), read off their descriptors.
//! 3. Answers are made as fast as they are read, a message at a time.
//! 4. A page of another origin cannot change anything: what changes something needs a content type that browsers
//!    ask leave for (`origins.rs`).

mod call;
mod fault;
mod file;
mod json;
mod origins;
mod range;
mod routes;
mod sse;
mod upload;

use std::{
    convert::Infallible,
    sync::Arc,
    task::{Context, Poll},
};

use futures::future::BoxFuture;
use http::{Request, Response, header, request::Parts};
use http_body_util::Full;
use prost::bytes::Bytes;
use tonic::{Code, body::Body};
use tower::{Layer, Service};

use self::{
    fault::{Fault, Result},
    routes::Answer,
};

pub(super) use self::json::Shapes;
use super::call_name;

pub use self::origins::Origin;
pub(super) use self::origins::{Hosts, cross_origin};

/// Where the routes begin.
const ROOT: &str = "/api/v1/";

/// What is behind the routes: the gRPC services, and the gate before them.
pub(super) trait Grpc:
    Service<
        Request<Body>,
        Response = Response<Body>,
        Error = Infallible,
        Future: Future<Output = std::result::Result<Response<Body>, Infallible>> + Send,
    > + Clone
    + Send
    + Sync
    + 'static
{
}

impl<S> Grpc for S where
    S: Service<
            Request<Body>,
            Response = Response<Body>,
            Error = Infallible,
            Future: Future<Output = std::result::Result<Response<Body>, Infallible>> + Send,
        > + Clone
        + Send
        + Sync
        + 'static
{
}

/// Puts the routes in front of gRPC services.
#[derive(Clone, Debug)]
pub(super) struct WebLayer {
    shapes: Arc<Shapes>,
    hosts: Arc<Hosts>,
}

impl WebLayer {
    /// Reads the shapes of messages off the descriptors.
    pub fn new(hosts: Hosts) -> std::result::Result<Self, prost_reflect::DescriptorError> {
        Ok(Self { shapes: Arc::new(Shapes::read()?), hosts: Arc::new(hosts) })
    }
}

impl<S> Layer<S> for WebLayer {
    type Service = Web<S>;

    fn layer(&self, inner: S) -> Web<S> {
        Web { web: self.clone(), inner }
    }
}

/// Services that also answer to the routes.
#[derive(Clone, Debug)]
pub(super) struct Web<S> {
    web: WebLayer,
    inner: S,
}

impl<S: Grpc> Service<Request<Body>> for Web<S> {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<'static, std::result::Result<Response<Body>, Infallible>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<std::result::Result<(), Infallible>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let inner = self.inner.clone();
        let mut inner = std::mem::replace(&mut self.inner, inner);
        let web = self.web.clone();
        let is_route = request.uri().path().starts_with(ROOT);
        Box::pin(async move {
            if !is_route && !is_from_browser(&request) {
                return inner.call(request).await;
            }
            if let Err(fault) = web.hosts.check(&request) {
                return Ok(fault.response());
            }
            // gRPC, on the web or not, asks otherwise.
            if !is_route && request.method() == http::Method::GET {
                return Ok(greeting(request.uri().path()));
            }
            if !is_route {
                return inner.call(request).await;
            }
            let (mut parts, body) = request.into_parts();
            let name = call_name::ensure(&mut parts.headers);
            let answer = answer(&web.shapes, inner, parts, body).await;
            let mut answer = answer.unwrap_or_else(|fault| fault.response());
            answer.headers_mut().insert(call_name::HEADER, name);
            Ok(answer)
        })
    }
}

/// For whoever opens the server's address in a browser.
fn greeting(path: &str) -> Response<Body> {
    if path != "/" {
        return Fault::no_route(path).response();
    }
    let text = format!(
        "Lookalike {}: levels of detail that look alike.\n\nThis port speaks gRPC, gRPC-Web and HTTP with JSON: \
         {ROOT}jobs lists jobs. Metrics have a port of their own. README.md describes all of it.\n",
        env!("CARGO_PKG_VERSION")
    );
    let mut response = Response::new(Body::new(Full::new(Bytes::from(text))));
    let plain = http::HeaderValue::from_static("text/plain; charset=utf-8");
    response.headers_mut().insert(header::CONTENT_TYPE, plain);
    response
}

/// Pages speak gRPC-Web, or nothing that is gRPC.
fn is_from_browser(request: &Request<Body>) -> bool {
    let kind = request.headers().get(header::CONTENT_TYPE).map_or(&b""[..], |kind| kind.as_bytes());
    !kind.starts_with(b"application/grpc") || kind.starts_with(b"application/grpc-web")
}

async fn answer<S: Grpc>(
    shapes: &Shapes,
    inner: S,
    parts: Parts,
    body: Body,
) -> Result<Response<Body>> {
    let found = routes::find(&parts.method, parts.uri.path())?;
    origins::check_content_type(&found, &parts.headers)?;
    let method = shapes.method(found.method).ok_or_else(|| Fault::no_route(parts.uri.path()))?;
    let fixed = [found.field].into_iter().filter(|f| !f.is_empty()).map(|f| (f, found.resource));
    let fixed = fixed.map(|(field, value)| (field.to_owned(), value.to_owned())).collect();
    match found.answer {
        Answer::Message => {
            let shape = (method.input(), fixed);
            let message = json::request(shape, &parts, body);
            let answer = call::one(inner, &parts, &method, message).await?;
            Ok(with_json(http::StatusCode::OK, &answer))
        }
        Answer::Events => {
            let query = json::from_query(method.input(), parts.uri.query(), fixed)?;
            sse::events(shapes, inner, &parts, json::typed(&query)?).await
        }
        Answer::File => {
            let query = json::from_query(method.input(), parts.uri.query(), fixed)?;
            file::bytes(inner, &parts, json::typed(&query)?).await
        }
        Answer::Upload => {
            let shape = shapes.upload_header().ok_or_else(|| Fault::no_route(ROOT))?;
            let header = json::from_query(shape, parts.uri.query(), fixed)?;
            let stored = upload::mesh(inner, &parts, json::typed(&header)?, body).await?;
            let mut answer = prost_reflect::DynamicMessage::new(method.output());
            answer.transcode_from(&stored).map_err(json::unreadable)?;
            Ok(with_json(http::StatusCode::OK, &answer))
        }
    }
}

/// An answer of one JSON text.
fn with_json(status: http::StatusCode, value: &impl serde::Serialize) -> Response<Body> {
    let text = match serde_json::to_vec(value) {
        Ok(text) => text,
        Err(error) => return Fault::new(Code::Internal, "JSON", &error.to_string()).response(),
    };
    let mut response = Response::new(Body::new(Full::new(Bytes::from(text))));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    let set = |name, value| (name, http::HeaderValue::from_static(value));
    headers.extend([
        set(header::CONTENT_TYPE, "application/json"),
        set(header::CACHE_CONTROL, "no-store"),
        set(header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    ]);
    response
}
