//! Turns of owners: an owner that asks for much at once waits for itself, not everybody for it.
//!
//! The database does one thing after another where it must (jobs are created one at a time), and few things at once
//! elsewhere. Of each owner only some calls stand in that line; its others wait here, in the order in which they came.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Who waits, by owner.
#[derive(Clone, Debug)]
pub(super) struct Turns {
    lines: Arc<Mutex<HashMap<String, Arc<Semaphore>>>>,
    at_once: usize,
}

/// An owner's turn, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    turns: Turns,
    owner: String,
    permit: Option<OwnedSemaphorePermit>,
}

impl Turns {
    /// So many of one owner at once.
    pub(super) fn new(at_once: usize) -> Self {
        Self { lines: Arc::default(), at_once }
    }

    /// Waits for a turn of this owner.
    pub(super) async fn of(&self, owner: &str) -> Turn {
        let line = || Arc::new(Semaphore::new(self.at_once));
        let line = Arc::clone(self.lines().entry(owner.into()).or_insert_with(line));
        // Made before the wait: whoever gives up leaves nothing behind. No line is ever closed.
        let mut turn = Turn { turns: self.clone(), owner: owner.into(), permit: None };
        turn.permit = line.acquire_owned().await.ok();
        turn
    }

    /// A turn of this owner, if there is one without waiting.
    pub(super) fn at_once(&self, owner: &str) -> Option<Turn> {
        let line = || Arc::new(Semaphore::new(self.at_once));
        let line = Arc::clone(self.lines().entry(owner.into()).or_insert_with(line));
        let mut turn = Turn { turns: self.clone(), owner: owner.into(), permit: None };
        turn.permit = line.try_acquire_owned().ok();
        turn.permit.is_some().then_some(turn)
    }

    fn lines(&self) -> std::sync::MutexGuard<'_, HashMap<String, Arc<Semaphore>>> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut lines = self.turns.lines();
        drop(self.permit.take());
        // The map's own is the only one: nobody waits.
        if lines.get(&self.owner).is_some_and(|line| Arc::strong_count(line) == 1) {
            lines.remove(&self.owner);
        }
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;

    use super::*;

    #[tokio::test]
    async fn owners_wait_for_themselves() {
        let turns = Turns::new(2);
        let (first, second) = (turns.of("ann").await, turns.of("ann").await);
        assert!(turns.of("ann").now_or_never().is_none());
        let bob = turns.of("bob").now_or_never().unwrap();
        let mut third = Box::pin(turns.of("ann"));
        assert!(third.as_mut().now_or_never().is_none());
        drop(first);
        let third = third.await;
        drop((bob, third));
        let fourth = turns.at_once("ann");
        assert!(fourth.is_some() && turns.at_once("ann").is_none());
        drop(fourth);
        assert_eq!(turns.lines().len(), 1, "only ann is still there");
        drop(second);
        assert!(turns.lines().is_empty());
    }
}
