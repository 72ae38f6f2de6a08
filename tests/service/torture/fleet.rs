//! Servers that share what they keep, and workers that have joined from elsewhere.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    process::{Child, Stdio},
};

use tempfile::TempDir;

use super::{LEASE_SECS, Pair};
use crate::{
    farm::Farm,
    support::{Client, Server, lookalike},
};

/// Everything that runs.
pub(crate) struct Fleet {
    pub(crate) servers: Vec<Server>,
    /// One for each server, to begin with.
    pub(crate) workers: Vec<Joined>,
    /// PostgreSQL and a bucket, where the pair is that.
    pub(crate) farm: Option<Farm>,
    folder: TempDir,
}

impl Fleet {
    /// Starts servers and workers; `None`, and a line that says so, when PostgreSQL is missing.
    pub(crate) fn start(pair: Pair) -> Option<Self> {
        let lease = format!("--lease-secs={LEASE_SECS}");
        let flags =
            [&lease, "--heartbeat-secs=0.5", "--max-attempts=1000000", "--checkpoint-secs=0.2"];
        let with = |n_workers: &'static str| [&flags[..], &[n_workers]].concat();
        let (farm, servers) = match pair {
            Pair::Local => (None, vec![Server::start_with(&with("--workers=1"))]),
            Pair::Shared => {
                let farm = Farm::start()?;
                let servers = ["--workers=1", "--workers=0"];
                let servers = servers.map(|n_workers| farm.server(&with(n_workers)));
                (Some(farm), servers.into())
            }
        };
        let folder = tempfile::tempdir().unwrap();
        let mut fleet = Self { servers, workers: Vec::new(), farm, folder };
        (0..fleet.servers.len()).for_each(|server| fleet.join(server));
        Some(fleet)
    }

    /// Has a worker join a server.
    pub(crate) fn join(&mut self, server: usize) {
        let id = format!("joined-{}", uuid::Uuid::new_v4().simple());
        let url = self.servers[server].url.clone();
        self.workers.push(Joined::start(id, server, &url, self.folder.path()));
    }

    pub(crate) fn client(&self, server: usize) -> Client {
        self.servers[server % self.servers.len()].client()
    }

    /// What the servers, their own workers and those that joined have logged.
    pub(crate) fn logged(&self) -> String {
        let servers = self.servers.iter().map(Server::logged);
        let joined = fs::read_dir(self.folder.path()).unwrap().map(|entry| entry.unwrap().path());
        let joined = joined.filter(|path| path.extension().is_some_and(|e| e == "log"));
        servers.chain(joined.map(|path| fs::read_to_string(path).unwrap())).collect()
    }
}

/// A worker process that no server supervises.
pub(crate) struct Joined {
    pub(crate) id: String,
    /// Which server it works for.
    pub(crate) server: usize,
    child: Child,
    scratch: PathBuf,
}

impl Joined {
    pub(crate) fn start(id: String, server: usize, url: &str, folder: &Path) -> Self {
        let log = File::create(folder.join(format!("{id}.log"))).unwrap();
        let scratch = folder.join(&id);
        let mut worker = lookalike();
        worker.args(["worker", "--device=cpu", "--give-up-secs=120", "--connect", url, "--id"]);
        worker.arg(&id).arg("--scratch").arg(&scratch).stderr(log).stdout(Stdio::null());
        Self { id, server, child: worker.spawn().unwrap(), scratch }
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn lives(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }
}

impl Drop for Joined {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = fs::remove_dir_all(&self.scratch);
    }
}
