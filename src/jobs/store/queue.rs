//! The order of the queue, and who has to make room.
//!
//! 1. The highest priority comes first; then the owner with the fewest jobs at work; then the one that has had least of
//!    the workers' time lately; then the oldest job.
//! 2. A claim costs as much as there are owners that wait, however many jobs they have: it looks at the ends of an
//!    index, never at all jobs.
//! 3. A job of higher priority that has waited a while for a worker gets that of a job of lower priority.

use sqlx::{AssertSqlSafe, Row, any::AnyRow};

use super::{Exclusive, Job, Store, Tx, fleet, job_of, now_ms, only, sql};
use crate::jobs::{
    error::Result,
    lease::{Claimant, Terms},
};

/// Time that an owner has had counts half as much after so long, in milliseconds.
const HALF_LIFE_MS: f64 = 3_600_000.0;
/// Jobs that are made room for at once.
const AT_ONCE: i64 = 64;

/// Jobs of one owner and priority that wait.
#[derive(Clone, Debug, PartialEq)]
pub struct Waiting {
    /// Whose.
    pub owner: String,
    /// Their priority.
    pub priority: i32,
    /// How many.
    pub n_jobs: u64,
    /// For how long the one has that has waited longest.
    pub oldest_secs: f64,
}

impl Store {
    /// How many jobs wait, and since when, by owner and priority, in this order. One look at an index of those that
    /// wait.
    pub async fn queue(&self) -> Result<Vec<Waiting>> {
        let mut conn = self.readers.acquire().await?;
        let query = "SELECT owner, priority, count(*) AS n_jobs, min(queued_ms) AS oldest_ms FROM jobs \
                     WHERE state = 'QUEUED' GROUP BY owner, priority ORDER BY owner, priority";
        let rows = sqlx::query(query).fetch_all(&mut *conn).await?;
        let now = now_ms(&mut conn).await?;
        let waiting = |row: &AnyRow| -> Result<Waiting> {
            let int = |column: &str| row.try_get::<i64, _>(column);
            Ok(Waiting {
                owner: row.try_get("owner")?,
                priority: int("priority")? as i32,
                n_jobs: int("n_jobs")? as u64,
                oldest_secs: (now - int("oldest_ms")?).max(0) as f64 / 1000.0,
            })
        };
        rows.iter().map(waiting).collect()
    }

    /// Asks workers to hand their jobs back where others of higher priority have waited too long; which jobs.
    pub async fn preempt(&self, terms: &Terms) -> Result<Vec<Job>> {
        let mut conn = self.readers.acquire().await?;
        let before = now_ms(&mut conn).await? - terms.preempt_after.as_millis() as i64;
        let n_waiting = waiting(&mut conn, before).await?.len();
        drop(conn);
        if n_waiting == 0 {
            return Ok(Vec::new());
        }
        transaction!(self, tx, {
            only(&mut tx, Exclusive::Preempt).await?;
            let waiting = waiting(&mut tx, before).await?;
            let query = "SELECT count(*) FROM jobs WHERE state = 'RUNNING' AND preempt = 1";
            let n_asked: i64 = sqlx::query_scalar(query).fetch_one(&mut *tx).await?;
            // Those that make room already do so for the highest of them.
            let waiting = waiting.into_iter().skip(n_asked as usize);
            let query = "SELECT * FROM jobs WHERE state = 'RUNNING' AND preempt = 0 \
                         AND cancel_requested = 0 ORDER BY priority, started_ms DESC, n DESC LIMIT $1 \
                         /*pg FOR UPDATE SKIP LOCKED */";
            let rows = sqlx::query(sql(&tx, query)).bind(AT_ONCE).fetch_all(&mut *tx).await?;
            let mut asked = Vec::new();
            for (priority, row) in waiting.zip(&rows) {
                let job = job_of(row)?;
                if i64::from(job.priority) >= priority {
                    break;
                }
                let update = sqlx::query("UPDATE jobs SET preempt = 1 WHERE id = $1").bind(&job.id);
                update.execute(&mut *tx).await?;
                asked.push(job);
            }
            Ok(asked)
        })
    }
}

/// The priorities of jobs that have waited since `before`, where one of lower priority is at work; highest first.
async fn waiting(conn: &mut sqlx::AnyConnection, before: i64) -> Result<Vec<i64>> {
    let query = "SELECT priority FROM jobs WHERE state = 'QUEUED' AND queued_ms < $1 \
                 AND priority > (SELECT min(priority) FROM jobs WHERE state = 'RUNNING') \
                 ORDER BY priority DESC LIMIT $2";
    Ok(sqlx::query_scalar(query).bind(before).bind(AT_ONCE).fetch_all(conn).await?)
}

/// The job that this worker should have, locked; one that its host has lost only where nobody else could have it.
pub(super) async fn next(
    tx: &mut Tx,
    who: &Claimant,
    terms: &Terms,
    now: i64,
) -> Result<Option<Job>> {
    let mut below = i64::MAX;
    while let Some(priority) = highest(tx, below).await? {
        for owner in by_share(tx, priority).await? {
            if let Some(job) = oldest(tx, who, (priority, &owner), now).await? {
                return Ok(Some(job));
            }
        }
        below = priority;
    }
    left_over(tx, who, terms, now).await
}

/// The oldest job of an owner and a priority that the host has not lost.
async fn oldest(
    tx: &mut Tx,
    who: &Claimant,
    (priority, owner): (i64, &str),
    now: i64,
) -> Result<Option<Job>> {
    let query = format!(
        "SELECT * FROM jobs WHERE state = 'QUEUED' AND priority = $3 AND owner BETWEEN $4 AND $4 \
         AND {} ORDER BY owner, n LIMIT 1 /*pg FOR UPDATE SKIP LOCKED */",
        fleet::UNSHUNNED
    );
    let query = sqlx::query(sql(tx, &query)).bind(&who.host).bind(fleet::shunned_since(now));
    let row = query.bind(priority).bind(owner).fetch_optional(&mut **tx).await?;
    row.as_ref().map(job_of).transpose()
}

/// A job that the host has lost, and that no other host could have instead.
async fn left_over(tx: &mut Tx, who: &Claimant, terms: &Terms, now: i64) -> Result<Option<Job>> {
    let query = format!(
        "SELECT * FROM jobs WHERE state = 'QUEUED' AND {} ORDER BY priority DESC, n LIMIT 1 \
         /*pg FOR UPDATE SKIP LOCKED */",
        fleet::NOBODY_ELSE_S
    );
    let query = sqlx::query(sql(tx, &query)).bind(&who.host).bind(fleet::shunned_since(now));
    let query = query.bind(now).bind(fleet::alive_since(now, terms));
    query.fetch_optional(&mut **tx).await?.as_ref().map(job_of).transpose()
}

/// The highest priority below one.
async fn highest(tx: &mut Tx, below: i64) -> Result<Option<i64>> {
    let query = "SELECT max(priority) FROM jobs WHERE state = 'QUEUED' AND priority < $1";
    Ok(sqlx::query_scalar(query).bind(below).fetch_one(&mut **tx).await?)
}

/// The owners of jobs that wait with this priority, in the order of their turns. From one owner the index leads to
/// the next, past all jobs of the first. What is asked in the index's order, with a range for the owner, keeps PostgreSQL
/// from looking through all jobs by number.
const BY_SHARE: &str = "WITH RECURSIVE waiting (owner) AS ( \
    SELECT (SELECT owner FROM jobs WHERE state = 'QUEUED' AND priority = $1 ORDER BY owner LIMIT 1) \
    UNION ALL \
    SELECT (SELECT jobs.owner FROM jobs WHERE state = 'QUEUED' AND priority = $1 \
    AND jobs.owner > waiting.owner ORDER BY jobs.owner LIMIT 1) \
    FROM waiting WHERE waiting.owner IS NOT NULL) \
    SELECT waiting.owner FROM waiting LEFT JOIN shares ON shares.owner = waiting.owner \
    WHERE waiting.owner IS NOT NULL \
    ORDER BY (SELECT count(*) FROM jobs WHERE state = 'RUNNING' AND jobs.owner = waiting.owner), \
    COALESCE(shares.score, 0), \
    (SELECT n FROM jobs WHERE state = 'QUEUED' AND priority = $1 \
    AND jobs.owner BETWEEN waiting.owner AND waiting.owner ORDER BY jobs.owner, n LIMIT 1)";

async fn by_share(tx: &mut Tx, priority: i64) -> Result<Vec<String>> {
    Ok(sqlx::query_scalar(AssertSqlSafe(BY_SHARE)).bind(priority).fetch_all(&mut **tx).await?)
}

/// An owner has had a worker for so long.
pub(super) async fn served(tx: &mut Tx, owner: &str, took_ms: i64, now: i64) -> Result<()> {
    let query = "SELECT score FROM shares WHERE owner = $1 /*pg FOR UPDATE */";
    let query = sqlx::query_scalar::<_, f64>(sql(tx, query)).bind(owner);
    let score = grown(query.fetch_optional(&mut **tx).await?, took_ms, now);
    let upsert = "INSERT INTO shares (owner, score) VALUES ($1, $2) \
                  ON CONFLICT (owner) DO UPDATE SET score = excluded.score";
    sqlx::query(upsert).bind(owner).bind(score).execute(&mut **tx).await?;
    Ok(())
}

/// What an owner has had, with `took_ms` more. Time that was had earlier counts less and less; instead of all owners'
/// numbers falling with time, that of this one rises: the logarithm of what it has had by now, in powers of two of
/// milliseconds, and one for each half-life since 1970. So numbers of different times can be compared.
fn grown(score: Option<f64>, took_ms: i64, now_ms: i64) -> f64 {
    let now = now_ms as f64 / HALF_LIFE_MS;
    let before = score.map_or(0.0, |score| (score - now).exp2());
    (before + took_ms.max(1) as f64).log2() + now
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_add_up_and_are_forgotten() {
        let now = 1_795_000_000_000;
        let hour = HALF_LIFE_MS as i64;
        let once = grown(None, 1000, now);
        let twice = grown(Some(once), 1000, now);
        assert!((twice - once - 1.0).abs() < 1e-6, "twice as much");
        // What was had an hour ago is as much as half of it now.
        let then = grown(None, 2000, now - hour);
        assert!((then - once).abs() < 1e-6);
        assert!(grown(Some(once), 0, now) > once && once > 0.0);
    }
}
