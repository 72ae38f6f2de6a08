//! Results have their time, and jobs with their logs have theirs: after it they are removed, unless they are pinned.
//! Checkpoints end with their jobs.

use super::{
    Jobs,
    error::{Error, Result},
    points::{Point, pass},
    store::Job,
};

/// Jobs of one look.
const AT_ONCE: u32 = 100;

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
