//! What can go wrong with jobs. `service::status` maps each to the wire.

use std::{io, path::PathBuf};

use super::{spec::Fault, state::State};

/// A failed operation on jobs.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is no such thing.
    #[error("{0} does not exist: it was never created, or it was deleted")]
    NotFound(String),
    /// The request is at fault; every fault is listed.
    #[error("{}", list(.0))]
    Invalid(Vec<Fault>),
    /// The same `request_id` came with other contents.
    #[error("request_id `{0}` was used before for another job: choose a new one")]
    RequestIdReused(String),
    /// The transition table forbids it.
    #[error("{job} is {state}: {remedy}")]
    Illegal {
        /// Resource name.
        job: String,
        /// Its state.
        state: State,
        /// What to do.
        remedy: &'static str,
    },
    /// The lease is not, or no longer, the job's.
    #[error("the lease of epoch {epoch} on {job} is stale ({why}): drop the attempt")]
    Stale {
        /// Resource name.
        job: String,
        /// The epoch of the call.
        epoch: u64,
        /// What holds instead.
        why: String,
    },
    /// A host gets no jobs for now.
    #[error(
        "worker {host} is out of service: {why}; mend it, then say so with \
         `lookalike workers reinstate {host}`{}",
        again(*.until_ms)
    )]
    OutOfService {
        /// Which.
        host: String,
        /// What speaks against it.
        why: String,
        /// When it gets jobs again by itself, milliseconds since 1970.
        until_ms: Option<i64>,
        /// It was found out just now.
        is_news: bool,
    },
    /// A batch of events leaves a gap.
    #[error("events from {first} on do not follow the {held} that are held: send them from {held}")]
    Gap {
        /// First index of the batch.
        first: u64,
        /// Events held.
        held: u64,
    },
    /// An upload begins beyond what is held of it.
    #[error(
        "the bytes from {offset} on do not follow the {held} that are held: send them from {held}"
    )]
    Offset {
        /// Where it begins.
        offset: u64,
        /// Bytes held.
        held: u64,
    },
    /// All bytes of an upload came by another stream.
    #[error("all bytes of this upload are here and are being stored: ask again in a moment")]
    UnderWay,
    /// An owner sends very much at once.
    #[error("this owner has as many uploads under way as it may have: send it again in a moment")]
    Busy,
    /// What arrived is not what was announced.
    #[error("{what}: {fault}; send it again")]
    Corrupt {
        /// Which transfer.
        what: String,
        /// How it differs.
        fault: String,
    },
    /// A transfer is larger than allowed.
    #[error("{what} is larger than the {limit} bytes allowed")]
    TooLarge {
        /// Which transfer.
        what: String,
        /// The cap in bytes.
        limit: u64,
    },
    /// The queue is full.
    #[error("the queue holds {0} jobs, which is its limit: try again later")]
    QueueFull(u64),
    /// An owner has as much as it may have.
    #[error("{}", quota.text(*limit))]
    Quota {
        /// Of what.
        quota: Quota,
        /// How much it may have.
        limit: u64,
    },
    /// Another server owns the data directory.
    #[error(
        "{} is in use by another server: stop that one, or choose another --data-dir",
        .0.display()
    )]
    InUse(PathBuf),
    /// The database tells of other objects.
    #[error(
        "the objects in {0} are not those that the database tells of: give every server that shares \
         it the same --objects s3://..., and keep database and objects together when you move them"
    )]
    OtherObjects(String),
    /// The database failed.
    #[error("the job database failed: {0}")]
    Sql(#[from] sqlx::Error),
    /// The database is of another version.
    #[error("the job database cannot be brought up to date: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// A stored value cannot be read.
    #[error("a stored value of {what} cannot be read: {source}")]
    Stored {
        /// Which.
        what: String,
        /// Why.
        source: serde_json::Error,
    },
    /// The object directory failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which file or folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The object store failed.
    #[error("object {key}: {source}")]
    Objects {
        /// Which object, or which bucket.
        key: String,
        /// Why.
        source: object_store::Error,
    },
    /// The object store's address would send everything over the network in the clear.
    #[error(
        "the object store {0} is not on this machine and not encrypted: use an https:// endpoint"
    )]
    PlainEndpoint(String),
    /// A background task died.
    #[error("a background task ended early: {0}")]
    Task(#[from] tokio::task::JoinError),
}

fn again(until_ms: Option<i64>) -> &'static str {
    if until_ms.is_some() { "; it is tried again after a while" } else { "" }
}

/// What an owner may have only so much of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quota {
    /// Jobs that wait.
    Queued,
    /// Bytes of meshes and results.
    Bytes,
}

impl Quota {
    fn text(self, limit: u64) -> String {
        match self {
            Self::Queued => format!(
                "this owner has {limit} jobs waiting, which is its limit: try again later, or cancel some"
            ),
            Self::Bytes => format!(
                "the meshes and results of this owner may be {limit} bytes together, and would be \
                 more: delete jobs"
            ),
        }
    }
}

/// What a database says when it may answer later: SQLSTATE, or SQLite's code for a busy database, or for a disk that is
/// full or fails.
#[rustfmt::skip]
const PASSING: [&str; 19] = [
    // Serialization failure, deadlock, lock or statement timeout, idle transaction.
    "40001", "40P01", "55P03", "57014", "25P03",
    // Shutting down, crashed, starting up, a stand-by server, no room for connections.
    "57P01", "57P02", "57P03", "25006", "53300",
    "5", "261", "517", "773",
    "13", "778", "1034", "53100", "58030",
];

/// What it says when a transaction lost against another one: serialization failure, deadlock; a snapshot too old.
const LOST: [&str; 3] = ["40001", "40P01", "517"];

impl Error {
    /// Nothing is wrong with the request: the same may work in a moment.
    pub fn is_passing(&self) -> bool {
        match self {
            // Objects: after all attempts of their client.
            Self::Sql(sqlx::Error::Io(_) | sqlx::Error::PoolTimedOut | sqlx::Error::PoolClosed)
            | Self::Objects { source: object_store::Error::Generic { .. }, .. }
            | Self::UnderWay
            | Self::Busy => true,
            Self::Sql(sqlx::Error::Database(error)) => {
                // Class 08: the connection.
                error.code().is_some_and(|code| PASSING.contains(&&*code) || code.starts_with("08"))
            }
            _ => false,
        }
    }

    /// A transaction lost against another one, and nothing of it has happened.
    pub fn has_lost(&self) -> bool {
        match self {
            Self::Sql(sqlx::Error::Database(error)) => {
                error.code().is_some_and(|code| LOST.contains(&&*code))
            }
            _ => false,
        }
    }

    /// Wraps an I/O error with its path.
    pub fn io(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }

    /// One fault of a request.
    pub fn invalid(field: impl Into<String>, text: impl Into<String>) -> Self {
        Self::Invalid(vec![Fault { field: field.into(), text: text.into() }])
    }
}

/// Of many faults so many are told.
pub const MOST_TOLD: usize = 64;

fn list(faults: &[Fault]) -> String {
    let told = faults.iter().take(MOST_TOLD);
    told.map(|fault| format!("{}: {}", fault.field, fault.text)).collect::<Vec<_>>().join("; ")
}

/// Results of this module.
pub type Result<T> = std::result::Result<T, Error>;
