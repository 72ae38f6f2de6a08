//! The edge queue: collapses by their effect on the pictures, some of it out of date.
//!
//! Invariants:
//! 1. an edge is in the queue at most once, under (change of energy, edge id): ties fall to the
//!    lower id, so the order never depends on timing;
//! 2. a *stale* edge keeps the key it had; it must be judged again before it is collapsed
//!    (lazy evaluation: keys of the neighbourhood change slowly).

use std::collections::BTreeSet;

use crate::mesh::EdgeId;

/// Collapse candidates, least change of energy first.
#[derive(Clone, Debug, Default)]
pub struct Queue {
    order: BTreeSet<(i64, u32)>,
    keys: Vec<Option<i64>>,
    stale: Vec<bool>,
}

impl Queue {
    /// An empty queue for edges below `n_slots`.
    pub fn new(n_slots: usize) -> Self {
        Self { order: BTreeSet::new(), keys: vec![None; n_slots], stale: vec![false; n_slots] }
    }

    /// Enters or moves an edge with an up-to-date key.
    pub fn set(&mut self, edge: EdgeId, key: i64) {
        self.remove(edge);
        self.order.insert((key, edge.0));
        self.keys[edge.index()] = Some(key);
        self.stale[edge.index()] = false;
    }

    /// Takes an edge out.
    pub fn remove(&mut self, edge: EdgeId) {
        if let Some(key) = self.keys[edge.index()].take() {
            self.order.remove(&(key, edge.0));
        }
    }

    /// Marks an edge as out of date; one that is not in the queue enters at the front, so that it
    /// is judged next.
    pub fn mark_stale(&mut self, edge: EdgeId) {
        if self.keys[edge.index()].is_none() {
            self.set(edge, i64::MIN);
        }
        self.stale[edge.index()] = true;
    }

    /// The first edge, and whether it is up to date.
    pub fn first(&self) -> Option<(EdgeId, bool)> {
        let (_, edge) = self.order.first()?;
        Some((EdgeId(*edge), !self.stale[*edge as usize]))
    }

    /// The first `n` stale edges among the first `reach` of the queue.
    pub fn first_stale(&self, n: usize, reach: usize) -> Vec<EdgeId> {
        let is_stale = |e: &u32| self.stale[*e as usize];
        let ids = self.order.iter().take(reach).map(|(_, e)| *e);
        ids.filter(is_stale).take(n).map(EdgeId).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ties_fall_to_the_lower_id_and_stale_edges_keep_their_place() {
        let mut q = Queue::new(4);
        q.set(EdgeId(2), 5);
        q.set(EdgeId(1), 5);
        q.set(EdgeId(0), 9);
        assert_eq!(q.first(), Some((EdgeId(1), true)));
        q.mark_stale(EdgeId(1));
        assert_eq!(q.first(), Some((EdgeId(1), false)));
        assert_eq!(q.first_stale(8, 8), [EdgeId(1)]);
        q.set(EdgeId(1), 100);
        assert_eq!(q.first(), Some((EdgeId(2), true)));
        // An edge that was dropped comes back at the front, to be judged again.
        q.mark_stale(EdgeId(3));
        assert_eq!(q.first(), Some((EdgeId(3), false)));
        q.remove(EdgeId(3));
        assert_eq!(q.first(), Some((EdgeId(2), true)));
    }
}
