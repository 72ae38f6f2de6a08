//! Load on the service alone, without a pipeline: what it bears, and what one tenant can do to another.
//!
//! `make loadtest` takes the figures of both pairs of stores and writes them into `docs/results.md`, under "The
//! service". Without `--full` (as `cargo test` runs it) everything is done a few times and no figure is judged:
//! it shows that the generator works. `--only figures|tenant` takes one part, `--abuse TEXT` the abuses with that in
//! their names. It talks to servers of its own on loopback alone, and is bounded in count.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "a load generator ends at the first fault"
)]
#![allow(dead_code, reason = "of what it shares with the tests it uses a part")]

mod figures;
mod page;
#[path = "../../tests/stores/postgres.rs"]
mod postgres;
#[path = "../../tests/service/abuse/raw.rs"]
mod raw;
#[path = "../../tests/stores/s3.rs"]
mod s3;
mod stores;
#[path = "../../tests/service/support.rs"]
mod support;
mod tenant;

use std::path::PathBuf;

use self::{page::Row, stores::Stores};

/// How much is done.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Size {
    /// Jobs submitted one by one, for latency.
    pub(crate) n_single: usize,
    /// Jobs submitted by many clients at once.
    pub(crate) n_jobs: usize,
    /// Batches of events that each of eight workers sends.
    pub(crate) n_batches: u64,
    /// Chunks of 512 records in the log that is replayed.
    pub(crate) n_chunks: u64,
    /// Streams that watch one job.
    pub(crate) n_watchers: usize,
    /// Submissions of the good tenant in a round.
    pub(crate) n_good: usize,
    /// Rounds of each abuse: the good tenant alone, then beset.
    pub(crate) n_rounds: usize,
    /// Jobs that the bad tenant has waiting.
    pub(crate) n_queued: usize,
    /// Seconds of pgbench.
    pub(crate) bench_secs: u32,
}

const SMOKE: Size = Size {
    n_single: 5,
    n_jobs: 50,
    n_batches: 5,
    n_chunks: 50,
    n_watchers: 50,
    n_good: 20,
    n_rounds: 1,
    n_queued: 100,
    bench_secs: 1,
};

const FULL: Size = Size {
    n_single: 200,
    n_jobs: 3000,
    n_batches: 250,
    n_chunks: 4000,
    n_watchers: 5000,
    n_good: 300,
    n_rounds: 3,
    n_queued: 10_000,
    bench_secs: 15,
};

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    if let [flag, abuse] = &args[..]
        && flag == tenant::BAD
    {
        return runtime.block_on(tenant::misbehave(abuse));
    }
    let value = |flag: &str| {
        let at = args.iter().position(|arg| arg == flag)?;
        args.get(at + 1).cloned()
    };
    let is_full = args.iter().any(|arg| arg == "--full");
    // `cargo test NAME` is for tests that have names.
    if !is_full && args.iter().any(|arg| !arg.starts_with('-')) {
        return;
    }
    let size = if is_full { FULL } else { SMOKE };
    let only = value("--only").unwrap_or_default();
    let abuse = value("--abuse").unwrap_or_default();
    let (mut rows, mut abuses) = (Vec::new(), Vec::new());
    runtime.block_on(async {
        for mut stores in Stores::all() {
            if only.is_empty() || only == "figures" {
                rows.push(figures::take(&mut stores, size).await);
            }
            if only.is_empty() || only == "tenant" {
                abuses.push((stores.name(), tenant::take(&mut stores, size, &abuse).await));
            }
        }
    });
    let text = page::section(&rows, &abuses, value("--note").as_deref());
    println!("{text}");
    if let Some(path) = value("--write").map(PathBuf::from) {
        page::write(&path, &text);
        println!("{}", path.display());
    }
}

/// The value below which `share` of all lie.
pub(crate) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = ((values.len() as f64 * share).ceil() as usize).clamp(1, values.len());
    values[at - 1]
}

pub(crate) type Figures = (&'static str, Vec<Row>);
