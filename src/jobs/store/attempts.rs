//! The history of attempts: who had a job, on which host, and how it ended.
//!
//! A row is begun with the claim and finished with whatever ends the attempt, in the same transactions.

use sqlx::{AnyConnection, Row, any::AnyRow};

use super::{Job, Store, Tx, queue, storable};
use crate::jobs::{error::Result, lease};

/// An attempt of a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attempt {
    /// Number, from 1.
    pub attempt: u32,
    /// Epoch of its lease.
    pub epoch: u64,
    /// The incarnation of the worker.
    pub worker: String,
    /// Where it ran.
    pub host: String,
    /// When it began, milliseconds since 1970.
    pub started_ms: i64,
    /// When it ended.
    pub ended_ms: Option<i64>,
    /// How it ended: a stable upper-snake-case code; empty while it goes on.
    pub reason: String,
    /// The same in a sentence.
    pub detail: String,
    /// It was lost in a way that may be the job's doing.
    pub counts: bool,
}

/// How an attempt ended.
#[derive(Clone, Copy, Debug)]
pub(super) struct Finish<'a> {
    pub reason: &'a str,
    pub detail: &'a str,
    pub counts: bool,
    pub now: i64,
}

impl Store {
    /// At most `limit` attempts of a job, the latest first.
    pub async fn attempts(&self, id: &str, limit: u32) -> Result<Vec<Attempt>> {
        let query = "SELECT * FROM attempts WHERE job = $1 ORDER BY epoch DESC LIMIT $2";
        let query = sqlx::query(query).bind(storable(id)).bind(i64::from(limit));
        query.fetch_all(&self.readers).await?.iter().map(attempt_of).collect()
    }
}

/// An attempt of `job` begins on `host`.
pub(super) async fn begin(tx: &mut Tx, job: &Job, host: &str, now: i64) -> Result<()> {
    let insert = "INSERT INTO attempts (job, epoch, attempt, worker, host, started_ms) \
                  VALUES ($1, $2, $3, $4, $5, $6)";
    let insert = sqlx::query(insert).bind(&job.id).bind(job.epoch as i64);
    let insert = insert.bind(i64::from(job.attempt)).bind(&job.worker).bind(host).bind(now);
    insert.execute(&mut **tx).await?;
    Ok(())
}

/// The attempt of `job` ends, unless it has ended already.
pub(super) async fn finish(tx: &mut Tx, job: &Job, finish: Finish<'_>) -> Result<()> {
    let update = "UPDATE attempts SET ended_ms = $1, reason = $2, detail = $3, counts = $4 \
                  WHERE job = $5 AND epoch = $6 AND ended_ms IS NULL";
    let update = sqlx::query(update).bind(finish.now).bind(storable(finish.reason));
    let update = update.bind(storable(finish.detail)).bind(i64::from(finish.counts));
    let done = update.bind(&job.id).bind(job.epoch as i64).execute(&mut **tx).await?;
    if done.rows_affected() == 1 {
        let took_ms = finish.now - job.started_ms.unwrap_or(finish.now);
        queue::served(tx, &job.owner, took_ms, finish.now).await?;
    }
    Ok(())
}

/// How much speaks against a job.
pub(super) async fn blame(tx: &mut Tx, job: &str) -> Result<u32> {
    let query = "SELECT count(DISTINCT worker) AS n_workers, count(*) AS n_losses FROM attempts \
                 WHERE job = $1 AND counts = 1";
    let row = sqlx::query(query).bind(job).fetch_one(&mut **tx).await?;
    let n = |column: &str| row.try_get::<i64, _>(column).map(|n| n as u32);
    Ok(lease::blame(n("n_workers")?, n("n_losses")?))
}

/// Where the attempt under this lease runs.
pub(super) async fn host_of(conn: &mut AnyConnection, job: &Job) -> Result<Option<String>> {
    let query = "SELECT host FROM attempts WHERE job = $1 AND epoch = $2";
    let query = sqlx::query_scalar(query).bind(&job.id).bind(job.epoch as i64);
    Ok(query.fetch_optional(conn).await?)
}

fn attempt_of(row: &AnyRow) -> Result<Attempt> {
    let int = |column: &str| row.try_get::<i64, _>(column);
    Ok(Attempt {
        attempt: int("attempt")? as u32,
        epoch: int("epoch")? as u64,
        worker: row.try_get("worker")?,
        host: row.try_get("host")?,
        started_ms: int("started_ms")?,
        ended_ms: row.try_get("ended_ms")?,
        reason: row.try_get("reason")?,
        detail: row.try_get("detail")?,
        counts: int("counts")? != 0,
    })
}
