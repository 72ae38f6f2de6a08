//! The edge queue: cheapest first, one 64-bit word per entry.
//!
//! The upper half of a word is the cost, to 21 bits of mantissa, the lower half the edge; so the
//! order is by cost, then by edge id, and the same on every machine.
//!
//! Invariants:
//! 1. every entry in `near` is less than `limit`, every entry in `far` is not;
//! 2. `near` is a min-heap with four children per node; it stays small enough for the cache,
//!    while `far`, which holds most entries most of the time, has no order to keep.
//!
//! Knows nothing of edges that died or changed: the driver sorts that out when they come up.

use std::cmp::Reverse;

use crate::mesh::EdgeId;

const N_CHILDREN: usize = 4;
/// Levels that a riser is told of.
const N_LEVELS_TOLD: u32 = 4;

/// An edge and its cost, ordered by cost, then by id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Entry(u64);

impl Entry {
    /// `cost` is not negative; NaN goes last.
    #[inline]
    pub(super) fn new(cost: f64, edge: EdgeId) -> Self {
        // The bits of non-negative floats are ordered as their values; the sign bit is spare.
        Self::with_key((cost.abs().to_bits() >> 31) as u32, edge)
    }

    /// The same of another's [`Self::key`].
    #[inline]
    pub(super) fn with_key(key: u32, edge: EdgeId) -> Self {
        Self(u64::from(key) << 32 | u64::from(edge.0))
    }

    /// The cost, to 21 bits of mantissa.
    #[inline]
    pub(super) fn key(self) -> u32 {
        (self.0 >> 32) as u32
    }

    pub(super) fn edge(self) -> EdgeId {
        EdgeId(self.0 as u32)
    }
}

/// The part of the far entries that comes near at a time, and the fewest that do. A smaller part
/// stays in the cache; but each time, all far entries are looked through.
const NEAR_SHARE: usize = 16;
const MIN_NEAR: usize = 2048;

/// Entries, cheapest first.
#[derive(Clone, Debug)]
pub(super) struct Queue {
    near: Vec<Entry>,
    far: Vec<Entry>,
    limit: Entry,
}

impl Queue {
    /// A queue of the given entries. O(n).
    pub(super) fn new(entries: Vec<Entry>) -> Self {
        let mut queue = Self { near: Vec::new(), far: entries, limit: Entry(0) };
        queue.refill();
        queue
    }

    /// The cheapest entry.
    #[inline]
    pub(super) fn peek(&self) -> Option<Entry> {
        self.near.first().copied()
    }

    /// Exchanges the cheapest entry for another one, or takes it out; `rises` hears of each entry
    /// that comes to a level nearer to the top (0) than [`N_LEVELS_TOLD`].
    pub(super) fn replace_top(&mut self, entry: Option<Entry>, rises: impl FnMut(u32, Entry)) {
        let replacement = match entry {
            Some(entry) if entry < self.limit => Some(entry),
            Some(entry) => {
                self.far.push(entry);
                self.near.pop()
            }
            None => self.near.pop(),
        };
        match replacement {
            Some(last) if !self.near.is_empty() => sink(&mut self.near, 0, last, rises),
            _ => self.refill(),
        }
    }

    /// Adds an entry.
    pub(super) fn push(&mut self, entry: Entry) {
        if entry >= self.limit {
            self.far.push(entry);
            if self.near.is_empty() {
                self.refill();
            }
            return;
        }
        let mut at = self.near.len();
        self.near.push(entry);
        while at > 0 {
            let parent = (at - 1) / N_CHILDREN;
            if self.near[parent] <= entry {
                break;
            }
            self.near[at] = self.near[parent];
            at = parent;
        }
        self.near[at] = entry;
    }

    /// Brings the cheapest far entries near, which is empty.
    fn refill(&mut self) {
        let n = (self.far.len() / NEAR_SHARE).max(MIN_NEAR).min(self.far.len());
        let Some(last) = self.far.len().checked_sub(n.max(1)) else { return };
        // The n cheapest go to the end, the dearest of them first.
        let (_, &mut dearest, _) = self.far.select_nth_unstable_by_key(last, |&e| Reverse(e));
        self.limit = Entry(dearest.0.saturating_add(1));
        self.near.extend(self.far.drain(last..));
        for at in (0..self.near.len().div_ceil(N_CHILDREN)).rev() {
            let entry = self.near[at];
            sink(&mut self.near, at, entry, |_, _| {});
        }
    }
}

/// Puts an entry at `at` or, after lesser ones have moved up, below.
#[inline]
fn sink(heap: &mut [Entry], mut at: usize, entry: Entry, mut rises: impl FnMut(u32, Entry)) {
    let mut level = 0;
    loop {
        let first = at * N_CHILDREN + 1;
        let Some((child, least)) = least_child(heap, first) else { break };
        if entry <= least {
            break;
        }
        heap[at] = least;
        if level < N_LEVELS_TOLD {
            rises(level, least);
        }
        level += 1;
        at = child;
    }
    heap[at] = entry;
}

/// The least of the up to four entries from `first` on, and where it is.
#[inline]
fn least_child(heap: &[Entry], first: usize) -> Option<(usize, Entry)> {
    if let Some(&[a, b, c, d]) = heap.get(first..first + N_CHILDREN) {
        // Two rounds of a tournament, as conditional moves.
        let (i, x) = if b < a { (1, b) } else { (0, a) };
        let (j, y) = if d < c { (3, d) } else { (2, c) };
        return Some(if y < x { (first + j, y) } else { (first + i, x) });
    }
    let rest = heap.get(first..)?;
    let (k, &least) = rest.iter().enumerate().min_by_key(|&(_, entry)| entry)?;
    Some((first + k, least))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(queue: &mut Queue) -> Option<Entry> {
        let cheapest = queue.peek()?;
        queue.replace_top(None, |_, _| {});
        Some(cheapest)
    }

    #[test]
    fn entries_leave_by_cost_then_id() {
        let costs = [3.0, 0.0, f64::MAX, 1e-300, 3.0, 1e300, 0.0, 7.0, f64::NAN];
        let entry = |(i, &cost): (usize, &f64)| Entry::new(cost, EdgeId(i as u32));
        let mut queue = Queue::new(costs.iter().enumerate().map(entry).collect());
        queue.push(Entry::new(2.0, EdgeId(100)));
        queue.push(Entry::new(-0.0, EdgeId(101)));
        let order: Vec<u32> =
            std::iter::from_fn(|| taken(&mut queue)).map(|e| e.edge().0).collect();
        assert_eq!(order, [1, 6, 101, 3, 100, 0, 4, 7, 5, 2, 8]);
    }

    #[test]
    fn many_entries_come_out_sorted() {
        let mut queue = Queue::new(Vec::new());
        for i in 0..1000u32 {
            queue.push(Entry::new(f64::from(i.wrapping_mul(2_654_435_761) >> 12), EdgeId(i)));
        }
        queue.replace_top(Some(Entry::new(5e5, EdgeId(2000))), |_, _| {});
        let out: Vec<Entry> = std::iter::from_fn(|| taken(&mut queue)).collect();
        assert_eq!(out.len(), 1000);
        assert!(out.is_sorted());
    }
}
