//! The corners at each vertex, as doubly linked lists in flat arrays.
//!
//! Links are stored plus one, so that a fresh table is all zeros: memory that nobody touches costs
//! nothing, however large the mesh of a file claims to be.

/// Lists of corners by vertex. Corners must be linked at most once.
#[derive(Clone, Debug)]
pub(super) struct Rings {
    first: Vec<u32>,
    next: Vec<u32>,
    previous: Vec<u32>,
}

impl Rings {
    pub(super) fn new(n_vertices: usize, n_faces: usize) -> Self {
        Self {
            first: vec![0; n_vertices],
            next: vec![0; 3 * n_faces],
            previous: vec![0; 3 * n_faces],
        }
    }

    /// Appends a vertex without corners.
    pub(super) fn push_vertex(&mut self) {
        self.first.push(0);
    }

    /// Removes the last vertex, which has no corners.
    pub(super) fn pop_vertex(&mut self) {
        self.first.pop();
    }

    /// Appends the three corners of a face, not linked yet.
    pub(super) fn push_face(&mut self) {
        self.next.extend([0; 3]);
        self.previous.extend([0; 3]);
    }

    /// Removes the corners of the last face, which are not linked.
    pub(super) fn pop_face(&mut self) {
        self.next.truncate(self.next.len().saturating_sub(3));
        self.previous.truncate(self.next.len());
    }

    /// Links `corner` to `vertex`.
    pub(super) fn insert(&mut self, vertex: u32, corner: u32) {
        let head = std::mem::replace(&mut self.first[vertex as usize], corner + 1);
        self.next[corner as usize] = head;
        self.previous[corner as usize] = 0;
        if head != 0 {
            self.previous[head as usize - 1] = corner + 1;
        }
    }

    /// Unlinks `corner` from `vertex`, to which it is linked.
    pub(super) fn remove(&mut self, vertex: u32, corner: u32) {
        let next = self.next[corner as usize];
        let previous = self.previous[corner as usize];
        match previous {
            0 => self.first[vertex as usize] = next,
            p => self.next[p as usize - 1] = next,
        }
        if next != 0 {
            self.previous[next as usize - 1] = previous;
        }
    }

    /// The corners of `vertex`, in no particular order.
    pub(super) fn of(&self, vertex: u32) -> impl Iterator<Item = u32> + '_ {
        let mut at = self.first[vertex as usize];
        std::iter::from_fn(move || {
            let corner = at.checked_sub(1)?;
            at = self.next[corner as usize];
            Some(corner)
        })
    }

    /// Whether `vertex` has no corners.
    pub(super) fn is_empty(&self, vertex: u32) -> bool {
        self.first[vertex as usize] == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_come_and_go() {
        let mut rings = Rings::new(2, 2);
        (0..4).for_each(|c| rings.insert(1, c));
        assert_eq!(rings.of(1).collect::<Vec<_>>(), [3, 2, 1, 0]);
        for (gone, left) in [(2, vec![3, 1, 0]), (3, vec![1, 0]), (0, vec![1]), (1, vec![])] {
            rings.remove(1, gone);
            assert_eq!(rings.of(1).collect::<Vec<_>>(), left);
        }
        assert!(rings.is_empty(1) && rings.is_empty(0));
    }

    #[test]
    fn vertices_and_faces_are_appended_and_removed() {
        let mut rings = Rings::new(1, 1);
        rings.insert(0, 1);
        rings.push_vertex();
        rings.push_face();
        (3..=5).for_each(|c| rings.insert(1, c));
        assert_eq!(rings.of(1).collect::<Vec<_>>(), [5, 4, 3]);
        (3..=5).for_each(|c| rings.remove(1, c));
        rings.pop_face();
        rings.pop_vertex();
        assert_eq!(rings.of(0).collect::<Vec<_>>(), [1]);
        assert_eq!((rings.first.len(), rings.next.len(), rings.previous.len()), (1, 3, 3));
    }
}
