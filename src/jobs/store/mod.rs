//! The job database, SQLite or PostgreSQL (`dialect.rs`), and all of its SQL (here, in `attempts.rs`, `checkpoints.rs`,
//! `clients.rs`, `expiry.rs`, `fleet.rs`, `owners.rs`, `queue.rs`, `webhooks.rs` and `workers.rs`).
//!
//! 1. A transaction that reads before it writes locks first what it reads: SQLite by BEGIN IMMEDIATE (a
//!    deferred one that upgrades is refused with SQLITE_BUSY whatever the busy timeout), PostgreSQL
//!    by the job's row.
//! 2. What a call returned `Ok` for is on disk.
//! 3. A change of state and the log entry that tells of it are one transaction.
//! 4. Time is the database's clock only, in milliseconds since 1970.
//! 5. Every write for a worker is conditional on its lease (`workers.rs`).
//! 6. Jobs are created one at a time, also by several servers: their numbers are committed in order,
//!    so that pages neither repeat nor skip, and caps on the queue are exact.
//! 7. What is refused is rolled back when the refusal is heard of, and what lost against another transaction is tried
//!    again (`transaction.rs`).
//!
//! Knows nothing of objects, or of who asks.

#[macro_use]
mod transaction;

mod attempts;
mod checkpoints;
mod clients;
mod dialect;
mod expiry;
mod fleet;
mod listen;
mod owners;
mod queue;
mod webhooks;
mod workers;

#[cfg(test)]
mod contract;

use serde::de::DeserializeOwned;
use sqlx::{Any, AnyConnection, AnyPool, AssertSqlSafe, Row, Transaction, any::AnyRow};

use self::dialect::{places, sql};

use super::{
    error::{Error, Result},
    event::{Body, Event, ServerEvent},
    labels::Labels,
    lease::{Loss, Orders},
    spec::Spec,
    state::State,
};

pub use attempts::Attempt;
pub use checkpoints::{Piece, RESUMED};
pub use clients::{Filter, MeshLock, NewJob};
pub use dialect::Address;
pub use fleet::{Service, Worker};
pub use listen::{Ear, Heard};
pub use queue::Waiting;
pub use webhooks::{CallEnd, DueCall};
pub use workers::{Appended, Claimed, Outcome};

/// A job as stored.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::struct_excessive_bools, reason = "it is a row of a table")]
pub struct Job {
    /// Order of creation, from 1.
    pub n: i64,
    /// A UUID without hyphens.
    pub id: String,
    /// Whose it is.
    pub owner: String,
    /// Hash of the input.
    pub mesh: String,
    /// The input's file name; its extension gives the format.
    pub file_name: String,
    /// What was asked.
    pub spec: Spec,
    /// Where it is.
    pub state: State,
    /// Number of the current or last attempt, from 1; 0 before the first.
    pub attempt: u32,
    /// Epoch of the current or last lease.
    pub epoch: u64,
    /// Who holds or last held the lease; empty when it was taken away.
    pub worker: String,
    /// How much speaks against the job: workers that have lost it (`lease::blame`).
    pub lost: u32,
    /// A client asked to stop it.
    pub cancel_requested: bool,
    /// Last number of the log.
    pub last_seq: u64,
    /// Entries of the log that the current attempt has sent.
    pub appended: u64,
    /// Why it failed: code and text, both empty otherwise.
    pub failure: (String, String),
    /// The stage at work, as last reported.
    pub stage: String,
    /// 0 to 1, as last reported.
    pub fraction: f64,
    /// When it was created, milliseconds since 1970.
    pub created_ms: i64,
    /// When the current or last attempt began.
    pub started_ms: Option<i64>,
    /// When it ended.
    pub ended_ms: Option<i64>,
    /// Those of higher priority come first.
    pub priority: i32,
    /// What its client calls it by.
    pub labels: Labels,
    /// One of higher priority waits for its worker.
    pub preempt: bool,
    /// Its results are kept beyond their time.
    pub pinned: bool,
    /// Its results are gone: their time was up.
    pub results_removed: bool,
    /// Where its trace goes on: a W3C traceparent; empty where nobody traces.
    pub trace: String,
    /// How its attempt was lost, where this very call found that out.
    pub loss: Option<Loss>,
}

impl Job {
    /// Resource name, `jobs/{id}`.
    pub fn name(&self) -> String {
        format!("jobs/{}", self.id)
    }

    /// What its worker should do.
    pub(super) fn orders(&self) -> Orders {
        Orders { cancel: self.cancel_requested, drain: false, preempt: self.preempt }
    }
}

/// A file of a result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Artifact {
    /// File name.
    pub file: String,
    /// IANA media type.
    pub media_type: String,
    /// Bytes.
    pub size: u64,
    /// BLAKE3, lower-case hexadecimal.
    pub blake3: String,
}

/// Where the bytes of a record chunk are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SegmentRange {
    /// File name of the segment.
    pub segment: String,
    /// First byte, once unpacked.
    pub offset: u64,
    /// Bytes.
    pub len: u64,
}

/// A log entry as stored: record bytes are elsewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredEvent {
    /// The entry; a `Records` body has no bytes yet.
    pub event: Event,
    /// Where they are.
    pub bytes: Option<SegmentRange>,
}

/// The database.
#[derive(Clone, Debug)]
pub struct Store {
    address: Address,
    writers: AnyPool,
    readers: AnyPool,
}

impl Store {
    /// Opens the database, creating it or bringing it up to date.
    pub async fn open(address: &Address) -> Result<Self> {
        let (writers, readers) = address.connect().await?;
        Ok(Self { address: address.clone(), writers, readers })
    }

    /// Waits for open connections; SQLite then folds the write-ahead log into the file.
    pub async fn close(&self) {
        self.readers.close().await;
        self.writers.close().await;
    }

    /// Whether a shared database answers, without a change to it: its version, and whether tables may
    /// be made in it.
    pub async fn probe(address: &Address) -> Result<(String, bool)> {
        let pool = address.pool(1).await?;
        let query = "SELECT current_setting('server_version') AS version, \
                     has_schema_privilege(current_schema(), 'CREATE') AS may_create";
        let row = sqlx::query(query).fetch_one(&pool).await?;
        Ok((
            row.try_get("version")?,
            row.try_get::<Option<bool>, _>("may_create")?.unwrap_or(false),
        ))
    }

    async fn begin(&self) -> Result<Tx> {
        Ok(self.writers.begin_with(self.address.begin()).await?)
    }
}

type Tx = Transaction<'static, Any>;

/// What only one transaction at a time may do, on all servers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Exclusive<'a> {
    /// Creating jobs.
    Create,
    /// Counting what an owner has against what it may have.
    Count,
    /// Asking workers to make room.
    Preempt,
    /// Storing or sweeping the mesh of this hash.
    Mesh(&'a str),
}

impl Exclusive<'_> {
    /// The number of the lock in PostgreSQL.
    fn number(self) -> i64 {
        match self {
            Self::Create => -1,
            Self::Count => -2,
            Self::Preempt => -3,
            // 60 bits of it; meshes that share them wait for one another.
            Self::Mesh(hash) => {
                i64::from_str_radix(hash.get(..15).unwrap_or_default(), 16).unwrap_or(0)
            }
        }
    }
}

/// Waits until this transaction is the only one that does so. SQLite has one at a time anyway.
async fn only(conn: &mut AnyConnection, what: Exclusive<'_>) -> Result<()> {
    let lock = sql(conn, "SELECT $1 /*pg FROM pg_advisory_xact_lock($1) */");
    sqlx::query(lock).bind(what.number()).execute(conn).await?;
    Ok(())
}

async fn now_ms(conn: &mut AnyConnection) -> Result<i64> {
    let now = sql(conn, "SELECT CAST(unixepoch('subsec') * 1000 AS INTEGER)");
    Ok(sqlx::query_scalar(now).fetch_one(conn).await?)
}

async fn find(conn: &mut AnyConnection, id: &str) -> Result<Job> {
    let query = sqlx::query("SELECT * FROM jobs WHERE id = $1").bind(storable(id));
    found(query.fetch_optional(conn).await?, id)
}

/// [`find`] for a transaction that will write: nobody else writes on the job until it ends.
async fn find_to_write(conn: &mut AnyConnection, id: &str) -> Result<Job> {
    let query = sql(conn, "SELECT * FROM jobs WHERE id = $1 /*pg FOR UPDATE */");
    found(sqlx::query(query).bind(id).fetch_optional(conn).await?, id)
}

fn found(row: Option<AnyRow>, id: &str) -> Result<Job> {
    job_of(&row.ok_or_else(|| Error::NotFound(format!("jobs/{id}")))?)
}

/// A text that PostgreSQL stores: it has no NUL.
fn storable(text: &str) -> String {
    text.replace('\0', "\u{fffd}")
}

/// Appends to the log of `job` and moves its `last_seq`, here and in the database.
async fn log(
    conn: &mut AnyConnection,
    job: &mut Job,
    at_ms: i64,
    entries: &[(Body, Option<SegmentRange>)],
) -> Result<()> {
    for chunk in entries.chunks(ROWS) {
        let rows: Vec<_> = (0..chunk.len()).map(|i| places(i * COLUMNS + 1, COLUMNS)).collect();
        let insert = AssertSqlSafe(format!("INSERT INTO events VALUES {}", rows.join(", ")));
        let mut insert = sqlx::query(insert);
        for (body, range) in chunk {
            let text = serde_json::to_string(body).map_err(stored("an event"))?;
            let range = range.as_ref();
            job.last_seq += 1;
            insert = insert.bind(&job.id).bind(job.last_seq as i64).bind(job.epoch as i64);
            insert = insert.bind(at_ms).bind(text).bind(range.map(|r| r.segment.clone()));
            insert = insert.bind(range.map(|r| r.offset as i64)).bind(range.map(|r| r.len as i64));
        }
        insert.execute(&mut *conn).await?;
    }
    let update = sqlx::query("UPDATE jobs SET last_seq = $1 WHERE id = $2");
    update.bind(job.last_seq as i64).bind(&job.id).execute(conn).await?;
    Ok(())
}

/// Columns of `events`, and rows of one statement: both databases cap placeholders.
const COLUMNS: usize = 8;
const ROWS: usize = 1000;

/// The log entry for the state that `job` is now in.
fn state_entry(job: &Job, reason: &str, text: String) -> (Body, Option<SegmentRange>) {
    let body = ServerEvent::StateChanged {
        state: job.state,
        reason: reason.into(),
        text,
        attempt: job.attempt,
        worker: job.worker.clone(),
    };
    (Body::Server(body), None)
}

fn stored(what: &str) -> impl FnOnce(serde_json::Error) -> Error {
    let what = what.to_owned();
    move |source| Error::Stored { what, source }
}

fn from_json<T: DeserializeOwned>(what: &str, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(stored(what))
}

fn job_of(row: &AnyRow) -> Result<Job> {
    let id: String = row.try_get("id")?;
    let state: String = row.try_get("state")?;
    let int = |column: &str| row.try_get::<i64, _>(column);
    Ok(Job {
        n: int("n")?,
        owner: row.try_get("owner")?,
        mesh: row.try_get("mesh")?,
        file_name: row.try_get("file_name")?,
        spec: from_json(&id, row.try_get("spec")?)?,
        state: state.parse().map_err(|fault| sqlx::Error::Decode(Box::new(fault)))?,
        attempt: int("attempt")? as u32,
        epoch: int("epoch")? as u64,
        worker: row.try_get("worker")?,
        lost: int("lost")? as u32,
        cancel_requested: int("cancel_requested")? != 0,
        last_seq: int("last_seq")? as u64,
        appended: int("appended")? as u64,
        failure: (row.try_get("failure_reason")?, row.try_get("failure_text")?),
        stage: row.try_get("stage")?,
        fraction: row.try_get("fraction")?,
        created_ms: int("created_ms")?,
        started_ms: row.try_get("started_ms")?,
        ended_ms: row.try_get("ended_ms")?,
        priority: int("priority")? as i32,
        labels: from_json(&id, row.try_get("labels")?)?,
        preempt: int("preempt")? != 0,
        pinned: int("pinned")? != 0,
        results_removed: int("swept")? != 0,
        trace: row.try_get("trace")?,
        loss: None,
        id,
    })
}

fn event_of(row: &AnyRow) -> Result<StoredEvent> {
    let int = |column: &str| row.try_get::<i64, _>(column);
    let body = from_json("an event", row.try_get("body")?)?;
    let segment: Option<String> = row.try_get("segment")?;
    let bytes = match segment {
        Some(segment) => Some(SegmentRange {
            segment,
            offset: int("segment_offset")? as u64,
            len: int("segment_len")? as u64,
        }),
        None => None,
    };
    let (seq, epoch, at_ms) = (int("seq")? as u64, int("epoch")? as u64, int("at_ms")?);
    Ok(StoredEvent { event: Event { seq, epoch, at_ms, body }, bytes })
}
