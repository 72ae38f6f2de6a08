//! A tape of answers: what was costly to find out, in the order in which it was asked.
//!
//! A deterministic run that asks the same questions again and is given the answers comes to the same state
//! without the work. That is how an attempt resumes: nothing of queues, moves or pictures is stored, what asks
//! is run again (about a seventh of the time), and what cannot be answered yet is computed.
//!
//! Invariants:
//! 1. a tape is cut between two answers only, when the next question is asked: whatever the run did before that
//!    question is behind it when the tape is at its end;
//! 2. a tape that does not fit the questions is noticed ([`Tape::fault`]): answers have a kind and a print of
//!    their question. From there on nothing is taken from it, and nothing of the run may be used.
//!
//! Knows nothing of what is asked, of time or of storage.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

mod answer;
mod piece;

pub use answer::Answer;
pub use piece::{MAX_PIECE, pack};

/// What was asked: a kind of question, 0 to 15, and something about it that is cheap to tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Question {
    /// Which kind; at most 15.
    pub kind: u8,
    /// Equal where the questions are; may be equal where they are not.
    pub print: u64,
}

impl Question {
    /// A question of a kind about which there is nothing to tell.
    pub const fn of(kind: u8) -> Self {
        Self { kind, print: 0 }
    }

    fn tag(self) -> u8 {
        let print = self.print ^ self.print >> 32;
        let print = print ^ print >> 16;
        let print = print ^ print >> 8;
        self.kind & 15 | (print as u8 ^ (print >> 4) as u8) << 4
    }
}

/// Called when a question is asked that the tape has no answer to, before it is answered, with the answers since
/// it last took them: it takes all of them, or none.
pub type Keeper = Box<dyn FnMut(&mut Vec<u8>) + Send>;

/// A handle on the tape of one run; see the module.
#[derive(Clone, Default)]
pub struct Tape(Option<Arc<Mutex<Reel>>>);

/// The tape.
struct Reel {
    /// Packed pieces that were not played yet.
    pieces: VecDeque<Vec<u8>>,
    /// The piece that is being played, and how far.
    playing: (Vec<u8>, usize),
    is_replaying: bool,
    fault: Option<String>,
    /// An answer is being found: what is asked meanwhile is part of finding it.
    is_finding: bool,
    /// Answers that nobody took yet.
    recorded: Vec<u8>,
    keeper: Keeper,
}

impl Tape {
    /// Keeps nothing, and costs nothing.
    pub fn off() -> Self {
        Self(None)
    }

    /// Answers from pieces (see [`pack`]) as long as they last, then records.
    pub fn new(pieces: Vec<Vec<u8>>, keeper: Keeper) -> Self {
        let is_replaying = !pieces.is_empty();
        Self(Some(Arc::new(Mutex::new(Reel {
            pieces: pieces.into(),
            playing: (Vec::new(), 0),
            is_replaying,
            fault: None,
            is_finding: false,
            recorded: Vec::new(),
            keeper,
        }))))
    }

    /// Whether what happens now has happened before. It ends with the first question without an answer.
    pub fn is_replaying(&self) -> bool {
        self.reel().is_some_and(|reel| reel.is_replaying)
    }

    /// Why the tape is not of this run, if that was found.
    pub fn fault(&self) -> Option<String> {
        self.reel().and_then(|reel| reel.fault.clone())
    }

    /// The answer from the tape, or what `find` finds; that is recorded. What `find` asks is not: it is part of
    /// finding the answer.
    pub fn answer<A: Answer, E>(
        &self,
        question: Question,
        find: impl FnOnce() -> Result<A, E>,
    ) -> Result<A, E> {
        let Some(mut reel) = self.reel() else { return find() };
        if reel.is_finding {
            drop(reel);
            return find();
        }
        if let Some(known) = reel.play(question) {
            return Ok(known);
        }
        reel.is_finding = true;
        drop(reel);
        let found = find();
        if let Some(mut reel) = self.reel() {
            reel.is_finding = false;
            if let Ok(found) = &found {
                reel.recorded.push(question.tag());
                found.write(&mut reel.recorded);
            }
        }
        found
    }

    /// [`Self::answer`] to a question that always has one.
    pub fn known<A: Answer>(&self, question: Question, find: impl FnOnce() -> A) -> A {
        let found: Result<A, std::convert::Infallible> = self.answer(question, || Ok(find()));
        match found {
            Ok(answer) => answer,
        }
    }

    fn reel(&self) -> Option<MutexGuard<'_, Reel>> {
        // Whoever panicked here ends the run.
        self.0.as_ref().map(|reel| reel.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Reel {
    /// The answer, if the tape has it; else the tape is at its end, and what is recorded may be taken.
    fn play<A: Answer>(&mut self, question: Question) -> Option<A> {
        if self.is_replaying {
            match self.next(question) {
                Ok(Some(answer)) => return Some(answer),
                Ok(None) => {}
                Err(fault) => self.fault = Some(fault),
            }
            self.is_replaying = false;
            (self.pieces, self.playing) = Default::default();
        }
        (self.keeper)(&mut self.recorded);
        None
    }

    fn next<A: Answer>(&mut self, question: Question) -> Result<Option<A>, String> {
        while self.playing.1 == self.playing.0.len() {
            let Some(packed) = self.pieces.pop_front() else { return Ok(None) };
            self.playing = (piece::unpack(&packed)?, 0);
        }
        let (bytes, at) = &mut self.playing;
        let mut rest = &bytes[*at..];
        let tag = u8::read(&mut rest);
        if tag != Some(question.tag()) {
            return Err(format!("it answers {tag:?} where {} is asked", question.tag()));
        }
        let answer = A::read(&mut rest).ok_or("an answer is broken off")?;
        *at = bytes.len() - rest.len();
        Ok(Some(answer))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIND: u8 = 3;

    fn ask(tape: &Tape, print: u64, found: i64) -> i64 {
        tape.known(Question { kind: KIND, print }, || found)
    }

    /// A tape that puts what it records into `kept`, a piece every `n` questions.
    fn tape(pieces: Vec<Vec<u8>>, n: usize) -> (Tape, Arc<Mutex<Vec<Vec<u8>>>>) {
        let kept = Arc::new(Mutex::new(Vec::new()));
        let (keep, mut asked) = (Arc::clone(&kept), 0);
        let keeper = move |recorded: &mut Vec<u8>| {
            asked += 1;
            if asked % n == 0 && !recorded.is_empty() {
                keep.lock().unwrap().push(pack(&std::mem::take(recorded)).unwrap());
            }
        };
        (Tape::new(pieces, Box::new(keeper)), kept)
    }

    #[test]
    fn what_was_answered_is_not_asked_again() {
        let (first, kept) = tape(Vec::new(), 4);
        assert!(!first.is_replaying());
        (0..10).for_each(|k| assert_eq!(ask(&first, k, k as i64 - 5), k as i64 - 5));
        // Cut at the fourth question and at the eighth: before they were answered.
        let pieces = kept.lock().unwrap().clone();
        assert_eq!(pieces.len(), 2);
        let (second, _) = tape(pieces, 4);
        for k in 0..7 {
            assert!(second.is_replaying());
            assert_eq!(ask(&second, k, 99), k as i64 - 5);
        }
        assert!(second.is_replaying(), "what follows the last answer is not new either");
        assert_eq!(ask(&second, 7, 99), 99);
        assert!(!second.is_replaying());
        assert_eq!(second.fault(), None);
    }

    #[test]
    fn pieces_of_several_attempts_follow_each_other() {
        let (first, kept) = tape(Vec::new(), 4);
        (0..6).for_each(|k| _ = ask(&first, k, 1));
        let mut pieces = kept.lock().unwrap().clone();
        let (second, kept) = tape(pieces.clone(), 4);
        (0..9).for_each(|k| _ = ask(&second, k, 2));
        pieces.extend(kept.lock().unwrap().clone());
        let (third, _) = tape(pieces, 4);
        let answers: Vec<i64> = (0..8).map(|k| ask(&third, k, 3)).collect();
        assert_eq!(answers, [1, 1, 1, 2, 2, 2, 3, 3]);
    }

    #[test]
    fn a_tape_of_another_run_is_noticed() {
        let (first, kept) = tape(Vec::new(), 4);
        (0..5).for_each(|k| _ = ask(&first, k, 1));
        let pieces = kept.lock().unwrap().clone();
        let (other, _) = tape(pieces.clone(), 4);
        assert_eq!(ask(&other, 0, 7), 1);
        assert_eq!(ask(&other, 9, 7), 7);
        assert!(other.fault().unwrap().contains("where"), "{:?}", other.fault());
        let (damaged, _) = tape(vec![pieces[0][..pieces[0].len() - 1].to_vec()], 4);
        assert_eq!(ask(&damaged, 0, 7), 7);
        assert!(damaged.fault().is_some());
    }

    #[test]
    fn what_is_asked_to_find_an_answer_is_no_question_of_its_own() {
        let (first, kept) = tape(Vec::new(), 2);
        let outer = |tape: &Tape, n: i64| -> i64 {
            let inner = tape.clone();
            tape.known(Question::of(1), || ask(&inner, 0, n) + 1)
        };
        assert_eq!([outer(&first, 5), outer(&first, 6), outer(&first, 7)], [6, 7, 8]);
        let (second, _) = tape(kept.lock().unwrap().clone(), 2);
        assert_eq!([outer(&second, 0), outer(&second, 1)], [6, 2]);
        assert_eq!(second.fault(), None);
    }

    #[test]
    fn a_tape_that_is_off_asks_always() {
        let tape = Tape::off();
        assert_eq!([ask(&tape, 0, 1), ask(&tape, 0, 2)], [1, 2]);
        assert!(!tape.is_replaying());
    }

    #[test]
    fn what_was_not_found_is_not_recorded() {
        let (first, kept) = tape(Vec::new(), 2);
        let failed: Result<i64, &str> = first.answer(Question::of(KIND), || Err("no device"));
        assert_eq!(failed, Err("no device"));
        assert_eq!(ask(&first, 0, 5), 5);
        ask(&first, 0, 6);
        ask(&first, 0, 7);
        let (second, _) = tape(kept.lock().unwrap().clone(), 2);
        assert_eq!(ask(&second, 0, 9), 5);
    }
}
