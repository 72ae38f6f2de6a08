//! The hosts that workers run on: who is there, who is out of service, and which jobs suit whom.
//!
//! 1. A host that loses several different jobs in a row, with no job done in between, gets none for a while. Jobs
//!    that another host has lost too say nothing about it: they may be the bad ones.
//! 2. A job that a host has lost goes to another one as long as there is one that has not.
//!
//! Rows are written seldom, so that claims do not wait for one another.

use std::time::Duration;

use sqlx::{Row, any::AnyRow};

use super::{Job, Store, Tx, attempts, now_ms};
use crate::jobs::{
    error::{Error, Result},
    lease::{Claimant, Terms},
};

/// A host keeps away from a job that it has lost for so long, if others are there.
const SHUNS: Duration = Duration::from_mins(5);
/// A host that nobody has heard of for so long is forgotten, unless somebody has drained it.
const STAYS: Duration = Duration::from_hours(24);

/// A host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Worker {
    /// Its name.
    pub host: String,
    /// The incarnation that was last heard of.
    pub worker: String,
    /// Version of that one's program.
    pub version: String,
    /// When it was last heard of, give or take some seconds; milliseconds since 1970.
    pub seen_ms: i64,
    /// It gets no jobs before then.
    pub quarantined_until_ms: Option<i64>,
    /// Why that is.
    pub why: String,
    /// It works no more until somebody reinstates it.
    pub drained: bool,
}

/// Whether a host gets jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Service {
    /// It does.
    In,
    /// It has lost too many, and gets none for a while.
    Quarantined,
    /// An administrator wants it to work no more.
    Drained,
}

impl Service {
    /// Every way, and its name.
    pub const ALL: [(Self, &str); 3] =
        [(Self::In, "in_service"), (Self::Quarantined, "quarantined"), (Self::Drained, "drained")];
}

impl Worker {
    /// Whether it gets jobs.
    pub fn service(&self) -> Service {
        match (self.drained, self.quarantined_until_ms) {
            (true, _) => Service::Drained,
            (false, Some(_)) => Service::Quarantined,
            (false, None) => Service::In,
        }
    }
}

impl Store {
    /// All hosts, by name.
    pub async fn workers(&self) -> Result<Vec<Worker>> {
        let mut conn = self.readers.acquire().await?;
        let now = now_ms(&mut conn).await?;
        let rows = sqlx::query("SELECT * FROM workers ORDER BY host").fetch_all(&mut *conn).await?;
        rows.iter().map(|row| worker_of(row, now)).collect()
    }

    /// Forgets hosts that have long been gone.
    pub async fn forget_workers(&self) -> Result<()> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            let delete = "DELETE FROM workers WHERE seen_ms < $1 AND drained = 0 \
                          AND quarantined_until_ms <= $2";
            let delete = sqlx::query(delete).bind(now - STAYS.as_millis() as i64).bind(now);
            delete.execute(&mut *tx).await?;
            Ok(())
        })
    }

    /// A host is to work no more, until somebody reinstates it.
    pub async fn drain(&self, host: &str) -> Result<Worker> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            let update = sqlx::query("UPDATE workers SET drained = 1 WHERE host = $1");
            update.bind(host).execute(&mut *tx).await?;
            let worker = find(&mut tx, host, now).await?;
            worker.ok_or_else(|| Error::NotFound(format!("workers/{host}")))
        })
    }

    /// Somebody vouches for a host: what it has lost so far does not speak against it any more.
    pub async fn reinstate(&self, host: &str) -> Result<Worker> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            let update = "UPDATE workers SET drained = 0, quarantined_until_ms = 0, why = '', sound_ms = $1 \
                          WHERE host = $2";
            sqlx::query(update).bind(now).bind(host).execute(&mut *tx).await?;
            let worker = find(&mut tx, host, now).await?;
            worker.ok_or_else(|| Error::NotFound(format!("workers/{host}")))
        })
    }
}

/// A host asks for a job; the refusal, when it is out of service or found to be bad.
pub(super) async fn check_in(
    tx: &mut Tx,
    who: &Claimant,
    terms: &Terms,
    now: i64,
) -> Result<Option<Error>> {
    let upsert = "INSERT INTO workers (host, worker, version, seen_ms) VALUES ($1, $2, $3, $4) \
                  ON CONFLICT (host) DO UPDATE SET worker = excluded.worker, \
                  version = excluded.version, seen_ms = excluded.seen_ms \
                  WHERE workers.worker <> excluded.worker OR workers.seen_ms < $5";
    let upsert = sqlx::query(upsert).bind(&who.host).bind(&who.worker).bind(&who.version);
    upsert.bind(now).bind(now - seldom(terms)).execute(&mut **tx).await?;
    let Some(worker) = find(tx, &who.host, now).await? else { return Ok(None) };
    let Worker { host, why, quarantined_until_ms: until_ms, drained, .. } = worker;
    if drained {
        let why = "an administrator has drained it".into();
        return Ok(Some(Error::OutOfService { host, why, until_ms: None, is_news: false }));
    }
    if until_ms.is_some() {
        return Ok(Some(Error::OutOfService { host, why, until_ms, is_news: false }));
    }
    judge(tx, host, terms, now).await
}

/// Takes a host out of service that has lost too many jobs in a row, and says why.
async fn judge(tx: &mut Tx, host: String, terms: &Terms, now: i64) -> Result<Option<Error>> {
    let lost = lost_in_a_row(tx, &host, terms.max_in_a_row).await?;
    if lost.len() < terms.max_in_a_row as usize {
        return Ok(None);
    }
    let why = format!("it has lost {} jobs in a row ({})", lost.len(), lost.join("; "));
    let until = now.saturating_add(terms.quarantine.as_millis() as i64);
    // When it is back it begins anew.
    let update = "UPDATE workers SET quarantined_until_ms = $1, why = $2, sound_ms = $3 \
                  WHERE host = $4 AND quarantined_until_ms <= $3";
    let update = sqlx::query(update).bind(until).bind(&why).bind(now).bind(&host);
    let is_news = update.execute(&mut **tx).await?.rows_affected() == 1;
    Ok(Some(Error::OutOfService { host, why, until_ms: Some(until), is_news }))
}

/// What a host has lost since it last did a job, and no other host has lost: a clause for each of at most
/// `limit` jobs.
async fn lost_in_a_row(tx: &mut Tx, host: &str, limit: u32) -> Result<Vec<String>> {
    let query = "SELECT mine.job AS job, max(mine.reason) AS reason FROM attempts mine \
                 JOIN workers ON workers.host = mine.host \
                 WHERE mine.host = $1 AND mine.counts = 1 AND mine.ended_ms > workers.sound_ms \
                 AND NOT EXISTS (SELECT 1 FROM attempts others WHERE others.job = mine.job \
                 AND others.counts = 1 AND others.host <> mine.host) \
                 GROUP BY mine.job ORDER BY mine.job LIMIT $2";
    let query = sqlx::query(query).bind(host).bind(i64::from(limit));
    let rows = query.fetch_all(&mut **tx).await?;
    let clause = |row: &AnyRow| -> Result<String> {
        let (job, reason): (String, String) = (row.try_get("job")?, row.try_get("reason")?);
        Ok(format!("jobs/{job}: {reason}"))
    };
    rows.iter().map(clause).collect()
}

/// The worker of a running job was heard of; whether its host is to be drained.
pub(super) async fn seen(tx: &mut Tx, job: &Job, terms: &Terms, now: i64) -> Result<bool> {
    let Some(host) = attempts::host_of(tx, job).await? else { return Ok(false) };
    let update = "UPDATE workers SET seen_ms = $1 WHERE host = $2 AND seen_ms < $3";
    let update = sqlx::query(update).bind(now).bind(&host).bind(now - seldom(terms));
    update.execute(&mut **tx).await?;
    Ok(find(tx, &host, now).await?.is_some_and(|worker| worker.drained))
}

/// The worker of a running job has done it: its host is sound.
pub(super) async fn is_sound(tx: &mut Tx, job: &Job, now: i64) -> Result<()> {
    let Some(host) = attempts::host_of(tx, job).await? else { return Ok(()) };
    // Most have lost nothing that could be held against them.
    let update = "UPDATE workers SET sound_ms = $1 WHERE host = $2 AND EXISTS \
                  (SELECT 1 FROM attempts WHERE attempts.host = workers.host \
                  AND attempts.counts = 1 AND attempts.ended_ms > workers.sound_ms)";
    sqlx::query(update).bind(now).bind(host).execute(&mut **tx).await?;
    Ok(())
}

/// A job that this host has not lost: `$1` is the host, `$2` since when losses count.
pub(super) const UNSHUNNED: &str = "(lost = 0 OR NOT EXISTS (SELECT 1 FROM attempts mine \
    WHERE mine.job = jobs.id AND mine.host = $1 AND mine.counts = 1 AND mine.ended_ms > $2))";

/// A job that no other host could have instead: `$3` is now, `$4` when hosts that live were last seen.
pub(super) const NOBODY_ELSE_S: &str = "lost > 0 AND NOT EXISTS (SELECT 1 FROM workers \
    WHERE workers.host <> $1 AND workers.seen_ms > $4 AND workers.drained = 0 \
    AND workers.quarantined_until_ms <= $3 \
    AND NOT EXISTS (SELECT 1 FROM attempts theirs WHERE theirs.job = jobs.id \
    AND theirs.host = workers.host AND theirs.counts = 1 AND theirs.ended_ms > $2))";

/// Losses before then are forgotten.
pub(super) fn shunned_since(now: i64) -> i64 {
    now - SHUNS.as_millis() as i64
}

/// Hosts that live have been seen since then.
pub(super) fn alive_since(now: i64, terms: &Terms) -> i64 {
    now - terms.lease.as_millis() as i64
}

/// A host's row is written no more often than this, in milliseconds.
fn seldom(terms: &Terms) -> i64 {
    terms.lease.as_millis() as i64 / 4
}

async fn find(tx: &mut Tx, host: &str, now: i64) -> Result<Option<Worker>> {
    let query = sqlx::query("SELECT * FROM workers WHERE host = $1").bind(host);
    query.fetch_optional(&mut **tx).await?.map(|row| worker_of(&row, now)).transpose()
}

fn worker_of(row: &AnyRow, now: i64) -> Result<Worker> {
    let until: i64 = row.try_get("quarantined_until_ms")?;
    let is_quarantined = until > now;
    Ok(Worker {
        host: row.try_get("host")?,
        worker: row.try_get("worker")?,
        version: row.try_get("version")?,
        seen_ms: row.try_get("seen_ms")?,
        quarantined_until_ms: is_quarantined.then_some(until),
        why: if is_quarantined { row.try_get("why")? } else { String::new() },
        drained: row.try_get::<i64, _>("drained")? != 0,
    })
}
