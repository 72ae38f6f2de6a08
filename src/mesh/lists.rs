//! Many short ascending lists in one pool: what connectivity is made of.
//!
//! Invariants:
//! 1. every list is strictly ascending, so its order depends on its content alone;
//! 2. spans (`start..start + cap`) of different lists do not overlap, `len <= cap`;
//! 3. `live` is the sum of all lengths; the pool is packed anew when more than half is unused.
//!
//! Knows nothing of meshes.

/// Where one list lies in the pool.
#[derive(Clone, Copy, Debug, Default)]
struct Span {
    start: u32,
    len: u32,
    cap: u32,
}

impl Span {
    fn range(self) -> std::ops::Range<usize> {
        self.start as usize..(self.start + self.len) as usize
    }
}

/// Pooled ascending lists, addressed by number.
#[derive(Clone, Debug)]
pub(super) struct Lists<T> {
    spans: Vec<Span>,
    pool: Vec<T>,
    live: usize,
}

/// Below this many pool entries packing is not worth its walk.
const MIN_POOL: usize = 1024;

impl<T: Copy + Ord> Lists<T> {
    /// `n_lists` lists from (list, item) pairs; the items of a list come ascending.
    pub(super) fn from_pairs(
        n_lists: usize,
        pairs: impl Iterator<Item = (usize, T)> + Clone,
    ) -> Self {
        let mut spans = vec![Span::default(); n_lists];
        let mut live = 0;
        let mut filler = None;
        for (list, item) in pairs.clone() {
            spans[list].cap += 1;
            live += 1;
            filler = Some(item);
        }
        let mut start = 0;
        for span in &mut spans {
            span.start = start;
            start += span.cap;
        }
        let mut pool = filler.map_or_else(Vec::new, |item| vec![item; live]);
        for (list, item) in pairs {
            let span = &mut spans[list];
            pool[(span.start + span.len) as usize] = item;
            span.len += 1;
        }
        Self { spans, pool, live }
    }

    /// Number of lists.
    pub(super) fn len(&self) -> usize {
        self.spans.len()
    }

    /// The items of one list, ascending.
    #[inline]
    pub(super) fn get(&self, list: usize) -> &[T] {
        &self.pool[self.spans[list].range()]
    }

    /// Replaces a list; `items` are strictly ascending.
    pub(super) fn set(&mut self, list: usize, items: &[T]) {
        let len = items.len() as u32;
        self.live = self.live + items.len() - self.spans[list].len as usize;
        if self.spans[list].cap < len {
            self.relocate(list, items);
            return;
        }
        let span = &mut self.spans[list];
        span.len = len;
        self.pool[span.range()].copy_from_slice(items);
    }

    /// Adds an item to a list; false if it was there.
    pub(super) fn insert(&mut self, list: usize, item: T) -> bool {
        let Err(at) = self.get(list).binary_search(&item) else { return false };
        let mut grown: smallvec::SmallVec<[T; 24]> = self.get(list).into();
        grown.insert(at, item);
        self.set(list, &grown);
        true
    }

    /// Takes an item out of a list; false if it was not there.
    pub(super) fn remove(&mut self, list: usize, item: T) -> bool {
        let span = self.spans[list];
        let items = &mut self.pool[span.range()];
        let Some(at) = items.iter().position(|&x| x == item) else { return false };
        items.copy_within(at + 1.., at);
        self.spans[list].len -= 1;
        self.live -= 1;
        true
    }

    /// Empties a list; its place stays reserved until the next packing.
    pub(super) fn clear(&mut self, list: usize) {
        self.live -= self.spans[list].len as usize;
        self.spans[list].len = 0;
    }

    /// Appends an empty list.
    pub(super) fn push_list(&mut self) {
        self.spans.push(Span::default());
    }

    /// Removes the last list.
    pub(super) fn pop_list(&mut self) {
        if let Some(span) = self.spans.pop() {
            self.live -= span.len as usize;
        }
    }

    /// Gives a list that outgrew its place a new one at the end of the pool.
    fn relocate(&mut self, list: usize, items: &[T]) {
        self.spans[list] = Span::default();
        if self.pool.len() + items.len() > 2 * self.live + MIN_POOL {
            self.pack();
        }
        let start = self.pool.len() as u32;
        self.pool.extend_from_slice(items);
        // Valences vary by one or two from edit to edit: room for that saves most moves.
        let cap = items.len().next_multiple_of(4);
        self.pool.extend(items.last().into_iter().cycle().take(cap - items.len()));
        self.spans[list] = Span { start, len: items.len() as u32, cap: cap as u32 };
    }

    /// Closes all gaps, keeping the lists in their order.
    fn pack(&mut self) {
        let mut pool = Vec::with_capacity(self.live + self.live / 4 + MIN_POOL);
        for span in &mut self.spans {
            let items = &self.pool[span.range()];
            *span = Span { start: pool.len() as u32, len: span.len, cap: span.len };
            pool.extend_from_slice(items);
        }
        self.pool = pool;
    }

    /// Whether invariants 1 to 3 hold.
    pub(super) fn is_sound(&self) -> bool {
        let mut spans: Vec<&Span> = self.spans.iter().filter(|s| s.cap > 0).collect();
        spans.sort_by_key(|s| s.start);
        let apart = spans.windows(2).all(|w| w[0].start + w[0].cap <= w[1].start);
        let inside = spans
            .iter()
            .all(|s| s.len <= s.cap && (s.start as usize + s.cap as usize) <= self.pool.len());
        let live = self.spans.iter().map(|s| s.len as usize).sum::<usize>() == self.live;
        apart
            && inside
            && live
            && (0..self.len()).all(|i| self.get(i).windows(2).all(|w| w[0] < w[1]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_grow_shrink_and_pack() {
        let pairs = [(0, 1u32), (0, 3), (2, 5)];
        let mut lists = Lists::from_pairs(3, pairs.into_iter());
        assert_eq!((lists.get(0), lists.get(1), lists.get(2)), (&[1, 3][..], &[][..], &[5][..]));
        assert!(lists.insert(0, 2) && !lists.insert(0, 2));
        assert!(lists.remove(2, 5) && !lists.remove(2, 5));
        for round in 0..2000u32 {
            lists.set(1, &(0..round % 50).collect::<Vec<_>>());
            lists.clear(1);
            lists.set(2, &(0..=round % 70).collect::<Vec<_>>());
        }
        assert!(lists.pool.len() < 3 * MIN_POOL, "garbage is collected");
        assert_eq!(lists.get(0), &[1, 2, 3]);
        assert!(lists.is_sound());
    }
}
