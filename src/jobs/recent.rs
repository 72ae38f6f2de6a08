//! What was lately read of logs: whoever follows the same log at the same place shares it. A thousand that watch one
//! job make one read of each page and of each segment.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
};

/// So many are kept. Of segments: 16 MiB, as a rule ([`MAX_SEGMENT`](super::segment::MAX_SEGMENT)); of pages: 4,096
/// entries without the bytes of records, a few MiB.
const N_KEPT: usize = 16;

/// What is kept, by key, the latest first. What a key stands for never changes.
#[derive(Debug)]
pub(super) struct Recent<T: ?Sized>(Mutex<VecDeque<(String, Arc<T>)>>);

impl<T: ?Sized> Default for Recent<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T: ?Sized> Recent<T> {
    /// What is kept under this key, if it still is.
    pub(super) fn get(&self, key: &str) -> Option<Arc<T>> {
        let mut kept = self.kept();
        let at = kept.iter().position(|(of, _)| of == key)?;
        let entry = kept.remove(at)?;
        let value = Arc::clone(&entry.1);
        kept.push_front(entry);
        Some(value)
    }

    /// Keeps it; whatever nobody asked for longest makes room.
    pub(super) fn keep(&self, key: String, value: Arc<T>) {
        let mut kept = self.kept();
        kept.retain(|(of, _)| *of != key);
        kept.push_front((key, value));
        kept.truncate(N_KEPT);
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, VecDeque<(String, Arc<T>)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_asks_for_makes_room() {
        let recent = Recent::default();
        let keep = |i: usize| recent.keep(format!("segment {i}"), Arc::new(i));
        (0..N_KEPT).for_each(keep);
        assert_eq!(*recent.get("segment 0").unwrap(), 0);
        keep(N_KEPT);
        assert!(recent.get("segment 1").is_none());
        assert_eq!(*recent.get("segment 0").unwrap(), 0);
        // Twice is once.
        keep(5);
        assert_eq!(recent.kept().len(), N_KEPT);
    }
}
