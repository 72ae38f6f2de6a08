//! The two databases: SQLite in a file, PostgreSQL behind an address; one text of SQL for both.
//!
//! SQL is written for SQLite, with placeholders that both know (`$1`). What PostgreSQL alone needs to
//! be told stands in comments (`/*pg FOR UPDATE */`), and what it calls by another name is in
//! [`NAMES`]. This holds for queries and migrations alike.
//!
//! SQLite locks the whole database for a transaction that writes; PostgreSQL locks the rows that
//! `FOR UPDATE` names. Both commit durably before they answer.

use std::{borrow::Cow, path::Path, time::Duration};

use sqlx::{
    AnyConnection, AnyPool, AssertSqlSafe,
    any::{AnyConnectOptions, AnyPoolOptions, install_default_drivers},
    migrate::{Migration, MigrationType, Migrator},
};

use crate::jobs::error::{Error, Result};

/// A database to be opened.
#[derive(Clone, PartialEq, Eq)]
pub struct Address {
    url: String,
    dialect: &'static Dialect,
}

/// Without the password that the address may hold.
impl std::fmt::Debug for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.dialect.backend)
    }
}

impl Address {
    /// A SQLite file, created when it is not there.
    pub fn file(path: &Path) -> Result<Self> {
        let path = std::path::absolute(path).map_err(Error::io(path))?;
        // What is special in a URL is escaped.
        let escape = |byte: u8| match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => {
                char::from(byte).to_string()
            }
            _ => format!("%{byte:02X}"),
        };
        let path: String =
            path.as_os_str().as_encoded_bytes().iter().copied().map(escape).collect();
        Ok(Self { url: format!("sqlite://{path}?mode=rwc"), dialect: &SQLITE })
    }

    /// A PostgreSQL database by its URL.
    pub fn parse(url: &str) -> std::result::Result<Self, String> {
        let scheme = url.split_once("://").map_or("", |(scheme, _)| scheme);
        if !["postgres", "postgresql"].contains(&scheme)
            || url.parse::<AnyConnectOptions>().is_err()
        {
            return Err("use postgres://USER:PASSWORD@HOST/DATABASE".into());
        }
        Ok(Self { url: url.into(), dialect: &POSTGRES })
    }

    /// Several servers may use it at once.
    pub fn is_shared(&self) -> bool {
        self.dialect == &POSTGRES
    }

    pub(super) fn url(&self) -> &str {
        &self.url
    }

    /// Connections for writing and for reading, to a database that is up to date.
    pub(super) async fn connect(&self) -> Result<(AnyPool, AnyPool)> {
        let writers = self.pool(self.dialect.n_writers).await?;
        self.dialect.migrations().run(&writers).await?;
        Ok((writers, self.pool(N_READERS).await?))
    }

    /// Connects.
    pub(super) async fn pool(&self, n_connections: u32) -> Result<AnyPool> {
        install_default_drivers();
        let options: AnyConnectOptions = self.url.parse()?;
        let session = self.dialect.session;
        let pool = AnyPoolOptions::new()
            .max_connections(n_connections)
            .acquire_timeout(self.dialect.patience)
            .after_connect(move |conn, _| {
                Box::pin(async move {
                    sqlx::raw_sql(session).execute(conn).await?;
                    Ok(())
                })
            });
        Ok(pool.connect_with(options).await?)
    }

    pub(super) fn begin(&self) -> &'static str {
        self.dialect.begin
    }
}

const N_READERS: u32 = 4;

#[derive(Debug, PartialEq, Eq)]
struct Dialect {
    /// As sqlx calls it.
    backend: &'static str,
    /// Begins a transaction that may read before it writes.
    begin: &'static str,
    /// Once for each connection.
    session: &'static str,
    /// SQLite has one writer at a time: writers of this process queue for the connection, not at
    /// SQLite's lock.
    n_writers: u32,
    /// How long a call waits for a connection before it is told to come back. SQLite's are never
    /// away, only busy.
    patience: Duration,
    /// What is called otherwise than in SQLite, longer names first.
    names: &'static [(&'static str, &'static str)],
}

static SQLITE: Dialect = Dialect {
    backend: "SQLite",
    begin: "BEGIN IMMEDIATE",
    session: "PRAGMA busy_timeout = 5000; PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; \
              PRAGMA foreign_keys = ON",
    n_writers: 1,
    patience: Duration::from_secs(30),
    names: &[],
};

static POSTGRES: Dialect = Dialect {
    backend: "PostgreSQL",
    begin: "BEGIN ISOLATION LEVEL READ COMMITTED READ WRITE",
    session: "SET synchronous_commit = on; SET lock_timeout = '10s'; SET statement_timeout = '60s'; \
              SET idle_in_transaction_session_timeout = '60s'",
    n_writers: 8,
    patience: Duration::from_secs(5),
    names: NAMES,
};

/// SQLite's names and PostgreSQL's. A change changes migrations that databases have been through:
/// only add what no migration contains.
const NAMES: &[(&str, &str)] = &[
    ("/*pg ", ""),
    ("*/", ""),
    ("unixepoch('subsec')", "extract(epoch FROM clock_timestamp())"),
    ("INTEGER PRIMARY KEY AUTOINCREMENT", "BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY"),
    ("INTEGER", "BIGINT"),
    ("REAL", "DOUBLE PRECISION"),
    // Texts are compared byte by byte, as in SQLite.
    ("TEXT", "TEXT COLLATE \"C\""),
    (" STRICT, WITHOUT ROWID;", ";"),
    (" STRICT;", ";"),
];

impl Dialect {
    fn text<'t>(&self, sql: &'t str) -> Cow<'t, str> {
        let replace = |text: Cow<'t, str>, (from, to): &(&str, &str)| {
            if text.contains(from) { Cow::Owned(text.replace(from, to)) } else { text }
        };
        self.names.iter().fold(Cow::Borrowed(sql), replace)
    }

    fn migrations(&self) -> Migrator {
        let table = [
            (1, "jobs", include_str!("../migrations/0001_jobs.sql")),
            (2, "owners", include_str!("../migrations/0002_owners.sql")),
            (3, "objects", include_str!("../migrations/0003_objects.sql")),
            (10, "webhooks", include_str!("../migrations/0010_webhooks.sql")),
            (11, "results", include_str!("../migrations/0011_results.sql")),
            (12, "checkpoints", include_str!("../migrations/0012_checkpoints.sql")),
            (13, "attempts", include_str!("../migrations/0013_attempts.sql")),
            (14, "queue", include_str!("../migrations/0014_queue.sql")),
            (15, "traces", include_str!("../migrations/0015_traces.sql")),
            (16, "labels", include_str!("../migrations/0016_labels.sql")),
            (17, "inputs", include_str!("../migrations/0017_inputs.sql")),
        ];
        let migration = |(version, name, sql): (i64, &'static str, &'static str)| {
            let sql = sqlx::SqlSafeStr::into_sql_str(AssertSqlSafe(self.text(sql).into_owned()));
            Migration::new(version, Cow::Borrowed(name), MigrationType::Simple, sql, false)
        };
        Migrator::with_migrations(table.into_iter().map(migration).collect())
    }
}

/// SQL as the database behind `conn` wants it. Only for texts that the two know differently.
pub(super) fn sql(conn: &AnyConnection, text: &str) -> AssertSqlSafe<String> {
    let dialect = [&SQLITE, &POSTGRES].into_iter().find(|d| d.backend == conn.backend_name());
    AssertSqlSafe(dialect.unwrap_or(&SQLITE).text(text).into_owned())
}

/// `($3, $4, $5)`: `n` placeholders from number `first` on.
pub(super) fn places(first: usize, n: usize) -> String {
    let places: Vec<_> = (first..first + n).map(|i| format!("${i}")).collect();
    format!("({})", places.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_checked_and_keep_their_password_to_themselves() {
        for good in ["postgres://u:secret@h:1/db", "postgresql:///db?host=/run"] {
            let address = Address::parse(good).unwrap();
            assert!(address.is_shared() && !format!("{address:?}").contains("secret"));
        }
        for bad in ["", "db", "sqlite://x", "mysql://u:secret@h/db", "postgres://h:port/db"] {
            let fault = Address::parse(bad).unwrap_err();
            assert!(fault.contains("postgres://") && !fault.contains("secret"), "{bad}: {fault}");
        }
        assert!(!Address::file(Path::new("x")).unwrap().is_shared());
    }

    #[test]
    fn one_text_serves_both() {
        let text = "SELECT a FROM b WHERE c = $1 /*pg FOR UPDATE */";
        assert_eq!(SQLITE.text(text), text);
        assert_eq!(POSTGRES.text(text), "SELECT a FROM b WHERE c = $1 FOR UPDATE ");
        let table =
            "CREATE TABLE t (a INTEGER PRIMARY KEY AUTOINCREMENT, b INTEGER, c TEXT) STRICT;";
        let wanted = "CREATE TABLE t (a BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, b BIGINT, \
                      c TEXT COLLATE \"C\");";
        assert_eq!(POSTGRES.text(table), wanted);
        assert_eq!(places(3, 2), "($3, $4)");
    }
}
