//! What clients ask of the database: meshes, jobs, logs, artifacts.

use std::time::Duration;

use sqlx::{AssertSqlSafe, Row, any::AnyRow};

use super::{
    Artifact, Body, Exclusive, Job, State, Store, StoredEvent, Tx, checkpoints, event_of, find,
    find_to_write, job_of, log, now_ms, only, owners, sql, state_entry, storable, stored, webhooks,
};
use crate::jobs::{
    Limits,
    error::{Error, Result},
    event::{CREATED_SEQ, ServerEvent},
    labels::Labels,
    points::{Point, pass},
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
    /// Those of higher priority come first.
    pub priority: i32,
    /// What its client calls it by.
    pub labels: Labels,
    /// Whom to call when it has ended; empty for nobody. A repeated request keeps the first one's.
    pub webhook: String,
    /// Where its trace goes on: a W3C traceparent; empty where nobody traces.
    pub trace: String,
}

/// Which jobs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Only this owner's.
    pub owner: Option<String>,
    /// Only those in one of these states; empty for all.
    pub states: Vec<State>,
    /// Only those that have all of these labels.
    pub labels: Labels,
    /// Only those created at this time or later, and before that; milliseconds since 1970.
    pub created_ms: (Option<i64>, Option<i64>),
}

impl Filter {
    /// A query, and the texts that it asks for from `$5` on; `$1` to `$4` are the number before which jobs are listed,
    /// how many, and the times.
    fn query(&self) -> (String, Vec<&str>) {
        let mut texts = Vec::new();
        let mut place = |text| {
            texts.push(text);
            format!("${}", texts.len() + 4)
        };
        let mut tables = vec!["jobs".to_owned()];
        let mut conditions =
            vec!["jobs.n < $1 AND created_ms >= $3 AND created_ms < $4".to_owned()];
        for (i, (key, value)) in self.labels.iter().enumerate() {
            let (key, value) = (place(key.as_str()), place(value));
            tables.push(format!(
                "JOIN labels AS label{i} ON label{i}.n = jobs.n AND label{i}.key = {key} \
                 AND label{i}.value = {value}"
            ));
        }
        conditions.extend(self.owner.iter().map(|owner| format!("owner = {}", place(owner))));
        let states: Vec<_> = self.states.iter().map(|state| place(state.name())).collect();
        if !states.is_empty() {
            conditions.push(format!("state IN ({})", states.join(", ")));
        }
        let (tables, conditions) = (tables.join(" "), conditions.join(" AND "));
        let query =
            format!("SELECT jobs.* FROM {tables} WHERE {conditions} ORDER BY jobs.n DESC LIMIT $2");
        (query, texts)
    }
}

/// Notes the labels of a new job, so that they can be searched.
async fn note_labels(tx: &mut Tx, job: &Job) -> Result<()> {
    for (key, value) in &job.labels {
        let insert = sqlx::query("INSERT INTO labels VALUES ($1, $2, $3)");
        insert.bind(key).bind(value).bind(job.n).execute(&mut **tx).await?;
    }
    Ok(())
}

/// A mesh that nobody else stores or sweeps.
#[derive(Debug)]
pub struct MeshLock {
    tx: Tx,
    hash: String,
}

impl MeshLock {
    /// Whether it has a row.
    pub async fn is_stored(&mut self) -> Result<bool> {
        let query = sqlx::query_scalar::<_, i64>("SELECT count(*) FROM meshes WHERE hash = $1");
        Ok(query.bind(&self.hash).fetch_one(&mut *self.tx).await? == 1)
    }

    /// Notes that its bytes are stored; false when that was known.
    pub async fn add(mut self, size: u64) -> Result<bool> {
        let now = now_ms(&mut self.tx).await?;
        let touched = touch_mesh(&mut self.tx, &self.hash, now).await?;
        let insert = sqlx::query("INSERT INTO meshes VALUES ($1, $2, $3) ON CONFLICT DO NOTHING");
        let insert = insert.bind(&self.hash).bind(size as i64).bind(now);
        let done = insert.execute(&mut *self.tx).await?;
        self.tx.commit().await?;
        Ok(!touched && done.rows_affected() == 1)
    }
}

impl Store {
    /// Waits until nobody else stores or sweeps this mesh.
    pub async fn lock_mesh(&self, hash: &str) -> Result<MeshLock> {
        let mut tx = self.begin().await?;
        only(&mut tx, Exclusive::Mesh(hash)).await?;
        Ok(MeshLock { tx, hash: hash.into() })
    }

    /// Notes that a client asked for a stored mesh; false when there is none.
    pub async fn touch_mesh(&self, hash: &str) -> Result<bool> {
        transaction!(self, tx, {
            let now = now_ms(&mut tx).await?;
            let found = touch_mesh(&mut tx, hash, now).await?;
            Ok(found)
        })
    }

    /// Notes the second inputs of jobs that a server of the version before this column has created meanwhile.
    pub async fn note_inputs(&self) -> Result<()> {
        transaction!(self, tx, {
            let update = "UPDATE jobs SET simplified = spec /*pg ::json */ -> 'simplified' ->> 'mesh' \
                          WHERE simplified IS NULL AND spec LIKE '%\"simplified\":{%'";
            sqlx::query(sql(&tx, update)).execute(&mut *tx).await?;
            Ok(())
        })
    }

    /// Forgets meshes, at most `limit` of them, that no job names and that nobody uploaded or asked for in so long;
    /// their hashes.
    pub async fn forget_meshes(&self, unused_for: Duration, limit: u32) -> Result<Vec<String>> {
        transaction!(self, tx, {
            let age_ms = i64::try_from(unused_for.as_millis()).unwrap_or(i64::MAX);
            let before = now_ms(&mut tx).await?.saturating_sub(age_ms);
            // Asked twice for the time: one that is touched meanwhile stays.
            let delete = "DELETE FROM meshes WHERE created_ms <= $1 AND hash IN ( \
                          SELECT hash FROM meshes AS old WHERE old.created_ms <= $1 \
                          AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.mesh = old.hash) \
                          AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.simplified = old.hash) \
                          LIMIT $2) RETURNING hash";
            let delete = sqlx::query_scalar::<_, String>(delete).bind(before);
            let delete = delete.bind(i64::from(limit));
            let hashes = delete.fetch_all(&mut *tx).await?;
            Ok(hashes)
        })
    }

    /// The name of the objects that the database tells of.
    pub async fn objects_id(&self) -> Result<Option<String>> {
        let query = sqlx::query_scalar("SELECT id FROM objects");
        Ok(query.fetch_optional(&self.readers).await?)
    }

    /// Says that the database tells of the objects of this name, unless it is known better; what is
    /// known then.
    pub async fn name_objects(&self, id: &str) -> Result<String> {
        let insert = "INSERT INTO objects VALUES (1, $1) ON CONFLICT DO NOTHING";
        sqlx::query(insert).bind(id).execute(&self.writers).await?;
        let query = sqlx::query_scalar("SELECT id FROM objects");
        Ok(query.fetch_one(&self.writers).await?)
    }

    /// How many meshes are stored.
    pub async fn n_meshes(&self) -> Result<i64> {
        let query = sqlx::query_scalar("SELECT count(*) FROM meshes");
        Ok(query.fetch_one(&self.readers).await?)
    }

    /// Size in bytes of a stored mesh.
    pub async fn mesh_size(&self, hash: &str) -> Result<Option<u64>> {
        let query = sqlx::query_scalar::<_, i64>("SELECT size FROM meshes WHERE hash = $1");
        let size = query.bind(hash).fetch_optional(&self.readers).await?;
        Ok(size.map(|size| size as u64))
    }

    /// Creates a job under `id`, unless its request already made one; says whether it is new.
    pub async fn create(&self, id: &str, new: &NewJob, limits: &Limits) -> Result<(Job, bool)> {
        transaction!(self, tx, {
            only(&mut tx, Exclusive::Create).await?;
            if let Some(job) = owners::requested(&mut tx, new).await? {
                return Ok((same_request(job, new)?, false));
            }
            check_queue(&mut tx, &new.owner, limits).await?;
            let now = now_ms(&mut tx).await?;
            keep_meshes(&mut tx, new, now).await?;
            let spec = serde_json::to_string(&new.spec).map_err(stored("the specification"))?;
            let insert = "INSERT INTO jobs (id, owner, mesh, file_name, spec, state, created_ms, \
                          queued_ms, priority, trace, labels, simplified) \
                          VALUES ($1, $2, $3, $4, $5, $6, $7, $7, $8, $9, $10, $11)";
            let insert = sqlx::query(insert).bind(id).bind(&new.owner).bind(&new.mesh);
            let insert =
                insert.bind(&new.file_name).bind(spec).bind(State::Queued.name()).bind(now);
            let labels = serde_json::to_string(&new.labels).map_err(stored("the labels"))?;
            let insert = insert.bind(i64::from(new.priority)).bind(&new.trace).bind(labels);
            let simplified = new.spec.simplified.as_ref().map(|input| &*input.mesh);
            let insert = insert.bind(simplified);
            insert.execute(&mut *tx).await?;
            owners::note_request(&mut tx, new, id).await?;
            webhooks::note(&mut tx, new, id).await?;
            let mut job = find(&mut tx, id).await?;
            note_labels(&mut tx, &job).await?;
            let entry = state_entry(&job, "CREATED", "waiting for a worker".into());
            log(&mut tx, &mut job, now, &[entry]).await?;
            pass(Point::CreateWritten);
            Ok((job, true))
        })
    }

    /// One job.
    pub async fn job(&self, id: &str) -> Result<Job> {
        find(&mut *self.readers.acquire().await?, id).await
    }

    /// Jobs that pass `filter`, newest first, older than the job numbered `before`.
    pub async fn list(&self, filter: &Filter, before: Option<i64>, limit: u32) -> Result<Vec<Job>> {
        let (query, texts) = filter.query();
        let query = sqlx::query(AssertSqlSafe(query)).bind(before.unwrap_or(i64::MAX));
        let (from, until) = filter.created_ms;
        let query = query.bind(i64::from(limit)).bind(from.unwrap_or(i64::MIN));
        let query = query.bind(until.unwrap_or(i64::MAX));
        let query = texts.into_iter().fold(query, |query, text| query.bind(storable(text)));
        query.fetch_all(&self.readers).await?.iter().map(job_of).collect()
    }

    /// How many jobs are in each state.
    pub async fn counts(&self) -> Result<Vec<(State, u64)>> {
        let query = "SELECT count(*) FROM jobs WHERE state = $1";
        let mut counts = Vec::with_capacity(State::ALL.len());
        for state in State::ALL {
            let query = sqlx::query_scalar::<_, i64>(query).bind(state.name());
            counts.push((state, query.fetch_one(&self.readers).await? as u64));
        }
        Ok(counts)
    }

    /// At most `limit` entries of a log after `after_seq`, in order.
    pub async fn events(&self, id: &str, after_seq: u64, limit: u32) -> Result<Vec<StoredEvent>> {
        let query = "SELECT * FROM events WHERE job = $1 AND seq > $2 ORDER BY seq LIMIT $3";
        let after_seq = i64::try_from(after_seq).unwrap_or(i64::MAX);
        let query = sqlx::query(query).bind(id).bind(after_seq).bind(i64::from(limit));
        query.fetch_all(&self.readers).await?.iter().map(event_of).collect()
    }

    /// Cancels a queued job, or asks the worker of a running one to stop; says whether this call
    /// ended the job.
    pub async fn cancel(&self, id: &str) -> Result<(Job, bool)> {
        transaction!(self, tx, {
            let mut job = find_to_write(&mut tx, id).await?;
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
                let update = sqlx::query("UPDATE jobs SET cancel_requested = 1 WHERE id = $1");
                update.bind(id).execute(&mut *tx).await?;
            } else {
                job.state = state;
                job.ended_ms = Some(now);
                let update =
                    "UPDATE jobs SET cancel_requested = 1, state = $1, ended_ms = $2 WHERE id = $3";
                let update = sqlx::query(update).bind(job.state.name()).bind(now).bind(id);
                update.execute(&mut *tx).await?;
                let entry = state_entry(&job, "CANCELLED", "cancelled on request".into());
                log(&mut tx, &mut job, now, &[entry]).await?;
                webhooks::due(&mut tx, id, now).await?;
            }
            let has_ended = job.state.is_final();
            Ok((job, has_ended))
        })
    }

    /// Queues a job anew that failed or was cancelled, with all its log; says whether this call did it. One that
    /// waits or runs is left alone.
    pub async fn retry(&self, id: &str, limits: &Limits) -> Result<(Job, bool)> {
        transaction!(self, tx, {
            only(&mut tx, Exclusive::Create).await?;
            let mut job = find_to_write(&mut tx, id).await?;
            let Some(state) = job.state.after(Trigger::Retry) else {
                let remedy = if job.state.is_final() {
                    "it has its results: submit it again if you want others"
                } else if job.cancel_requested {
                    "it is being cancelled: retry it when that is confirmed"
                } else {
                    return Ok((job, false));
                };
                return Err(Error::Illegal { job: job.name(), state: job.state, remedy });
            };
            check_queue(&mut tx, &job.owner, limits).await?;
            job.state = state;
            renew(&mut tx, &mut job).await?;
            Ok((job, true))
        })
    }

    /// Deletes an ended job, with its log and the list of its artifacts.
    pub async fn delete(&self, id: &str) -> Result<()> {
        transaction!(self, tx, {
            let job = find_to_write(&mut tx, id).await?;
            if !job.state.is_final() {
                let remedy = "cancel it first";
                return Err(Error::Illegal { job: job.name(), state: job.state, remedy });
            }
            sqlx::query("DELETE FROM jobs WHERE id = $1").bind(id).execute(&mut *tx).await?;
            pass(Point::DeleteWritten);
            Ok(())
        })
    }

    /// The artifacts of the attempt that ended the job, by name; none while it has not ended.
    pub async fn artifacts(&self, id: &str) -> Result<(Job, Vec<Artifact>)> {
        let job = self.job(id).await?;
        if !job.state.is_final() {
            return Ok((job, Vec::new()));
        }
        let query = "SELECT * FROM artifacts WHERE job = $1 AND epoch = $2 ORDER BY file";
        let query = sqlx::query(query).bind(id).bind(job.epoch as i64);
        let rows = query.fetch_all(&self.readers).await?;
        let artifact = |row: &AnyRow| -> Result<Artifact> {
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
        let query = sqlx::query_scalar::<_, i64>("SELECT count(*) FROM jobs WHERE id = $1");
        Ok(query.bind(id).fetch_one(&self.readers).await? == 1)
    }
}

/// Takes from a job that has ended what it ended with, and says so in its log.
async fn renew(tx: &mut Tx, job: &mut Job) -> Result<()> {
    let now = now_ms(tx).await?;
    let update = "UPDATE jobs SET state = $1, queued_ms = $2, worker = '', lost = 0, cancel_requested = 0, \
                  preempt = 0, failure_reason = '', failure_text = '', ended_ms = NULL, stage = '', \
                  fraction = 0, swept = 0 WHERE id = $3";
    let update = sqlx::query(update).bind(job.state.name()).bind(now).bind(&job.id);
    update.execute(&mut **tx).await?;
    // What was lost before is history, and speaks against it no more; nor is anything left of its results.
    for forget in
        ["UPDATE attempts SET counts = 0 WHERE job = $1", "DELETE FROM artifacts WHERE job = $1"]
    {
        sqlx::query(forget).bind(&job.id).execute(&mut **tx).await?;
    }
    checkpoints::forget(tx, &job.id).await?;
    webhooks::renew(tx, &job.id).await?;
    let mut renewed = find(tx, &job.id).await?;
    let text = "queued anew on request";
    let restarted = ServerEvent::Restarted {
        rewind_to_seq: CREATED_SEQ,
        lost_attempt: renewed.attempt,
        reason: RETRIED.into(),
        text: text.into(),
    };
    let entries = [(Body::Server(restarted), None), state_entry(&renewed, RETRIED, text.into())];
    log(tx, &mut renewed, now, &entries).await?;
    *job = renewed;
    Ok(())
}

/// Why a job waits that had ended.
const RETRIED: &str = "RETRIED";

/// Refuses when as many jobs wait as may. Waiting jobs are counted only where they may be so many, by the numbers
/// of the first and the last of them: counting takes the longer the more there are.
async fn check_queue(tx: &mut Tx, owner: &str, limits: &Limits) -> Result<()> {
    let query = "SELECT COALESCE((SELECT max(n) FROM jobs WHERE state = 'QUEUED') + 1 \
                 - (SELECT min(n) FROM jobs WHERE state = 'QUEUED'), 0)";
    let at_most = sqlx::query_scalar::<_, i64>(query).fetch_one(&mut **tx).await? as u64;
    if at_most >= limits.max_owner_queued {
        owners::check_queue(tx, owner, limits.max_owner_queued).await?;
    }
    if at_most >= limits.max_queued {
        let query =
            sqlx::query_scalar::<_, i64>("SELECT count(*) FROM jobs WHERE state = 'QUEUED'");
        if query.fetch_one(&mut **tx).await? as u64 >= limits.max_queued {
            return Err(Error::QueueFull(limits.max_queued));
        }
    }
    Ok(())
}

/// Makes a mesh as young as if it were stored now; false when there is none.
async fn touch_mesh(tx: &mut Tx, hash: &str, now: i64) -> Result<bool> {
    let update = sqlx::query("UPDATE meshes SET created_ms = $1 WHERE hash = $2");
    let done = update.bind(now).bind(hash).execute(&mut **tx).await?;
    Ok(done.rows_affected() == 1)
}

/// Makes the meshes of a job as young as if they were stored now: none of them is forgotten before the
/// job names it.
async fn keep_meshes(tx: &mut Tx, new: &NewJob, now: i64) -> Result<()> {
    let simplified = new.spec.simplified.as_ref().map(|input| &input.mesh);
    for (field, mesh) in [("mesh", Some(&new.mesh)), ("spec.simplified.mesh", simplified)] {
        let Some(mesh) = mesh else { continue };
        if !touch_mesh(tx, mesh, now).await? {
            let text = format!("meshes/{mesh} is not stored any more: upload it again");
            return Err(Error::invalid(field, text));
        }
    }
    Ok(())
}

/// The job an earlier request made, if this one asks for the same.
fn same_request(job: Job, new: &NewJob) -> Result<Job> {
    let same = (&job.mesh, &job.file_name, &job.spec, &job.labels)
        == (&new.mesh, &new.file_name, &new.spec, &new.labels);
    if same { Ok(job) } else { Err(Error::RequestIdReused(new.request_id.clone())) }
}
