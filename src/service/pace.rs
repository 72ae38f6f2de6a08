//! Turns: each visitor has one after another at a steady pace, and some at once if it came seldom before.
//!
//! Unlike a bucket of `governor` it promises turns to those who wait: a hundred that come at once wait for one pause
//! after the other, and not all for the next.

use std::{
    collections::HashMap,
    hash::Hash,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Visitors that have not come for a while are forgotten when there are more than this.
const MANY: usize = 10_000;

/// See the module.
#[derive(Debug)]
pub(super) struct Pace<K> {
    pause: Duration,
    /// So much of the time that a visitor was away it may make up for.
    credit: Duration,
    /// When the next turn of each would be had it kept its distance; in the past where it comes seldom.
    next: Mutex<HashMap<K, Instant>>,
}

impl<K: Eq + Hash> Pace<K> {
    /// So many turns a second, and `at_once` of them at once.
    pub fn new(per_sec: u32, at_once: u32) -> Self {
        let pause = Duration::from_secs(1) / per_sec.max(1);
        Self { pause, credit: pause * at_once.saturating_sub(1), next: Mutex::default() }
    }

    /// How long it is until this visitor's turn, which is its own from now on; nothing if that is longer than it would
    /// wait.
    pub fn turn(&self, visitor: K, now: Instant, patience: Duration) -> Option<Duration> {
        self.turns(visitor, 1, now, patience)
    }

    /// The same for so many turns, the first of which is waited for.
    pub fn turns(&self, visitor: K, n: u32, now: Instant, patience: Duration) -> Option<Duration> {
        // Whoever panicked here had put in a whole time.
        let mut all = self.next.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() > MANY {
            all.retain(|_, next| *next > now);
        }
        let next = all.entry(visitor).or_insert(now);
        let turn = (*next).max(now);
        let wait = (turn - now).saturating_sub(self.credit);
        if wait > patience {
            return None;
        }
        *next = turn + self.pause * n;
        Some(wait)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_follow_each_other() {
        let (pace, now) = (Pace::new(10, 4), Instant::now());
        let come = |visitor, at| pace.turn(visitor, now + at, Duration::from_millis(300));
        let ms = |n| Some(Duration::from_millis(n));
        let came: Vec<_> = (0..9).map(|_| come("ann", Duration::ZERO)).collect();
        assert_eq!(came, [ms(0), ms(0), ms(0), ms(0), ms(100), ms(200), ms(300), None, None]);
        assert_eq!(come("bob", Duration::ZERO), ms(0));
        // Who was sent away has used up nothing.
        assert_eq!(come("ann", Duration::from_millis(150)), ms(250));
        assert_eq!(pace.turns("eve", 9, now, Duration::MAX), ms(0));
        assert_eq!(pace.turns("eve", 9, now, Duration::MAX), ms(600));
        let later: Vec<_> = (0..5).map(|_| come("ann", Duration::from_hours(1))).collect();
        assert_eq!(later, [ms(0), ms(0), ms(0), ms(0), ms(100)]);
    }

    #[test]
    fn visitors_are_forgotten() {
        let (pace, now) = (Pace::new(1000, 1), Instant::now());
        for k in 0..=2 * MANY as u64 {
            pace.turn(k, now + Duration::from_secs(k), Duration::ZERO);
        }
        assert!(pace.next.lock().unwrap().len() <= MANY + 1);
    }
}
