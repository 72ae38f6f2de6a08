//! Wire types to and from those of [`crate::jobs`]. Wire types go no further than this.

mod event;
mod spec;

use prost_types::Timestamp;
use tonic::Status;

use super::{
    proto::{v1, worker::v1 as worker},
    status,
};
use crate::jobs::{
    blobs::is_safe_name,
    labels,
    lease::Lease,
    state::State,
    store::{Artifact, Attempt, Filter, Job, Outcome, Service, Worker},
};

pub use event::{event_from_wire, event_to_wire, report_from_wire, report_to_wire};
pub use spec::{field_on_wire, spec_from_wire, spec_to_wire};

const STATES: [(v1::JobState, State); 5] = [
    (v1::JobState::Queued, State::Queued),
    (v1::JobState::Running, State::Running),
    (v1::JobState::Succeeded, State::Succeeded),
    (v1::JobState::Failed, State::Failed),
    (v1::JobState::Cancelled, State::Cancelled),
];

/// A state on the wire.
pub fn state_to_wire(state: State) -> v1::JobState {
    let row = STATES.iter().find(|(_, ours)| *ours == state);
    row.map_or(v1::JobState::Unspecified, |(wire, _)| *wire)
}

/// A state from the wire; `None` for one that this version does not know.
pub fn state_from_wire(wire: i32) -> Option<State> {
    STATES.iter().find(|(state, _)| *state as i32 == wire).map(|(_, ours)| *ours)
}

/// Which jobs a list asks for.
pub(super) fn filter_from_wire(request: &v1::ListJobsRequest) -> Result<Filter, Status> {
    let unknown = |state| format!("{state} is no state that a job can be in");
    let mut states = Vec::new();
    for &state in &request.states {
        let state =
            state_from_wire(state).ok_or_else(|| status::invalid("states", unknown(state)))?;
        if !states.contains(&state) {
            states.push(state);
        }
    }
    let label = |text: &String| labels::parse(text).map_err(|text| status::invalid("labels", text));
    if request.labels.len() > labels::MOST {
        let text =
            format!("{} labels: no job has more than {}", request.labels.len(), labels::MOST);
        return Err(status::invalid("labels", text));
    }
    let time = |time: &Option<Timestamp>| time.as_ref().map(time_from_wire);
    Ok(Filter {
        owner: Some(request.owner.clone()).filter(|owner| !owner.is_empty()),
        states,
        labels: request.labels.iter().map(label).collect::<Result<_, _>>()?,
        created_ms: (time(&request.create_time_from), time(&request.create_time_until)),
    })
}

/// A job on the wire.
pub fn job_to_wire(job: &Job) -> v1::Job {
    let (reason, text) = job.failure.clone();
    v1::Job {
        name: job.name(),
        mesh: mesh_name(&job.mesh),
        file_name: job.file_name.clone(),
        spec: Some(spec_to_wire(&job.spec)),
        state: state_to_wire(job.state).into(),
        create_time: Some(time_to_wire(job.created_ms)),
        start_time: job.started_ms.map(time_to_wire),
        end_time: job.ended_ms.map(time_to_wire),
        attempt: job.attempt,
        epoch: job.epoch,
        last_seq: job.last_seq,
        cancel_requested: job.cancel_requested && !job.state.is_final(),
        failure: (job.state == State::Failed).then_some(v1::JobFailure { reason, text }),
        stage: job.stage.clone(),
        fraction: job.fraction,
        owner: job.owner.clone(),
        pinned: job.pinned,
        priority: job.priority,
        labels: job.labels.clone().into_iter().collect(),
        results_removed: job.results_removed,
    }
}

/// An attempt on the wire.
pub fn attempt_to_wire(attempt: Attempt) -> v1::Attempt {
    v1::Attempt {
        attempt: attempt.attempt,
        epoch: attempt.epoch,
        worker: attempt.worker,
        host: format!("workers/{}", attempt.host),
        start_time: Some(time_to_wire(attempt.started_ms)),
        end_time: attempt.ended_ms.map(time_to_wire),
        reason: attempt.reason,
        text: attempt.detail,
        counts: attempt.counts,
    }
}

/// A host on the wire.
pub fn worker_to_wire(worker: Worker) -> v1::Worker {
    let service = worker.service();
    let state = match service {
        Service::In => v1::WorkerState::InService,
        Service::Quarantined => v1::WorkerState::Quarantined,
        Service::Drained => v1::WorkerState::Drained,
    };
    v1::Worker {
        name: format!("workers/{}", worker.host),
        incarnation: worker.worker,
        version: worker.version,
        seen_time: Some(time_to_wire(worker.seen_ms)),
        state: state.into(),
        reason: worker.why,
        until_time: worker
            .quarantined_until_ms
            .filter(|_| service == Service::Quarantined)
            .map(time_to_wire),
    }
}

/// The host in `workers/{host}`.
pub fn worker_host(field: &str, name: &str) -> Result<String, Status> {
    let host = name.strip_prefix("workers/").filter(|host| is_host(host));
    let text = || format!("`{}` is no worker: use `workers/{{host}}`", name.escape_default());
    host.map(Into::into).ok_or_else(|| status::invalid(field, text()))
}

/// Whether a text can name a host or an incarnation.
pub fn is_host(name: &str) -> bool {
    is_safe_name(name) && name.len() <= 64
}

/// An artifact on the wire.
pub fn artifact_to_wire(job: &str, artifact: &Artifact) -> v1::Artifact {
    v1::Artifact {
        name: format!("jobs/{job}/artifacts/{}", artifact.file),
        media_type: artifact.media_type.clone(),
        size: artifact.size,
        blake3: artifact.blake3.clone(),
    }
}

/// Milliseconds since 1970 on the wire.
pub fn time_to_wire(ms: i64) -> Timestamp {
    Timestamp { seconds: ms.div_euclid(1000), nanos: ms.rem_euclid(1000) as i32 * 1_000_000 }
}

/// Milliseconds since 1970 from the wire.
pub fn time_from_wire(time: &Timestamp) -> i64 {
    time.seconds.saturating_mul(1000).saturating_add(i64::from(time.nanos) / 1_000_000)
}

/// `meshes/{hash}`.
pub fn mesh_name(hash: &str) -> String {
    format!("meshes/{hash}")
}

/// The hash in `meshes/{hash}`; empty when the name is none.
pub fn mesh_hash(name: &str) -> String {
    name.strip_prefix("meshes/").unwrap_or_default().into()
}

/// The id in `jobs/{id}`.
pub fn job_id(field: &str, name: &str) -> Result<String, Status> {
    let id = name.strip_prefix("jobs/").filter(|id| is_id(id));
    let text = || format!("`{}` is no job: use `jobs/{{id}}`", name.escape_default());
    id.map(Into::into).ok_or_else(|| status::invalid(field, text()))
}

/// The job's id and the file in `jobs/{id}/artifacts/{file}`.
pub fn artifact_id(field: &str, name: &str) -> Result<(String, String), Status> {
    let parts = name.strip_prefix("jobs/").and_then(|rest| rest.split_once("/artifacts/"));
    let parts = parts.filter(|(id, _)| is_id(id));
    let text = || {
        format!("`{}` is no artifact: use `jobs/{{id}}/artifacts/{{file}}`", name.escape_default())
    };
    parts.map(|(id, file)| (id.into(), file.into())).ok_or_else(|| status::invalid(field, text()))
}

fn is_id(id: &str) -> bool {
    (1..=64).contains(&id.len()) && id.bytes().all(|c| c.is_ascii_alphanumeric())
}

/// A lease on the wire.
pub fn lease_to_wire(lease: &Lease) -> worker::Lease {
    let job = format!("jobs/{}", lease.job);
    worker::Lease { job, epoch: lease.epoch, worker: lease.worker.clone() }
}

/// A lease from the wire.
pub fn lease_from_wire(lease: Option<worker::Lease>) -> Result<Lease, Status> {
    let lease = lease.ok_or_else(|| status::invalid("lease", "missing: every call carries it"))?;
    let job = job_id("lease.job", &lease.job)?;
    Ok(Lease { job, epoch: lease.epoch, worker: lease.worker })
}

/// An outcome from the wire.
pub fn outcome_from_wire(
    outcome: Option<worker::complete_request::Outcome>,
) -> Result<Outcome, Status> {
    use worker::complete_request::Outcome as Wire;
    let outcome = outcome.ok_or_else(|| status::invalid("outcome", "missing: say how it ended"))?;
    Ok(match outcome {
        Wire::Succeeded(end) => Outcome::Succeeded(end.files),
        Wire::Failed(end) => Outcome::Failed(end.reason, end.text),
        Wire::Cancelled(worker::Cancelled {}) => Outcome::Cancelled,
        Wire::AttemptFailed(end) => Outcome::AttemptFailed(end.text),
        Wire::Released(end) => Outcome::Released(end.text),
    })
}

/// An outcome on the wire.
pub fn outcome_to_wire(outcome: Outcome) -> worker::complete_request::Outcome {
    use worker::complete_request::Outcome as Wire;
    match outcome {
        Outcome::Succeeded(files) => Wire::Succeeded(worker::Succeeded { files }),
        Outcome::Failed(reason, text) => Wire::Failed(worker::Failed { reason, text }),
        Outcome::Cancelled => Wire::Cancelled(worker::Cancelled {}),
        Outcome::AttemptFailed(text) => Wire::AttemptFailed(worker::AttemptFailed { text }),
        Outcome::Released(text) => Wire::Released(worker::Released { text }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_strictly() {
        assert_eq!(job_id("name", "jobs/0a1").unwrap(), "0a1");
        for bad in ["", "0a1", "jobs/", "jobs/a/b", "jobs/../x", "meshes/0a1"] {
            assert!(job_id("name", bad).is_err(), "{bad}");
        }
        let (id, file) = artifact_id("name", "jobs/0a1/artifacts/lod-0.glb").unwrap();
        assert_eq!((id.as_str(), file.as_str()), ("0a1", "lod-0.glb"));
        assert!(artifact_id("name", "jobs/0a1/lod-0.glb").is_err());
    }

    #[test]
    fn states_and_times_survive_a_round_trip() {
        for state in State::ALL {
            assert_eq!(state_from_wire(state_to_wire(state).into()), Some(state));
        }
        for ms in [0, 1, -1, 1_795_000_000_123] {
            assert_eq!(time_from_wire(&time_to_wire(ms)), ms);
        }
    }
}
