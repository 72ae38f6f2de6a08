//! What workers ask for: work, and places for what they make of it.

use std::time::Duration;

use tokio::{
    sync::mpsc,
    time::{Instant, timeout},
};
use tokio_util::bytes::Bytes;

use super::{
    Jobs,
    blobs::{Blob, is_safe_name},
    clients::Announced,
    error::{Error, Result},
    event::Report,
    lease::{Claimant, Lease, Loss, Orders},
    points::{Point, pass},
    segment,
    state::State,
    store::{Appended, Artifact, Attempt, Job, Outcome, Piece, Waiting, Worker},
};

/// The queue is looked at this often even when nobody calls.
const POLL: Duration = Duration::from_secs(2);
/// Attempts of a job that are shown.
const MAX_HISTORY: u32 = 100;

impl Jobs {
    /// Gives a queued job to a worker, waiting up to `wait` for one; refused when its host is out of service.
    pub async fn claim(&self, who: impl Into<Claimant>, wait: Duration) -> Result<Option<Job>> {
        let who = who.into();
        let deadline = Instant::now() + wait;
        let mut queue = self.0.signals.watch_queue();
        loop {
            let claimed = self.0.store.claim(&who, &self.0.terms).await?;
            self.note_lost(claimed.abandoned);
            if let Some(job) = claimed.job? {
                pass(Point::ClaimCommitted);
                self.0.signals.log_grew(&job.id);
                return Ok(Some(job));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            // Time out or not: look again.
            let _ = timeout(left.min(POLL), queue.changed()).await;
        }
    }

    /// Which jobs wait, and since when, by owner and priority.
    pub async fn queue(&self) -> Result<Vec<Waiting>> {
        self.0.store.queue().await
    }

    /// Extends a lease; what the worker should do.
    pub async fn heartbeat(&self, lease: &Lease) -> Result<Orders> {
        self.0.store.heartbeat(lease, &self.0.terms).await
    }

    /// An input of the job under `lease`: the mesh of that hash, which the job must name, or the
    /// original where the hash is empty.
    pub async fn input(&self, lease: &Lease, hash: &str) -> Result<Blob> {
        let job = self.0.store.check(lease).await?;
        let simplified = job.spec.simplified.as_ref().map(|input| &input.mesh);
        let wanted = if hash.is_empty() { &job.mesh } else { hash };
        if wanted != job.mesh && simplified.is_none_or(|mesh| mesh != wanted) {
            let text = format!("meshes/{} is no input of {}", hash.escape_default(), job.name());
            return Err(Error::invalid("mesh", text));
        }
        let missing = || Error::NotFound(format!("meshes/{wanted}"));
        let size = self.0.store.mesh_size(wanted).await?.ok_or_else(missing)?;
        Ok(self.0.blobs.mesh(wanted, size))
    }

    /// Appends to the log. `first` is the number (from 0) of the attempt's event that `reports`
    /// begins with; those that are held already are skipped.
    pub async fn append(
        &self,
        lease: &Lease,
        first: u64,
        reports: Vec<Report>,
    ) -> Result<Appended> {
        // Refuse a stale worker before it fills the disk; the transaction checks again.
        let job = self.0.store.check(lease).await?;
        if first + reports.len() as u64 <= job.appended {
            return Ok(Appended { held: job.appended, orders: job.orders() });
        }
        let pack = tokio::task::spawn_blocking(move || segment::pack(first, reports));
        let (segments, entries) = pack.await??;
        for segment in segments {
            let put =
                self.0.blobs.put_segment(segment.packed, &lease.job, lease.epoch, &segment.name);
            put.await?;
            pass(Point::SegmentStored);
        }
        let appended = self.0.store.append(lease, first, &entries).await?;
        pass(Point::AppendCommitted);
        self.0.signals.log_grew(&lease.job);
        Ok(appended)
    }

    /// Stores a file of the result: the bytes that arrive on `chunks` until it closes.
    pub async fn put_artifact(
        &self,
        lease: &Lease,
        artifact: Artifact,
        chunks: mpsc::Receiver<Bytes>,
    ) -> Result<()> {
        if !is_safe_name(&artifact.file) {
            let text = "use 1 to 128 characters of [A-Za-z0-9._-], the first of which is no dot";
            return Err(Error::invalid("header.file", text));
        }
        self.0.store.check(lease).await?;
        let limit = self.0.limits.max_artifact_bytes;
        let staged = self.0.blobs.stage(chunks, limit).await?;
        let announced = Announced {
            size: artifact.size,
            hash: artifact.blake3.clone(),
            ..Announced::default()
        };
        announced.check(&artifact.file, staged.size, &staged.hash)?;
        let stored = Artifact { size: staged.size, blake3: staged.hash.clone(), ..artifact };
        pass(Point::ArtifactStaged);
        self.0.blobs.commit_artifact(staged, &lease.job, lease.epoch, &stored.file).await?;
        pass(Point::ArtifactNamed);
        self.0.store.add_artifact(lease, &stored).await?;
        pass(Point::ArtifactCommitted);
        Ok(())
    }

    /// The latest attempts of a job, the last one first.
    pub async fn attempts(&self, id: &str) -> Result<Vec<Attempt>> {
        self.0.store.attempts(id, MAX_HISTORY).await
    }

    /// The hosts that have asked for work, by name.
    pub async fn workers(&self) -> Result<Vec<Worker>> {
        self.0.store.workers().await
    }

    /// Takes a host out of service.
    pub async fn drain(&self, host: &str) -> Result<Worker> {
        self.0.store.drain(host).await
    }

    /// Takes back whatever a worker holds that ends in peace; the jobs concerned.
    pub async fn leave(&self, worker: &str) -> Result<Vec<Job>> {
        self.lose_worker(worker, Loss::Released).await
    }

    /// Takes a host back into service.
    pub async fn reinstate(&self, host: &str) -> Result<Worker> {
        let worker = self.0.store.reinstate(host).await?;
        self.0.signals.queue_grew();
        Ok(worker)
    }

    /// What the worker that has just claimed the job goes on from: pieces of a checkpoint. None where it starts
    /// over.
    pub async fn resume(&self, lease: &Lease, build: &str) -> Result<Vec<Piece>> {
        let pieces = self.0.store.resume(lease, build, self.0.terms.max_lost).await?;
        pass(Point::ResumeCommitted);
        self.0.signals.log_grew(&lease.job);
        Ok(pieces)
    }

    /// The bytes of the checkpoint, piece by piece.
    pub async fn checkpoint(&self, lease: &Lease) -> Result<Vec<Blob>> {
        let pieces = self.0.store.pieces(lease).await?;
        let blob = |p: &Piece| self.0.blobs.piece(&lease.job, p.epoch, p.n, p.size);
        Ok(pieces.iter().map(blob).collect())
    }

    /// Stores piece `n` of the checkpoint, made by this build: the bytes that arrive on `chunks` until it closes.
    /// All that the attempt reported before it must be in the log.
    pub async fn put_piece(
        &self,
        lease: &Lease,
        (n, build): (u32, &str),
        announced: &Announced,
        chunks: mpsc::Receiver<Bytes>,
    ) -> Result<()> {
        self.0.store.check(lease).await?;
        let staged = self.0.blobs.stage(chunks, self.0.limits.max_piece_bytes).await?;
        announced.check(&format!("piece {n} of the checkpoint"), staged.size, &staged.hash)?;
        let size = staged.size;
        pass(Point::PieceStaged);
        self.0.blobs.commit_piece(staged, &lease.job, lease.epoch, n).await?;
        pass(Point::PieceNamed);
        self.0.store.add_piece(lease, n, size, build).await?;
        pass(Point::PieceCommitted);
        Ok(())
    }

    /// Ends the attempt; says whether this call did it, or one before whose answer was lost.
    pub async fn complete(&self, lease: &Lease, outcome: &Outcome) -> Result<(Job, bool)> {
        let (job, is_new) = self.0.store.complete(lease, outcome, self.0.terms.max_lost).await?;
        pass(Point::CompleteCommitted);
        self.announce(std::slice::from_ref(&job));
        // It has ended, whatever becomes of what is in nobody's way.
        if let Err(error) = self.clear(&job).await {
            tracing::error!(job = job.id, %error, "files of earlier attempts cannot be removed");
        }
        Ok((job, is_new))
    }

    /// Removes what earlier attempts left of a job that has ended.
    async fn clear(&self, job: &Job) -> Result<()> {
        if job.state == State::Succeeded {
            self.0.blobs.remove_artifacts_before(&job.id, job.epoch).await?;
        }
        self.forget_checkpoints(std::slice::from_ref(job)).await
    }
}
