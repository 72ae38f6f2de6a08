//! The configuration of a server, read once from a file, the environment and the command line
//! (`settings.rs`), and checked as a whole: every fault is reported at once.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
    time::Duration,
};

mod guard;
mod settings;
mod traces;
mod webhooks;

use clap::Args;
use lookalike::{
    jobs::{Limits, Places, blobs::BucketName, lease::Terms, store::Address},
    service::webhook::WebhookRules,
};

use self::{
    guard::{Guard, GuardArgs},
    traces::TraceArgs,
    webhooks::WebhookArgs,
};
pub(crate) use self::{
    guard::{Port, TlsArgs},
    settings::Settings,
};

/// Flags of `lookalike serve`. Each can also be given as an environment variable, or in a file.
#[derive(Args, Clone, Debug)]
pub(crate) struct ServeArgs {
    /// A file of settings (TOML): the flags below by name, `_` for `-`, in a table [serve].
    #[arg(long, env = "LOOKALIKE_CONFIG", value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Show all settings and where each is from, without secrets, and end.
    #[arg(long)]
    pub(crate) print_config: bool,
    /// Where to listen for gRPC: an address and a port.
    #[arg(long, env = "LOOKALIKE_LISTEN", default_value = "127.0.0.1:7420")]
    pub(crate) listen: SocketAddr,
    /// Where jobs, meshes and results are kept.
    #[arg(long, env = "LOOKALIKE_DATA_DIR", value_name = "DIR")]
    pub(crate) data_dir: PathBuf,
    #[command(flatten)]
    pub(crate) stores: StoreArgs,
    /// Worker processes to run beside the server; 0 for none.
    #[arg(long, env = "LOOKALIKE_WORKERS", default_value_t = 1, value_name = "N")]
    pub(crate) workers: usize,
    /// Evaluator of the workers: auto, cpu, or the name of an adapter.
    #[arg(long, env = "LOOKALIKE_DEVICE", default_value = "auto")]
    pub(crate) device: String,
    /// Where to serve Prometheus metrics and health over HTTP.
    #[arg(long, env = "LOOKALIKE_METRICS_LISTEN", default_value = "127.0.0.1:7421")]
    pub(crate) metrics_listen: SocketAddr,
    /// Seconds after which a silent worker loses its job.
    #[arg(long, env = "LOOKALIKE_LEASE_SECS", default_value_t = 30.0, value_name = "SECS")]
    pub(crate) lease_secs: f64,
    /// Seconds between a worker's signs of life; at most half the lease.
    #[arg(long, env = "LOOKALIKE_HEARTBEAT_SECS", default_value_t = 10.0, value_name = "SECS")]
    pub(crate) heartbeat_secs: f64,
    /// Seconds of work between checkpoints, which is what a job whose worker is lost has to do again; 0 for none.
    #[arg(long, env = "LOOKALIKE_CHECKPOINT_SECS", default_value_t = 10.0, value_name = "SECS")]
    pub(crate) checkpoint_secs: f64,
    /// A job fails as POISONED when this many workers have lost it.
    #[arg(long, env = "LOOKALIKE_MAX_ATTEMPTS", default_value_t = 3, value_name = "N")]
    pub(crate) max_attempts: u32,
    /// A host that loses this many different jobs in a row gets no more for a while. Default: 3, or as --max-attempts
    /// where that is more.
    #[arg(long, env = "LOOKALIKE_MAX_IN_A_ROW", value_name = "N")]
    pub(crate) max_in_a_row: Option<u32>,
    /// How long that is, in seconds.
    #[arg(long, env = "LOOKALIKE_QUARANTINE_SECS", default_value_t = 600.0, value_name = "SECS")]
    pub(crate) quarantine_secs: f64,
    /// Seconds after which a job that waits gets the worker of one of lower priority.
    #[arg(long, env = "LOOKALIKE_PREEMPT_AFTER_SECS", default_value_t = 5.0, value_name = "SECS")]
    pub(crate) preempt_after_secs: f64,
    /// Jobs that may wait at once.
    #[arg(long, env = "LOOKALIKE_MAX_QUEUED", default_value_t = 100_000, value_name = "N")]
    pub(crate) max_queued: u64,
    /// Jobs of one owner that may wait at once.
    #[arg(long, env = "LOOKALIKE_MAX_OWNER_QUEUED", default_value_t = 100_000, value_name = "N")]
    pub(crate) max_owner_queued: u64,
    /// Meshes and results of one owner together, in MiB; 0 for no limit.
    #[arg(long, env = "LOOKALIKE_MAX_OWNER_MIB", default_value_t = 0, value_name = "MIB")]
    pub(crate) max_owner_mib: u64,
    /// Memory of each local worker, in MiB; one that needs more is ended. 0 for no limit.
    #[arg(long, env = "LOOKALIKE_WORKER_MEMORY_MIB", default_value_t = 16_384, value_name = "MIB")]
    pub(crate) worker_memory_mib: u64,
    /// Processor time of a job on a local worker, all threads together; 0 for no limit.
    #[arg(long, env = "LOOKALIKE_WORKER_CPU_SECS", default_value_t = 864_000, value_name = "SECS")]
    pub(crate) worker_cpu_secs: u64,
    /// Largest mesh file, in MiB.
    #[arg(long, env = "LOOKALIKE_MAX_MESH_MIB", default_value_t = 4096, value_name = "MIB")]
    pub(crate) max_mesh_mib: u64,
    /// Hours for which a mesh that no job names is kept; it is removed within an hour after that.
    #[arg(long, env = "LOOKALIKE_KEEP_MESHES_HOURS", default_value_t = 168, value_name = "HOURS")]
    pub(crate) keep_meshes_hours: u32,
    /// Hours for which the results of an ended job are kept, unless it is pinned; 0 for ever.
    #[arg(long, env = "LOOKALIKE_KEEP_RESULTS_HOURS", default_value_t = 0, value_name = "HOURS")]
    pub(crate) keep_results_hours: u32,
    /// Hours for which jobs are kept after their end, with their logs and results, unless they are pinned; 0 for ever.
    #[arg(long, env = "LOOKALIKE_KEEP_JOBS_HOURS", default_value_t = 0, value_name = "HOURS")]
    pub(crate) keep_jobs_hours: u32,
    /// Seconds that workers and open calls get to end in peace.
    #[arg(long, env = "LOOKALIKE_DRAIN_SECS", default_value_t = 10.0, value_name = "SECS")]
    pub(crate) drain_secs: f64,
    /// Log in JSON, one object a line.
    #[arg(long, env = "LOOKALIKE_LOG_JSON")]
    pub(crate) log_json: bool,
    #[command(flatten)]
    pub(crate) guard: GuardArgs,
    #[command(flatten)]
    webhooks: WebhookArgs,
    #[command(flatten)]
    traces: TraceArgs,
}

/// Where jobs and bytes are kept when not in the data directory.
#[derive(Args, Clone, Debug)]
pub(crate) struct StoreArgs {
    /// PostgreSQL database for the jobs, which several servers may share:
    /// postgres://USER:PASSWORD@HOST/DATABASE.
    #[arg(long, env = "LOOKALIKE_DATABASE", value_name = "URL", hide_env_values = true)]
    database: Option<String>,
    /// Bucket for meshes and results, s3://BUCKET/PREFIX; credentials, region and endpoint are read
    /// from the usual AWS_* variables.
    #[arg(long, env = "LOOKALIKE_OBJECTS", value_name = "URL")]
    objects: Option<String>,
}

impl StoreArgs {
    /// All places, with what is wrong with them added to `faults`.
    pub(crate) fn places(&self, data_dir: &Path, faults: &mut Vec<String>) -> Places {
        let mut places = Places::from(data_dir);
        // An empty variable is none.
        let given = |url: &Option<String>| url.clone().filter(|url| !url.is_empty());
        if let Some(url) = given(&self.database) {
            // The URL may hold a password.
            let fault = |text| faults.push(format!("--database: {text}"));
            places.database = Address::parse(&url).map_err(fault).ok();
        }
        if let Some(url) = given(&self.objects) {
            let fault = |text| faults.push(format!("--objects {text}"));
            places.bucket = BucketName::parse(&url).map_err(fault).ok();
        }
        places
    }
}

/// A server's configuration, sound as a whole.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ServeConfig {
    pub(crate) listen: SocketAddr,
    pub(crate) metrics_listen: SocketAddr,
    pub(crate) places: Places,
    pub(crate) n_workers: usize,
    pub(crate) device: String,
    pub(crate) terms: Terms,
    pub(crate) limits: Limits,
    pub(crate) guard: Guard,
    pub(crate) webhooks: WebhookRules,
    pub(crate) otlp_endpoint: Option<String>,
    pub(crate) worker_memory_mib: u64,
    pub(crate) worker_cpu_secs: u64,
    pub(crate) drain: Duration,
    pub(crate) log_json: bool,
}

const MAX_WORKERS: usize = 256;

impl ServeArgs {
    /// The configuration, or everything that is wrong with it.
    pub(crate) fn check(self) -> Result<ServeConfig, Vec<String>> {
        let mut faults = Vec::new();
        let guard = self.guard.check(self.listen, self.metrics_listen, &mut faults);
        if self.workers > MAX_WORKERS {
            faults.push(format!("--workers {}: use 0 to {MAX_WORKERS}", self.workers));
        }
        let lease = seconds(&mut faults, "--lease-secs", self.lease_secs);
        let heartbeat = seconds(&mut faults, "--heartbeat-secs", self.heartbeat_secs);
        let drain = seconds(&mut faults, "--drain-secs", self.drain_secs);
        let checkpoint = match self.checkpoint_secs {
            0.0 => Duration::ZERO,
            secs => seconds(&mut faults, "--checkpoint-secs", secs),
        };
        if heartbeat * 2 > lease {
            let text = "a lease must outlive one missed sign of life";
            faults.push(format!("--heartbeat-secs is more than half of --lease-secs: {text}"));
        }
        let quarantine = seconds(&mut faults, "--quarantine-secs", self.quarantine_secs);
        let preempt_after = seconds(&mut faults, "--preempt-after-secs", self.preempt_after_secs);
        let usual = Terms::default().max_in_a_row.max(self.max_attempts);
        let max_in_a_row = self.max_in_a_row.unwrap_or(usual);
        for (flag, n) in [("--max-attempts", self.max_attempts), ("--max-in-a-row", max_in_a_row)] {
            if n == 0 {
                faults.push(format!("{flag} 0: use at least 1"));
            }
        }
        let webhooks = self.webhooks.check(&mut faults);
        let otlp_endpoint = self.traces.check(|name| std::env::var(name).ok(), &mut faults);
        let places = self.stores.places(&self.data_dir, &mut faults);
        if !faults.is_empty() {
            return Err(faults);
        }
        Ok(ServeConfig {
            listen: self.listen,
            metrics_listen: self.metrics_listen,
            places,
            n_workers: self.workers,
            device: self.device,
            terms: Terms {
                lease,
                heartbeat,
                max_lost: self.max_attempts,
                max_in_a_row,
                quarantine,
                preempt_after,
                checkpoint,
            },
            limits: Limits {
                max_mesh_bytes: self.max_mesh_mib.saturating_mul(1 << 20),
                max_queued: self.max_queued,
                max_owner_queued: self.max_owner_queued,
                max_owner_bytes: most_bytes(self.max_owner_mib),
                keep_meshes: Duration::from_hours(self.keep_meshes_hours.into()),
                keep_results: kept_for(self.keep_results_hours),
                keep_jobs: kept_for(self.keep_jobs_hours),
                ..Limits::default()
            },
            guard,
            webhooks,
            otlp_endpoint,
            worker_memory_mib: self.worker_memory_mib,
            worker_cpu_secs: self.worker_cpu_secs,
            drain,
            log_json: self.log_json,
        })
    }
}

/// 0 hours is for ever.
fn kept_for(hours: u32) -> Option<Duration> {
    (hours > 0).then(|| Duration::from_hours(hours.into()))
}

/// 0 MiB is no limit.
fn most_bytes(mib: u64) -> u64 {
    if mib == 0 { u64::MAX } else { mib.saturating_mul(1 << 20) }
}

fn seconds(faults: &mut Vec<String>, flag: &str, secs: f64) -> Duration {
    if !(0.01..=1e6).contains(&secs) {
        faults.push(format!("{flag} {secs}: use 0.01 to 1000000 seconds"));
        return Duration::from_secs(1);
    }
    Duration::from_secs_f64(secs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Probe {
        #[command(flatten)]
        args: ServeArgs,
    }

    fn check(flags: &[&str]) -> Result<ServeConfig, Vec<String>> {
        let flags = ["probe", "--data-dir", "d"].iter().chain(flags);
        Probe::try_parse_from(flags).unwrap().args.check()
    }

    #[test]
    fn the_defaults_are_sound() {
        let config = check(&[]).unwrap();
        assert_eq!(config.terms, Terms::default());
        assert_eq!(config.limits, Limits::default());
    }

    #[test]
    fn every_fault_is_reported_at_once() {
        let faults = check(&[
            "--listen=0.0.0.0:1",
            "--metrics-listen=[::]:2",
            "--workers=257",
            "--lease-secs=5",
            "--drain-secs=nan",
            "--max-attempts=0",
            "--database=mysql://u:hush@h/db",
            "--objects=farm",
            "--webhook-secret=whsec_hush",
            "--webhook-url=http://hooks.test/",
            "--otlp-endpoint=http://u:hush@collector.test/",
        ]);
        let faults = faults.unwrap_err();
        assert_eq!(faults.len(), 11, "{faults:#?}");
        assert!(!faults.concat().contains("hush"), "{faults:#?}");
        assert!(faults[0].contains("give --tls-cert, --tls-key and --tokens"));
    }

    #[test]
    fn only_guarded_ports_are_open_to_others() {
        let tls = ["--tls-cert=c", "--tls-key=k"];
        let jwt = ["--jwks=j", "--jwt-issuer=i", "--jwt-audience=a"];
        let (open, metrics) = (["--listen=0.0.0.0:1"], ["--metrics-listen=0.0.0.0:2"]);
        let table: [(&[&[&str]], &[&str]); 10] = [
            (&[&open, &tls, &["--tokens=t"]], &[]),
            (&[&open, &tls, &jwt], &[]),
            (&[&open, &tls], &["without TLS and authentication"]),
            (&[&open, &["--tokens=t"]], &["without TLS and authentication"]),
            (&[&open, &["--insecure-listen=grpc"]], &[]),
            (&[&metrics, &tls, &["--tokens=t"]], &["--insecure-listen metrics"]),
            (&[&metrics, &["--insecure-listen=metrics"]], &[]),
            (&[&["--tls-cert=c"]], &["a certificate and its key"]),
            (&[&["--jwks=j"]], &["--jwt-issuer and --jwt-audience"]),
            (&[&tls, &["--tls-client-ca=a"]], &["--tokens FILE"]),
        ];
        for (flags, wanted) in table {
            let flags = flags.concat();
            let faults = check(&flags).err().unwrap_or_default();
            assert_eq!(faults.len(), wanted.len(), "{flags:?}: {faults:?}");
            for (fault, wanted) in faults.iter().zip(wanted) {
                assert!(fault.contains(wanted), "{flags:?}: {fault}");
            }
        }
    }
}
