//! Segments that were lately unpacked: whoever follows the same log at the same place shares them. A thousand that
//! watch one job make one read of each segment.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
};

/// So many are kept: 16 MiB, as a rule ([`MAX_SEGMENT`](super::segment::MAX_SEGMENT)).
const N_KEPT: usize = 16;

/// What is kept, the latest first.
#[derive(Debug, Default)]
pub(super) struct Unpacked(Mutex<VecDeque<Entry>>);

/// Its key, and its bytes.
type Entry = (String, Arc<Vec<u8>>);

impl Unpacked {
    /// The bytes of a segment, if they are kept.
    pub(super) fn get(&self, key: &str) -> Option<Arc<Vec<u8>>> {
        let mut kept = self.kept();
        let at = kept.iter().position(|(of, _)| of == key)?;
        let entry = kept.remove(at)?;
        let bytes = Arc::clone(&entry.1);
        kept.push_front(entry);
        Some(bytes)
    }

    /// Keeps the bytes of a segment; whatever nobody asked for longest makes room.
    pub(super) fn keep(&self, key: String, bytes: Arc<Vec<u8>>) {
        let mut kept = self.kept();
        kept.retain(|(of, _)| *of != key);
        kept.push_front((key, bytes));
        kept.truncate(N_KEPT);
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, VecDeque<Entry>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_asks_for_makes_room() {
        let unpacked = Unpacked::default();
        let keep = |i: usize| unpacked.keep(format!("segment {i}"), Arc::new(vec![i as u8]));
        (0..N_KEPT).for_each(keep);
        assert_eq!(*unpacked.get("segment 0").unwrap(), [0]);
        keep(N_KEPT);
        assert!(unpacked.get("segment 1").is_none());
        assert_eq!(*unpacked.get("segment 0").unwrap(), [0]);
        // Twice is once.
        keep(5);
        assert_eq!(unpacked.kept().len(), N_KEPT);
    }
}
