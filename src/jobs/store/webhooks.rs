//! Calls that tell of the end of a job: noted with the job, due with its end, each in the same transaction.
//!
//! Whoever takes a call has it for a while; when nothing is heard of it by then it is due again. So a call is
//! made at least once, whatever is killed.

use std::time::Duration;

use sqlx::{AnyConnection, Row};

use super::{Job, NewJob, Store, Tx, find, now_ms, sql, storable};
use crate::jobs::error::Result;

/// A call to be made now.
#[derive(Clone, Debug, PartialEq)]
pub struct DueCall {
    /// Names the call: the same at each attempt.
    pub id: String,
    /// Whom to call.
    pub url: String,
    /// Number of this attempt, from 1.
    pub attempt: u32,
    /// The job, which has ended.
    pub job: Job,
}

/// What becomes of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CallEnd {
    /// It was heard.
    Delivered,
    /// It was not, for this reason, and will be made again after a while.
    Again(String, Duration),
    /// It was not, for this reason, and nobody will try again.
    GivenUp(String),
}

impl Store {
    /// Takes at most `limit` calls that are due, and has them for a while. Each owner's first one comes before anybody's
    /// second.
    pub async fn take_calls(&self, limit: u32, held_for: Duration) -> Result<Vec<DueCall>> {
        let now = now_ms(&mut *self.readers.acquire().await?).await?;
        let query = "SELECT count(*) FROM webhooks WHERE next_ms <= $1";
        if sqlx::query_scalar::<_, i64>(query).bind(now).fetch_one(&self.readers).await? == 0 {
            return Ok(Vec::new());
        }
        transaction!(self, tx, {
            // What another server has taken is its own.
            let query = "SELECT job, id, url, attempts FROM webhooks \
                         WHERE next_ms <= $1 AND job IN (SELECT job FROM ( \
                         SELECT due.job, due.next_ms, row_number() OVER ( \
                         PARTITION BY jobs.owner ORDER BY due.next_ms, due.job) AS turn \
                         FROM webhooks AS due JOIN jobs ON jobs.id = due.job \
                         WHERE due.next_ms <= $1) AS in_turn ORDER BY turn, next_ms, job LIMIT $2) \
                         ORDER BY next_ms, job /*pg FOR UPDATE SKIP LOCKED */";
            let query = sqlx::query(sql(&tx, query)).bind(now).bind(i64::from(limit));
            let rows = query.fetch_all(&mut *tx).await?;
            let mut due = Vec::with_capacity(rows.len());
            for row in &rows {
                let job = find(&mut tx, row.try_get("job")?).await?;
                let attempt = row.try_get::<i64, _>("attempts")? + 1;
                let update = "UPDATE webhooks SET attempts = $1, next_ms = $2 WHERE job = $3";
                let until = now.saturating_add(held_for.as_millis() as i64);
                let update = sqlx::query(update).bind(attempt).bind(until).bind(&job.id);
                update.execute(&mut *tx).await?;
                let (id, url) = (row.try_get("id")?, row.try_get("url")?);
                due.push(DueCall { id, url, attempt: attempt as u32, job });
            }
            Ok(due)
        })
    }

    /// Notes how an attempt ended, unless a later one has begun.
    pub async fn end_call(&self, call: &DueCall, end: &CallEnd) -> Result<()> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            let (outcome, next_ms) = match end {
                CallEnd::Delivered => ("DELIVERED", None),
                CallEnd::Again(why, pause) => {
                    (why.as_str(), Some(now.saturating_add(pause.as_millis() as i64)))
                }
                CallEnd::GivenUp(why) => (why.as_str(), None),
            };
            let update = "UPDATE webhooks SET outcome = $1, next_ms = $2 WHERE job = $3 AND attempts = $4 AND id = $5";
            let update = sqlx::query(update).bind(storable(outcome)).bind(next_ms);
            let update = update.bind(&call.job.id).bind(i64::from(call.attempt)).bind(&call.id);
            update.execute(&mut *tx).await?;
            Ok(())
        })
    }
}

/// Notes whom to call at the end of a new job, if anybody.
pub(super) async fn note(tx: &mut Tx, new: &NewJob, job: &str) -> Result<()> {
    if !new.webhook.is_empty() {
        let id = uuid::Uuid::new_v4().to_string();
        let insert = sqlx::query("INSERT INTO webhooks (job, id, url) VALUES ($1, $2, $3)");
        let insert = insert.bind(job).bind(id).bind(storable(&new.webhook));
        insert.execute(&mut **tx).await?;
    }
    Ok(())
}

/// The job begins anew: its next end is another one, to be told of by a call of another name.
pub(super) async fn renew(tx: &mut Tx, job: &str) -> Result<()> {
    let update =
        "UPDATE webhooks SET id = $1, next_ms = NULL, attempts = 0, outcome = '' WHERE job = $2";
    let id = uuid::Uuid::new_v4().to_string();
    sqlx::query(update).bind(id).bind(job).execute(&mut **tx).await?;
    Ok(())
}

/// The job has ended at `now`: whoever wants to know is called from then on.
pub(super) async fn due(conn: &mut AnyConnection, job: &str, now: i64) -> Result<()> {
    let update = sqlx::query("UPDATE webhooks SET next_ms = $1 WHERE job = $2");
    update.bind(now).bind(job).execute(conn).await?;
    Ok(())
}
