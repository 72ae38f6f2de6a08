//! The worker API: `lookalike.worker.v1.WorkerService`.

use std::{pin::Pin, sync::Arc, time::Duration};

use futures::{Stream, TryStreamExt, stream};
use prost::bytes::Bytes;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use super::{
    api::until,
    auth::call_of,
    convert,
    observe::{self, Counted, Observer},
    proto::worker::v1 as worker,
    status::{self, status_of},
    transfer,
};
use crate::jobs::{
    Jobs,
    clients::Announced,
    error::Error,
    lease::{Claimant, Lease},
    store::{Artifact, Job},
};

/// Longest wait of a claim.
const MAX_WAIT: Duration = Duration::from_mins(1);

/// Serves workers.
#[derive(Clone, Debug)]
pub(super) struct WorkerApi {
    /// The data directory.
    pub jobs: Jobs,
    /// Ends waiting claims and open streams.
    pub shutdown: CancellationToken,
    /// Learns what workers report.
    pub observer: Arc<Observer>,
}

#[tonic::async_trait]
impl worker::worker_service_server::WorkerService for WorkerApi {
    async fn claim(
        &self,
        request: Request<worker::ClaimRequest>,
    ) -> Result<Response<worker::ClaimResponse>, Status> {
        let request = request.into_inner();
        check_worker(&request)?;
        let wait = Duration::try_from_secs_f64(request.wait_secs).unwrap_or_default().min(MAX_WAIT);
        let claim = self.jobs.claim(claimant(&request), wait);
        let claimed = tokio::select! {
            claimed = claim => claimed,
            () = self.shutdown.cancelled() => return Err(status::shutting_down()),
        };
        let claimed = claimed.map_err(|error| {
            self.observer.refused(&error);
            status_of(&error)
        })?;
        let Some(job) = claimed else { return Ok(Response::new(worker::ClaimResponse::default())) };
        let lease = Lease { job: job.id.clone(), epoch: job.epoch, worker: job.worker.clone() };
        let pieces = self.jobs.resume(&lease, &request.build).await.map_err(|e| status_of(&e))?;
        let (attempt, epoch, n_pieces) = (job.attempt, job.epoch, pieces.len() as u32);
        tracing::info!(job = job.id, worker = request.worker, attempt, epoch, n_pieces, "claimed");
        self.observer.claimed(&lease, n_pieces > 0);
        let assignment = Some(self.assignment(&job, n_pieces));
        Ok(Response::new(worker::ClaimResponse { assignment }))
    }

    async fn heartbeat(
        &self,
        request: Request<worker::HeartbeatRequest>,
    ) -> Result<Response<worker::HeartbeatResponse>, Status> {
        let lease = convert::lease_from_wire(request.into_inner().lease)?;
        let orders = self.jobs.heartbeat(&lease).await.map_err(|e| status_of(&e))?;
        Ok(Response::new(worker::HeartbeatResponse {
            cancel_requested: orders.cancel,
            drain_requested: orders.drain,
            preempt_requested: orders.preempt,
        }))
    }

    type FetchMeshStream =
        Pin<Box<dyn Stream<Item = Result<worker::FetchMeshResponse, Status>> + Send>>;

    async fn fetch_mesh(
        &self,
        request: Request<worker::FetchMeshRequest>,
    ) -> Result<Response<Self::FetchMeshStream>, Status> {
        let request = request.into_inner();
        let lease = convert::lease_from_wire(request.lease)?;
        let hash = convert::mesh_hash(&request.mesh);
        let mesh = self.jobs.input(&lease, &hash).await.map_err(|e| status_of(&e))?;
        let bytes = mesh.read(0, u64::MAX).await.map_err(|e| status_of(&e))?;
        let answers = observe::sent("mesh", bytes);
        let answers = answers.map_ok(|data| worker::FetchMeshResponse { data });
        let answers = answers.map_err(|e| status_of(&e));
        Ok(Response::new(until(answers, self.shutdown.clone())))
    }

    async fn append_events(
        &self,
        request: Request<worker::AppendEventsRequest>,
    ) -> Result<Response<worker::AppendEventsResponse>, Status> {
        let request = request.into_inner();
        let lease = convert::lease_from_wire(request.lease)?;
        let bodies: Option<Vec<_>> = request.events.into_iter().map(|event| event.body).collect();
        let bodies = bodies.ok_or_else(|| status::invalid("events", "one has no body"))?;
        let reports: Vec<_> = bodies.into_iter().map(convert::report_from_wire).collect();
        let counted: Vec<_> = reports.iter().map(Counted::of).collect();
        let appended = self.jobs.append(&lease, request.first_index, reports).await;
        let appended = appended.map_err(|e| status_of(&e))?;
        self.observer.reported(&lease, request.first_index, &counted);
        Ok(Response::new(worker::AppendEventsResponse {
            appended: appended.held,
            cancel_requested: appended.orders.cancel,
            preempt_requested: appended.orders.preempt,
        }))
    }

    async fn put_artifact(
        &self,
        request: Request<Streaming<worker::PutArtifactRequest>>,
    ) -> Result<Response<worker::PutArtifactResponse>, Status> {
        let call = call_of(&request)?;
        let mut parts = request.into_inner();
        let first = parts.message().await?.and_then(|message| message.part);
        let Some(worker::put_artifact_request::Part::Header(header)) = first else {
            return Err(status::invalid("part", "the first message must be the header"));
        };
        let lease = convert::lease_from_wire(header.lease)?;
        let artifact = Artifact {
            file: header.file,
            media_type: header.media_type,
            size: header.size,
            blake3: header.blake3,
        };
        let (job, file) = (lease.job.clone(), artifact.file.clone());
        call.is_about(format!("jobs/{job}/artifacts/{file}"));
        transfer::receive("artifact", parts, (artifact_chunk, |_| None), |chunks| {
            self.jobs.put_artifact(&lease, artifact, chunks)
        })
        .await?;
        tracing::info!(job, file, "artifact stored");
        Ok(Response::new(worker::PutArtifactResponse {}))
    }

    async fn put_checkpoint(
        &self,
        request: Request<Streaming<worker::PutCheckpointRequest>>,
    ) -> Result<Response<worker::PutCheckpointResponse>, Status> {
        let mut parts = request.into_inner();
        let first = parts.message().await?.and_then(|message| message.part);
        let Some(worker::put_checkpoint_request::Part::Header(header)) = first else {
            return Err(status::invalid("part", "the first message must be the header"));
        };
        check_build(&header.build)?;
        let lease = convert::lease_from_wire(header.lease)?;
        let announced =
            Announced { size: header.size, hash: header.blake3, ..Announced::default() };
        transfer::receive("checkpoint", parts, (piece_chunk, |_| None), |chunks| {
            self.jobs.put_piece(&lease, (header.piece, &header.build), &announced, chunks)
        })
        .await?;
        tracing::debug!(job = lease.job, piece = header.piece, "checkpoint stored");
        Ok(Response::new(worker::PutCheckpointResponse {}))
    }

    type FetchCheckpointStream =
        Pin<Box<dyn Stream<Item = Result<worker::FetchCheckpointResponse, Status>> + Send>>;

    async fn fetch_checkpoint(
        &self,
        request: Request<worker::FetchCheckpointRequest>,
    ) -> Result<Response<Self::FetchCheckpointStream>, Status> {
        let lease = convert::lease_from_wire(request.into_inner().lease)?;
        let pieces = self.jobs.checkpoint(&lease).await.map_err(|e| status_of(&e))?;
        let pieces = stream::iter((0..).zip(pieces).map(Ok::<_, Error>));
        let bytes = pieces.and_then(|(piece, blob)| async move {
            let bytes = observe::sent("checkpoint", blob.read(0, u64::MAX).await?);
            Ok(bytes.map_ok(move |data| worker::FetchCheckpointResponse { piece, data }))
        });
        let answers = bytes.try_flatten().map_err(|e| status_of(&e));
        Ok(Response::new(until(answers, self.shutdown.clone())))
    }

    async fn complete(
        &self,
        request: Request<worker::CompleteRequest>,
    ) -> Result<Response<worker::CompleteResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let lease = convert::lease_from_wire(request.lease)?;
        call.is_about(format!("jobs/{}", lease.job));
        let outcome = convert::outcome_from_wire(request.outcome)?;
        let ended = self.jobs.complete(&lease, &outcome).await;
        let (job, is_new) = ended.map_err(|e| status_of(&e))?;
        if is_new {
            tracing::info!(job = job.id, state = %job.state, ?outcome, "attempt ended");
            self.observer.ended(&job);
        }
        Ok(Response::new(worker::CompleteResponse {}))
    }

    async fn leave(
        &self,
        request: Request<worker::LeaveRequest>,
    ) -> Result<Response<worker::LeaveResponse>, Status> {
        let request = request.into_inner();
        let handed_back = self.jobs.leave(&request.worker).await.map_err(|e| status_of(&e))?;
        tracing::info!(worker = request.worker, n_jobs = handed_back.len(), "worker left");
        handed_back.iter().for_each(|job| self.observer.ended(job));
        Ok(Response::new(worker::LeaveResponse {}))
    }
}

impl WorkerApi {
    fn assignment(&self, job: &Job, checkpoint_pieces: u32) -> worker::Assignment {
        let lease = worker::Lease { job: job.name(), epoch: job.epoch, worker: job.worker.clone() };
        worker::Assignment {
            lease: Some(lease),
            mesh: convert::mesh_name(&job.mesh),
            file_name: job.file_name.clone(),
            spec: Some(convert::spec_to_wire(&job.spec)),
            attempt: job.attempt,
            lease_secs: self.jobs.terms().lease.as_secs_f64(),
            heartbeat_secs: self.jobs.terms().heartbeat.as_secs_f64(),
            checkpoint_pieces,
            checkpoint_secs: self.jobs.terms().checkpoint.as_secs_f64(),
        }
    }
}

fn artifact_chunk(message: worker::PutArtifactRequest) -> Option<Bytes> {
    match message.part {
        Some(worker::put_artifact_request::Part::Chunk(chunk)) => Some(chunk),
        _ => None,
    }
}

fn claimant(request: &worker::ClaimRequest) -> Claimant {
    let host = if request.host.is_empty() { &request.worker } else { &request.host };
    let (worker, version) = (request.worker.clone(), request.version.clone());
    Claimant { worker, host: host.clone(), version }
}

fn piece_chunk(message: worker::PutCheckpointRequest) -> Option<Bytes> {
    match message.part {
        Some(worker::put_checkpoint_request::Part::Chunk(chunk)) => Some(chunk),
        _ => None,
    }
}

fn check_build(build: &str) -> Result<(), Status> {
    let is_sound = build.len() <= 64 && build.chars().all(|c| c.is_ascii_graphic());
    let fault = || status::invalid("build", "use at most 64 printable ASCII characters");
    if is_sound { Ok(()) } else { Err(fault()) }
}

fn check_worker(request: &worker::ClaimRequest) -> Result<(), Status> {
    let text = "use 1 to 64 characters of [A-Za-z0-9._-]";
    if !convert::is_host(&request.worker) {
        return Err(status::invalid("worker", text));
    }
    if !request.host.is_empty() && !convert::is_host(&request.host) {
        return Err(status::invalid("host", text));
    }
    check_build(&request.build)?;
    let server = env!("CARGO_PKG_VERSION");
    if compatible(&request.version, server) {
        return Ok(());
    }
    let text = format!(
        "a worker of version `{}` cannot work for a server of version {server}: run the same version",
        request.version.escape_default()
    );
    Err(status::invalid("version", text))
}

/// One minor version apart still works.
fn compatible(worker: &str, server: &str) -> bool {
    let version = |text: &str| -> Option<(u32, u32)> {
        let mut parts = text.split('.');
        Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
    };
    match (version(worker), version(server)) {
        (Some(a), Some(b)) => a.0 == b.0 && a.1.abs_diff(b.1) <= 1,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_one_minor_apart_work_together() {
        assert!(compatible("0.1.0", "0.1.9"));
        assert!(compatible("0.2.0", "0.1.0"));
        assert!(!compatible("0.3.0", "0.1.0"));
        assert!(!compatible("1.1.0", "0.1.0"));
        assert!(!compatible("", "0.1.0"));
    }
}
