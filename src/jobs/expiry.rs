//! Results have their time, and jobs with their logs have theirs: after it they are removed, unless they are pinned.
//! Checkpoints end with their jobs, and meshes some time after the last one that names them.

use std::time::{Duration, SystemTime};

use super::{
    Jobs,
    error::{Error, Result},
    points::{Point, pass},
    store::Job,
};

/// Jobs, or meshes, of one look.
const AT_ONCE: u32 = 100;
/// A mesh without a row is an orphan when it was written so long ago.
const ORPHANS_STAY: Duration = Duration::from_hours(1);

impl Jobs {
    /// Keeps the results of a job beyond their time, or no longer so.
    pub async fn pin(&self, id: &str, pinned: bool) -> Result<Job> {
        self.0.store.pin(id, pinned).await
    }

    /// Removes the checkpoint of a job that has ended, whose last epoch is this one.
    pub(super) async fn forget_checkpoint(&self, id: &str, epoch: u64) -> Result<()> {
        self.0.blobs.remove_pieces(id, epoch).await?;
        match self.0.store.checkpoint_gone(id).await {
            // Deleted a moment ago.
            Err(Error::NotFound(_)) => Ok(()),
            gone => gone,
        }
    }

    /// Removes checkpoints that stayed when their jobs ended: their server had died. To be called now and then.
    pub async fn sweep_checkpoints(&self) -> Result<()> {
        for (id, epoch) in self.0.store.useless_checkpoints(AT_ONCE).await? {
            self.forget_checkpoint(&id, epoch).await?;
        }
        Ok(())
    }

    /// Removes meshes that nobody wants, the objects of jobs that are no more, uploads that broke off long ago, and old
    /// entries of the audit table. To be called now and then; other servers, and this one, may be at work: a job has its
    /// row before it has objects, and meshes without a row are left alone while they may be on their way to one.
    pub async fn sweep_orphans(&self) -> Result<()> {
        self.0.store.forget_audit(self.0.limits.keep_audit).await?;
        self.0.store.forget_workers().await?;
        self.0.blobs.sweep_uploads().await?;
        self.0.store.note_inputs().await?;
        loop {
            let unused = self.0.store.forget_meshes(self.0.limits.keep_meshes, AT_ONCE).await?;
            pass(Point::MeshesForgotten);
            self.remove_unlisted(&unused).await?;
            if unused.len() < AT_ONCE as usize {
                break;
            }
        }
        let old = SystemTime::now() - ORPHANS_STAY;
        let meshes = self.0.blobs.meshes().await?.into_iter();
        for hash in meshes.filter(|(_, written)| *written < old).map(|(hash, _)| hash) {
            if self.0.store.mesh_size(&hash).await?.is_none() {
                self.remove_unlisted(&[hash]).await?;
            }
        }
        for id in self.0.blobs.jobs().await? {
            if !self.0.store.exists(&id).await? {
                self.0.blobs.remove_job(&id).await?;
            }
        }
        Ok(())
    }

    /// Removes the bytes of meshes, unless they have got a row.
    async fn remove_unlisted(&self, hashes: &[String]) -> Result<()> {
        for hash in hashes {
            let mut lock = self.0.store.lock_mesh(hash).await?;
            if !lock.is_stored().await? {
                self.0.blobs.remove_mesh(hash).await?;
            }
        }
        Ok(())
    }

    /// Deletes jobs whose time is up, with their logs; how many. To be called now and then.
    pub async fn sweep_jobs(&self) -> Result<usize> {
        let Some(kept_for) = self.0.limits.keep_jobs else { return Ok(0) };
        let mut n_swept = 0;
        for id in self.0.store.outdated(kept_for, AT_ONCE).await? {
            match self.delete(&id).await {
                Ok(()) => n_swept += 1,
                // Deleted or queued anew a moment ago.
                Err(Error::NotFound(_) | Error::Illegal { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(n_swept)
    }

    /// Removes results whose time is up; of how many jobs. To be called now and then.
    pub async fn sweep_results(&self) -> Result<usize> {
        let Some(kept_for) = self.0.limits.keep_results else { return Ok(0) };
        let mut n_swept = 0;
        for id in self.0.store.expired(kept_for, AT_ONCE).await? {
            let job = match self.0.store.forget_results(&id).await {
                // Deleted or pinned a moment ago.
                Ok(None) | Err(Error::NotFound(_)) => continue,
                forgotten => forgotten?,
            };
            let Some(job) = job else { continue };
            pass(Point::ResultsForgotten);
            self.0.blobs.remove_artifacts_before(&id, job.epoch + 1).await?;
            pass(Point::ResultsRemoved);
            self.0.store.results_gone(&id).await?;
            n_swept += 1;
        }
        Ok(n_swept)
    }
}
