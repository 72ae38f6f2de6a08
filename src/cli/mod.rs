//! The command line: one file a command, and the exit codes that scripts rely on.
//!
//! 0 done, 1 the job (or the command) failed, 2 wrong usage, 3 no server, 130 cancelled. Every error
//! says what to do next.

mod bar;
mod compare;
mod doctor;
mod exit;
mod extract;
mod fetch;
mod job;
mod job_args;
mod jobs;
mod leftovers;
mod optimize;
mod optimize_args;
mod out_file;
mod output_args;
mod picture_args;
mod quiet;
mod remote;
mod run;
mod sample;
mod serve;
mod show;
mod signals;
mod submit;
mod summary;
mod token;
mod watch;
mod worker;
mod workers;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use lookalike::telemetry;

use self::exit::Failure;
use crate::config::Settings;

/// Levels of detail that look alike: image-driven mesh simplification.
#[derive(Parser, Debug)]
#[command(version, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Run a server, with its own workers.
    Serve(Box<crate::config::ServeArgs>),
    /// Run a worker for a server.
    Worker(worker::WorkerArgs),
    /// Simplify a file on a server: upload, wait, fetch the result.
    Submit(submit::SubmitArgs),
    /// Follow a job on a server.
    Watch(watch::WatchArgs),
    /// List the jobs of a server.
    Jobs(jobs::JobsArgs),
    /// Tell all of one job: times, labels, failure, attempts.
    Job(job::JobArgs),
    /// Cancel a job.
    Cancel(jobs::CancelArgs),
    /// Queue a job anew that failed or was cancelled.
    Retry(jobs::RetryArgs),
    /// Keep the results of a job beyond the time that the server keeps them.
    Pin(jobs::PinArgs),
    /// Delete a job that has ended, with its results.
    Delete(jobs::DeleteArgs),
    /// List the workers of a server, take one out of service or back into it (administrators).
    Workers(workers::WorkersArgs),
    /// Fetch the results of a job.
    Fetch(fetch::FetchArgs),
    /// Simplify a file in this process, without a server.
    Run(run::RunArgs),
    /// Make a mesh that any tool has simplified look more like its original.
    Optimize(Box<optimize::OptimizeCommandArgs>),
    /// Tell how much a simplified mesh looks like its original: pictures and distances.
    Compare(Box<compare::CompareArgs>),
    /// Take any level of detail out of a progressive mesh.
    Extract(extract::ExtractArgs),
    /// Write a sample model to try things on.
    Sample(sample::SampleArgs),
    /// Make a token for a server that asks who calls.
    Token(token::TokenArgs),
    /// Find out what is wrong with this machine or server, and how to mend it.
    Doctor(doctor::DoctorArgs),
    /// Print a completion script for a shell.
    Completions {
        /// Which shell.
        shell: clap_complete::Shell,
    },
}

/// Reads the command line, runs the command, reports its error.
pub(crate) async fn run() -> ExitCode {
    let root = Cli::command();
    let settings =
        Settings::gather(&root, std::env::args_os().collect(), |name| std::env::var_os(name));
    match Cli::try_parse_from(&settings.argv) {
        Ok(cli) if settings.faults.is_empty() => {
            if cli.command.opens_devices() {
                quiet::start_over();
            }
            init_logs(&cli.command);
            let ran = if cli.command.shows_settings() {
                cli.command.check().map(|()| show::print(&settings.show(&root)))
            } else {
                dispatch(cli.command).await
            };
            ran.map_or_else(|failure| failure.at(&settings).report(), |()| ExitCode::SUCCESS)
        }
        Err(error) if settings.faults.is_empty() => error.exit(),
        _ => Failure::faults(&settings.faults).report(),
    }
}

impl Command {
    /// Looks for devices in this process.
    fn opens_devices(&self) -> bool {
        matches!(self, Self::Run(_) | Self::Optimize(_) | Self::Worker(_) | Self::Doctor(_))
    }

    /// Only the settings are asked for.
    fn shows_settings(&self) -> bool {
        match self {
            Self::Serve(args) => args.print_config,
            Self::Worker(args) => args.print_config,
            _ => false,
        }
    }

    /// Whether the settings are sound as a whole.
    fn check(self) -> Result<(), Failure> {
        match self {
            Self::Serve(args) => args.check().map(drop).map_err(|faults| Failure::faults(&faults)),
            _ => Ok(()),
        }
    }
}

/// Roles log what they do; commands only what goes wrong.
fn init_logs(command: &Command) {
    let (level, json) = match command {
        Command::Serve(args) => ("info", args.log_json),
        Command::Worker(args) => ("info", args.log_json),
        _ => ("warn", false),
    };
    telemetry::init_logs(level, std::env::var("RUST_LOG").ok().as_deref(), json);
}

async fn dispatch(command: Command) -> Result<(), Failure> {
    match command {
        Command::Serve(args) => Box::pin(serve::run(*args)).await,
        Command::Worker(args) => worker::run(args).await,
        Command::Submit(args) => submit::run(args).await,
        Command::Watch(args) => watch::run(args).await,
        Command::Jobs(args) => jobs::list(args).await,
        Command::Job(args) => job::run(args).await,
        Command::Cancel(args) => jobs::cancel(args).await,
        Command::Retry(args) => jobs::retry(args).await,
        Command::Pin(args) => jobs::pin(args).await,
        Command::Delete(args) => jobs::delete(args).await,
        Command::Workers(args) => workers::run(args).await,
        Command::Fetch(args) => fetch::run(args).await,
        Command::Run(args) => run::run(args).await,
        Command::Optimize(args) => optimize::run(*args).await,
        Command::Compare(args) => compare::run(*args).await,
        Command::Extract(args) => extract::run(&args),
        Command::Sample(args) => sample::run(&args),
        Command::Token(args) => token::run(&args),
        Command::Doctor(args) => doctor::run(args).await,
        Command::Completions { shell } => {
            let mut out = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "lookalike", &mut out);
            show::print(&String::from_utf8_lossy(&out));
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Cli::command().debug_assert();
    }
}
