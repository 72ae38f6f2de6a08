//! SIGKILL and SIGSTOP at random moments: whatever was acknowledged ends with the bytes of an undisturbed run.
//!
//! `LOOKALIKE_TORTURE_ROUNDS` (4) says how often, on each pair of stores; `LOOKALIKE_TORTURE_SEED` when.

pub(crate) mod checks;
pub(crate) mod fleet;
mod strikes;

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    process::Output,
    sync::Arc,
    time::{Duration, Instant},
};

use lookalike::jobs::event::{Body, Event, ServerEvent};
use tokio::{task::JoinSet, time::sleep};

use self::{
    checks::{Acknowledged, Reference},
    fleet::Fleet,
    strikes::Strike,
};
use crate::support::{JOB, Server, small_torus};

/// How long leases hold: many times what a busy machine keeps a process waiting.
pub(crate) const LEASE_SECS: u64 = 3;

/// Where jobs and objects are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pair {
    /// SQLite and a directory, one server.
    Local,
    /// PostgreSQL and a bucket, two servers.
    Shared,
}

/// A small generator (Steele & others, SplitMix64): enough to choose moments.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % n
    }
}

pub(crate) fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// What came of all rounds.
#[derive(Default)]
struct Tally {
    strikes: BTreeMap<Strike, u64>,
    attempts: u64,
    events: u64,
    refusals: u64,
}

impl Tally {
    fn line(&self, pair: Pair, rounds: u64, fleet: &Fleet, took: Duration) -> String {
        let logged = fleet.logged();
        let n = |text: &str| logged.matches(text).count();
        let mut line = format!(
            "torture on {pair:?}: {rounds} rounds in {:.0} s, {} attempts, {} events, {} writes of stale \
             leases tried and refused, {} attempts dropped by workers that woke up late; strikes:",
            took.as_secs_f64(),
            self.attempts,
            self.events,
            self.refusals,
            n("attempt dropped"),
        );
        for (strike, times) in &self.strikes {
            let _ = write!(line, " {strike:?} {times}");
        }
        line + "; nothing lost, nothing done twice"
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn torture_of_sqlite_and_a_directory() {
    torture(Pair::Local).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn torture_of_postgresql_and_a_bucket() {
    torture(Pair::Shared).await;
}

async fn torture(pair: Pair) {
    let rounds = number("LOOKALIKE_TORTURE_ROUNDS", 4);
    let seed = number("LOOKALIKE_TORTURE_SEED", u64::from(std::process::id()));
    eprintln!("torture on {pair:?}: {rounds} rounds, LOOKALIKE_TORTURE_SEED={seed}");
    let Some(mut fleet) = Fleet::start(pair) else { return };
    let (start, mut random) = (Instant::now(), Random(seed));
    let reference = Reference::of_undisturbed(&fleet.servers[0]).await;
    let (mut tally, mut acknowledged) = (Tally::default(), Vec::new());
    for round in 0..rounds {
        let strike = Strike::of_round(pair, seed, round);
        let job = run(&mut fleet, strike, round, &mut random).await;
        tally.refusals += job.check(&fleet.servers, &reference).await;
        tally.attempts += job.n_attempts();
        tally.events += job.log.len() as u64;
        *tally.strikes.entry(strike).or_default() += 1;
        acknowledged.push(job);
        checks::all_are_there(&fleet, &acknowledged, &mut random).await;
        for worker in &mut fleet.workers {
            assert!(worker.lives(), "round {round}, {strike:?}: worker {} ended", worker.id);
        }
    }
    // A job that is struck while somebody works at it takes another attempt, most of the time.
    assert!(rounds < 20 || tally.attempts > rounds, "{rounds} strikes hit nobody at work");
    for job in &acknowledged {
        job.check(&fleet.servers, &reference).await;
    }
    eprintln!("{}", tally.line(pair, rounds, &fleet, start.elapsed()));
}

/// One round: a job is submitted and followed, and something is done to the processes meanwhile.
async fn run(fleet: &mut Fleet, strike: Strike, round: u64, random: &mut Random) -> Acknowledged {
    let server = random.below(fleet.servers.len() as u64) as usize;
    let request_id = format!("round-{round}");
    let mut submitting = JoinSet::new();
    submitting.spawn(submit(submission(&fleet.servers[server], &request_id)));
    let (mut watching, log) = (JoinSet::new(), Arc::default());
    // Half of the strikes may come while the job is submitted.
    let is_early = random.below(2) == 0;
    if is_early {
        sleep(Duration::from_millis(random.below(600))).await;
        strike.strike(fleet, None, random).await;
    }
    let name = submitting.join_next().await.unwrap().unwrap();
    watching.spawn(checks::watch(clients(fleet), name.clone(), Arc::clone(&log)));
    if !is_early {
        sleep(Duration::from_millis(random.below(2000))).await;
        let holder = holder(&log.lock().unwrap());
        strike.strike(fleet, holder.as_deref(), random).await;
    }
    let in_time = tokio::time::timeout(checks::PATIENCE, watching.join_next()).await;
    in_time.unwrap_or_else(|_| panic!("{name} did not end: {strike:?}")).unwrap().unwrap();
    let log = log.lock().unwrap().clone();
    Acknowledged { name, request_id, server, log }
}

fn clients(fleet: &Fleet) -> Vec<crate::support::Client> {
    fleet.servers.iter().map(Server::client).collect()
}

/// Who has the job, by what was heard of its log.
fn holder(log: &[Event]) -> Option<String> {
    match &log.iter().rev().find(|event| event.body.state().is_some())?.body {
        Body::Server(ServerEvent::StateChanged { worker, .. }) => Some(worker.clone()),
        _ => None,
    }
}

/// The command that submits the job of a round; the same again finds it.
pub(crate) fn submission(server: &Server, request_id: &str) -> tokio::process::Command {
    let file = server.file("torus.ply", &small_torus());
    let request_id = format!("--request-id={request_id}");
    server.command("submit", &[&[&*file, "--no-wait", &*request_id], &JOB[..]].concat()).into()
}

/// Submits until somebody answers; the job's name.
pub(crate) async fn submit(mut command: tokio::process::Command) -> String {
    let deadline = Instant::now() + checks::PATIENCE;
    loop {
        let output: Output = command.output().await.unwrap();
        if output.status.success() {
            return String::from_utf8(output.stdout).unwrap().trim().to_owned();
        }
        // No server listened at the first call: whoever submits tries again.
        assert_eq!(output.status.code(), Some(3), "{output:?}");
        assert!(Instant::now() < deadline, "{output:?}");
        sleep(Duration::from_millis(200)).await;
    }
}
