//! Artifacts as files: ranges, and tags by which caches know what they have.

use futures::TryStreamExt;
use http::{HeaderMap, HeaderValue, Method, Response, StatusCode, header, request::Parts};
use http_body::Frame;
use http_body_util::StreamBody;
use tonic::{Streaming, body::Body};

use super::{
    Grpc,
    call::on_behalf,
    fault::{Fault, Result},
    range::{Wanted, wanted},
};
use crate::service::{
    proto::v1::{
        Artifact, ReadArtifactRequest, ReadArtifactResponse,
        lookalike_service_client::LookalikeServiceClient,
    },
    server::MAX_MESSAGE_BYTES,
};

pub(super) async fn bytes<S: Grpc>(
    inner: S,
    parts: &Parts,
    request: ReadArtifactRequest,
) -> Result<Response<Body>> {
    let headers = &parts.headers;
    let conditions = [header::RANGE, header::IF_NONE_MATCH];
    let is_head = parts.method == Method::HEAD;
    if !is_head && !conditions.iter().any(|name| headers.contains_key(name)) {
        let limit = request.limit;
        let (artifact, bytes) = read(inner, parts, request.clone()).await?;
        let rest = artifact.size.saturating_sub(request.offset);
        let len = if limit == 0 { rest } else { rest.min(limit) };
        return Ok(with_bytes(StatusCode::OK, &artifact, len, bytes));
    }
    // What the file is, before what is wanted of it.
    let look = ReadArtifactRequest { offset: 0, limit: 1, ..request.clone() };
    let (artifact, _) = read(inner.clone(), parts, look).await?;
    if names(headers, header::IF_NONE_MATCH, &artifact) == Some(true) {
        return Ok(without_bytes(StatusCode::NOT_MODIFIED, &artifact));
    }
    if is_head {
        let mut response = without_bytes(StatusCode::OK, &artifact);
        response.headers_mut().insert(header::CONTENT_LENGTH, artifact.size.into());
        return Ok(response);
    }
    // A part of another version than the one that the client has would be of no use.
    let is_same = names(headers, header::IF_RANGE, &artifact) != Some(false);
    let range = headers.get(header::RANGE).filter(|_| is_same);
    let range = range.and_then(|range| range.to_str().ok()).unwrap_or_default();
    let (status, offset, limit) = match wanted(range, artifact.size) {
        Wanted::Whole => (StatusCode::OK, 0, 0),
        Wanted::Part(offset, limit) => (StatusCode::PARTIAL_CONTENT, offset, limit),
        Wanted::Nothing => return Err(Fault::past_the_end(artifact.size)),
    };
    let (artifact, bytes) =
        read(inner, parts, ReadArtifactRequest { offset, limit, ..request }).await?;
    let len = if limit == 0 { artifact.size } else { limit };
    let mut response = with_bytes(status, &artifact, len, bytes);
    if status == StatusCode::PARTIAL_CONTENT {
        let range = format!("bytes {offset}-{}/{}", offset + len - 1, artifact.size);
        response.headers_mut().extend(value(&range).map(|range| (header::CONTENT_RANGE, range)));
    }
    Ok(response)
}

async fn read<S: Grpc>(
    inner: S,
    parts: &Parts,
    request: ReadArtifactRequest,
) -> Result<(Artifact, Streaming<ReadArtifactResponse>)> {
    let client = LookalikeServiceClient::new(inner);
    let mut client = client.max_decoding_message_size(MAX_MESSAGE_BYTES);
    let mut messages = client.read_artifact(on_behalf(parts, request)).await?.into_inner();
    let first = messages.message().await?.and_then(|message| message.artifact);
    Ok((first.unwrap_or_default(), messages))
}

/// Whether a header names the version that there is; `None` where it is absent.
fn names(headers: &HeaderMap, name: header::HeaderName, artifact: &Artifact) -> Option<bool> {
    let tag = tag(artifact);
    let list = headers.get(name)?.to_str().unwrap_or_default();
    Some(list.split(',').map(str::trim).any(|named| named == tag || named == "*"))
}

fn tag(artifact: &Artifact) -> String {
    format!("\"{}\"", artifact.blake3)
}

fn with_bytes(
    status: StatusCode,
    artifact: &Artifact,
    len: u64,
    bytes: Streaming<ReadArtifactResponse>,
) -> Response<Body> {
    let mut response = without_bytes(status, artifact);
    response.headers_mut().insert(header::CONTENT_LENGTH, len.into());
    *response.body_mut() = Body::new(StreamBody::new(bytes.map_ok(|part| Frame::data(part.data))));
    response
}

fn without_bytes(status: StatusCode, artifact: &Artifact) -> Response<Body> {
    let mut response = Response::new(Body::empty());
    *response.status_mut() = status;
    let kind = value(&artifact.media_type).filter(|kind| !kind.is_empty());
    let unknown = HeaderValue::from_static("application/octet-stream");
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, kind.unwrap_or(unknown));
    headers.extend(value(&tag(artifact)).map(|tag| (header::ETAG, tag)));
    let set = |name, value| (name, HeaderValue::from_static(value));
    headers.extend([
        set(header::ACCEPT_RANGES, "bytes"),
        // It is somebody's: caches that are shared do not keep it, others ask whether it is still there.
        set(header::CACHE_CONTROL, "private, no-cache"),
        // Drawings made from somebody's model run no scripts in this origin.
        set(header::CONTENT_SECURITY_POLICY, "sandbox; default-src 'none'"),
        set(header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    ]);
    response
}

fn value(text: &str) -> Option<HeaderValue> {
    HeaderValue::from_str(text).ok()
}
