//! One short ascending list per vertex, with something else kept beside it: what connectivity is
//! made of.
//!
//! Up to seven items lie in the row itself, next to its companion, so that what an edit needs of
//! a vertex comes with one cache line; longer lists lie in a common pool.
//!
//! Invariants:
//! 1. every list is strictly ascending, so its order depends on its content alone;
//! 2. a list is in the pool if and only if it has more than [`N_INLINE`] items; its row then holds
//!    its place (`start`, `cap`) as the first two inline items; places do not overlap;
//! 3. `live` is the sum of the lengths in the pool; the pool is packed anew when more than that
//!    and one entry per row are unused, so that any order of appending is linear.
//!
//! Knows nothing of meshes.

use super::model::{EdgeId, FaceId};
use crate::intrinsics::prefetch;

/// Items that a row holds itself.
const N_INLINE: usize = 7;

/// Below this many unused pool entries (and one per row) packing is not worth its walk.
const MIN_POOL: usize = 1024;

/// An id that is a number underneath.
pub(super) trait Id: Copy + Ord {
    fn from_raw(raw: u32) -> Self;
    fn raw(self) -> u32;
}

impl Id for FaceId {
    fn from_raw(raw: u32) -> Self {
        Self(raw)
    }
    fn raw(self) -> u32 {
        self.0
    }
}

impl Id for EdgeId {
    fn from_raw(raw: u32) -> Self {
        Self(raw)
    }
    fn raw(self) -> u32 {
        self.0
    }
}

/// Aligns a row that is as large as a cache line to one.
#[derive(Clone, Copy, Debug, Default)]
#[repr(align(64))]
pub(super) struct CacheLine;

#[derive(Clone, Copy, Debug)]
struct Row<T, C, A> {
    companion: C,
    len: u32,
    inline: [T; N_INLINE],
    _alignment: A,
}

impl<T: Id, C, A: Default> Row<T, C, A> {
    fn new(companion: C) -> Self {
        Self { companion, len: 0, inline: [T::from_raw(0); N_INLINE], _alignment: A::default() }
    }

    #[inline]
    fn is_inline(&self) -> bool {
        self.len as usize <= N_INLINE
    }

    /// Start and capacity in the pool, of a list that is there.
    fn place(&self) -> (usize, usize) {
        (self.inline[0].raw() as usize, self.inline[1].raw() as usize)
    }
}

/// Ascending lists of `T`, addressed by number, each with a companion `C`, in rows aligned as `A`.
#[derive(Clone, Debug)]
pub(super) struct Lists<T, C = (), A = ()> {
    rows: Vec<Row<T, C, A>>,
    pool: Vec<T>,
    live: usize,
}

impl<T: Id, C, A: Default> Lists<T, C, A> {
    /// An empty list for each companion.
    pub(super) fn new(companions: impl Iterator<Item = C>) -> Self {
        Self { rows: companions.map(Row::new).collect(), pool: Vec::new(), live: 0 }
    }

    /// Number of lists.
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// The items of one list, ascending.
    #[inline]
    pub(super) fn get(&self, list: usize) -> &[T] {
        let row = &self.rows[list];
        row.inline.get(..row.len as usize).unwrap_or_else(|| {
            let start = row.place().0;
            &self.pool[start..start + row.len as usize]
        })
    }

    /// Begins to load the row of a list.
    #[inline]
    pub(super) fn prefetch(&self, list: usize) {
        prefetch(&self.rows, list);
    }

    /// What is kept beside a list.
    #[inline]
    pub(super) fn companion(&self, list: usize) -> &C {
        &self.rows[list].companion
    }

    /// What is kept beside a list.
    #[inline]
    pub(super) fn companion_mut(&mut self, list: usize) -> &mut C {
        &mut self.rows[list].companion
    }

    /// Replaces a list; `items` are strictly ascending.
    pub(super) fn set(&mut self, list: usize, items: &[T]) {
        let row = &mut self.rows[list];
        let capacity = if row.is_inline() { 0 } else { row.place().1 };
        self.live -= if row.is_inline() { 0 } else { row.len as usize };
        row.len = items.len() as u32;
        if let Some(inline) = row.inline.get_mut(..items.len()) {
            inline.copy_from_slice(items);
        } else if items.len() <= capacity {
            let start = row.place().0;
            self.pool[start..start + items.len()].copy_from_slice(items);
            self.live += items.len();
        } else {
            self.relocate(list, items);
        }
    }

    /// Adds an item to a list; false if it was there.
    pub(super) fn insert(&mut self, list: usize, item: T) -> bool {
        let Err(at) = self.get(list).binary_search(&item) else { return false };
        let mut grown: smallvec::SmallVec<[T; 24]> = self.get(list).into();
        grown.insert(at, item);
        self.set(list, &grown);
        true
    }

    /// Appends an item that is higher than all in its list. O(1), amortised.
    pub(super) fn push(&mut self, list: usize, item: T) {
        let row = &mut self.rows[list];
        let len = row.len as usize;
        if let Some(free) = row.inline.get_mut(len) {
            *free = item;
            row.len += 1;
        } else if !row.is_inline() && len < row.place().1 {
            self.pool[row.place().0 + len] = item;
            row.len += 1;
            self.live += 1;
        } else {
            self.insert(list, item);
        }
    }

    /// Takes an item out of a list; false if it was not there.
    pub(super) fn remove(&mut self, list: usize, item: T) -> bool {
        let Ok(at) = self.get(list).binary_search(&item) else { return false };
        let row = &mut self.rows[list];
        let len = row.len as usize;
        if row.is_inline() {
            row.inline[..len].copy_within(at + 1.., at);
            row.len -= 1;
        } else if len > N_INLINE + 1 {
            let start = row.place().0;
            self.pool[start..start + len].copy_within(at + 1.., at);
            row.len -= 1;
            self.live -= 1;
        } else {
            let mut shrunk: smallvec::SmallVec<[T; 24]> = self.get(list).into();
            shrunk.remove(at);
            self.set(list, &shrunk);
        }
        true
    }

    /// Empties a list.
    pub(super) fn clear(&mut self, list: usize) {
        self.set(list, &[]);
    }

    /// Appends an empty list.
    pub(super) fn push_list(&mut self, companion: C) {
        self.rows.push(Row::new(companion));
    }

    /// Removes the last list.
    pub(super) fn pop_list(&mut self) {
        if let Some(last) = self.rows.len().checked_sub(1) {
            self.clear(last);
            self.rows.pop();
        }
    }

    /// Gives a list that outgrew its place a new one at the end of the pool.
    fn relocate(&mut self, list: usize, items: &[T]) {
        // Not to be packed along: it has no place.
        self.rows[list].len = 0;
        self.live += items.len();
        if self.pool.len() > 2 * self.live + self.rows.len() + MIN_POOL {
            self.pack();
        }
        let (start, capacity) = append(&mut self.pool, items);
        let row = &mut self.rows[list];
        row.len = items.len() as u32;
        row.inline[0] = T::from_raw(start as u32);
        row.inline[1] = T::from_raw(capacity as u32);
    }

    /// Closes the gaps between places in the pool, keeping the lists in their order.
    fn pack(&mut self) {
        let mut pool = Vec::with_capacity(self.live + self.live / 2 + MIN_POOL);
        for row in self.rows.iter_mut().filter(|row| !row.is_inline()) {
            let (start, len) = (row.place().0, row.len as usize);
            let (start, capacity) = append(&mut pool, &self.pool[start..start + len]);
            row.inline[0] = T::from_raw(start as u32);
            row.inline[1] = T::from_raw(capacity as u32);
        }
        self.pool = pool;
    }

    /// Whether invariants 1 to 3 hold.
    pub(super) fn is_sound(&self) -> bool {
        let pooled = self.rows.iter().filter(|row| !row.is_inline());
        let live = pooled.clone().map(|row| row.len as usize).sum::<usize>() == self.live;
        let fits = pooled.clone().all(|row| {
            let (start, capacity) = row.place();
            row.len as usize <= capacity && start + capacity <= self.pool.len()
        });
        let mut places: Vec<_> = pooled.map(Row::place).collect();
        places.sort_unstable();
        let apart = places.windows(2).all(|pair| pair[0].0 + pair[0].1 <= pair[1].0);
        let ascends = |list| self.get(list).windows(2).all(|pair| pair[0] < pair[1]);
        live && fits && apart && (0..self.len()).all(ascends)
    }
}

/// Gives a list a place at the end of the pool: (start, capacity).
fn append<T: Id>(pool: &mut Vec<T>, items: &[T]) -> (usize, usize) {
    let start = pool.len();
    // Valences vary by one or two from edit to edit: room for that saves most moves. In
    // proportion, so that appending to a long list stays cheap.
    let capacity = (items.len() + items.len() / 4).next_multiple_of(4);
    pool.extend_from_slice(items);
    pool.resize(start + capacity, T::from_raw(0));
    (start, capacity)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ids(range: std::ops::Range<u32>) -> Vec<FaceId> {
        range.map(FaceId).collect()
    }

    #[test]
    fn lists_move_between_their_row_and_the_pool() {
        let mut lists: Lists<FaceId> = Lists::new(std::iter::repeat_n((), 3));
        for item in ids(0..9) {
            lists.push(0, item);
            assert!(lists.is_sound());
        }
        assert_eq!(lists.get(0), ids(0..9));
        assert!(lists.remove(0, FaceId(4)) && lists.remove(0, FaceId(0)));
        assert_eq!(lists.get(0), [1, 2, 3, 5, 6, 7, 8].map(FaceId));
        assert!(lists.insert(0, FaceId(0)) && !lists.insert(0, FaceId(8)));
        assert!(lists.is_sound() && !lists.remove(2, FaceId(5)));
        lists.push_list(());
        lists.set(3, &ids(0..20));
        lists.pop_list();
        assert!(lists.len() == 3 && lists.is_sound());
    }

    #[test]
    fn garbage_is_collected() {
        let mut lists: Lists<FaceId> = Lists::new(std::iter::repeat_n((), 3));
        lists.set(0, &ids(0..10));
        for round in 0..2000u32 {
            lists.set(1, &ids(0..round % 50));
            lists.set(2, &ids(0..round % 70));
            lists.clear(1);
        }
        assert!(lists.pool.len() < 3 * MIN_POOL && lists.is_sound());
        assert_eq!(lists.get(0), ids(0..10));
    }

    #[test]
    fn long_lists_grow_in_turn() {
        // Packing the pool must leave them room, or every item appended would move a whole list.
        let mut lists: Lists<FaceId> = Lists::new(std::iter::repeat_n((), 2));
        for item in ids(0..400_000) {
            lists.push(item.0 as usize % 2, item);
        }
        assert!(lists.is_sound() && lists.pool.len() < 2 * 400_000 + MIN_POOL);
        assert!(lists.get(1).iter().all(|item| item.0 % 2 == 1));
    }
}
