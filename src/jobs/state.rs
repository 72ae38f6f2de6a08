//! The states of a job and the one table of transitions between them.
//!
//! 1. `TRANSITIONS` is the only place that says what may follow what; everything that writes a
//!    state goes through [`State::after`].
//! 2. The states that nothing leaves but a retry are final.
//!
//! Knows nothing of leases, storage or reasons.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// Where a job is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum State {
    /// Waits for a worker.
    Queued,
    /// A worker holds its lease.
    Running,
    /// All artifacts are there.
    Succeeded,
    /// The job is at fault, or too many attempts were lost.
    Failed,
    /// Stopped on request.
    Cancelled,
}

/// What makes a job change its state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Trigger {
    /// A worker claims it.
    Claim,
    /// The worker has done everything.
    Succeed,
    /// The job is found to be at fault.
    Fail,
    /// A client asks to stop it, or its worker confirms that.
    Cancel,
    /// The attempt is lost, or handed back.
    Requeue,
    /// A client wants a job anew that did not succeed.
    Retry,
}

const TRANSITIONS: [(State, Trigger, State); 8] = [
    (State::Queued, Trigger::Claim, State::Running),
    (State::Queued, Trigger::Cancel, State::Cancelled),
    (State::Running, Trigger::Succeed, State::Succeeded),
    (State::Running, Trigger::Fail, State::Failed),
    (State::Running, Trigger::Cancel, State::Cancelled),
    (State::Running, Trigger::Requeue, State::Queued),
    (State::Failed, Trigger::Retry, State::Queued),
    (State::Cancelled, Trigger::Retry, State::Queued),
];

const NAMES: [(State, &str); 5] = [
    (State::Queued, "QUEUED"),
    (State::Running, "RUNNING"),
    (State::Succeeded, "SUCCEEDED"),
    (State::Failed, "FAILED"),
    (State::Cancelled, "CANCELLED"),
];

impl State {
    /// Every state, in the order of a job's life.
    pub const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The state that follows; `None` when the transition is illegal.
    pub fn after(self, trigger: Trigger) -> Option<Self> {
        let row = TRANSITIONS.iter().find(|(from, by, _)| (*from, *by) == (self, trigger));
        row.map(|(_, _, to)| *to)
    }

    /// Nothing follows by itself: the job has ended, unless somebody retries it.
    pub fn is_final(self) -> bool {
        TRANSITIONS.iter().all(|(from, by, _)| *from != self || *by == Trigger::Retry)
    }

    /// The upper-case name, as stored and shown.
    pub fn name(self) -> &'static str {
        NAMES.iter().find(|(state, _)| *state == self).map_or("", |(_, name)| name)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// The text names no state.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is not a job state: use queued, running, succeeded, failed or cancelled")]
pub struct UnknownState(String);

impl FromStr for State {
    type Err = UnknownState;

    fn from_str(text: &str) -> Result<Self, UnknownState> {
        let row = NAMES.iter().find(|(_, name)| name.eq_ignore_ascii_case(text));
        row.map(|(state, _)| *state).ok_or_else(|| UnknownState(text.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TRIGGERS: [Trigger; 6] = [
        Trigger::Claim,
        Trigger::Succeed,
        Trigger::Fail,
        Trigger::Cancel,
        Trigger::Requeue,
        Trigger::Retry,
    ];

    /// The life of a job said another way: a job is with the queue, with a worker, or over.
    fn model(state: State, trigger: Trigger) -> Option<State> {
        match state {
            State::Queued => match trigger {
                Trigger::Claim => Some(State::Running),
                Trigger::Cancel => Some(State::Cancelled),
                _ => None,
            },
            State::Running => match trigger {
                Trigger::Claim | Trigger::Retry => None,
                Trigger::Succeed => Some(State::Succeeded),
                Trigger::Fail => Some(State::Failed),
                Trigger::Cancel => Some(State::Cancelled),
                Trigger::Requeue => Some(State::Queued),
            },
            State::Failed | State::Cancelled if trigger == Trigger::Retry => Some(State::Queued),
            State::Succeeded | State::Failed | State::Cancelled => None,
        }
    }

    #[test]
    fn names_survive_a_round_trip() {
        for state in State::ALL {
            assert_eq!(state.name().parse(), Ok(state));
            assert_eq!(state.name().to_lowercase().parse(), Ok(state));
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
        }
        assert!("done".parse::<State>().is_err());
    }

    proptest! {
        #[test]
        fn walks_follow_the_model(steps in prop::collection::vec(0..TRIGGERS.len(), 0..40)) {
            let mut state = State::Queued;
            for step in steps {
                let next = state.after(TRIGGERS[step]);
                prop_assert_eq!(next, model(state, TRIGGERS[step]));
                let is_retry = TRIGGERS[step] == Trigger::Retry;
                prop_assert!(next.is_none() || state.is_final() == is_retry);
                state = next.unwrap_or(state);
            }
        }
    }
}
