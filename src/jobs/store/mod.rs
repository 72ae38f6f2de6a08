//! The job database: SQLite in one file, and all of its SQL (here, in `clients.rs`, `owners.rs`
//! and `workers.rs`).
//!
//! 1. A transaction that reads before it writes begins IMMEDIATE: a deferred one that upgrades is
//!    refused with SQLITE_BUSY whatever the busy timeout.
//! 2. What a call returned `Ok` for is on disk (WAL with synchronous=FULL).
//! 3. A change of state and the log entry that tells of it are one transaction.
//! 4. Time is the database's clock only, in milliseconds since 1970.
//! 5. Every write for a worker is conditional on its lease (`workers.rs`).
//!
//! Knows nothing of the object directory, of notifications, or of who asks.

mod clients;
mod owners;
mod workers;

use std::{borrow::Cow, path::Path, time::Duration};

use serde::de::DeserializeOwned;
use sqlx::{
    QueryBuilder, Row, Sqlite, SqliteConnection, SqlitePool, Transaction,
    migrate::{Migration, MigrationType, Migrator},
    sqlite::{
        SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteRow, SqliteSynchronous,
    },
};

use super::{
    error::{Error, Result},
    event::{Body, Event, ServerEvent},
    spec::Spec,
    state::State,
};

pub use clients::NewJob;
pub use workers::{Appended, Outcome};

/// A job as stored.
#[derive(Clone, Debug, PartialEq)]
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
    /// Lost attempts that count against the job.
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
}

impl Job {
    /// Resource name, `jobs/{id}`.
    pub fn name(&self) -> String {
        format!("jobs/{}", self.id)
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
    /// One connection: writers of this process queue here, not at SQLite's lock.
    writer: SqlitePool,
    readers: SqlitePool,
}

impl Store {
    /// Opens the database, creating it or bringing it up to date.
    pub async fn open(path: &Path) -> Result<Self> {
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(Duration::from_secs(5));
        let writer =
            SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        migrations().run(&writer).await?;
        let readers = SqlitePoolOptions::new().max_connections(4).connect_with(options).await?;
        Ok(Self { writer, readers })
    }

    /// Waits for open connections and folds the write-ahead log into the file.
    pub async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }

    async fn begin(&self) -> Result<Transaction<'static, Sqlite>> {
        Ok(self.writer.begin_with("BEGIN IMMEDIATE").await?)
    }
}

fn migrations() -> Migrator {
    let table = [
        (1, "jobs", include_str!("../migrations/0001_jobs.sql")),
        (2, "owners", include_str!("../migrations/0002_owners.sql")),
    ];
    let migration = |(version, name, sql): (i64, &'static str, &'static str)| {
        let sql = sqlx::SqlSafeStr::into_sql_str(sql);
        Migration::new(version, Cow::Borrowed(name), MigrationType::Simple, sql, false)
    };
    Migrator::with_migrations(table.into_iter().map(migration).collect())
}

async fn now_ms(conn: &mut SqliteConnection) -> Result<i64> {
    let now = sqlx::query_scalar("SELECT CAST(unixepoch('subsec') * 1000 AS INTEGER)");
    Ok(now.fetch_one(conn).await?)
}

async fn find(conn: &mut SqliteConnection, id: &str) -> Result<Job> {
    let row = sqlx::query("SELECT * FROM jobs WHERE id = ?").bind(id).fetch_optional(conn).await?;
    job_of(&row.ok_or_else(|| Error::NotFound(format!("jobs/{id}")))?)
}

/// Appends to the log of `job` and moves its `last_seq`, here and in the database.
async fn log(
    conn: &mut SqliteConnection,
    job: &mut Job,
    at_ms: i64,
    entries: &[(Body, Option<SegmentRange>)],
) -> Result<()> {
    let mut rows = Vec::with_capacity(entries.len());
    for (body, range) in entries {
        let text = serde_json::to_string(body).map_err(stored("an event"))?;
        rows.push((job.last_seq as i64 + 1 + rows.len() as i64, text, range.clone()));
    }
    if rows.is_empty() {
        return Ok(());
    }
    job.last_seq += rows.len() as u64;
    let mut insert = QueryBuilder::<Sqlite>::new("INSERT INTO events ");
    insert.push_values(rows, |mut row, (seq, text, range)| {
        row.push_bind(job.id.clone()).push_bind(seq).push_bind(job.epoch as i64).push_bind(at_ms);
        row.push_bind(text).push_bind(range.as_ref().map(|r| r.segment.clone()));
        row.push_bind(range.as_ref().map(|r| r.offset as i64));
        row.push_bind(range.as_ref().map(|r| r.len as i64));
    });
    insert.build().execute(&mut *conn).await?;
    let update = sqlx::query("UPDATE jobs SET last_seq = ? WHERE id = ?");
    update.bind(job.last_seq as i64).bind(&job.id).execute(conn).await?;
    Ok(())
}

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

fn job_of(row: &SqliteRow) -> Result<Job> {
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
        id,
    })
}

fn event_of(row: &SqliteRow) -> Result<StoredEvent> {
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
