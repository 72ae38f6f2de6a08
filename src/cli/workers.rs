//! `lookalike workers`: the hosts that workers run on, and whether they get jobs.

use clap::{Args, Subcommand};
use lookalike::service::{convert, proto::v1};

use super::{
    exit::Failure,
    remote::{Remote, ServerArgs},
    show::print,
};

/// Flags of `lookalike workers`.
#[derive(Args, Debug)]
pub(crate) struct WorkersArgs {
    #[command(subcommand)]
    act: Option<Act>,
    #[command(flatten)]
    server: ServerArgs,
}

#[derive(Subcommand, Debug)]
enum Act {
    /// List them (what happens without a verb).
    List,
    /// Take a worker out of service: it hands back the job that it has, and gets no other.
    Drain {
        /// `workers/{host}` or just the host.
        worker: String,
    },
    /// Take a worker back into service: what it has lost so far does not count any more.
    Reinstate {
        /// `workers/{host}` or just the host.
        worker: String,
    },
}

pub(crate) async fn run(args: WorkersArgs) -> Result<(), Failure> {
    let remote = Remote::connect(&args.server).await?;
    match args.act.unwrap_or(Act::List) {
        Act::List => list(&remote).await,
        Act::Drain { worker } => {
            let request = v1::DrainWorkerRequest { name: worker_name(&worker) };
            let answer = remote.call(|mut client| {
                let request = request.clone();
                async move { client.drain_worker(request).await }
            });
            show(answer.await?.worker);
            Ok(())
        }
        Act::Reinstate { worker } => {
            let request = v1::ReinstateWorkerRequest { name: worker_name(&worker) };
            let answer = remote.call(|mut client| {
                let request = request.clone();
                async move { client.reinstate_worker(request).await }
            });
            show(answer.await?.worker);
            Ok(())
        }
    }
}

async fn list(remote: &Remote) -> Result<(), Failure> {
    let mut request = v1::ListWorkersRequest::default();
    loop {
        let page = remote.call(|mut client| {
            let request = request.clone();
            async move { client.list_workers(request).await }
        });
        let page = page.await?;
        page.workers.into_iter().for_each(|worker| show(Some(worker)));
        if page.next_page_token.is_empty() {
            return Ok(());
        }
        request.page_token = page.next_page_token;
    }
}

fn worker_name(text: &str) -> String {
    if text.starts_with("workers/") { text.into() } else { format!("workers/{text}") }
}

/// One line: name, state, seconds since it was heard of, why it gets no jobs.
fn show(worker: Option<v1::Worker>) {
    let Some(worker) = worker else { return };
    let state = worker.state().as_str_name().trim_start_matches("WORKER_STATE_");
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let now_ms = now.map_or(0, |now| now.as_millis() as i64);
    let seen_ms = worker.seen_time.as_ref().map_or(now_ms, convert::time_from_wire);
    let secs = (now_ms - seen_ms).max(0) / 1000;
    let line = format!("{}  {state:<11}  seen {secs} s ago  {}", worker.name, worker.reason);
    print(&format!("{}\n", line.trim_end()));
}
