//! `lookalike worker`: a worker process.

use std::{path::PathBuf, time::Duration};

use clap::Args;
use lookalike::worker::{
    agent::{self, WorkerConfig, WorkerError},
    confine,
    pipeline::{self, DeviceChoice},
    supervisor,
};
use tokio_util::sync::CancellationToken;

use super::{
    exit::{Exit, Failure},
    remote::AccessArgs,
    signals,
};

/// Flags of `lookalike worker`.
#[derive(Args, Debug)]
pub(crate) struct WorkerArgs {
    /// A file of settings (TOML): the flags below by name, `_` for `-`, in a table [worker].
    #[arg(long, env = "LOOKALIKE_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    /// Show all settings and where each is from, without secrets, and end.
    #[arg(long)]
    pub(crate) print_config: bool,
    /// The server's URL, or unix:PATH for its socket.
    #[arg(
        long,
        env = "LOOKALIKE_SERVER",
        default_value = "http://127.0.0.1:7420",
        value_name = "URL"
    )]
    connect: String,
    /// Evaluator: auto, cpu, or the name of an adapter.
    #[arg(long, env = "LOOKALIKE_DEVICE", default_value = "auto")]
    device: String,
    /// Names this incarnation of the worker. Default: a new name.
    #[arg(long)]
    id: Option<String>,
    /// Names what this worker runs on, when a machine has several devices. Default: the machine's name. A host that loses
    /// several jobs in a row gets none for a while.
    #[arg(long, env = "LOOKALIKE_HOST")]
    host: Option<String>,
    /// A folder for the files of the job at work; it is emptied.
    #[arg(long, env = "LOOKALIKE_SCRATCH", value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// A file to hold locked as long as this process lives.
    #[arg(long, value_name = "FILE", hide = true)]
    lock: Option<PathBuf>,
    /// End when the parent process is gone and there is nothing to do.
    #[arg(long, hide = true)]
    supervised: bool,
    /// End when the server does not answer for so many seconds.
    #[arg(long, env = "LOOKALIKE_GIVE_UP_SECS", default_value_t = 60, value_name = "SECS")]
    give_up_secs: u64,
    /// Seconds that a job gets to stop in when it has to be handed back, because this worker is to end, to be drained or to
    /// make room.
    #[arg(long, env = "LOOKALIKE_DRAIN_SECS", default_value_t = 10.0, value_name = "SECS")]
    drain_secs: f64,
    /// Memory of this process, in MiB; it ends when it needs more. 0 for no limit.
    #[arg(long, env = "LOOKALIKE_WORKER_MEMORY_MIB", default_value_t = 0, value_name = "MIB")]
    memory_mib: u64,
    /// Processor time of a job, all threads together; 0 for no limit.
    #[arg(long, env = "LOOKALIKE_WORKER_CPU_SECS", default_value_t = 0, value_name = "SECS")]
    cpu_secs: u64,
    #[command(flatten)]
    access: AccessArgs,
    /// Log in JSON, one object a line.
    #[arg(long, env = "LOOKALIKE_LOG_JSON")]
    pub(crate) log_json: bool,
}

pub(crate) async fn run(args: WorkerArgs) -> Result<(), Failure> {
    let drain = Duration::try_from_secs_f64(args.drain_secs).map_err(|_| {
        let text = format!("--drain-secs {}: use a number of seconds", args.drain_secs);
        Failure::new(Exit::Usage, text)
    })?;
    let id = args.id.unwrap_or_else(|| format!("remote-{}", uuid::Uuid::new_v4().simple()));
    let scratch =
        args.scratch.unwrap_or_else(|| std::env::temp_dir().join(format!("lookalike-{id}")));
    confine::limit_resources(args.memory_mib);
    if args.connect.starts_with("unix:") {
        confine::leave_the_network();
    }
    let config = WorkerConfig {
        url: args.connect,
        access: args.access.access(),
        id,
        host: args.host.unwrap_or_else(|| supervisor::host_name("")),
        device: DeviceChoice(args.device),
        pipeline: pipeline::run,
        scratch,
        lock: args.lock,
        supervised: args.supervised,
        drain,
        give_up: Duration::from_secs(args.give_up_secs),
        cpu_secs: args.cpu_secs,
    };
    let drain = CancellationToken::new();
    let mut agent = agent::run(config, drain.clone());
    let ended = tokio::select! {
        ended = &mut agent => ended,
        () = signals::asked_to_end() => {
            drain.cancel();
            agent.await
        }
    };
    if let Err(error @ WorkerError::Stuck) = &ended {
        // The end of `main` would wait for the pipeline. It is no failure when this worker was to end.
        let exit = if drain.is_cancelled() { 0 } else { Exit::Failed as i32 };
        tracing::warn!(%error, "ending at once");
        std::process::exit(exit);
    }
    ended.map_err(|error| {
        let exit = match error {
            WorkerError::Unreachable { .. } => Exit::Unreachable,
            WorkerError::Url(_) => Exit::Usage,
            _ => Exit::Failed,
        };
        Failure::new(exit, error.to_string())
    })
}
