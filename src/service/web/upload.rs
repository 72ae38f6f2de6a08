//! A mesh as the body of a request. A body that breaks off stores nothing.

use futures::{StreamExt, stream};
use http::request::Parts;
use http_body_util::BodyExt;
use prost::bytes::Bytes;
use tokio::sync::mpsc;
use tonic::body::Body;

use super::{
    Grpc,
    call::on_behalf,
    fault::{Fault, Result},
};
use crate::service::proto::v1::{
    UploadMeshHeader, UploadMeshRequest, UploadMeshResponse,
    lookalike_service_client::LookalikeServiceClient, upload_mesh_request::Part,
};

/// Bytes of a chunk.
const CHUNK: usize = 1 << 20;

pub(super) async fn mesh<S: Grpc>(
    inner: S,
    parts: &Parts,
    header: UploadMeshHeader,
    body: Body,
) -> Result<UploadMeshResponse> {
    let (broken, mut breaks) = mpsc::channel(1);
    let message = |part| UploadMeshRequest { part: Some(part) };
    let chunks = stream::unfold((body, Bytes::new(), broken), next);
    let messages = stream::iter([Part::Header(header)]).chain(chunks.map(Part::Chunk)).map(message);
    let mut client = LookalikeServiceClient::new(inner);
    tokio::select! {
        biased;
        // The call is dropped, and with it what it has received.
        Some(fault) = breaks.recv() => Err(fault),
        stored = client.upload_mesh(on_behalf(parts, messages)) => Ok(stored?.into_inner()),
    }
}

type Rest = (Body, Bytes, mpsc::Sender<Fault>);

async fn next((mut body, mut held, broken): Rest) -> Option<(Bytes, Rest)> {
    while held.is_empty() {
        match body.frame().await? {
            Ok(frame) => held = frame.into_data().unwrap_or_default(),
            Err(error) => {
                let fault =
                    Fault::invalid("body", format!("it broke off ({error}): send it again"));
                let _ = broken.send(fault).await;
                // An end would look like the end of the mesh.
                std::future::pending::<()>().await;
            }
        }
    }
    let chunk = held.split_to(held.len().min(CHUNK));
    Some((chunk, (body, held, broken)))
}
