//! What clients ask of the database: meshes, jobs, logs, artifacts.

use std::time::Duration;

use sqlx::{QueryBuilder, Row, Sqlite, Transaction};

use super::{Artifact, Job, State, Store, StoredEvent, event_of, find, job_of, log, now_ms};
use super::{owners, state_entry, stored};
use crate::jobs::{
    Limits,
    error::{Error, Result},
    spec::Spec,
    state::Trigger,
};

/// A job to be created. The caller has validated it.
#[derive(Clone, Debug, PartialEq)]
pub struct NewJob {
    /// Whose it will be.
    pub owner: String,
    /// Names the request among its owner's; empty for a request that may not be repeated.
    pub request_id: String,
    /// Hash of the input.
    pub mesh: String,
    /// The input's file name.
    pub file_name: String,
    /// What to do.
    pub spec: Spec,
}

impl Store {
    /// Notes that the bytes of a mesh are stored; false when that was known.
    pub async fn add_mesh(&self, hash: &str, size: u64) -> Result<bool> {
        let mut tx = self.begin().await?;
        let now = now_ms(&mut tx).await?;
        let touched = touch_mesh(&mut tx, hash, now).await?;
        let insert = sqlx::query("INSERT INTO meshes VALUES (?, ?, ?) ON CONFLICT DO NOTHING");
        let done = insert.bind(hash).bind(size as i64).bind(now).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(!touched && done.rows_affected() == 1)
    }

    /// Notes that a client asked for a stored mesh; false when there is none.
    pub async fn touch_mesh(&self, hash: &str) -> Result<bool> {
        let mut tx = self.begin().await?;
        let now = now_ms(&mut tx).await?;
        let found = touch_mesh(&mut tx, hash, now).await?;
        tx.commit().await?;
        Ok(found)
    }

    /// Forgets the meshes that no job names and that nobody uploaded or asked for in so long; their
    /// hashes.
    pub async fn forget_meshes(&self, unused_for: Duration) -> Result<Vec<String>> {
        let mut tx = self.begin().await?;
        let age_ms = i64::try_from(unused_for.as_millis()).unwrap_or(i64::MAX);
        let before = now_ms(&mut tx).await?.saturating_sub(age_ms);
        let delete = "DELETE FROM meshes WHERE created_ms <= ? \
                      AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.mesh = meshes.hash \
                      OR json_extract(jobs.spec, '$.simplified.mesh') = meshes.hash) \
                      RETURNING hash";
        let delete = sqlx::query_scalar::<_, String>(delete).bind(before);
        let hashes = delete.fetch_all(&mut *tx).await?;
        tx.commit().await?;
        Ok(hashes)
    }

    /// Creates a job under `id`, unless its request already made one; says whether it is new.
    pub async fn create(&self, id: &str, new: &NewJob, limits: &Limits) -> Result<(Job, bool)> {
        let mut tx = self.begin().await?;
        if let Some(job) = owners::requested(&mut tx, new).await? {
            return Ok((same_request(job, new)?, false));
        }
        owners::check_queue(&mut tx, &new.owner, limits.max_owner_queued).await?;
        let query =
            sqlx::query_scalar::<_, i64>("SELECT count(*) FROM jobs WHERE state = 'QUEUED'");
        if query.fetch_one(&mut *tx).await? as u64 >= limits.max_queued {
            return Err(Error::QueueFull(limits.max_queued));
        }
        let now = now_ms(&mut tx).await?;
        let spec = serde_json::to_string(&new.spec).map_err(stored("the specification"))?;
        let insert = "INSERT INTO jobs (id, owner, mesh, file_name, spec, state, created_ms) \
                      VALUES (?, ?, ?, ?, ?, ?, ?)";
        let insert = sqlx::query(insert).bind(id).bind(&new.owner).bind(&new.mesh);
        let insert = insert.bind(&new.file_name).bind(spec).bind(State::Queued.name()).bind(now);
        insert.execute(&mut *tx).await?;
        owners::note_request(&mut tx, new, id).await?;
        let mut job = find(&mut tx, id).await?;
        let entry = state_entry(&job, "CREATED", "waiting for a worker".into());
        log(&mut tx, &mut job, now, &[entry]).await?;
        tx.commit().await?;
        Ok((job, true))
    }

    /// One job.
    pub async fn job(&self, id: &str) -> Result<Job> {
        find(&mut *self.readers.acquire().await?, id).await
    }

    /// Jobs of `owner` (everybody's where there is none) in one of `states` (all when empty), newest
    /// first, older than the job numbered `before`.
    pub async fn list(
        &self,
        owner: Option<&str>,
        states: &[State],
        before: Option<i64>,
        limit: u32,
    ) -> Result<Vec<Job>> {
        let mut query = QueryBuilder::<Sqlite>::new("SELECT * FROM jobs WHERE n < ");
        query.push_bind(before.unwrap_or(i64::MAX));
        if let Some(owner) = owner {
            query.push(" AND owner = ").push_bind(owner);
        }
        if !states.is_empty() {
            query.push(" AND state IN (");
            let mut list = query.separated(", ");
            for state in states {
                list.push_bind(state.name());
            }
            query.push(")");
        }
        query.push(" ORDER BY n DESC LIMIT ").push_bind(limit);
        query.build().fetch_all(&self.readers).await?.iter().map(job_of).collect()
    }

    /// How many jobs are in each state.
    pub async fn counts(&self) -> Result<Vec<(State, u64)>> {
        let query = "SELECT count(*) FROM jobs WHERE state = ?";
        let mut counts = Vec::with_capacity(State::ALL.len());
        for state in State::ALL {
            let query = sqlx::query_scalar::<_, i64>(query).bind(state.name());
            counts.push((state, query.fetch_one(&self.readers).await? as u64));
        }
        Ok(counts)
    }

    /// At most `limit` entries of a log after `after_seq`, in order.
    pub async fn events(&self, id: &str, after_seq: u64, limit: u32) -> Result<Vec<StoredEvent>> {
        let query = "SELECT * FROM events WHERE job = ? AND seq > ? ORDER BY seq LIMIT ?";
        let after_seq = i64::try_from(after_seq).unwrap_or(i64::MAX);
        let query = sqlx::query(query).bind(id).bind(after_seq).bind(limit);
        query.fetch_all(&self.readers).await?.iter().map(event_of).collect()
    }

    /// Cancels a queued job, or asks the worker of a running one to stop; says whether this call
    /// ended the job.
    pub async fn cancel(&self, id: &str) -> Result<(Job, bool)> {
        let mut tx = self.begin().await?;
        let mut job = find(&mut tx, id).await?;
        if job.state == State::Cancelled || job.cancel_requested {
            return Ok((job, false));
        }
        let remedy = "only a job that waits or runs can be cancelled";
        let Some(state) = job.state.after(Trigger::Cancel) else {
            return Err(Error::Illegal { job: job.name(), state: job.state, remedy });
        };
        let now = now_ms(&mut tx).await?;
        job.cancel_requested = true;
        if job.state == State::Running {
            let update = sqlx::query("UPDATE jobs SET cancel_requested = 1 WHERE id = ?");
            update.bind(id).execute(&mut *tx).await?;
        } else {
            job.state = state;
            job.ended_ms = Some(now);
            let update =
                "UPDATE jobs SET cancel_requested = 1, state = ?, ended_ms = ? WHERE id = ?";
            let update = sqlx::query(update).bind(job.state.name()).bind(now).bind(id);
            update.execute(&mut *tx).await?;
            let entry = state_entry(&job, "CANCELLED", "cancelled on request".into());
            log(&mut tx, &mut job, now, &[entry]).await?;
        }
        tx.commit().await?;
        let has_ended = job.state.is_final();
        Ok((job, has_ended))
    }

    /// Deletes an ended job, with its log and the list of its artifacts.
    pub async fn delete(&self, id: &str) -> Result<()> {
        let mut tx = self.begin().await?;
        let job = find(&mut tx, id).await?;
        if !job.state.is_final() {
            let remedy = "cancel it first";
            return Err(Error::Illegal { job: job.name(), state: job.state, remedy });
        }
        sqlx::query("DELETE FROM jobs WHERE id = ?").bind(id).execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(())
    }

    /// The artifacts of the attempt that ended the job, by name; none while it has not ended.
    pub async fn artifacts(&self, id: &str) -> Result<(Job, Vec<Artifact>)> {
        let job = self.job(id).await?;
        if !job.state.is_final() {
            return Ok((job, Vec::new()));
        }
        let query = "SELECT * FROM artifacts WHERE job = ? AND epoch = ? ORDER BY file";
        let query = sqlx::query(query).bind(id).bind(job.epoch as i64);
        let rows = query.fetch_all(&self.readers).await?;
        let artifact = |row: &sqlx::sqlite::SqliteRow| -> Result<Artifact> {
            Ok(Artifact {
                file: row.try_get("file")?,
                media_type: row.try_get("media_type")?,
                size: row.try_get::<i64, _>("size")? as u64,
                blake3: row.try_get("blake3")?,
            })
        };
        let artifacts = rows.iter().map(artifact).collect::<Result<_>>()?;
        Ok((job, artifacts))
    }

    /// Whether there is such a job.
    pub async fn exists(&self, id: &str) -> Result<bool> {
        let query = sqlx::query_scalar::<_, i64>("SELECT count(*) FROM jobs WHERE id = ?");
        Ok(query.bind(id).fetch_one(&self.readers).await? == 1)
    }
}

/// Makes a mesh as young as if it were stored now; false when there is none.
async fn touch_mesh(tx: &mut Transaction<'static, Sqlite>, hash: &str, now: i64) -> Result<bool> {
    let update = sqlx::query("UPDATE meshes SET created_ms = ? WHERE hash = ?");
    let done = update.bind(now).bind(hash).execute(&mut **tx).await?;
    Ok(done.rows_affected() == 1)
}

/// The job an earlier request made, if this one asks for the same.
fn same_request(job: Job, new: &NewJob) -> Result<Job> {
    let same = (&job.mesh, &job.file_name, &job.spec) == (&new.mesh, &new.file_name, &new.spec);
    if same { Ok(job) } else { Err(Error::RequestIdReused(new.request_id.clone())) }
}
