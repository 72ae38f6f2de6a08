//! When an attempt leaves a checkpoint: each time that an interval has passed, and when it is to hand its job back.
//!
//! 1. Pieces go the way of the reports, so that each follows what was reported before it.
//! 2. All pieces of a job together are at most [`MAX_BYTES`]; a job that finds out more goes on from there.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use tokio::sync::{mpsc, watch};

use super::{attempt::Stop, outbox::Parcel};
use crate::tape::{Keeper, Tape, pack};

/// So many bytes of answers are not kept waiting.
const SOON: usize = 4 << 20;
/// Most bytes of a job's pieces.
const MAX_BYTES: usize = 1 << 30;
/// An attempt that is to hand its job back waits so long at most for the next question.
const LAST_WAIT: Duration = Duration::from_secs(2);

/// The tape of an attempt that goes on from `pieces`.
pub(super) fn tape(
    pieces: Vec<Vec<u8>>,
    interval: Duration,
    parcels: &mpsc::Sender<Parcel>,
    handing_back: &HandingBack,
) -> Tape {
    if interval.is_zero() && pieces.is_empty() {
        return Tape::off();
    }
    let n_bytes = pieces.iter().map(Vec::len).sum();
    let (parcels, handing_back) = (parcels.clone(), handing_back.clone());
    let last = Instant::now();
    let mut pace = Pace { interval, n_bytes, last, is_full: interval.is_zero() };
    let keeper: Keeper = Box::new(move |recorded| {
        // One piece is enough, however many questions follow until the run reports.
        let is_asked = handing_back.is_asked() && !handing_back.is_ready.load(Ordering::Relaxed);
        if let Some(piece) = pace.take(recorded, is_asked) {
            // Where nobody listens any more, the run is told when it reports.
            let _ = parcels.blocking_send(Parcel::Piece(piece));
        }
        if is_asked {
            handing_back.is_ready.store(true, Ordering::Relaxed);
        }
    });
    Tape::new(pieces, keeper)
}

struct Pace {
    interval: Duration,
    n_bytes: usize,
    last: Instant,
    /// No piece can follow any more.
    is_full: bool,
}

impl Pace {
    /// A piece, if it is time for one.
    fn take(&mut self, recorded: &mut Vec<u8>, at_once: bool) -> Option<Vec<u8>> {
        if self.is_full {
            recorded.clear();
        }
        if recorded.is_empty() {
            self.last = Instant::now();
            return None;
        }
        if !at_once && recorded.len() < SOON && self.last.elapsed() < self.interval {
            return None;
        }
        self.last = Instant::now();
        let piece = pack(&std::mem::take(recorded));
        self.n_bytes += piece.as_ref().map_or(MAX_BYTES, Vec::len);
        self.is_full = self.n_bytes >= MAX_BYTES;
        piece.filter(|_| !self.is_full)
    }
}

/// Whether the attempt is to hand its job back, and whether its checkpoint is ready for that.
#[derive(Clone)]
pub(super) struct HandingBack {
    stopped: watch::Receiver<Option<Stop>>,
    is_ready: Arc<AtomicBool>,
    since: Option<Instant>,
}

impl HandingBack {
    /// When `stopped` says so.
    pub fn when(stopped: &watch::Receiver<Option<Stop>>) -> Self {
        Self { stopped: stopped.clone(), is_ready: Arc::default(), since: None }
    }

    fn is_asked(&self) -> bool {
        matches!(*self.stopped.borrow(), Some(Stop::Drain | Stop::Preempt))
    }

    /// Whether the attempt should end now; `makes_pieces` while it does.
    pub fn should_end(&mut self, makes_pieces: bool) -> bool {
        let stop = *self.stopped.borrow();
        match stop {
            None => false,
            Some(Stop::Drain | Stop::Preempt) if makes_pieces => {
                let since = *self.since.get_or_insert_with(Instant::now);
                self.is_ready.load(Ordering::Relaxed) || since.elapsed() > LAST_WAIT
            }
            Some(_) => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pace(interval: Duration) -> Pace {
        Pace { interval, n_bytes: 0, last: Instant::now(), is_full: false }
    }

    #[test]
    fn pieces_come_when_it_is_time_or_they_are_large_or_wanted() {
        let mut slow = pace(Duration::from_hours(1));
        assert!(slow.take(&mut vec![1; 100], false).is_none());
        assert!(slow.take(&mut vec![1; 100], true).is_some());
        assert!(slow.take(&mut vec![1; SOON], false).is_some());
        assert!(slow.take(&mut Vec::new(), true).is_none());
        let mut recorded = vec![1; 100];
        assert!(pace(Duration::ZERO).take(&mut recorded, false).is_some());
        assert!(recorded.is_empty());
    }

    #[test]
    fn a_checkpoint_that_is_full_gets_no_more_pieces() {
        let mut full = pace(Duration::ZERO);
        full.n_bytes = MAX_BYTES - 5;
        assert!(full.take(&mut vec![1; 100], false).is_none());
        full.n_bytes = 0;
        let mut recorded = vec![1; 100];
        assert!(full.take(&mut recorded, true).is_none());
        assert!(recorded.is_empty(), "a piece after a gap would be worse than none");
    }

    #[test]
    fn a_job_is_handed_back_with_its_checkpoint() {
        for reason in [Stop::Drain, Stop::Preempt] {
            check_handing_back(reason);
        }
    }

    fn check_handing_back(reason: Stop) {
        let (stop, stopped) = watch::channel(None);
        let mut handing_back = HandingBack::when(&stopped);
        let (parcels, mut received) = mpsc::channel(8);
        let tape = tape(Vec::new(), Duration::from_hours(1), &parcels, &handing_back);
        let ask = |n: u64| tape.known(crate::tape::Question::of(0), || n);
        ask(1);
        assert!(!handing_back.should_end(true));
        stop.send(Some(reason)).unwrap();
        assert!(!handing_back.should_end(true), "not before the next question");
        assert!(handing_back.clone().should_end(false));
        ask(2);
        assert!(handing_back.should_end(true));
        assert!(matches!(received.try_recv(), Ok(Parcel::Piece(_))));
        ask(3);
        assert!(received.try_recv().is_err());
    }
}
