//! Numbers distinct records of fixed width in the order of their first appearance.

use std::hash::{BuildHasher, RandomState};

const EMPTY: u32 = u32::MAX;

/// An open-addressing table from records of `width` words to dense ids.
///
/// Hashed with the randomly keyed hasher of the standard library, so that no file can be made of
/// records that all collide. Ids follow first appearance, so the keys do not show in results.
#[derive(Debug)]
pub(super) struct Interner {
    width: usize,
    words: Vec<u32>,
    slots: Vec<u32>,
    hasher: RandomState,
}

impl Interner {
    /// `width` is at least 1.
    pub(super) fn new(width: usize) -> Self {
        Self {
            width: width.max(1),
            words: Vec::new(),
            slots: vec![EMPTY; 16],
            hasher: RandomState::new(),
        }
    }

    /// Number of distinct records.
    pub(super) fn len(&self) -> usize {
        self.words.len() / self.width
    }

    /// All records in the order of their ids.
    pub(super) fn into_words(self) -> Vec<u32> {
        self.words
    }

    /// The id of `record`, which holds `width` words.
    pub(super) fn intern(&mut self, record: &[u32]) -> u32 {
        if self.len() * 4 >= self.slots.len() * 3 {
            self.grow();
        }
        let mut slot = self.home(record);
        loop {
            let id = self.slots[slot];
            if id == EMPTY {
                let new = self.len() as u32;
                self.words.extend_from_slice(record);
                self.slots[slot] = new;
                return new;
            }
            if self.record(id) == record {
                return id;
            }
            slot = (slot + 1) & (self.slots.len() - 1);
        }
    }

    fn record(&self, id: u32) -> &[u32] {
        let at = id as usize * self.width;
        &self.words[at..at + self.width]
    }

    fn home(&self, record: &[u32]) -> usize {
        self.hasher.hash_one(record) as usize & (self.slots.len() - 1)
    }

    fn grow(&mut self) {
        self.slots = vec![EMPTY; self.slots.len() * 2];
        for id in 0..self.len() as u32 {
            let mut slot = self.home(self.record(id));
            while self.slots[slot] != EMPTY {
                slot = (slot + 1) & (self.slots.len() - 1);
            }
            self.slots[slot] = id;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_follow_first_appearance() {
        let mut table = Interner::new(2);
        for i in 0..1000_u32 {
            assert_eq!(table.intern(&[i % 100, i % 7]), table.intern(&[i % 100, i % 7]));
        }
        assert_eq!(table.intern(&[0, 0]), 0);
        assert_eq!(table.len(), 700, "100 and 7 are coprime");
        assert_eq!(&table.into_words()[..4], &[0, 0, 1, 1]);
    }
}
