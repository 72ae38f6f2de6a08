//! Leases: who may write on a running job, for how long, and what a lost attempt leads to.
//!
//! 1. A claim raises the epoch; a write is legal only under the job's current epoch, by the worker
//!    that claimed it, while the job runs.
//! 2. An attempt may be lost without blame (the worker handed it back, the machine restarted): only
//!    losses that may be the job's own doing count towards `POISONED`.
//!
//! Knows nothing of storage: the store asks [`verdict`] and writes the answer.

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
    /// A job is `POISONED` when it has lost this many attempts.
    pub max_lost: u32,
    /// How often workers are told to leave a checkpoint; never where it is zero.
    pub checkpoint: Duration,
}

impl Default for Terms {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(30),
            heartbeat: Duration::from_secs(10),
            max_lost: 3,
            checkpoint: Duration::from_secs(10),
        }
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
const LOSSES: [LossRow; 6] = [
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

/// What becomes of a running job whose attempt is lost, when `lost` attempts (this one included)
/// count against it.
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
            Loss::ServerRestarted,
        ];
        for loss in all {
            assert_eq!(loss.row().loss, loss);
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
