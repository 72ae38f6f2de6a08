//! The connection to the server: every call of the worker API, repeated until it is answered.

use std::{path::Path, time::Duration};

use futures::stream;
use prost::bytes::Bytes;
use tokio::{
    io::AsyncReadExt,
    time::{Instant, timeout},
};
use tonic::{Response, Status};

use super::build::build;
use crate::{
    jobs::{
        lease::{Lease, Orders},
        store::{Appended, Artifact, Outcome},
    },
    service::{
        client::{Access, Backoff, BadTarget, Connection, connection, is_transient},
        convert,
        proto::worker::v1::{self as wire, worker_service_client::WorkerServiceClient},
        server::MAX_MESSAGE_BYTES,
        status::{STALE_LEASE, reason_of},
    },
};

/// A call that takes longer is repeated.
const CALL: Duration = Duration::from_secs(30);
/// The same for a call that moves a whole file.
const TRANSFER: Duration = Duration::from_hours(1);
/// How long a claim waits for a job.
const CLAIM_WAIT_SECS: f64 = 20.0;
/// Bytes of a chunk sent.
const CHUNK: usize = 256 << 10;

/// The connection to the server.
#[derive(Clone, Debug)]
pub struct Link {
    client: WorkerServiceClient<Connection>,
    give_up: Duration,
}

/// A call has no result, and will have none.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The job is no longer this worker's.
    #[error("{0}")]
    Stale(String),
    /// The server refused the call.
    #[error("the server refused: {}", .0.message())]
    Refused(Box<Status>),
    /// No answer for too long.
    #[error("no answer from the server for {} s: {last}", .secs)]
    Unreachable {
        /// Seconds waited.
        secs: u64,
        /// What the last attempt met.
        last: String,
    },
    /// What came is not what its name says.
    #[error(
        "{0} is damaged in the server's store: upload the model again, and submit the job anew"
    )]
    Damaged(String),
    /// A file of the result cannot be read.
    #[error("{path}: {source}")]
    File {
        /// Which.
        path: String,
        /// Why.
        source: std::io::Error,
    },
}

impl Link {
    /// Connects at the first call; gives a call up when there was no answer for `give_up`.
    pub fn new(url: &str, access: &Access, give_up: Duration) -> Result<Self, BadTarget> {
        let client = WorkerServiceClient::new(connection(url, access)?);
        Ok(Self { client: client.max_decoding_message_size(MAX_MESSAGE_BYTES), give_up })
    }

    /// Asks once for a job, waiting a while for one to come.
    pub async fn claim(
        &self,
        worker: &str,
        host: &str,
    ) -> Result<Option<wire::Assignment>, Status> {
        let request = wire::ClaimRequest {
            worker: worker.into(),
            version: env!("CARGO_PKG_VERSION").into(),
            wait_secs: CLAIM_WAIT_SECS,
            host: host.into(),
            build: build().into(),
        };
        let late = |_| Status::deadline_exceeded("the claim was not answered");
        let answer = timeout(CALL, self.client.clone().claim(request)).await.map_err(late)??;
        Ok(answer.into_inner().assignment)
    }

    /// Extends the lease; what the attempt should do.
    pub async fn heartbeat(&self, lease: &Lease) -> Result<Orders, LinkError> {
        let request = wire::HeartbeatRequest { lease: Some(convert::lease_to_wire(lease)) };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move { client.heartbeat(request).await }
        };
        let answer = self.answered(CALL, call).await?;
        Ok(Orders {
            cancel: answer.cancel_requested,
            drain: answer.drain_requested,
            preempt: answer.preempt_requested,
        })
    }

    /// The bytes of an input, the mesh of that hash.
    pub async fn fetch_mesh(&self, lease: &Lease, hash: &str) -> Result<Vec<u8>, LinkError> {
        let mesh = convert::mesh_name(hash);
        let lease = Some(convert::lease_to_wire(lease));
        let request = wire::FetchMeshRequest { lease, mesh: mesh.clone() };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move {
                let mut chunks = client.fetch_mesh(request).await?.into_inner();
                let mut bytes = Vec::new();
                while let Some(chunk) = chunks.message().await? {
                    bytes.extend_from_slice(&chunk.data);
                }
                Ok(Response::new(bytes))
            }
        };
        let bytes = self.answered(TRANSFER, call).await?;
        if blake3::hash(&bytes).to_hex().as_str() != hash {
            return Err(LinkError::Damaged(mesh));
        }
        Ok(bytes)
    }

    /// Sends a batch of events, the first of which is the attempt's number `first`.
    pub async fn append(
        &self,
        lease: &Lease,
        first: u64,
        events: Vec<wire::WorkerEvent>,
    ) -> Result<Appended, LinkError> {
        let lease = Some(convert::lease_to_wire(lease));
        let request = wire::AppendEventsRequest { lease, first_index: first, events };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move { client.append_events(request).await }
        };
        let answer = self.answered(CALL, call).await?;
        let (cancel, preempt) = (answer.cancel_requested, answer.preempt_requested);
        Ok(Appended { held: answer.appended, orders: Orders { cancel, preempt, drain: false } })
    }

    /// Sends a file of the result.
    pub async fn put_artifact(
        &self,
        lease: &Lease,
        artifact: &Artifact,
        path: &Path,
    ) -> Result<(), LinkError> {
        let header = wire::PutArtifactHeader {
            lease: Some(convert::lease_to_wire(lease)),
            file: artifact.file.clone(),
            media_type: artifact.media_type.clone(),
            size: artifact.size,
            blake3: artifact.blake3.clone(),
        };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let header = header.clone();
            async move {
                let file = tokio::fs::File::open(path).await.map_err(|e| unreadable(path, &e))?;
                client.put_artifact(artifact_parts(header, file)).await
            }
        };
        self.answered(TRANSFER, call).await?;
        Ok(())
    }

    /// Sends piece number `n` of the checkpoint.
    pub async fn put_piece(&self, lease: &Lease, n: u32, piece: &Bytes) -> Result<(), LinkError> {
        use wire::put_checkpoint_request::Part;
        let header = wire::PutCheckpointHeader {
            lease: Some(convert::lease_to_wire(lease)),
            piece: n,
            size: piece.len() as u64,
            blake3: blake3::hash(piece).to_hex().to_string(),
            build: build().into(),
        };
        let chunk = |at: usize| piece.slice(at..piece.len().min(at + CHUNK));
        let chunks = (0..piece.len()).step_by(CHUNK).map(|at| Part::Chunk(chunk(at)));
        let parts: Vec<_> = std::iter::once(Part::Header(header)).chain(chunks).collect();
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = |part| wire::PutCheckpointRequest { part: Some(part) };
            let parts = stream::iter(parts.clone().into_iter().map(request));
            async move { client.put_checkpoint(parts).await }
        };
        self.answered(TRANSFER, call).await?;
        Ok(())
    }

    /// The pieces of the checkpoint that the attempt goes on from.
    pub async fn fetch_checkpoint(&self, lease: &Lease) -> Result<Vec<Vec<u8>>, LinkError> {
        let request = wire::FetchCheckpointRequest { lease: Some(convert::lease_to_wire(lease)) };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move {
                let mut chunks = client.fetch_checkpoint(request).await?.into_inner();
                let mut pieces: Vec<Vec<u8>> = Vec::new();
                while let Some(chunk) = chunks.message().await? {
                    if chunk.piece as usize >= pieces.len() {
                        pieces.push(Vec::new());
                    }
                    pieces
                        .iter_mut()
                        .last()
                        .iter_mut()
                        .for_each(|p| p.extend_from_slice(&chunk.data));
                }
                Ok(Response::new(pieces))
            }
        };
        self.answered(TRANSFER, call).await
    }

    /// Ends the attempt.
    pub async fn complete(&self, lease: &Lease, outcome: Outcome) -> Result<(), LinkError> {
        let request = wire::CompleteRequest {
            lease: Some(convert::lease_to_wire(lease)),
            outcome: Some(convert::outcome_to_wire(outcome)),
        };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move { client.complete(request).await }
        };
        self.answered(CALL, call).await?;
        Ok(())
    }

    /// Tells the server that this worker ends.
    pub async fn leave(&self, worker: &str) -> Result<(), LinkError> {
        let request = wire::LeaveRequest { worker: worker.into() };
        let call = |mut client: WorkerServiceClient<Connection>| {
            let request = request.clone();
            async move { client.leave(request).await }
        };
        self.answered(CALL, call).await?;
        Ok(())
    }

    /// Repeats `call` until the server answers it.
    async fn answered<T, F>(
        &self,
        limit: Duration,
        call: impl Fn(WorkerServiceClient<Connection>) -> F,
    ) -> Result<T, LinkError>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let mut backoff = Backoff::default();
        let mut since = None;
        loop {
            let status = match timeout(limit, call(self.client.clone())).await {
                Ok(Ok(answer)) => return Ok(answer.into_inner()),
                Ok(Err(status)) => status,
                Err(_) => Status::deadline_exceeded("the call was not answered"),
            };
            if !is_transient(&status) {
                return Err(refusal(status));
            }
            // The minute begins when the first failure is noticed, not when the call began.
            let since = *since.get_or_insert_with(Instant::now);
            if since.elapsed() > self.give_up {
                let (secs, last) = (since.elapsed().as_secs(), status.message().into());
                return Err(LinkError::Unreachable { secs, last });
            }
            tracing::debug!(status = status.message(), "no answer, trying again");
            backoff.pause().await;
        }
    }
}

fn refusal(status: Status) -> LinkError {
    match reason_of(&status).as_deref() {
        Some(STALE_LEASE) => LinkError::Stale(status.message().into()),
        _ => LinkError::Refused(Box::new(status)),
    }
}

fn unreadable(path: &Path, error: &std::io::Error) -> Status {
    Status::failed_precondition(format!("{}: {error}", path.display()))
}

/// The header, then the file in chunks. A file that cannot be read on ends the stream early, and the
/// server sees that it is not what was announced.
fn artifact_parts(
    header: wire::PutArtifactHeader,
    file: tokio::fs::File,
) -> impl stream::Stream<Item = wire::PutArtifactRequest> {
    use wire::put_artifact_request::Part;
    stream::unfold((Some(header), file), |(header, mut file)| async move {
        let part = if let Some(header) = header {
            Part::Header(header)
        } else {
            let mut chunk = prost::bytes::BytesMut::with_capacity(CHUNK);
            match file.read_buf(&mut chunk).await {
                Ok(1..) => Part::Chunk(chunk.freeze()),
                _ => return None,
            }
        };
        Some((wire::PutArtifactRequest { part: Some(part) }, (None, file)))
    })
}
