//! A job's log as Server-Sent Events: `id` is the entry's number, `data` its JSON.
//!
//! After the last entry comes an event `end`; where the log breaks off, an event `fault` with the status. A client
//! that connects again with `Last-Event-ID` goes on where it was.

use std::time::Duration;

use futures::{Stream, stream};
use http::{HeaderValue, Response, header, request::Parts};
use http_body::Frame;
use http_body_util::StreamBody;
use prost::bytes::Bytes;
use prost_reflect::{DynamicMessage, MessageDescriptor};
use tonic::{Status, Streaming, body::Body};

use super::{
    Grpc,
    call::on_behalf,
    fault::{Fault, Result, to_json},
    json::Shapes,
};
use crate::service::{
    proto::v1::{
        JobEvent, WatchJobRequest, WatchJobResponse,
        lookalike_service_client::LookalikeServiceClient,
    },
    server::MAX_MESSAGE_BYTES,
};

/// Proxies cut off what is silent for longer, as a rule; and it shows who is gone.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Browsers wait so long before they connect again.
const RETRY: &str = "retry: 1000\n\n";

pub(super) async fn events<S: Grpc>(
    shapes: &Shapes,
    inner: S,
    parts: &Parts,
    mut request: WatchJobRequest,
) -> Result<Response<Body>> {
    // A browser that connects again sends the same query as before.
    if let Some(last) = parts.headers.get("last-event-id") {
        let last = last.to_str().ok().and_then(|last| last.parse().ok());
        let fault = || Fault::invalid("last-event-id", "use the `id` of an event, a whole number");
        request.after_seq = last.ok_or_else(fault)?;
    }
    let shape = shapes.event().ok_or_else(|| Fault::no_route("events"))?;
    let client = LookalikeServiceClient::new(inner);
    let mut client = client.max_decoding_message_size(MAX_MESSAGE_BYTES);
    let log = client.watch_job(on_behalf(parts, request)).await?.into_inner();
    let texts = stream_of(log, shape);
    let frames = futures::StreamExt::map(texts, |text| {
        Ok::<_, std::convert::Infallible>(Frame::data(Bytes::from(text)))
    });
    let mut response = Response::new(Body::new(StreamBody::new(frames)));
    let set = |name, value| (name, HeaderValue::from_static(value));
    response.headers_mut().extend([
        set(header::CONTENT_TYPE, "text/event-stream"),
        set(header::CACHE_CONTROL, "no-store"),
        set(header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // Some proxies gather answers otherwise.
        set(header::HeaderName::from_static("x-accel-buffering"), "no"),
    ]);
    Ok(response)
}

/// One text for each entry, made when it is asked for.
fn stream_of(
    log: Streaming<WatchJobResponse>,
    shape: MessageDescriptor,
) -> impl Stream<Item = String> + Send + 'static {
    let head = stream::once(async { RETRY.to_owned() });
    let rest = stream::unfold(Some(log), move |log| {
        let shape = shape.clone();
        async move {
            let mut log = log?;
            match tokio::time::timeout(KEEP_ALIVE, log.message()).await {
                Err(_) => Some((":\n\n".into(), Some(log))),
                Ok(Ok(Some(message))) => {
                    let text = entry(shape, &message.event.unwrap_or_default());
                    Some(match text {
                        Ok(text) => (text, Some(log)),
                        Err(status) => (fault(&status), None),
                    })
                }
                Ok(Ok(None)) => Some(("event: end\ndata: {}\n\n".into(), None)),
                Ok(Err(status)) => Some((fault(&status), None)),
            }
        }
    });
    futures::StreamExt::chain(head, rest)
}

fn entry(shape: MessageDescriptor, event: &JobEvent) -> std::result::Result<String, Status> {
    let internal = |text: String| Status::internal(text);
    let mut message = DynamicMessage::new(shape);
    message.transcode_from(event).map_err(|error| internal(error.to_string()))?;
    let text = serde_json::to_string(&message).map_err(|error| internal(error.to_string()))?;
    Ok(format!("id: {}\ndata: {text}\n\n", event.seq))
}

fn fault(status: &Status) -> String {
    format!("event: fault\ndata: {}\n\n", to_json(status))
}
