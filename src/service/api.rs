//! The public API: `lookalike.v1.LookalikeService`.

use std::{
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use base64::{Engine, engine::general_purpose::URL_SAFE_NO_PAD};
use futures::{Stream, StreamExt, TryStreamExt, stream};
use prost::bytes::Bytes;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use super::{
    auth::{Rates, call_of},
    convert,
    observe::{self, Observer},
    pace::Pace,
    proto::v1,
    status,
    status::status_of,
    transfer,
    webhook::WebhookRules,
};
use crate::jobs::{
    Jobs,
    clients::{Announced, StoredMesh},
    error::Error,
    spec::Fault,
    store::{Filter, NewJob},
};

/// Jobs on a page when the client does not say.
const PAGE: u32 = 100;
const MAX_PAGE: u32 = 1000;

/// Serves clients.
#[derive(Clone, Debug)]
pub(super) struct Api {
    /// The data directory.
    pub jobs: Jobs,
    /// Ends open streams.
    pub shutdown: CancellationToken,
    /// Counts what happens.
    pub observer: Arc<Observer>,
    /// Whom jobs may have called.
    pub webhooks: Arc<WebhookRules>,
    /// How fast the uploads of each owner may come.
    pub uploads: Arc<Pace<String>>,
}

type BoxStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl v1::lookalike_service_server::LookalikeService for Api {
    async fn upload_mesh(
        &self,
        request: Request<Streaming<v1::UploadMeshRequest>>,
    ) -> Result<Response<v1::UploadMeshResponse>, Status> {
        let call = call_of(&request)?;
        let desk = self.jobs.desk(&call.who);
        let mut parts = request.into_inner();
        let first = parts.message().await?.and_then(|message| message.part);
        let Some(v1::upload_mesh_request::Part::Header(header)) = first else {
            return Err(status::invalid("part", "the first message must be the header"));
        };
        let known = desk.reuse_mesh(&header.blake3).await.map_err(|e| status_of(&e))?;
        let mesh = if let Some(mesh) = known {
            mesh
        } else {
            let v1::UploadMeshHeader { size, blake3: hash, upload_id: upload, offset } = header;
            let announced = Announced { size, hash, upload, offset };
            let put = |chunks| desk.put_mesh(announced, chunks);
            let wait = |n_bytes: usize| {
                let n_turns = n_bytes.div_ceil(Rates::TURN) as u32;
                let owner = call.who.owner.clone();
                self.uploads.turns(owner, n_turns, Instant::now(), Duration::MAX)
            };
            transfer::receive("mesh", parts, (mesh_chunk, wait), put).await?
        };
        tracing::info!(mesh = mesh.hash, bytes = mesh.size, existed = mesh.existed, "mesh stored");
        let StoredMesh { hash, size, existed } = mesh;
        let mesh = convert::mesh_name(&hash);
        call.is_about(&mesh);
        Ok(Response::new(v1::UploadMeshResponse { mesh, size, existed }))
    }

    async fn query_upload(
        &self,
        request: Request<v1::QueryUploadRequest>,
    ) -> Result<Response<v1::QueryUploadResponse>, Status> {
        let call = call_of(&request)?;
        let v1::QueryUploadRequest { mesh, upload_id } = request.into_inner();
        let desk = self.jobs.desk(&call.who);
        let known = desk.reuse_mesh(&convert::mesh_hash(&mesh)).await.map_err(|e| status_of(&e))?;
        let held = match &known {
            Some(mesh) => Ok(mesh.size),
            None => desk.held_of_upload(&upload_id).await,
        };
        let held = held.map_err(|e| status_of(&e))?;
        Ok(Response::new(v1::QueryUploadResponse { held, is_stored: known.is_some() }))
    }

    async fn create_job(
        &self,
        request: Request<v1::CreateJobRequest>,
    ) -> Result<Response<v1::CreateJobResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let (spec, mut faults) = convert::spec_from_wire(request.spec);
        let asked = Some(&request.webhook_url).filter(|url| !url.is_empty());
        let fault = asked.and_then(|url| self.webhooks.fault(url));
        faults.extend(fault.map(|text| Fault { field: "webhook_url".into(), text }));
        let new = NewJob {
            owner: call.who.owner.clone(),
            request_id: request.request_id,
            mesh: convert::mesh_hash(&request.mesh),
            file_name: request.file_name,
            spec,
            priority: request.priority,
            labels: request.labels.into_iter().collect(),
            webhook: self.webhooks.url_for(request.webhook_url),
            trace: call.trace.map(|at| at.to_string()).unwrap_or_default(),
        };
        let spec = new.spec.clone();
        let on_wire = |mut error: Error| {
            if let Error::Invalid(faults) = &mut error {
                faults.iter_mut().for_each(|f| f.field = convert::field_on_wire(&spec, &f.field));
            }
            status_of(&error)
        };
        let job = self.jobs.desk(&call.who).create(new, faults).await.map_err(on_wire)?;
        call.is_about(job.name());
        tracing::info!(job = job.id, state = %job.state, "job created");
        Ok(Response::new(v1::CreateJobResponse { job: Some(convert::job_to_wire(&job)) }))
    }

    async fn get_job(
        &self,
        request: Request<v1::GetJobRequest>,
    ) -> Result<Response<v1::GetJobResponse>, Status> {
        let call = call_of(&request)?;
        let id = convert::job_id("name", &request.into_inner().name)?;
        let found = self.jobs.desk(&call.who).job_and_attempts(&id).await;
        let (job, attempts) = found.map_err(|e| status_of(&e))?;
        let attempts = attempts.into_iter().map(convert::attempt_to_wire).collect();
        Ok(Response::new(v1::GetJobResponse { job: Some(convert::job_to_wire(&job)), attempts }))
    }

    async fn list_jobs(
        &self,
        request: Request<v1::ListJobsRequest>,
    ) -> Result<Response<v1::ListJobsResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let filter = convert::filter_from_wire(&request)?;
        let before = read_token(&request.page_token, &filter)?;
        let limit = page_size(request.page_size, PAGE);
        // One more than asked for tells whether there is a next page.
        let found = self.jobs.desk(&call.who).list(&filter, before, limit + 1).await;
        let mut jobs = found.map_err(|e| status_of(&e))?;
        let more = jobs.len() > limit as usize;
        jobs.truncate(limit as usize);
        let last = jobs.last().filter(|_| more);
        let next_page_token = last.map(|job| write_token(job.n, &filter)).unwrap_or_default();
        let jobs = jobs.iter().map(convert::job_to_wire).collect();
        Ok(Response::new(v1::ListJobsResponse { jobs, next_page_token }))
    }

    type WatchJobStream = BoxStream<v1::WatchJobResponse>;

    async fn watch_job(
        &self,
        request: Request<v1::WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let id = convert::job_id("name", &request.name)?;
        // A missing job is the answer to the call, not the first item of the stream.
        self.jobs.desk(&call.who).job(&id).await.map_err(|e| status_of(&e))?;
        let log =
            self.jobs.follow(&call.who.owner, &id, request.after_seq).map_err(|e| status_of(&e));
        let answers =
            log.map_ok(|event| v1::WatchJobResponse { event: Some(convert::event_to_wire(event)) });
        Ok(Response::new(until(answers, self.shutdown.clone())))
    }

    async fn cancel_job(
        &self,
        request: Request<v1::CancelJobRequest>,
    ) -> Result<Response<v1::CancelJobResponse>, Status> {
        let call = call_of(&request)?;
        let id = convert::job_id("name", &request.into_inner().name)?;
        call.is_about(format!("jobs/{id}"));
        let cancelled = self.jobs.desk(&call.who).cancel(&id).await;
        let (job, has_ended) = cancelled.map_err(|e| status_of(&e))?;
        if has_ended {
            self.observer.ended(&job);
        }
        tracing::info!(job = id, state = %job.state, "cancellation requested");
        Ok(Response::new(v1::CancelJobResponse { job: Some(convert::job_to_wire(&job)) }))
    }

    async fn retry_job(
        &self,
        request: Request<v1::RetryJobRequest>,
    ) -> Result<Response<v1::RetryJobResponse>, Status> {
        let call = call_of(&request)?;
        let id = convert::job_id("name", &request.into_inner().name)?;
        call.is_about(format!("jobs/{id}"));
        let job = self.jobs.desk(&call.who).retry(&id).await.map_err(|e| status_of(&e))?;
        tracing::info!(job = id, state = %job.state, "retry requested");
        Ok(Response::new(v1::RetryJobResponse { job: Some(convert::job_to_wire(&job)) }))
    }

    async fn pin_job(
        &self,
        request: Request<v1::PinJobRequest>,
    ) -> Result<Response<v1::PinJobResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let id = convert::job_id("name", &request.name)?;
        call.is_about(format!("jobs/{id}"));
        let pinned = self.jobs.desk(&call.who).pin(&id, request.pinned).await;
        let job = pinned.map_err(|e| status_of(&e))?;
        Ok(Response::new(v1::PinJobResponse { job: Some(convert::job_to_wire(&job)) }))
    }

    async fn delete_job(
        &self,
        request: Request<v1::DeleteJobRequest>,
    ) -> Result<Response<v1::DeleteJobResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let id = convert::job_id("name", &request.name)?;
        call.is_about(format!("jobs/{id}"));
        match self.jobs.desk(&call.who).delete(&id).await {
            Err(Error::NotFound(_)) if request.allow_missing => {}
            deleted => deleted.map_err(|e| status_of(&e))?,
        }
        tracing::info!(job = id, "job deleted");
        Ok(Response::new(v1::DeleteJobResponse {}))
    }

    async fn list_artifacts(
        &self,
        request: Request<v1::ListArtifactsRequest>,
    ) -> Result<Response<v1::ListArtifactsResponse>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let id = convert::job_id("parent", &request.parent)?;
        let after = read_name_token(&request.page_token)?;
        let limit = page_size(request.page_size, MAX_PAGE);
        let artifacts =
            self.jobs.desk(&call.who).artifacts(&id).await.map_err(|e| status_of(&e))?;
        let (page, next_page_token) = page_after(&artifacts, &after, limit, |a| &a.file);
        let artifacts = page.iter().map(|a| convert::artifact_to_wire(&id, a)).collect();
        Ok(Response::new(v1::ListArtifactsResponse { artifacts, next_page_token }))
    }

    async fn list_workers(
        &self,
        request: Request<v1::ListWorkersRequest>,
    ) -> Result<Response<v1::ListWorkersResponse>, Status> {
        let request = request.into_inner();
        let after = read_name_token(&request.page_token)?;
        let limit = page_size(request.page_size, MAX_PAGE);
        let workers = self.jobs.workers().await.map_err(|e| status_of(&e))?;
        let (page, next_page_token) = page_after(&workers, &after, limit, |w| &w.host);
        let workers = page.iter().cloned().map(convert::worker_to_wire).collect();
        Ok(Response::new(v1::ListWorkersResponse { workers, next_page_token }))
    }

    async fn drain_worker(
        &self,
        request: Request<v1::DrainWorkerRequest>,
    ) -> Result<Response<v1::DrainWorkerResponse>, Status> {
        let call = call_of(&request)?;
        let host = convert::worker_host("name", &request.into_inner().name)?;
        call.is_about(format!("workers/{host}"));
        let worker = self.jobs.drain(&host).await.map_err(|e| status_of(&e))?;
        tracing::info!(host, "a worker is drained");
        let worker = Some(convert::worker_to_wire(worker));
        Ok(Response::new(v1::DrainWorkerResponse { worker }))
    }

    async fn reinstate_worker(
        &self,
        request: Request<v1::ReinstateWorkerRequest>,
    ) -> Result<Response<v1::ReinstateWorkerResponse>, Status> {
        let call = call_of(&request)?;
        let host = convert::worker_host("name", &request.into_inner().name)?;
        call.is_about(format!("workers/{host}"));
        let worker = self.jobs.reinstate(&host).await.map_err(|e| status_of(&e))?;
        tracing::info!(host, "a worker is back in service");
        let worker = Some(convert::worker_to_wire(worker));
        Ok(Response::new(v1::ReinstateWorkerResponse { worker }))
    }

    type ReadArtifactStream = BoxStream<v1::ReadArtifactResponse>;

    async fn read_artifact(
        &self,
        request: Request<v1::ReadArtifactRequest>,
    ) -> Result<Response<Self::ReadArtifactStream>, Status> {
        let call = call_of(&request)?;
        let request = request.into_inner();
        let (id, file) = convert::artifact_id("name", &request.name)?;
        let found = self.jobs.desk(&call.who).artifact(&id, &file).await;
        let (artifact, blob) = found.map_err(|e| status_of(&e))?;
        if request.offset > artifact.size {
            let text =
                format!("{} is past the end: the file has {} bytes", request.offset, artifact.size);
            return Err(status::invalid("offset", text));
        }
        let limit = if request.limit == 0 { u64::MAX } else { request.limit };
        let bytes = blob.read(request.offset, limit).await.map_err(|e| status_of(&e))?;
        let head = v1::ReadArtifactResponse {
            artifact: Some(convert::artifact_to_wire(&id, &artifact)),
            data: Bytes::new(),
        };
        let body = observe::sent("artifact", bytes)
            .map_ok(|data| v1::ReadArtifactResponse { artifact: None, data });
        let answers = stream::iter([Ok(head)]).chain(body.map_err(|e| status_of(&e)));
        Ok(Response::new(until(answers, self.shutdown.clone())))
    }
}

/// A stream that a shutdown ends with a status of its own, so that clients know to come back.
pub(super) fn until<T: Send + 'static>(
    answers: impl Stream<Item = Result<T, Status>> + Send + 'static,
    shutdown: CancellationToken,
) -> BoxStream<T> {
    let ended = shutdown.clone().cancelled_owned();
    let goodbye = stream::once(async move { shutdown.is_cancelled() })
        .filter_map(|cut| async move { cut.then(|| Err(status::shutting_down())) });
    Box::pin(answers.take_until(ended).chain(goodbye))
}

fn mesh_chunk(message: v1::UploadMeshRequest) -> Option<Bytes> {
    match message.part {
        Some(v1::upload_mesh_request::Part::Chunk(chunk)) => Some(chunk),
        _ => None,
    }
}

/// How many items a page may have.
fn page_size(asked: u32, default: u32) -> u32 {
    if asked == 0 { default } else { asked.min(MAX_PAGE) }
}

/// A page of what is ordered by name, behind the last name of the page before; and the token of the next one.
fn page_after<'a, T>(
    all: &'a [T],
    after: &str,
    limit: u32,
    name: impl Fn(&T) -> &str,
) -> (&'a [T], String) {
    let rest = &all[all.partition_point(|item| name(item) <= after)..];
    let page = rest.get(..limit as usize).unwrap_or(rest);
    let last = page.last().filter(|_| page.len() < rest.len());
    (page, last.map(|item| URL_SAFE_NO_PAD.encode(name(item))).unwrap_or_default())
}

/// The last name of the page before.
fn read_name_token(token: &str) -> Result<String, Status> {
    let name = URL_SAFE_NO_PAD.decode(token).ok().and_then(|bytes| String::from_utf8(bytes).ok());
    name.ok_or_else(|| status::invalid("page_token", "not a token of this server: start over"))
}

/// Where the next page begins, and for which filter.
fn write_token(before: i64, filter: &Filter) -> String {
    let print = blake3::hash(format!("{filter:?}").as_bytes()).to_hex();
    URL_SAFE_NO_PAD.encode(format!("{before} {}", &print[..16]))
}

fn read_token(token: &str, filter: &Filter) -> Result<Option<i64>, Status> {
    if token.is_empty() {
        return Ok(None);
    }
    let fault = |text: &str| status::invalid("page_token", text);
    let text = URL_SAFE_NO_PAD.decode(token).ok().and_then(|bytes| String::from_utf8(bytes).ok());
    let before = text.as_deref().and_then(|text| text.split(' ').next()?.parse().ok());
    let before: i64 = before.ok_or_else(|| fault("not a token of this server: start over"))?;
    if write_token(before, filter) != token {
        return Err(fault("it belongs to a list of other jobs: start over, or ask for the same"));
    }
    Ok(Some(before))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::state::State;

    #[test]
    fn page_tokens_remember_their_filter() {
        let filter = Filter {
            owner: Some("ann".into()),
            states: vec![State::Queued, State::Failed],
            labels: [("batch".into(), "7".into())].into(),
            created_ms: (None, Some(9)),
        };
        let token = write_token(42, &filter);
        assert_eq!(read_token(&token, &filter).unwrap(), Some(42));
        assert_eq!(read_token("", &filter).unwrap(), None);
        let others = [
            Filter { owner: None, ..filter.clone() },
            Filter { states: vec![State::Queued], ..filter.clone() },
            Filter { labels: [("batch".into(), "8".into())].into(), ..filter.clone() },
            Filter { created_ms: (Some(9), None), ..filter.clone() },
        ];
        for other in others {
            assert!(read_token(&token, &other).is_err(), "{other:?}");
        }
        for bad in ["@", "YWJj"] {
            assert!(read_token(bad, &filter).is_err(), "{bad}");
        }
    }
}
