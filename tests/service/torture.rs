//! SIGKILL at random moments: whatever was acknowledged ends with the bytes of an undisturbed run.
//!
//! `LOOKALIKE_TORTURE_ROUNDS` (4) says how often, `LOOKALIKE_TORTURE_SEED` when.

use std::{collections::BTreeMap, time::Duration};

use lookalike::jobs::{
    event::{Body, Event, Report, ServerEvent},
    state::State,
};
use rustix::process::Signal;

use crate::support::{JOB, Server, ended, log, reference, results, signal, small_torus, state};

/// A small generator (Steele & others, SplitMix64): enough to choose moments.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % n
    }
}

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// Kills a worker, the server, or both, and brings the server back.
async fn strike(server: &mut Server, random: &mut Random) {
    let what = random.below(3);
    if what != 0 {
        server.kill();
    }
    if what != 1 {
        let pids = server.worker_pids();
        let n_workers = pids.len().max(1) as u64;
        pids.into_iter()
            .skip(random.below(n_workers) as usize)
            .for_each(|p| signal(p, Signal::KILL));
    }
    if what != 0 {
        tokio::time::sleep(Duration::from_millis(random.below(500))).await;
        server.restart();
    }
}

#[tokio::test]
async fn torture() {
    let rounds = number("LOOKALIKE_TORTURE_ROUNDS", 4);
    let seed = number("LOOKALIKE_TORTURE_SEED", u64::from(std::process::id()));
    eprintln!("torture: {rounds} rounds, LOOKALIKE_TORTURE_SEED={seed}");
    let mut random = Random(seed);
    let flags = ["--workers=2", "--lease-secs=2", "--heartbeat-secs=0.3", "--max-attempts=1000000"];
    let mut server = Server::start_with(&flags);
    let reference = reference(&server);
    let file = server.file("torus.ply", &small_torus());
    let mut names = Vec::new();
    for round in 0..rounds {
        let request_id = format!("--request-id=round-{round}");
        let flags = [&[&*file, "--no-wait", &*request_id], &JOB[..]].concat();
        let output = server.run("submit", &flags);
        assert!(output.status.success(), "{output:?}");
        names.push(String::from_utf8(output.stdout).unwrap().trim().to_owned());
        tokio::time::sleep(Duration::from_millis(random.below(1200))).await;
        strike(&mut server, &mut random).await;
    }
    let mut client = server.client();
    for (i, name) in names.iter().enumerate() {
        let done = ended(&client, name).await;
        assert_eq!(state(&done), State::Succeeded, "{done:?}");
        let out = server.dir.path().join(format!("out-{i}"));
        let fetched = server.run("fetch", &[name, "--out", &out.display().to_string()]);
        assert!(fetched.status.success(), "{fetched:?}");
        assert_eq!(results(&out), reference, "{name}");
        check_log(&log(&mut client, name, 0).await);
        eprintln!("torture: {name} ended in attempt {}", done.attempt);
    }
}

/// No gaps, and what counts of it is one whole stream of records.
fn check_log(log: &[Event]) {
    let seqs: Vec<_> = log.iter().map(|event| event.seq).collect();
    assert_eq!(seqs, (1..=log.len() as u64).collect::<Vec<_>>());
    let mut counts: Vec<&Event> = Vec::new();
    for event in log {
        if let Body::Server(ServerEvent::Restarted { rewind_to_seq, .. }) = &event.body {
            counts.retain(|event| event.seq <= *rewind_to_seq);
        }
        counts.push(event);
    }
    let mut next_record = BTreeMap::new();
    for event in counts {
        if let Body::Worker(Report::Records { level, first, count, .. }) = &event.body {
            let next = next_record.entry(*level).or_insert(0);
            assert_eq!(first, next);
            *next += u64::from(*count);
        }
    }
    assert!(next_record[&None] > 0 && next_record[&Some(0)] > 0);
}
