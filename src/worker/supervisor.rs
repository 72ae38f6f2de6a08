//! Keeps a server's own workers alive: one child process each, started again with a growing pause.
//!
//! 1. A child gets a new identity at every start, so that its old leases cannot be mistaken for new.
//! 2. `LP_*` variables are withheld from children: `LP_NATIVE_VECTOR_WIDTH` makes Mesa's software
//!    rasterizer corrupt its heap.
//! 3. So are those of this program that hold secrets: a child shows who it is by the socket it calls on.
//! 4. Children may outlive a killed server; they hold their lock file until they end.
//!
//! Knows nothing of jobs: it reports who is gone.

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Stdio,
    time::{Duration, Instant},
};

use futures::future::join_all;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};
use tokio_util::sync::CancellationToken;

use crate::service::accept::SOCKET;

/// A child that lived this long was no false start.
const SOUND: Duration = Duration::from_secs(10);
const FIRST_PAUSE: Duration = Duration::from_millis(200);
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

/// The workers of a server.
#[derive(Clone, Debug)]
pub struct Crew {
    /// Memory of a worker in MiB, and seconds of processor time of its jobs; 0 for no limit.
    pub memory_mib: u64,
    /// See `memory_mib`.
    pub cpu_secs: u64,
    /// Device of every worker.
    pub device: String,
    /// How many.
    pub n_workers: usize,
    /// Where the server's socket is, and lock files are kept, one a worker: `{id}.lock`.
    pub locks: PathBuf,
    /// Where workers keep the files of jobs at work, one folder a worker.
    pub scratch: PathBuf,
    /// Stands in for an unset `XDG_RUNTIME_DIR`, without which Mesa is noisy.
    pub runtime_dir: PathBuf,
    /// Log in JSON.
    pub log_json: bool,
    /// How long a child may take to end; half of it to hand its job back.
    pub drain: Duration,
}

impl Crew {
    /// Keeps the workers running until `shutdown`; tells `gone` the identity of each that ended.
    pub async fn run(&self, shutdown: CancellationToken, gone: impl AsyncFn(String)) {
        self.sweep_scratch();
        if let Err(error) = self.create_runtime_dir() {
            tracing::warn!(%error, "no runtime folder for workers");
        }
        join_all((0..self.n_workers).map(|slot| self.keep(slot, &shutdown, &gone))).await;
    }

    /// Keeps one worker running.
    async fn keep(&self, slot: usize, shutdown: &CancellationToken, gone: &impl AsyncFn(String)) {
        let mut pause = FIRST_PAUSE;
        while !shutdown.is_cancelled() {
            let id = format!("local-{}", uuid::Uuid::new_v4().simple());
            let start = Instant::now();
            match self.spawn(&id, slot) {
                Ok(child) => self.watch(child, &id, shutdown).await,
                Err(error) => tracing::error!(%error, "a worker cannot be started"),
            }
            gone(id.clone()).await;
            let _ = fs::remove_dir_all(self.scratch.join(&id));
            pause =
                if start.elapsed() > SOUND { FIRST_PAUSE } else { (pause * 2).min(LONGEST_PAUSE) };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                () = shutdown.cancelled() => {}
            }
        }
    }

    /// Waits until a child has ended; asks it to when the server shuts down.
    async fn watch(&self, mut child: Child, id: &str, shutdown: &CancellationToken) {
        let pid = child.id();
        tracing::info!(worker = id, pid, "worker started");
        tokio::select! {
            status = child.wait() => tracing::warn!(worker = id, ?status, "worker ended"),
            () = shutdown.cancelled() => {
                let pid = pid.and_then(|pid| Pid::from_raw(pid as i32));
                if let Some(pid) = pid {
                    // It may have ended by itself just now.
                    let _ = kill_process(pid, Signal::TERM);
                }
                if tokio::time::timeout(self.drain, child.wait()).await.is_err() {
                    tracing::warn!(worker = id, "worker did not end in time and is killed");
                    let _ = child.kill().await;
                }
            }
        }
    }

    fn spawn(&self, id: &str, slot: usize) -> io::Result<Child> {
        let mut command = Command::new(program());
        command.arg0("lookalike").arg("worker").arg("--supervised");
        // Addresses of Unix sockets are short, those of folders may be long.
        command.current_dir(&self.locks).arg("--connect").arg(format!("unix:{SOCKET}"));
        command.arg("--device").arg(&self.device).arg("--id").arg(id);
        command.arg("--host").arg(host_name(&format!("-{slot}")));
        command.arg("--memory-mib").arg(self.memory_mib.to_string());
        command.arg("--cpu-secs").arg(self.cpu_secs.to_string());
        command.arg("--drain-secs").arg((self.drain.as_secs_f64() / 2.0).to_string());
        command.arg("--lock").arg(self.locks.join(format!("{id}.lock")));
        command.arg("--scratch").arg(self.scratch.join(id));
        if self.log_json {
            command.arg("--log-json");
        }
        for (name, _) in std::env::vars_os() {
            if is_withheld(&name.to_string_lossy()) {
                command.env_remove(name);
            }
        }
        if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
            command.env("XDG_RUNTIME_DIR", &self.runtime_dir);
        }
        command.stdin(Stdio::null()).spawn()
    }

    fn create_runtime_dir(&self) -> io::Result<()> {
        use std::os::unix::fs::PermissionsExt;
        fs::create_dir_all(&self.runtime_dir)?;
        fs::set_permissions(&self.runtime_dir, fs::Permissions::from_mode(0o700))
    }

    /// Removes the folders of workers that no longer live; those that do have a lock file.
    fn sweep_scratch(&self) {
        for entry in fs::read_dir(&self.scratch).into_iter().flatten().flatten() {
            let id = entry.file_name().to_string_lossy().into_owned();
            if !self.locks.join(format!("{id}.lock")).exists() {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }
}

/// The name of this machine as one that a server takes, at most 64 characters, with `suffix` behind it.
pub fn host_name(suffix: &str) -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let is_plain = |c: &char| c.is_ascii_alphanumeric() || "._-".contains(*c);
    let room = 64 - suffix.len().min(64);
    let name: String = name.trim_start_matches('.').chars().filter(is_plain).take(room).collect();
    if name.is_empty() { format!("local{suffix}") } else { format!("{name}{suffix}") }
}

/// What workers must not find in their environment: settings that make lavapipe abort, and the ways
/// into the database, the bucket and other servers, which are not theirs.
const WITHHELD: [&str; 9] = [
    "LP_",
    "AWS_",
    "OTEL_",
    "PG",
    "LOOKALIKE_CONFIG",
    "LOOKALIKE_DATABASE",
    "LOOKALIKE_OBJECTS",
    "LOOKALIKE_TOKEN",
    "LOOKALIKE_WEBHOOK",
];

fn is_withheld(variable: &str) -> bool {
    WITHHELD.iter().any(|prefix| variable.starts_with(prefix))
}

/// This program. The link stays good when the file is replaced by an upgrade.
fn program() -> PathBuf {
    let link = Path::new("/proc/self/exe");
    if link.exists() {
        link.into()
    } else {
        std::env::current_exe().unwrap_or_else(|_| link.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rasterizer_settings_and_credentials_are_withheld() {
        for withheld in [
            "LP_NATIVE_VECTOR_WIDTH",
            "AWS_SECRET_ACCESS_KEY",
            "OTEL_EXPORTER_OTLP_HEADERS",
            "LOOKALIKE_DATABASE",
            "LOOKALIKE_TOKEN",
            "LOOKALIKE_WEBHOOK_SECRET",
        ] {
            assert!(is_withheld(withheld), "{withheld}");
        }
        for passed_on in ["HELP_ME", "PATH", "LOOKALIKE_DEVICE"] {
            assert!(!is_withheld(passed_on), "{passed_on}");
        }
    }
}
