//! The edge queue: collapses by their effect on the pictures, some of it out of date.
//!
//! Invariants:
//! 1. an edge is in the queue at most once, under (change of energy, edge id): ties fall to the
//!    lower id, so the order never depends on timing;
//! 2. a *stale* edge keeps the key it had; it must be judged again before it is collapsed
//!    (lazy evaluation: keys of the neighbourhood change slowly).

use std::collections::BTreeSet;

use crate::mesh::EdgeId;

/// How much the key of an edge is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Its neighbourhood has changed since.
    Stale,
    /// It is that of the memoryless optimum.
    Judged,
    /// It is that of the best place that a search has found.
    Searched,
}

/// Collapse candidates, least change of energy first.
#[derive(Clone, Debug, Default)]
pub struct Queue {
    order: BTreeSet<(i64, u32)>,
    keys: Vec<Option<i64>>,
    standings: Vec<Standing>,
}

impl Queue {
    /// An empty queue for edges below `n_slots`.
    pub fn new(n_slots: usize) -> Self {
        let (keys, standings) = (vec![None; n_slots], vec![Standing::Stale; n_slots]);
        Self { order: BTreeSet::new(), keys, standings }
    }

    /// Enters or moves an edge.
    pub fn set(&mut self, edge: EdgeId, key: i64, standing: Standing) {
        self.remove(edge);
        self.order.insert((key, edge.0));
        self.keys[edge.index()] = Some(key);
        self.standings[edge.index()] = standing;
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
            self.set(edge, i64::MIN, Standing::Stale);
        }
        self.standings[edge.index()] = Standing::Stale;
    }

    /// The first edge.
    pub fn first(&self) -> Option<(EdgeId, Standing)> {
        let (_, edge) = self.order.first()?;
        Some((EdgeId(*edge), self.standings[*edge as usize]))
    }

    /// The first `n` edges of a standing among the first `reach` of the queue.
    pub fn first_of(&self, standing: Standing, n: usize, reach: usize) -> Vec<EdgeId> {
        let is_one = |e: &u32| self.standings[*e as usize] == standing;
        let ids = self.order.iter().take(reach).map(|(_, e)| *e);
        ids.filter(is_one).take(n).map(EdgeId).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{
        Standing::{Judged, Searched, Stale},
        *,
    };

    #[test]
    fn ties_fall_to_the_lower_id_and_stale_edges_keep_their_place() {
        let mut q = Queue::new(4);
        q.set(EdgeId(2), 5, Judged);
        q.set(EdgeId(1), 5, Judged);
        q.set(EdgeId(0), 9, Searched);
        assert_eq!(q.first(), Some((EdgeId(1), Judged)));
        q.mark_stale(EdgeId(1));
        assert_eq!(q.first(), Some((EdgeId(1), Stale)));
        assert_eq!(q.first_of(Stale, 8, 8), [EdgeId(1)]);
        assert_eq!(q.first_of(Searched, 8, 2), []);
        assert_eq!(q.first_of(Searched, 8, 3), [EdgeId(0)]);
        q.set(EdgeId(1), 100, Searched);
        assert_eq!(q.first(), Some((EdgeId(2), Judged)));
        // An edge that was dropped comes back at the front, to be judged again.
        q.mark_stale(EdgeId(3));
        assert_eq!(q.first(), Some((EdgeId(3), Stale)));
        q.remove(EdgeId(3));
        assert_eq!(q.first(), Some((EdgeId(2), Judged)));
    }
}
