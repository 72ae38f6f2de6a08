//! Jobs: specification, states, leases, events, stores. Knows nothing of geometry or of gRPC.
//!
//! [`Jobs`] is a cloneable handle on one data directory, and on a database and a bucket elsewhere where
//! they are named:
//!
//! ```text
//! DIR/lock           held by the server that owns the directory
//! DIR/jobs.sqlite3   jobs, leases, event log, manifests (store/), unless they are in PostgreSQL
//! DIR/objects/       meshes, record segments, checkpoints, artifacts (blobs/), or what is on its way to a bucket
//! DIR/workers/       one lock file for each local worker, held while it lives; the server's socket
//! ```
//!
//! 1. What a call returned `Ok` for survives the death of every process.
//! 2. Bytes are in place before the row that tells of them.
//! 3. Every write of a worker is conditional on its lease.
//!
//! `clients.rs`, `attempts.rs` and `follow.rs` hold what clients, workers and watchers ask for;
//! `owners.rs` what of that a principal may see; `webhooks.rs` who is told of the end.

pub mod audit;
pub mod blobs;
pub mod clients;
pub mod error;
pub mod event;
pub mod follow;
pub mod labels;
pub mod lease;
pub mod owners;
pub mod places;
pub mod principal;
pub mod segment;
pub mod signals;
pub mod spec;
pub mod state;
pub mod store;
pub mod webhooks;

mod attempts;
mod expiry;
mod points;
mod recent;
mod turns;

pub use places::Places;

use std::{
    fs::{self, File, TryLockError},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use tokio::{task::JoinSet, time::timeout};
use tokio_util::task::TaskTracker;

use self::{
    blobs::Blobs,
    error::{Error, Result},
    lease::{Loss, Terms},
    recent::Recent,
    signals::Signals,
    store::{Job, Store, StoredEvent},
    turns::Turns,
};

/// Caps on what clients may ask for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bytes of a mesh file.
    pub max_mesh_bytes: u64,
    /// Bytes of an artifact.
    pub max_artifact_bytes: u64,
    /// Bytes of a piece of a checkpoint.
    pub max_piece_bytes: u64,
    /// Jobs that may wait at once.
    pub max_queued: u64,
    /// Jobs of one owner that may wait at once.
    pub max_owner_queued: u64,
    /// Bytes of an owner's meshes and results together.
    pub max_owner_bytes: u64,
    /// Meshes that no job names are removed at a start when nobody asked for them in so long.
    pub keep_meshes: Duration,
    /// Entries of the audit table are removed at a start when they are older.
    pub keep_audit: Duration,
    /// Results of ended jobs are removed after so long, unless the job is pinned; never where it is not said.
    pub keep_results: Option<Duration>,
    /// How long jobs are kept after their end, with their logs; for ever where it is not given.
    pub keep_jobs: Option<Duration>,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_mesh_bytes: 4 << 30,
            max_artifact_bytes: 4 << 30,
            max_piece_bytes: 256 << 20,
            max_queued: 100_000,
            max_owner_queued: 100_000,
            max_owner_bytes: u64::MAX,
            keep_meshes: Duration::from_hours(7 * 24),
            keep_audit: Duration::from_hours(366 * 24),
            keep_results: None,
            keep_jobs: None,
        }
    }
}

/// Of one owner's submissions: one is at work, and one is ready to follow. A single owner loses nothing.
const CREATIONS_AT_ONCE: usize = 2;
/// Of one owner's uploads, each of which has a thread. Others are told to come back: one that waited would hold up those
/// beside it on its connection.
const UPLOADS_AT_ONCE: usize = 64;
/// Of one reader's followers: fewer than there are connections for reading.
const READS_AT_ONCE: usize = 3;
/// Uploads that are whole get so long to be stored before a server ends.
const LAST_UPLOADS: Duration = Duration::from_secs(10);

/// A data directory and everything in it.
#[derive(Clone, Debug)]
pub struct Jobs(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    store: Store,
    blobs: Blobs,
    signals: Arc<Signals>,
    ledger: audit::Ledger,
    /// Pass signals on between servers, and entries of the audit table to it.
    _couriers: JoinSet<()>,
    /// Of those who create jobs, and of those who follow logs.
    turns: Turns,
    readers: Turns,
    /// Pages of logs, and segments of records, that followers share.
    pages: Recent<[StoredEvent]>,
    unpacked: Recent<Vec<u8>>,
    /// Of those who upload.
    uploads: Turns,
    /// Uploads that go on though their senders may have left, and those that are whole.
    receiving: TaskTracker,
    keeping: TaskTracker,
    /// Jobs whose attempts were lost while nobody asked for them.
    lost: Mutex<Vec<Job>>,
    terms: Terms,
    limits: Limits,
    workers: PathBuf,
    /// Held as long as this process owns the directory.
    _lock: File,
}

impl Jobs {
    /// Opens a data directory, creating it; fails when another process owns it.
    pub async fn open(places: impl Into<Places>, terms: Terms, limits: Limits) -> Result<Self> {
        let places = places.into();
        let data_dir = &places.data_dir;
        fs::create_dir_all(data_dir).map_err(Error::io(data_dir))?;
        let lock = lock(data_dir)?;
        let workers = data_dir.join("workers");
        fs::create_dir_all(&workers).map_err(Error::io(&workers))?;
        let blobs = places.blobs()?;
        let store = places.store().await?;
        places.check_pair(&store, &blobs).await?;
        let (signals, mut couriers) = Signals::open(&store);
        let (ledger, keep) = audit::open(store.clone());
        couriers.spawn(keep);
        let jobs = Self(Arc::new(Inner {
            store,
            blobs,
            signals,
            ledger,
            _couriers: couriers,
            turns: Turns::new(CREATIONS_AT_ONCE),
            readers: Turns::new(READS_AT_ONCE),
            pages: Recent::default(),
            unpacked: Recent::default(),
            uploads: Turns::new(UPLOADS_AT_ONCE),
            receiving: TaskTracker::new(),
            keeping: TaskTracker::new(),
            lost: Mutex::default(),
            terms,
            limits,
            workers,
            _lock: lock,
        }));
        jobs.recover().await?;
        Ok(jobs)
    }

    /// Looks into a data directory that no server uses, without touching its jobs: how many are in
    /// each state.
    pub async fn inspect(data_dir: &Path) -> Result<Vec<(state::State, u64)>> {
        let _lock = lock(data_dir)?;
        let store = Places::from(data_dir).store().await?;
        let counts = store.counts().await;
        store.close().await;
        counts
    }

    /// The terms on which leases are given.
    pub fn terms(&self) -> &Terms {
        &self.0.terms
    }

    /// How many jobs are in each state.
    pub async fn counts(&self) -> Result<Vec<(state::State, u64)>> {
        self.0.store.counts().await
    }

    /// Finishes what is being written.
    pub async fn close(&self) {
        self.0.keeping.close();
        // What takes longer is gone on with after the next start.
        let _ = timeout(LAST_UPLOADS, self.0.keeping.wait()).await;
        self.0.store.close().await;
    }

    /// Takes away every lease that ran out, or whose holder's process ended (nobody waits for the
    /// workers of an earlier server). To be called now and then; the jobs concerned, and those that were lost since by a
    /// start or a claim.
    pub async fn sweep_leases(&self) -> Result<Vec<Job>> {
        let expired = self.0.store.lose_expired(self.0.terms.max_lost).await?;
        self.note_lost(expired);
        for worker in self.0.store.lease_holders().await? {
            if is_alive(&self.worker_lock(&worker)) == Some(false) {
                let gone = self.worker_gone(&worker).await?;
                self.lost().extend(gone);
            }
        }
        let lost = std::mem::take(&mut *self.lost());
        self.forget_checkpoints(&lost).await?;
        Ok(lost)
    }

    /// Asks workers to hand back jobs, where others of higher priority wait. To be called now and then; the jobs.
    pub async fn preempt(&self) -> Result<Vec<Job>> {
        self.0.store.preempt(&self.0.terms).await
    }

    /// Takes away what a worker holds whose process is known to have ended; the jobs concerned.
    pub async fn worker_gone(&self, worker: &str) -> Result<Vec<Job>> {
        let _ = fs::remove_file(self.worker_lock(worker));
        self.lose_worker(worker, Loss::WorkerExited).await
    }

    /// The folder of local workers: their lock files, and the server's socket for them.
    pub fn workers_dir(&self) -> PathBuf {
        self.0.workers.clone()
    }

    /// The file that a local worker locks as long as it lives.
    pub fn worker_lock(&self, worker: &str) -> PathBuf {
        self.0.workers.join(format!("{worker}.lock"))
    }

    /// After a start: jobs of local workers that are gone start over at once; workers that outlived
    /// the last server keep their leases, and get the time back in which nobody could hear them.
    async fn recover(&self) -> Result<()> {
        for worker in self.0.store.lease_holders().await? {
            if is_alive(&self.worker_lock(&worker)) == Some(false) {
                let lost = self.lose_worker(&worker, Loss::ServerRestarted).await?;
                self.lost().extend(lost);
            } else {
                self.0.store.renew(&worker, &self.0.terms).await?;
            }
        }
        for entry in fs::read_dir(&self.0.workers).map_err(Error::io(&self.0.workers))?.flatten() {
            if is_alive(&entry.path()) == Some(false) {
                let _ = fs::remove_file(entry.path());
            }
        }
        Ok(())
    }

    async fn lose_worker(&self, worker: &str, loss: Loss) -> Result<Vec<Job>> {
        let lost = self.0.store.lose_worker(worker, loss, self.0.terms.max_lost).await?;
        self.announce(&lost);
        Ok(lost)
    }

    fn lost(&self) -> MutexGuard<'_, Vec<Job>> {
        self.0.lost.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps what was lost beside something else until [`Self::sweep_leases`] tells of it.
    fn note_lost(&self, jobs: Vec<Job>) {
        self.announce(&jobs);
        self.lost().extend(jobs);
    }

    /// Removes the checkpoints of those that ended.
    async fn forget_checkpoints(&self, jobs: &[Job]) -> Result<()> {
        for job in jobs.iter().filter(|job| job.state.is_final()) {
            self.forget_checkpoint(&job.id, job.epoch).await?;
        }
        Ok(())
    }

    /// Wakes whoever waits for these jobs.
    fn announce(&self, jobs: &[Job]) {
        for job in jobs {
            self.0.signals.log_grew(&job.id);
            if job.state == state::State::Queued {
                self.0.signals.queue_grew();
            }
        }
    }
}

fn lock(data_dir: &Path) -> Result<File> {
    let path = data_dir.join("lock");
    let file = File::options().create(true).truncate(false).write(true).open(&path);
    let file = file.map_err(Error::io(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Error::InUse(data_dir.into())),
        Err(TryLockError::Error(source)) => Err(Error::Io { path, source }),
    }
}

/// Whether the process that locked this file lives; `None` when there is no such file, as for a
/// worker on another machine.
fn is_alive(lock: &Path) -> Option<bool> {
    let file = File::open(lock).ok()?;
    Some(matches!(file.try_lock(), Err(TryLockError::WouldBlock)))
}

#[cfg(test)]
mod tests;
