//! Results whose time is up: which they are, and how far their removal is.
//!
//! Rows go first, bytes second, and both are noted: whoever dies in between leaves nothing that nobody removes.

use std::time::Duration;

use super::{Job, Store, find_to_write, now_ms};
use crate::jobs::error::Result;

impl Store {
    /// Keeps the results of a job beyond their time, or no longer so.
    pub async fn pin(&self, id: &str, pinned: bool) -> Result<Job> {
        transaction!(self, tx, {
            let mut job = find_to_write(&mut tx, id).await?;
            job.pinned = pinned;
            let update = sqlx::query("UPDATE jobs SET pinned = $1 WHERE id = $2");
            update.bind(i64::from(pinned)).bind(id).execute(&mut *tx).await?;
            Ok(job)
        })
    }

    /// At most `limit` jobs whose results are to be removed: they ended so long ago and are not pinned, or
    /// somebody has begun.
    pub async fn expired(&self, kept_for: Duration, limit: u32) -> Result<Vec<String>> {
        let age_ms = i64::try_from(kept_for.as_millis()).unwrap_or(i64::MAX);
        let now = now_ms(&mut *self.readers.acquire().await?).await?;
        let query = "SELECT id FROM jobs WHERE swept < 2 AND ended_ms <= $1 \
                     AND (pinned = 0 OR swept = 1) ORDER BY ended_ms, n LIMIT $2";
        let query = sqlx::query_scalar(query).bind(now.saturating_sub(age_ms));
        Ok(query.bind(i64::from(limit)).fetch_all(&self.readers).await?)
    }

    /// Forgets the results of an ended job, unless it is pinned; the job, if so, whose bytes may go.
    pub async fn forget_results(&self, id: &str) -> Result<Option<Job>> {
        transaction!(self, tx, {
            let mut job = find_to_write(&mut tx, id).await?;
            if !job.state.is_final() || (job.pinned && !job.results_removed) {
                return Ok(None);
            }
            sqlx::query("DELETE FROM artifacts WHERE job = $1").bind(id).execute(&mut *tx).await?;
            let update = sqlx::query("UPDATE jobs SET swept = 1 WHERE id = $1 AND swept = 0");
            update.bind(id).execute(&mut *tx).await?;
            job.results_removed = true;
            Ok(Some(job))
        })
    }

    /// At most `limit` jobs whose time is up: they ended so long ago and are not pinned.
    pub async fn outdated(&self, kept_for: Duration, limit: u32) -> Result<Vec<String>> {
        let age_ms = i64::try_from(kept_for.as_millis()).unwrap_or(i64::MAX);
        let now = now_ms(&mut *self.readers.acquire().await?).await?;
        let query =
            "SELECT id FROM jobs WHERE ended_ms <= $1 AND pinned = 0 ORDER BY ended_ms LIMIT $2";
        let query = sqlx::query_scalar(query).bind(now.saturating_sub(age_ms));
        Ok(query.bind(i64::from(limit)).fetch_all(&self.readers).await?)
    }

    /// Notes that the bytes of a job's results are gone.
    pub async fn results_gone(&self, id: &str) -> Result<()> {
        let update = sqlx::query("UPDATE jobs SET swept = 2 WHERE id = $1 AND swept = 1");
        update.bind(id).execute(&self.writers).await?;
        Ok(())
    }
}
