//! The claim loop: a worker process from its start to its end.
//!
//! A worker ends when it is told to, when its server is gone for good, when it outlived the server
//! that started it and has nothing to do, and after many jobs (graphics drivers leak slowly).

use std::{
    fs::{self, File},
    io,
    path::PathBuf,
    time::Duration,
};

use futures::future::BoxFuture;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::{
    attempt::{self, Ended, Work},
    confine,
    link::{Link, LinkError},
    pipeline::{DeviceChoice, Pipeline},
};
use crate::service::{
    client::{Access, Backoff, BadTarget, is_transient},
    proto::worker::v1::Assignment,
    status::{OUT_OF_SERVICE, reason_of},
};

/// Jobs after which a worker makes room for a fresh one.
const MAX_JOBS: u32 = 500;
/// A worker whose host is out of service asks again this often.
const OUT_OF_SERVICE_PAUSE: Duration = Duration::from_secs(2);

/// How a worker is set up.
#[derive(Clone, Debug)]
pub struct WorkerConfig {
    /// The server's URL.
    pub url: String,
    /// What the server asks of its callers.
    pub access: Access,
    /// Names this incarnation.
    pub id: String,
    /// Names the machine, or its device, that it runs on; empty where it stands for itself.
    pub host: String,
    /// Which evaluator.
    pub device: DeviceChoice,
    /// What runs the jobs.
    pub pipeline: Pipeline,
    /// A folder for the files of the job at work; removed at the end.
    pub scratch: PathBuf,
    /// A file to hold locked as long as this process lives.
    pub lock: Option<PathBuf>,
    /// End when the parent process is gone and there is nothing to do.
    pub supervised: bool,
    /// End when the server does not answer for so long.
    pub give_up: Duration,
    /// What an attempt gets to stop in, once it has to be handed back.
    pub drain: Duration,
    /// Seconds of processor time that a job may take; 0 for no limit.
    pub cpu_secs: u64,
}

/// Why a worker ended early.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The server cannot be called like this.
    #[error(transparent)]
    Url(#[from] BadTarget),
    /// The server is gone.
    #[error("the server at {url} cannot be reached ({last}): start it, then this worker again")]
    Unreachable {
        /// Where it was.
        url: String,
        /// What the last attempt met.
        last: String,
    },
    /// The server wants no work from this worker.
    #[error("the server refused this worker: {0}")]
    Refused(String),
    /// A local file or folder failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Another process has this worker's identity.
    #[error("worker `{0}` is running already: choose another --id")]
    Twin(String),
    /// The pipeline panicked: a fresh process should take over.
    #[error("the pipeline panicked: this process ends so that a fresh one can take over")]
    Tainted,
    /// The pipeline goes on with a job that was handed back: only the end of the process stops it.
    #[error("the pipeline did not stop in time: its job is handed back, and this process ends")]
    Stuck,
}

/// Claims jobs and runs them until `drain`. Boxed, so that it is compiled with this crate.
pub fn run(
    config: WorkerConfig,
    drain: CancellationToken,
) -> BoxFuture<'static, Result<(), WorkerError>> {
    Box::pin(serve(config, drain))
}

async fn serve(config: WorkerConfig, drain: CancellationToken) -> Result<(), WorkerError> {
    let _lock = config.lock.as_deref().map(|path| lock(path, &config.id)).transpose()?;
    let link = Link::new(&config.url, &config.access, config.give_up)?;
    let parent = rustix::process::getppid();
    let supervised = config.supervised;
    let orphaned = move || supervised && rustix::process::getppid() != parent;
    for _ in 0..MAX_JOBS {
        let assignment = tokio::select! {
            claimed = claim(&config, &link, orphaned) => claimed?,
            () = drain.cancelled() => {
                // A job may be on its way here.
                leave(&link, &config).await;
                None
            }
        };
        let Some(assignment) = assignment else { break };
        work(&config, &link, assignment, &drain).await?;
        if orphaned() || drain.is_cancelled() {
            break;
        }
    }
    remove(&config.scratch);
    Ok(())
}

/// Hands back a job whose assignment was not waited for. A server that does not answer by the time that this worker has
/// left takes the job back when the lease runs out.
async fn leave(link: &Link, config: &WorkerConfig) {
    match timeout(config.drain, link.leave(&config.id)).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::warn!(%error, "left without a word"),
        Err(_) => tracing::warn!("left without a word: the server does not answer"),
    }
}

/// Waits for a job; `None` when there is no reason to wait on.
async fn claim(
    config: &WorkerConfig,
    link: &Link,
    orphaned: impl Fn() -> bool,
) -> Result<Option<Assignment>, WorkerError> {
    let mut backoff = Backoff::default();
    let mut silent_since: Option<Instant> = None;
    let mut is_told = false;
    while !orphaned() {
        match link.claim(&config.id, &config.host).await {
            Ok(None) => {
                silent_since = None;
                backoff.reset();
            }
            Ok(assignment) => return Ok(assignment),
            Err(status) if reason_of(&status).as_deref() == Some(OUT_OF_SERVICE) => {
                silent_since = None;
                if !is_told {
                    tracing::error!(reason = status.message(), "no jobs for this worker");
                    is_told = true;
                }
                tokio::time::sleep(OUT_OF_SERVICE_PAUSE).await;
            }
            Err(status) if is_transient(&status) => {
                let since = *silent_since.get_or_insert_with(Instant::now);
                if since.elapsed() > config.give_up {
                    return Err(unreachable(config, &status));
                }
                backoff.pause().await;
            }
            Err(status) => return Err(WorkerError::Refused(status.message().into())),
        }
    }
    Ok(None)
}

/// Runs one job in a fresh folder.
async fn work(
    config: &WorkerConfig,
    link: &Link,
    assignment: Assignment,
    drain: &CancellationToken,
) -> Result<(), WorkerError> {
    let Some(work) = Work::read(assignment) else {
        let text = "it assigned a job that this version does not understand: run the same version";
        return Err(WorkerError::Refused(text.into()));
    };
    let (job, epoch) = (work.lease.job.clone(), work.lease.epoch);
    tracing::info!(job, epoch, "attempt begins");
    remove(&config.scratch);
    let fault = |source| WorkerError::Io { path: config.scratch.clone(), source };
    fs::create_dir_all(&config.scratch).map_err(fault)?;
    confine::grant_cpu(config.cpu_secs);
    let ended = attempt::run(link, work, config, drain).await;
    remove(&config.scratch);
    match ended {
        Ok(Ended::Ready) => Ok(()),
        Ok(Ended::Tainted) => Err(WorkerError::Tainted),
        Ok(Ended::Stuck) => Err(WorkerError::Stuck),
        Err(LinkError::Unreachable { last, .. }) => {
            Err(WorkerError::Unreachable { url: config.url.clone(), last })
        }
        // The job is someone else's now, or the server knows how it ended.
        Err(error) => {
            tracing::warn!(job, epoch, %error, "attempt dropped");
            Ok(())
        }
    }
}

fn unreachable(config: &WorkerConfig, status: &Status) -> WorkerError {
    WorkerError::Unreachable { url: config.url.clone(), last: status.message().into() }
}

/// The kernel releases the lock when this process ends, however it ends.
fn lock(path: &std::path::Path, id: &str) -> Result<File, WorkerError> {
    let fault = |source| WorkerError::Io { path: path.into(), source };
    let file =
        File::options().create(true).truncate(false).write(true).open(path).map_err(fault)?;
    file.try_lock().map_err(|_| WorkerError::Twin(id.into()))?;
    io::Write::write_all(&mut &file, std::process::id().to_string().as_bytes()).map_err(fault)?;
    Ok(file)
}

/// Leftovers are only wasted space: the next start removes them.
fn remove(folder: &std::path::Path) {
    let _ = fs::remove_dir_all(folder);
}
