//! The time of a job: seconds since its work began, those of lost attempts up to the checkpoint included.
//!
//! What a run reads from it is on its tape: a resumed attempt reads what the lost one read, so that seconds in the
//! curve and limits on time go on where they were.

use std::{cell::Cell, time::Instant};

use crate::tape::{Question, Tape};

/// 0 to 5 and 9: `render/taped.rs`, `optimize`; 7: `studio.rs`; 8: `memoryless/driver.rs`.
const CLOCK: Question = Question::of(6);

/// See the module.
pub(super) struct Clock {
    tape: Tape,
    /// When it was read last, and what it said.
    last: Cell<(Instant, f64)>,
}

impl Clock {
    /// Starts at 0.
    pub fn new(tape: &Tape) -> Self {
        Self { tape: tape.clone(), last: Cell::new((Instant::now(), 0.0)) }
    }

    /// Seconds; what follows from them, a resumed attempt does again.
    pub fn read(&self) -> f64 {
        let secs = self.tape.known(CLOCK, || self.glance());
        self.last.set((Instant::now(), secs));
        secs
    }

    /// Seconds, for people: nothing may follow from them.
    pub fn glance(&self) -> f64 {
        let (then, secs) = self.last.get();
        secs + then.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::tape::pack;

    #[test]
    fn a_resumed_clock_says_what_it_said_and_goes_on() {
        let kept: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
        let keep = Arc::clone(&kept);
        let keeper = move |recorded: &mut Vec<u8>| {
            keep.lock().unwrap().extend(pack(&std::mem::take(recorded)));
        };
        let clock = Clock::new(&Tape::new(Vec::new(), Box::new(keeper)));
        clock.last.set((Instant::now(), 1000.0));
        let said = [clock.read(), clock.read()];
        clock.read();
        assert!(said[0] >= 1000.0 && said[1] >= said[0]);
        let pieces = kept.lock().unwrap().clone();
        let resumed = Clock::new(&Tape::new(pieces, Box::new(|_| ())));
        assert_eq!([resumed.read(), resumed.read()], said);
        let next = resumed.read();
        assert!(next >= said[1] && next < said[1] + 500.0, "{next}");
    }
}
