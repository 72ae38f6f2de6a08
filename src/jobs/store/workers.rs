//! What workers ask of the database, and what becomes of the jobs of workers that are gone.
//!
//! Every write checks the lease inside its own transaction ([`held`]): a worker whose attempt was
//! taken away cannot change anything.

use sqlx::AnyConnection;

use super::{
    Artifact, Body, Job, SegmentRange, Store, Tx,
    attempts::{self, Finish},
    checkpoints, find, find_to_write, fleet, job_of, log, now_ms, queue, sql, state_entry,
    storable, webhooks,
};
use crate::jobs::{
    error::{Error, Result},
    event::{CREATED_SEQ, Report, ServerEvent},
    lease::{Claimant, Lease, Loss, Orders, Terms, verdict},
    points::{Point, pass},
    state::Trigger,
};

/// How a worker says its attempt ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All is done; these files are the result.
    Succeeded(Vec<String>),
    /// The job is at fault: code and text.
    Failed(String, String),
    /// Stopped as asked.
    Cancelled,
    /// The attempt is at fault, for this reason.
    AttemptFailed(String),
    /// The worker hands the job back, for this reason.
    Released(String),
}

/// What a claim led to.
#[derive(Debug)]
pub struct Claimed {
    /// The job, if there was one for this worker, or why it gets none.
    pub job: Result<Option<Job>>,
    /// What the worker still held by the books.
    pub abandoned: Vec<Job>,
}

/// What a batch of events led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Appended {
    /// Events of this attempt now held.
    pub held: u64,
    /// What the worker should do.
    pub orders: Orders,
}

impl Store {
    /// Gives the queued job whose turn it is to a worker, those last that its host has lost; refused when the host is
    /// out of service.
    pub async fn claim(&self, who: impl Into<Claimant>, terms: &Terms) -> Result<Claimed> {
        let who = who.into();
        transaction!(self, tx, {
            let lost = lose_all_of(&mut tx, &who.worker, Loss::Abandoned, terms.max_lost);
            let abandoned = lost.await?;
            let now = now_ms(&mut tx).await?;
            if let Some(refusal) = fleet::check_in(&mut tx, &who, terms, now).await? {
                // What has been found out about the host stays.
                return Ok(Claimed { job: Err(refusal), abandoned });
            }
            let job = match queue::next(&mut tx, &who, terms, now).await? {
                Some(job) => Some(start(&mut tx, job, &who, terms).await?),
                None => None,
            };
            pass(Point::ClaimWritten);
            Ok(Claimed { job: Ok(job), abandoned })
        })
    }

    /// Extends a lease; what the worker should do.
    pub async fn heartbeat(&self, lease: &Lease, terms: &Terms) -> Result<Orders> {
        transaction!(self, tx, {
            let job = held_to_write(&mut tx, lease).await?;
            let now = now_ms(&mut tx).await?;
            let until = now + terms.lease.as_millis() as i64;
            let update = sqlx::query("UPDATE jobs SET lease_until_ms = $1 WHERE id = $2");
            update.bind(until).bind(&lease.job).execute(&mut *tx).await?;
            let drain = fleet::seen(&mut tx, &job, terms, now).await?;
            Ok(Orders { drain, ..job.orders() })
        })
    }

    /// The job, if the lease is good at this moment.
    pub async fn check(&self, lease: &Lease) -> Result<Job> {
        may_write(find(&mut *self.readers.acquire().await?, &lease.job).await, lease)
    }

    /// Appends `entries`, the first of which is the attempt's event number `first` (from 0). Those
    /// that are held already are skipped.
    pub async fn append(
        &self,
        lease: &Lease,
        first: u64,
        entries: &[(Body, Option<SegmentRange>)],
    ) -> Result<Appended> {
        transaction!(self, tx, {
            let mut job = held_to_write(&mut tx, lease).await?;
            let held = job.appended;
            let skip = held.checked_sub(first).ok_or(Error::Gap { first, held })?;
            let entries = entries.get(skip as usize..).unwrap_or_default();
            if !entries.is_empty() {
                let now = now_ms(&mut tx).await?;
                log(&mut tx, &mut job, now, entries).await?;
                job.appended += entries.len() as u64;
                note_progress(&mut job, entries);
                let update =
                    "UPDATE jobs SET appended = $1, stage = $2, fraction = $3 WHERE id = $4";
                let update = sqlx::query(update).bind(job.appended as i64).bind(&job.stage);
                update.bind(job.fraction).bind(&job.id).execute(&mut *tx).await?;
                pass(Point::AppendWritten);
            }
            Ok(Appended { held: job.appended, orders: job.orders() })
        })
    }

    /// Notes that a file of the result is stored.
    pub async fn add_artifact(&self, lease: &Lease, artifact: &Artifact) -> Result<()> {
        transaction!(self, tx, {
            held_to_write(&mut tx, lease).await?;
            let insert = "INSERT INTO artifacts VALUES ($1, $2, $3, $4, $5, $6) \
                          ON CONFLICT (job, epoch, file) DO UPDATE SET \
                          media_type = excluded.media_type, size = excluded.size, \
                          blake3 = excluded.blake3";
            let insert =
                sqlx::query(insert).bind(&lease.job).bind(lease.epoch as i64).bind(&artifact.file);
            let insert = insert.bind(storable(&artifact.media_type)).bind(artifact.size as i64);
            insert.bind(&artifact.blake3).execute(&mut *tx).await?;
            pass(Point::ArtifactWritten);
            Ok(())
        })
    }

    /// Ends the attempt; says whether this call did it. A repetition of the call that ended the job is accepted.
    pub async fn complete(
        &self,
        lease: &Lease,
        outcome: &Outcome,
        max_lost: u32,
    ) -> Result<(Job, bool)> {
        transaction!(self, tx, {
            if let Some(job) = repeated(&mut tx, lease, outcome).await? {
                return Ok((job, false));
            }
            let job = held_to_write(&mut tx, lease).await?;
            let job = match outcome {
                Outcome::Succeeded(files) => succeed(&mut tx, job, files).await?,
                Outcome::Failed(reason, text) => {
                    end(&mut tx, job, Trigger::Fail, reason, text.clone()).await?
                }
                Outcome::Cancelled if !job.cancel_requested => {
                    let remedy = "nobody asked to cancel it: complete it in another way";
                    return Err(Error::Illegal { job: job.name(), state: job.state, remedy });
                }
                Outcome::Cancelled => {
                    let text = "cancelled on request".into();
                    end(&mut tx, job, Trigger::Cancel, "CANCELLED", text).await?
                }
                Outcome::AttemptFailed(text) => {
                    lose(&mut tx, job, Loss::AttemptFailed, text, max_lost).await?
                }
                Outcome::Released(text) => {
                    let loss = if job.preempt { Loss::Preempted } else { Loss::Released };
                    lose(&mut tx, job, loss, text, max_lost).await?
                }
            };
            pass(Point::CompleteWritten);
            Ok((job, true))
        })
    }

    /// Takes away every lease that ran out; the jobs concerned, as they are then.
    pub async fn lose_expired(&self, max_lost: u32) -> Result<Vec<Job>> {
        let query = "SELECT count(*) FROM jobs WHERE state = 'RUNNING' AND lease_until_ms < $1";
        let now = now_ms(&mut *self.readers.acquire().await?).await?;
        if sqlx::query_scalar::<_, i64>(query).bind(now).fetch_one(&self.readers).await? == 0 {
            return Ok(Vec::new());
        }
        transaction!(self, tx, {
            // Another server may be about the same: what it has locked is its own.
            let query = "SELECT * FROM jobs WHERE state = 'RUNNING' AND lease_until_ms < $1 ORDER BY n \
                         /*pg FOR UPDATE SKIP LOCKED */";
            let rows = sqlx::query(sql(&tx, query)).bind(now).fetch_all(&mut *tx).await?;
            let mut jobs = Vec::with_capacity(rows.len());
            for row in &rows {
                jobs.push(lose(&mut tx, job_of(row)?, Loss::LeaseExpired, "", max_lost).await?);
            }
            Ok(jobs)
        })
    }

    /// Takes away whatever `worker` holds; the jobs concerned, as they are then.
    pub async fn lose_worker(&self, worker: &str, loss: Loss, max_lost: u32) -> Result<Vec<Job>> {
        transaction!(self, tx, {
            let jobs = lose_all_of(&mut tx, worker, loss, max_lost).await?;
            Ok(jobs)
        })
    }

    /// The workers that hold a lease.
    pub async fn lease_holders(&self) -> Result<Vec<String>> {
        let query = "SELECT DISTINCT worker FROM jobs WHERE state = 'RUNNING' ORDER BY worker";
        Ok(sqlx::query_scalar(query).fetch_all(&self.readers).await?)
    }

    /// Extends what `worker` holds, as if it had been heard of: for the time nobody could hear it.
    pub async fn renew(&self, worker: &str, terms: &Terms) -> Result<()> {
        transaction!(self, tx, {
            let until = now_ms(&mut tx).await? + terms.lease.as_millis() as i64;
            let update =
                "UPDATE jobs SET lease_until_ms = $1 WHERE state = 'RUNNING' AND worker = $2";
            sqlx::query(update).bind(until).bind(worker).execute(&mut *tx).await?;
            Ok(())
        })
    }
}

/// The job, if `lease` may write on it; nobody else writes on it until the transaction ends.
pub(super) async fn held_to_write(conn: &mut AnyConnection, lease: &Lease) -> Result<Job> {
    may_write(find_to_write(conn, &lease.job).await, lease)
}

fn may_write(found: Result<Job>, lease: &Lease) -> Result<Job> {
    let stale = |why| Error::Stale { job: format!("jobs/{}", lease.job), epoch: lease.epoch, why };
    let job = match found {
        Err(Error::NotFound(_)) => return Err(stale("the job was deleted".into())),
        found => found?,
    };
    if job.state.after(Trigger::Succeed).is_none() {
        Err(stale(format!("the job is {}", job.state)))
    } else if (job.epoch, job.worker.as_str()) != (lease.epoch, lease.worker.as_str()) {
        Err(stale(format!("epoch {} belongs to worker `{}`", job.epoch, job.worker)))
    } else {
        Ok(job)
    }
}

/// The job, if `outcome` is what ended it under this very lease: the answer was lost on the way.
async fn repeated(
    conn: &mut AnyConnection,
    lease: &Lease,
    outcome: &Outcome,
) -> Result<Option<Job>> {
    use super::State::{Cancelled, Failed, Succeeded};
    let end = match outcome {
        Outcome::Succeeded(_) => Succeeded,
        Outcome::Failed(..) => Failed,
        Outcome::Cancelled => Cancelled,
        Outcome::AttemptFailed(_) | Outcome::Released(_) => return Ok(None),
    };
    let query = "SELECT * FROM jobs WHERE id = $1 AND epoch = $2 AND worker = $3 AND state = $4";
    let query = sqlx::query(query).bind(&lease.job).bind(lease.epoch as i64);
    let query = query.bind(storable(&lease.worker)).bind(end.name());
    query.fetch_optional(conn).await?.as_ref().map(job_of).transpose()
}

async fn start(tx: &mut Tx, mut job: Job, who: &Claimant, terms: &Terms) -> Result<Job> {
    let now = now_ms(tx).await?;
    job.state = after(&job, Trigger::Claim)?;
    job.epoch += 1;
    job.attempt += 1;
    job.appended = 0;
    job.preempt = false;
    job.worker.clone_from(&who.worker);
    job.started_ms = Some(now);
    let update = "UPDATE jobs SET state = $1, epoch = $2, attempt = $3, worker = $4, appended = 0, \
                  lease_until_ms = $5, started_ms = $6, preempt = 0, stage = '', fraction = 0 WHERE id = $7";
    let update = sqlx::query(update).bind(job.state.name()).bind(job.epoch as i64);
    let update = update
        .bind(i64::from(job.attempt))
        .bind(&job.worker)
        .bind(now + terms.lease.as_millis() as i64);
    update.bind(now).bind(&job.id).execute(&mut **tx).await?;
    attempts::begin(tx, &job, &who.host, now).await?;
    let text = format!("attempt {} begins", job.attempt);
    let entry = state_entry(&job, "CLAIMED", text);
    log(tx, &mut job, now, &[entry]).await?;
    Ok(job)
}

async fn succeed(tx: &mut Tx, job: Job, files: &[String]) -> Result<Job> {
    let query = "SELECT file FROM artifacts WHERE job = $1 AND epoch = $2";
    let query = sqlx::query_scalar::<_, String>(query).bind(&job.id).bind(job.epoch as i64);
    let stored = query.fetch_all(&mut **tx).await?;
    if let Some(missing) = files.iter().find(|file| !stored.contains(file)) {
        let text = format!("`{missing}` was never stored: send it with PutArtifact first");
        return Err(Error::invalid("succeeded.files", text));
    }
    for file in stored.iter().filter(|file| !files.contains(file)) {
        let delete = "DELETE FROM artifacts WHERE job = $1 AND epoch = $2 AND file = $3";
        let delete = sqlx::query(delete).bind(&job.id).bind(job.epoch as i64).bind(file);
        delete.execute(&mut **tx).await?;
    }
    end(tx, job, Trigger::Succeed, "COMPLETED", format!("{} files are ready", files.len())).await
}

/// Moves a running job to a final state.
async fn end(
    tx: &mut Tx,
    mut job: Job,
    trigger: Trigger,
    reason: &str,
    text: String,
) -> Result<Job> {
    let now = now_ms(tx).await?;
    job.state = after(&job, trigger)?;
    job.ended_ms = Some(now);
    if trigger == Trigger::Fail {
        job.failure = (storable(reason), storable(&text));
    }
    if trigger == Trigger::Succeed {
        job.fraction = 1.0;
        fleet::is_sound(tx, &job, now).await?;
    }
    attempts::finish(tx, &job, Finish { reason, detail: &text, counts: false, now }).await?;
    let update = "UPDATE jobs SET state = $1, ended_ms = $2, failure_reason = $3, failure_text = $4, \
                  fraction = $5 WHERE id = $6";
    let update = sqlx::query(update).bind(job.state.name()).bind(now).bind(&job.failure.0);
    let update = update.bind(&job.failure.1).bind(job.fraction).bind(&job.id);
    update.execute(&mut **tx).await?;
    let entry = state_entry(&job, reason, text);
    log(tx, &mut job, now, &[entry]).await?;
    webhooks::due(tx, &job.id, now).await?;
    Ok(job)
}

async fn lose_all_of(tx: &mut Tx, worker: &str, loss: Loss, max_lost: u32) -> Result<Vec<Job>> {
    let query = "SELECT * FROM jobs WHERE state = 'RUNNING' AND worker = $1 ORDER BY n \
                 /*pg FOR UPDATE */";
    let rows = sqlx::query(sql(tx, query)).bind(worker).fetch_all(&mut **tx).await?;
    let mut jobs = Vec::with_capacity(rows.len());
    for row in &rows {
        jobs.push(lose(tx, job_of(row)?, loss, "", max_lost).await?);
    }
    Ok(jobs)
}

/// Takes a lease away: the job starts over, or ends when it lost too many attempts or is unwanted.
async fn lose(tx: &mut Tx, mut job: Job, loss: Loss, detail: &str, max_lost: u32) -> Result<Job> {
    let why = [loss.text(), detail].into_iter().filter(|s| !s.is_empty()).collect::<Vec<_>>();
    let why = why.join(": ");
    let (reason, counts, now) = (loss.reason(), loss.counts(), now_ms(tx).await?);
    attempts::finish(tx, &job, Finish { reason, detail: &why, counts, now }).await?;
    job.lost = attempts::blame(tx, &job.id).await?;
    job.loss = Some(loss);
    let update = sqlx::query("UPDATE jobs SET lost = $1 WHERE id = $2");
    update.bind(i64::from(job.lost)).bind(&job.id).execute(&mut **tx).await?;
    match verdict(job.lost, max_lost, job.cancel_requested) {
        Trigger::Requeue => requeue(tx, job, loss, &why).await,
        Trigger::Cancel => {
            let text = format!("cancelled on request; {why}");
            end(tx, job, Trigger::Cancel, "CANCELLED", text).await
        }
        trigger => {
            let text = format!(
                "{} workers lost it, the last because {why}; see the log, then submit it again \
                 with other settings or a repaired mesh",
                job.lost
            );
            end(tx, job, trigger, "POISONED", text).await
        }
    }
}

async fn requeue(tx: &mut Tx, mut job: Job, loss: Loss, why: &str) -> Result<Job> {
    let now = now_ms(tx).await?;
    job.state = after(&job, Trigger::Requeue)?;
    let lost = format!("attempt {} was lost, because {why}", job.attempt);
    let entries = if checkpoints::exists(tx, &job.id).await? {
        // Whoever claims it finds out whether it can go on from there (`Store::resume`).
        vec![state_entry(&job, loss.reason(), format!("{lost}; there is a checkpoint"))]
    } else {
        let text = format!("{lost}; the job starts over");
        let restarted = ServerEvent::Restarted {
            rewind_to_seq: CREATED_SEQ,
            lost_attempt: job.attempt,
            reason: loss.reason().into(),
            text: text.clone(),
        };
        vec![(Body::Server(restarted), None), state_entry(&job, loss.reason(), text)]
    };
    job.worker = String::new();
    let update = "UPDATE jobs SET state = $1, worker = '', stage = '', fraction = 0, queued_ms = $2 \
                  WHERE id = $3";
    let update = sqlx::query(update).bind(job.state.name()).bind(now).bind(&job.id);
    update.execute(&mut **tx).await?;
    log(tx, &mut job, now, &entries).await?;
    Ok(job)
}

fn after(job: &Job, trigger: Trigger) -> Result<super::State> {
    let remedy = "it cannot do that";
    job.state.after(trigger).ok_or_else(|| Error::Illegal {
        job: job.name(),
        state: job.state,
        remedy,
    })
}

fn note_progress(job: &mut Job, entries: &[(Body, Option<SegmentRange>)]) {
    let last = entries.iter().rev().find_map(|(body, _)| match body {
        Body::Worker(Report::Progress { stage, fraction, .. }) => Some((stage, *fraction)),
        _ => None,
    });
    if let Some((stage, fraction)) = last {
        job.stage = storable(stage);
        job.fraction = if fraction.is_finite() { fraction.clamp(0.0, 1.0) } else { 0.0 };
    }
}
