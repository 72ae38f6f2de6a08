//! Leases: who may write on a running job, for how long, and what a lost attempt leads to.
//!
//! 1. A claim raises the epoch; a write is legal only under the job's current epoch, by the worker
//!    that claimed it, while the job runs.
//! 2. An attempt may be lost without blame (the worker handed it back, the machine restarted): only
//!    losses that may be the job's own doing count towards `POISONED`.
//! 3. A job that many workers lose is bad; a host that loses many jobs in a row is bad.
//!
//! Knows nothing of storage: the store asks [`blame`] and [`verdict`], and writes the answer.

use std::time::Duration;

use super::state::Trigger;

/// The right to write on a running job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lease {
    /// The job's id.
    pub job: String,
    /// Which attempt.
    pub epoch: u64,
    /// The incarnation of the worker that claimed it.
    pub worker: String,
}

/// The operator's terms.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Terms {
    /// How long a claim or heartbeat holds.
    pub lease: Duration,
    /// How often workers are told to report.
    pub heartbeat: Duration,
    /// A job is `POISONED` when this many workers have lost it.
    pub max_lost: u32,
    /// A host that loses this many different jobs in a row gets no more for a while.
    pub max_in_a_row: u32,
    /// How long that is.
    pub quarantine: Duration,
    /// A job that has waited so long gets the worker of one of lower priority.
    pub preempt_after: Duration,
    /// How often workers are told to leave a checkpoint; never where it is zero.
    pub checkpoint: Duration,
}

impl Default for Terms {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(30),
            heartbeat: Duration::from_secs(10),
            max_lost: 3,
            max_in_a_row: 3,
            quarantine: Duration::from_mins(10),
            preempt_after: Duration::from_secs(5),
            checkpoint: Duration::from_secs(10),
        }
    }
}

/// What a server wants of the worker of a running job.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orders {
    /// Stop: a client wants the job no more.
    pub cancel: bool,
    /// Hand the job back: this host is to work no more.
    pub drain: bool,
    /// Hand the job back: one of higher priority waits.
    pub preempt: bool,
}

/// Who asks for a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Claimant {
    /// Names this incarnation.
    pub worker: String,
    /// The machine, or the device on it, that incarnations come and go on.
    pub host: String,
    /// Version of its program.
    pub version: String,
}

/// A worker that names no host stands for itself.
impl From<&str> for Claimant {
    fn from(worker: &str) -> Self {
        Self { worker: worker.into(), host: worker.into(), version: String::new() }
    }
}

impl From<&Self> for Claimant {
    fn from(who: &Self) -> Self {
        who.clone()
    }
}

/// Why an attempt was lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loss {
    /// No heartbeat in time.
    LeaseExpired,
    /// The worker process ended.
    WorkerExited,
    /// The worker reported that the attempt failed.
    AttemptFailed,
    /// The worker asked for other work.
    Abandoned,
    /// The worker handed the job back, because it shuts down.
    Released,
    /// The worker handed the job back, because one of higher priority waits.
    Preempted,
    /// The server came back and the worker was gone.
    ServerRestarted,
}

struct LossRow {
    loss: Loss,
    reason: &'static str,
    text: &'static str,
    counts: bool,
}

#[rustfmt::skip]
const LOSSES: [LossRow; 7] = [
    LossRow { loss: Loss::LeaseExpired, reason: "LEASE_EXPIRED", counts: true,
        text: "the worker was not heard of in time" },
    LossRow { loss: Loss::WorkerExited, reason: "WORKER_EXITED", counts: true,
        text: "the worker process ended" },
    LossRow { loss: Loss::AttemptFailed, reason: "ATTEMPT_FAILED", counts: true,
        text: "the attempt failed" },
    LossRow { loss: Loss::Abandoned, reason: "ABANDONED", counts: true,
        text: "the worker asked for other work" },
    LossRow { loss: Loss::Released, reason: "RELEASED", counts: false,
        text: "the worker handed the job back" },
    LossRow { loss: Loss::Preempted, reason: "PREEMPTED", counts: false,
        text: "a job of higher priority waits" },
    LossRow { loss: Loss::ServerRestarted, reason: "SERVER_RESTARTED", counts: false,
        text: "the server restarted and the worker was gone" },
];

impl Loss {
    fn row(self) -> &'static LossRow {
        // `Released` stands in for a row that was forgotten; the test below forbids that.
        LOSSES.iter().find(|row| row.loss == self).unwrap_or(&LOSSES[4])
    }

    /// Stable upper-snake-case code.
    pub fn reason(self) -> &'static str {
        self.row().reason
    }

    /// One clause for people.
    pub fn text(self) -> &'static str {
        self.row().text
    }

    /// It may be the job's own doing.
    pub fn counts(self) -> bool {
        self.row().counts
    }
}

/// A worker that loses the same job again and again (there may be no other) counts once in so many times.
const LOSSES_A_WORKER: u32 = 3;

/// How much speaks against a job: so many workers have lost it, so often in all.
pub fn blame(n_workers: u32, n_losses: u32) -> u32 {
    n_workers.max(n_losses / LOSSES_A_WORKER)
}

/// What becomes of a running job whose attempt is lost, when `lost` workers (this one included) speak
/// against it.
pub fn verdict(lost: u32, max_lost: u32, cancel_requested: bool) -> Trigger {
    if cancel_requested {
        Trigger::Cancel
    } else if lost >= max_lost {
        Trigger::Fail
    } else {
        Trigger::Requeue
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_loss_has_its_row() {
        let all = [
            Loss::LeaseExpired,
            Loss::WorkerExited,
            Loss::AttemptFailed,
            Loss::Abandoned,
            Loss::Released,
            Loss::Preempted,
            Loss::ServerRestarted,
        ];
        for loss in all {
            assert_eq!(loss.row().loss, loss);
        }
    }

    #[test]
    fn one_worker_alone_condemns_a_job_in_the_end() {
        let table = [((1, 1), 1), ((1, 8), 2), ((1, 9), 3), ((3, 3), 3), ((2, 4), 2), ((0, 0), 0)];
        for ((n_workers, n_losses), wanted) in table {
            assert_eq!(blame(n_workers, n_losses), wanted, "{n_losses} by {n_workers}");
        }
    }

    #[test]
    fn verdicts() {
        assert_eq!(verdict(1, 3, false), Trigger::Requeue);
        assert_eq!(verdict(3, 3, false), Trigger::Fail);
        // A job that someone wants gone is not run again, nor blamed.
        assert_eq!(verdict(3, 3, true), Trigger::Cancel);
    }
}
