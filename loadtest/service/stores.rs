//! The two pairs of stores, and servers on them.

use crate::{postgres::Cluster, s3::S3, support::Server};

/// A pair of stores.
pub(crate) enum Stores {
    Local,
    Shared { cluster: Box<Cluster>, bucket: S3, n_servers: usize },
}

impl Stores {
    /// Both, or the first where PostgreSQL is missing.
    pub(crate) fn all() -> Vec<Self> {
        let shared = Cluster::start().map(|cluster| Self::Shared {
            cluster: Box::new(cluster),
            bucket: S3::start(),
            n_servers: 0,
        });
        std::iter::once(Self::Local).chain(shared).collect()
    }

    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Local => "SQLite, directory",
            Self::Shared { .. } => "PostgreSQL, S3",
        }
    }

    /// A server with empty stores of its own, and without workers.
    pub(crate) fn server(&mut self, flags: &[&str]) -> Server {
        let flags = [flags, &["--workers=0"]].concat();
        let environment = match self {
            Self::Local => Vec::new(),
            Self::Shared { cluster, bucket, n_servers } => {
                *n_servers += 1;
                let mut environment = bucket.environment();
                environment.push(("LOOKALIKE_DATABASE".into(), cluster.create()));
                let objects = format!("{}/{n_servers}", S3::url());
                environment.push(("LOOKALIKE_OBJECTS".into(), objects));
                environment
            }
        };
        Server::start_in(&flags, environment)
    }
}
