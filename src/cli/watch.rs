//! `lookalike watch`: follows the log of a job to its end.

use clap::Args;
use lookalike::jobs::state::State;

use super::{
    bar::Bar,
    exit::{Exit, Failure},
    remote::{Heard, Remote, ServerArgs},
    show,
};

/// Flags of `lookalike watch`.
#[derive(Args, Debug)]
pub(crate) struct WatchArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    /// Only what comes after this entry of the log.
    #[arg(long, default_value_t = 0, value_name = "N")]
    after_seq: u64,
    /// Print every entry as one JSON object a line.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn run(args: WatchArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    if args.json {
        let line = |heard: Heard<'_>| match heard {
            Heard::Entry(event) => show::print_or_end(&format!("{}\n", show::event_json(event))),
            Heard::Silence(text) => eprintln!("{text}"),
        };
        remote.follow(&args.job, args.after_seq, line).await?;
    } else {
        let mut bar = Bar::new();
        let end = remote.follow(&args.job, args.after_seq, |heard| bar.heard(heard)).await;
        bar.finish();
        end?;
    }
    verdict(&remote, &args.job).await
}

/// The exit code for how a job ended.
pub(crate) async fn verdict(remote: &Remote, job: &str) -> Result<(), Failure> {
    let job = remote.job(job).await?;
    match show::state_of(&job) {
        Some(State::Succeeded) => Ok(()),
        Some(State::Cancelled) => {
            Err(Failure::new(Exit::Cancelled, format!("{} was cancelled", job.name)))
        }
        _ => {
            let failure = job.failure.unwrap_or_default();
            let text = format!("{} failed: {}: {}", job.name, failure.reason, failure.text);
            Err(Failure::new(Exit::Failed, text))
        }
    }
}
