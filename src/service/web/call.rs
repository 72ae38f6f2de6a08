//! Calls of the gRPC services in this process: as a client makes them, on behalf of whoever sent the request.

use std::sync::{Arc, Mutex, PoisonError};

use futures::{Stream, StreamExt};
use http::{request::Parts, uri::PathAndQuery};
use prost::Message;
use prost_reflect::{DynamicMessage, MessageDescriptor, MethodDescriptor};
use tonic::{
    Request, Status,
    client::Grpc as Client,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
};

use super::{
    Grpc,
    fault::{Fault, Result},
};
use crate::{
    service::{accept::Peer, call_name, server::MAX_MESSAGE_BYTES},
    telemetry::trace::TRACEPARENT,
};

/// A call that says who makes it as the request did: by its connection and its token.
pub(super) fn on_behalf<T>(parts: &Parts, message: T) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(peer) = parts.extensions.get::<Peer>() {
        request.extensions_mut().insert(peer.clone());
    }
    for name in ["authorization", TRACEPARENT, call_name::HEADER] {
        // What is no text is no token either: the gate says so.
        let value = parts.headers.get(name).map(|value| value.to_str().unwrap_or("?").parse());
        if let Some(Ok(value)) = value {
            request.metadata_mut().insert(name, value);
        }
    }
    request
}

/// Calls a method that has one answer. A fault of the message is the answer when the gate has let the call in.
pub(super) async fn one<S: Grpc>(
    inner: S,
    parts: &Parts,
    method: &MethodDescriptor,
    message: impl Stream<Item = Result<DynamicMessage>> + Send + 'static,
) -> Result<DynamicMessage> {
    let fault = Arc::new(Mutex::new(None));
    let noted = Arc::clone(&fault);
    let messages = message.filter_map(move |message| {
        let note =
            |fault: Fault| *noted.lock().unwrap_or_else(PoisonError::into_inner) = Some(fault);
        let message = message.map_err(note).ok();
        async move { message }
    });
    let path = format!("/{}/{}", method.parent_service().full_name(), method.name());
    let path: PathAndQuery = path.parse().map_err(|_| Fault::no_route(&path))?;
    let mut client = Client::new(inner).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let Ok(()) = client.ready().await;
    let request = on_behalf(parts, messages);
    let answer = client.client_streaming(request, path, Dynamic(method.output())).await;
    let fault = fault.lock().unwrap_or_else(PoisonError::into_inner).take();
    match fault {
        Some(fault) => Err(fault),
        None => Ok(answer?.into_inner()),
    }
}

/// Messages of whatever shape in; messages of one shape out.
struct Dynamic(MessageDescriptor);

impl Codec for Dynamic {
    type Encode = DynamicMessage;
    type Decode = DynamicMessage;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self(self.0.clone())
    }

    fn decoder(&mut self) -> Self {
        Self(self.0.clone())
    }
}

impl Encoder for Dynamic {
    type Item = DynamicMessage;
    type Error = Status;

    fn encode(
        &mut self,
        item: DynamicMessage,
        buf: &mut EncodeBuf<'_>,
    ) -> std::result::Result<(), Status> {
        item.encode(buf).map_err(|error| Status::internal(error.to_string()))
    }
}

impl Decoder for Dynamic {
    type Item = DynamicMessage;
    type Error = Status;

    fn decode(
        &mut self,
        buf: &mut DecodeBuf<'_>,
    ) -> std::result::Result<Option<DynamicMessage>, Status> {
        let message = DynamicMessage::decode(self.0.clone(), buf);
        message.map(Some).map_err(|error| Status::internal(error.to_string()))
    }
}
