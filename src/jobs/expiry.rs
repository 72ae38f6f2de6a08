//! Results have their time: after it they are removed, but for those of pinned jobs. Logs stay.

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
