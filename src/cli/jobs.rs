//! `lookalike jobs`, `cancel`, `retry`, `pin` and `delete`.

use std::time::Duration;

use clap::Args;
use lookalike::{
    jobs::state::State,
    service::{convert, proto::v1},
};
use prost_types::Timestamp;

use super::{
    exit::{Exit, Failure},
    remote::{Remote, ServerArgs, job_name},
    show::{job_json, job_line, print, state_of},
};

/// Flags of `lookalike jobs`.
#[derive(Args, Debug)]
pub(crate) struct JobsArgs {
    /// Only jobs in these states, separated by commas.
    #[arg(long, value_delimiter = ',', value_name = "STATE")]
    state: Vec<State>,
    /// Only this owner's jobs (administrators; others see their own).
    #[arg(long, value_name = "OWNER", default_value = "", hide_default_value = true)]
    owner: String,
    /// Only jobs with this label; may be given several times.
    #[arg(long = "label", value_name = "KEY=VALUE")]
    labels: Vec<String>,
    /// Only jobs created at this time (RFC 3339, such as 2026-05-01T00:00:00Z) or later.
    #[arg(long, value_name = "TIME")]
    from: Option<Timestamp>,
    /// Only jobs created before this time.
    #[arg(long, value_name = "TIME")]
    until: Option<Timestamp>,
    /// At most this many, newest first.
    #[arg(long, default_value_t = 1000, value_name = "N")]
    limit: usize,
    /// One JSON object a line.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

/// Flags of `lookalike cancel`.
#[derive(Args, Debug)]
pub(crate) struct CancelArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    /// Return as soon as the request is noted, before the worker confirms.
    #[arg(long)]
    no_wait: bool,
    #[command(flatten)]
    server: ServerArgs,
}

/// Flags of `lookalike retry`.
#[derive(Args, Debug)]
pub(crate) struct RetryArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    #[command(flatten)]
    server: ServerArgs,
}

/// Flags of `lookalike delete`.
#[derive(Args, Debug)]
pub(crate) struct DeleteArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    #[command(flatten)]
    server: ServerArgs,
}

/// Flags of `lookalike pin`.
#[derive(Args, Debug)]
pub(crate) struct PinArgs {
    /// The job, `jobs/{id}` or just the id.
    job: String,
    /// Let the results go when their time is up.
    #[arg(long)]
    undo: bool,
    #[command(flatten)]
    server: ServerArgs,
}

pub(crate) async fn list(args: JobsArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let states = args.state.iter().map(|state| convert::state_to_wire(*state).into()).collect();
    let mut request = v1::ListJobsRequest {
        page_size: 100,
        page_token: String::new(),
        states,
        owner: args.owner,
        labels: args.labels,
        create_time_from: args.from,
        create_time_until: args.until,
    };
    let mut left = args.limit;
    loop {
        let page = remote.call(|mut client| {
            let request = request.clone();
            async move { client.list_jobs(request).await }
        });
        let page = page.await?;
        for job in page.jobs.into_iter().take(left) {
            left -= 1;
            print(&if args.json { format!("{}\n", job_json(job)) } else { job_line(&job) });
        }
        if left == 0 || page.next_page_token.is_empty() {
            return Ok(());
        }
        request.page_token = page.next_page_token;
    }
}

pub(crate) async fn cancel(args: CancelArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let mut job = remote.cancel(&args.job).await?;
    while !args.no_wait && state_of(&job).is_some_and(|state| !state.is_final()) {
        tokio::time::sleep(Duration::from_millis(100)).await;
        job = remote.job(&args.job).await?;
    }
    print(&job_line(&job));
    match state_of(&job) {
        Some(State::Succeeded | State::Failed) => {
            let text = format!("{} ended before it could be cancelled", job.name);
            Err(Failure::new(Exit::Failed, text))
        }
        _ => Ok(()),
    }
}

pub(crate) async fn retry(args: RetryArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let request = v1::RetryJobRequest { name: job_name(&args.job) };
    let answer = remote.call(|mut client| {
        let request = request.clone();
        async move { client.retry_job(request).await }
    });
    print(&job_line(&remote.present(answer.await?.job)?));
    Ok(())
}

pub(crate) async fn pin(args: PinArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let request = v1::PinJobRequest { name: job_name(&args.job), pinned: !args.undo };
    let answer = remote.call(|mut client| {
        let request = request.clone();
        async move { client.pin_job(request).await }
    });
    let job = remote.present(answer.await?.job)?;
    let what =
        if job.pinned { "is pinned: its results are kept" } else { "is not pinned any more" };
    print(&format!("{} {what}\n", job.name));
    Ok(())
}

pub(crate) async fn delete(args: DeleteArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    let request = v1::DeleteJobRequest { name: job_name(&args.job), allow_missing: false };
    let answer = remote.call(|mut client| {
        let request = request.clone();
        async move { client.delete_job(request).await }
    });
    answer.await?;
    print(&format!("{} is deleted\n", job_name(&args.job)));
    Ok(())
}
