//! What is done to processes, and how each is brought back.

use std::time::Duration;

use rustix::process::Signal;
use tokio::time::sleep;

use super::{LEASE_SECS, Pair, Random, fleet::Fleet};
use crate::support::{Server, signal};

/// One kind of harm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Strike {
    KillWorker,
    /// For longer than its lease holds: then it wakes and wants to go on.
    FreezeWorker,
    KillServer,
    /// For as long as leases hold, more or less.
    FreezeServer,
    KillServerAndWorker,
    CrashDatabase,
    FreezeDatabase,
}

/// All of them, and which pairs know them.
const STRIKES: [(Strike, &[Pair]); 7] = [
    (Strike::KillWorker, &[Pair::Local, Pair::Shared]),
    (Strike::FreezeWorker, &[Pair::Local, Pair::Shared]),
    (Strike::KillServer, &[Pair::Local, Pair::Shared]),
    (Strike::FreezeServer, &[Pair::Local, Pair::Shared]),
    (Strike::KillServerAndWorker, &[Pair::Local, Pair::Shared]),
    (Strike::CrashDatabase, &[Pair::Shared]),
    (Strike::FreezeDatabase, &[Pair::Shared]),
];

impl Strike {
    /// One after another from where the seed says, so that few rounds meet many kinds.
    pub(crate) fn of_round(pair: Pair, seed: u64, round: u64) -> Self {
        let known: Vec<_> = STRIKES.iter().filter(|(_, pairs)| pairs.contains(&pair)).collect();
        known[((seed % known.len() as u64 + round) % known.len() as u64) as usize].0
    }

    /// Does it, and brings back what does not come back by itself. `holder` is the worker that has the job,
    /// where that is known.
    pub(crate) async fn strike(self, fleet: &mut Fleet, holder: Option<&str>, random: &mut Random) {
        let server = random.below(fleet.servers.len() as u64) as usize;
        let pause = Duration::from_millis(random.below(500));
        let long = Duration::from_millis(1000 * LEASE_SECS + 500 + random.below(1500));
        match self {
            Self::KillWorker => kill(fleet, holder, random),
            Self::FreezeWorker => freeze(&[victim(fleet, holder, random)], long).await,
            Self::KillServer | Self::KillServerAndWorker => {
                fleet.servers[server].kill();
                if self == Self::KillServerAndWorker {
                    kill(fleet, holder, random);
                }
                sleep(pause).await;
                fleet.servers[server].restart();
            }
            Self::FreezeServer => {
                let long = Duration::from_millis(random.below(2000 * LEASE_SECS));
                freeze(&[fleet.servers[server].pid()], long).await;
            }
            Self::CrashDatabase => database(fleet, "crash"),
            Self::FreezeDatabase => {
                database(fleet, "freeze");
                sleep(Duration::from_millis(random.below(2000 * LEASE_SECS))).await;
                database(fleet, "thaw");
            }
        }
    }
}

fn database(fleet: &mut Fleet, order: &str) {
    fleet.farm.as_mut().unwrap().cluster.order(order);
}

async fn freeze(pids: &[u32], long: Duration) {
    pids.iter().for_each(|&pid| signal(pid, Signal::STOP));
    sleep(long).await;
    pids.iter().for_each(|&pid| signal(pid, Signal::CONT));
}

/// The worker that has the job, or any.
fn victim(fleet: &Fleet, holder: Option<&str>, random: &mut Random) -> u32 {
    let local = fleet.servers.iter().flat_map(Server::worker_processes);
    let joined = fleet.workers.iter().map(|worker| (worker.id.clone(), worker.pid()));
    let workers: Vec<_> = local.chain(joined).collect();
    let at_work = workers.iter().find(|(id, _)| holder == Some(id));
    at_work.unwrap_or_else(|| &workers[random.below(workers.len() as u64) as usize]).1
}

/// Kills a worker. One that joined is replaced here, a server's own by its server.
fn kill(fleet: &mut Fleet, holder: Option<&str>, random: &mut Random) {
    let pid = victim(fleet, holder, random);
    signal(pid, Signal::KILL);
    if let Some(i) = fleet.workers.iter().position(|worker| worker.pid() == pid) {
        let server = fleet.workers.swap_remove(i).server;
        fleet.join(server);
    }
}
