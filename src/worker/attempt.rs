//! One attempt of a job: fetch the input, run the pipeline on its own thread, and meanwhile keep the
//! lease alive and send what it reports.
//!
//! The pipeline learns of a stop through the return value of its callback; a panic inside it fails
//! the attempt and nothing else.

use std::{
    any::Any,
    ops::ControlFlow,
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    time::Duration,
};

use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::{
    agent::WorkerConfig,
    checkpoint::{self, HandingBack},
    link::{Link, LinkError},
    outbox::{AHEAD, Outbox, Parcel},
    pipeline::{DeviceChoice, Inputs, ModelFile, Pipeline, PipelineError},
};
use crate::{
    jobs::{
        event::Report,
        lease::{Lease, Orders},
        spec::Spec,
        store::Outcome,
    },
    service::{
        convert,
        proto::worker::v1::Assignment,
        status::{STORAGE, reason_of},
    },
};

/// A server whose storage fails gets so long to be mended before the job is handed back.
const FULL_PAUSE: Duration = Duration::from_secs(10);

/// Why an attempt is stopped before its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// A client cancelled the job.
    Cancel,
    /// The worker shuts down, or its host is to work no more.
    Drain,
    /// A job of higher priority waits.
    Preempt,
    /// The job is no longer ours, or the server is gone.
    Abandon,
}

impl Stop {
    /// Does what the server wants.
    pub fn obey(orders: Orders, stop: &watch::Sender<Option<Self>>) {
        let wanted = [
            (orders.cancel, Self::Cancel),
            (orders.drain, Self::Drain),
            (orders.preempt, Self::Preempt),
        ];
        for (_, reason) in wanted.into_iter().filter(|(is_wanted, _)| *is_wanted) {
            reason.raise(stop);
        }
    }

    /// Asks for a stop; the first reason holds, but `Abandon` overrides all.
    pub fn raise(self, stop: &watch::Sender<Option<Self>>) {
        stop.send_if_modified(|reason| {
            let changes = reason.is_none() || (self == Self::Abandon && *reason != Some(self));
            if changes {
                *reason = Some(self);
            }
            changes
        });
    }
}

/// How an attempt left its worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// Ready for the next job.
    Ready,
    /// The pipeline panicked: the process should not be trusted with another job.
    Tainted,
    /// The pipeline does not stop, though its job is handed back.
    Stuck,
}

/// What is to be done, read from the wire.
#[derive(Debug)]
pub struct Work {
    /// The right to do it.
    pub lease: Lease,
    spec: Spec,
    /// Hash of the original.
    mesh: String,
    file_name: String,
    heartbeat: Duration,
    /// Pieces of the checkpoint that it goes on from.
    n_pieces: u32,
    /// Between checkpoints; zero for none.
    checkpoint: Duration,
}

impl Work {
    /// Reads an assignment; `None` when it is not one that this version understands.
    pub fn read(assignment: Assignment) -> Option<Self> {
        let lease = convert::lease_from_wire(assignment.lease).ok()?;
        let (spec, faults) = convert::spec_from_wire(assignment.spec);
        let heartbeat = Duration::try_from_secs_f64(assignment.heartbeat_secs).ok()?;
        let heartbeat = heartbeat.max(Duration::from_millis(10));
        let checkpoint = Duration::try_from_secs_f64(assignment.checkpoint_secs).ok()?;
        faults.is_empty().then_some(Self {
            lease,
            spec,
            mesh: convert::mesh_hash(&assignment.mesh),
            file_name: assignment.file_name,
            heartbeat,
            n_pieces: assignment.checkpoint_pieces,
            checkpoint,
        })
    }
}

/// Runs one attempt to its end and tells the server how it ended.
pub async fn run(
    link: &Link,
    work: Work,
    config: &WorkerConfig,
    drain: &CancellationToken,
) -> Result<Ended, LinkError> {
    let (stop, stopped) = watch::channel(None);
    let (send, mut parcels) = mpsc::channel(AHEAD);
    let (lease, heartbeat) = (work.lease.clone(), work.heartbeat);
    let fetched = tokio::select! {
        fetched = fetch(link, &work) => fetched,
        lost = keep_alive(link, &lease, heartbeat, &stop, drain) => return Err(lost),
        reason = asked_to_stop(&stop) => {
            let stopped = Err(Fault::Pipeline(PipelineError::Cancelled));
            link.complete(&lease, outcome(stopped, Vec::new(), Some(reason))).await?;
            return Ok(Ended::Ready);
        }
    };
    let input = match fetched {
        Ok(input) => input,
        Err(error) => return fail(link, &lease, error).await.map(|()| Ended::Ready),
    };
    let (folder, device, pipeline) =
        (config.scratch.clone(), config.device.clone(), config.pipeline);
    let mut outbox = Outbox {
        link: link.clone(),
        lease: lease.clone(),
        out_dir: config.scratch.clone(),
        stop: stop.clone(),
        n_sent: 0,
        files: Vec::new(),
        n_pieces: work.n_pieces,
    };
    let mut running = tokio::task::spawn_blocking(move || {
        guarded(pipeline, &work, input, (&folder, &device), &send, &stopped)
    });
    let finish = async {
        outbox.run(&mut parcels).await?;
        let result = (&mut running).await.unwrap_or_else(|fault| Err(Fault::panic(&fault)));
        if result.is_ok() {
            outbox.store_rest().await?;
        }
        Ok(result)
    };
    let finished = tokio::select! {
        finished = finish => finished,
        lost = keep_alive(link, &lease, heartbeat, &stop, drain) => Err(lost),
        reason = overdue(&stop, config.drain) => {
            tracing::warn!(job = lease.job, "the pipeline does not stop, and its job is handed back");
            link.complete(&lease, Outcome::Released(reason.into())).await?;
            return Ok(Ended::Stuck);
        }
    };
    match finished {
        Ok(result) => {
            let ended =
                if matches!(result, Err(Fault::Panic(_))) { Ended::Tainted } else { Ended::Ready };
            let outcome = outcome(result, outbox.files, *stop.borrow());
            tracing::info!(job = lease.job, epoch = lease.epoch, ?outcome, "attempt ends");
            link.complete(&lease, outcome).await?;
            Ok(ended)
        }
        Err(error) => {
            Stop::Abandon.raise(&stop);
            // Nobody reads on: whatever the pipeline still reports tells it to stop.
            drop(parcels);
            if !running.is_finished() {
                let _ = running.await;
            }
            let alive = keep_alive(link, &lease, heartbeat, &stop, drain);
            hand_back(link, &lease, error, alive).await.map(|()| Ended::Ready)
        }
    }
}

/// Heartbeats until one fails; passes on what the server and the process's owner ask for.
async fn keep_alive(
    link: &Link,
    lease: &Lease,
    heartbeat: Duration,
    stop: &watch::Sender<Option<Stop>>,
    drain: &CancellationToken,
) -> LinkError {
    let mut beat = tokio::time::interval(heartbeat);
    beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut draining = false;
    loop {
        tokio::select! {
            _ = beat.tick() => match link.heartbeat(lease).await {
                Ok(orders) => Stop::obey(orders, stop),
                Err(error) => return error,
            },
            () = drain.cancelled(), if !draining => {
                draining = true;
                Stop::Drain.raise(stop);
            }
        }
    }
}

/// Returns when nothing needs to be done any more before the attempt can end.
async fn asked_to_stop(stop: &watch::Sender<Option<Stop>>) -> Stop {
    let mut stopped = stop.subscribe();
    match stopped.wait_for(Option::is_some).await.map(|reason| *reason) {
        Ok(Some(reason)) => reason,
        // The sender is in the caller's hands: it is never gone.
        _ => std::future::pending().await,
    }
}

/// Returns when the attempt was to be handed back so long ago.
async fn overdue(stop: &watch::Sender<Option<Stop>>, limit: Duration) -> &'static str {
    let hands_back = |reason: &Option<Stop>| matches!(reason, Some(Stop::Drain | Stop::Preempt));
    let mut stopped = stop.subscribe();
    if stopped.wait_for(hands_back).await.is_err() {
        // The sender is in the caller's hands: it is never gone.
        return std::future::pending().await;
    }
    tokio::time::sleep(limit).await;
    "the worker did not stop in time"
}

/// After a refusal of what the attempt has made. That the server cannot store it is not held against the job, which goes
/// back to the queue after a while.
async fn hand_back(
    link: &Link,
    lease: &Lease,
    error: LinkError,
    alive: impl Future<Output = LinkError>,
) -> Result<(), LinkError> {
    match error {
        LinkError::Refused(status) if reason_of(&status).as_deref() == Some(STORAGE) => {
            tracing::error!(job = lease.job, reason = status.message(), "the server cannot store");
            let _ = tokio::time::timeout(FULL_PAUSE, alive).await;
            let text = format!("the server's storage failed: {}", status.message());
            link.complete(lease, Outcome::Released(text)).await
        }
        error => fail(link, lease, error).await,
    }
}

/// After a call that the server refused: the attempt failed, if the server still listens.
async fn fail(link: &Link, lease: &Lease, error: LinkError) -> Result<(), LinkError> {
    match error {
        LinkError::Refused(_) | LinkError::File { .. } | LinkError::Damaged(_) => {
            link.complete(lease, Outcome::AttemptFailed(error.to_string())).await
        }
        LinkError::Stale(_) | LinkError::Unreachable { .. } => Err(error),
    }
}

enum Fault {
    Pipeline(PipelineError),
    Panic(String),
}

impl Fault {
    fn panic(cause: &dyn std::fmt::Display) -> Self {
        Self::Panic(cause.to_string())
    }
}

/// What an attempt begins with.
struct Input {
    original: Vec<u8>,
    simplified: Option<Vec<u8>>,
    /// Of the checkpoint that it goes on from.
    pieces: Vec<Vec<u8>>,
}

async fn fetch(link: &Link, work: &Work) -> Result<Input, LinkError> {
    let original = link.fetch_mesh(&work.lease, &work.mesh).await?;
    let simplified = match &work.spec.simplified {
        Some(input) => Some(link.fetch_mesh(&work.lease, &input.mesh).await?),
        None => None,
    };
    let has_pieces = work.n_pieces > 0;
    let pieces = if has_pieces { link.fetch_checkpoint(&work.lease).await? } else { Vec::new() };
    Ok(Input { original, simplified, pieces })
}

fn guarded(
    pipeline: Pipeline,
    work: &Work,
    input: Input,
    (out_dir, device): (&Path, &DeviceChoice),
    parcels: &mpsc::Sender<Parcel>,
    stopped: &watch::Receiver<Option<Stop>>,
) -> Result<(), Fault> {
    let mut handing_back = HandingBack::when(stopped);
    let tape = checkpoint::tape(input.pieces, work.checkpoint, parcels, &handing_back);
    let makes_pieces = !work.checkpoint.is_zero();
    let mut on = |report: Report| {
        let sent = parcels.blocking_send(Parcel::Report(report)).is_ok();
        if sent && !handing_back.should_end(makes_pieces) {
            ControlFlow::Continue(())
        } else {
            ControlFlow::Break(())
        }
    };
    let simplified = input.simplified.as_deref().zip(work.spec.simplified.as_ref());
    let inputs = Inputs {
        original: ModelFile { name: &work.file_name, bytes: &input.original },
        simplified: simplified.map(|(bytes, i)| ModelFile { name: &i.file_name, bytes }),
    };
    let run = || pipeline(&work.spec, &inputs, out_dir, (device, &tape), &mut on);
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(result) => result.map_err(Fault::Pipeline),
        Err(payload) => Err(Fault::panic(&panic_text(payload.as_ref()))),
    }
}

fn panic_text(payload: &(dyn Any + Send)) -> &str {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}

fn outcome(result: Result<(), Fault>, files: Vec<String>, stop: Option<Stop>) -> Outcome {
    match (result, stop) {
        (Ok(()), _) => Outcome::Succeeded(files),
        (Err(Fault::Panic(text)), _) => {
            Outcome::AttemptFailed(format!("a bug in the program, which panicked: {text}"))
        }
        (Err(Fault::Pipeline(PipelineError::Job { code, text })), _) => {
            Outcome::Failed(code.into(), text)
        }
        (Err(Fault::Pipeline(PipelineError::Cancelled)), Some(Stop::Cancel)) => Outcome::Cancelled,
        (Err(Fault::Pipeline(PipelineError::Cancelled)), Some(Stop::Preempt)) => {
            Outcome::Released(String::new())
        }
        (Err(Fault::Pipeline(PipelineError::Cancelled)), Some(_)) => {
            Outcome::Released("the worker shuts down".into())
        }
        (Err(Fault::Pipeline(PipelineError::Cancelled)), None) => {
            Outcome::AttemptFailed("a bug in the program, which stopped unasked".into())
        }
        (Err(Fault::Pipeline(PipelineError::Machine(text))), _) => Outcome::AttemptFailed(text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_reason_to_stop_holds_until_all_is_lost() {
        let (stop, _) = watch::channel(None);
        Stop::Cancel.raise(&stop);
        Stop::Drain.raise(&stop);
        assert_eq!(*stop.borrow(), Some(Stop::Cancel));
        Stop::Abandon.raise(&stop);
        assert_eq!(*stop.borrow(), Some(Stop::Abandon));
    }

    #[test]
    fn outcomes() {
        let files = || vec!["lod-0.glb".to_owned()];
        let stopped = || Err(Fault::Pipeline(PipelineError::Cancelled));
        assert_eq!(outcome(Ok(()), files(), Some(Stop::Cancel)), Outcome::Succeeded(files()));
        assert_eq!(outcome(stopped(), files(), Some(Stop::Cancel)), Outcome::Cancelled);
        let released = outcome(stopped(), files(), Some(Stop::Drain));
        assert!(matches!(released, Outcome::Released(text) if text.contains("shuts down")));
        let preempted = outcome(stopped(), files(), Some(Stop::Preempt));
        assert_eq!(preempted, Outcome::Released(String::new()));
        let panicked = outcome(Err(Fault::panic(&"index out of bounds")), files(), None);
        assert!(matches!(panicked, Outcome::AttemptFailed(text) if text.contains("index out of")));
    }
}
