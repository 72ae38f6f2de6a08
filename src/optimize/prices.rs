//! What changing each edge would cost: the queues of collapses and of splits that teleports pair.
//!
//! Invariants:
//! 1. an edge is in the queue once, under its ends ascending, or unknown to it;
//! 2. an entry that is not stale holds what an evaluation has said since its surroundings last
//!    changed; a stale one keeps its key until it comes up (the simplifier's lazy queue). The
//!    paper resets such entries to zero, which judges every edge of a lively region again;
//! 3. an edge that is gone may stay in the queue until it comes up.
//!
//! Source: Lindstrom & Turk 2000, section 7.1.5, for collapses; the queue of splits is ours.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use crate::mesh::{EditMesh, VertexId};

use super::statistics::Average;

/// An edge by its ends, ascending.
pub type Ends = [VertexId; 2];

/// What is known of an edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Entry {
    /// The change of energy.
    pub cost: i64,
    /// The level at which it was found.
    pub level: u8,
    /// Where the vertex went.
    pub place: Option<DVec3>,
    /// Its surroundings have changed since.
    pub is_stale: bool,
}

/// See the module.
pub struct Prices {
    entries: BTreeMap<Ends, Entry>,
    order: BTreeSet<(i64, Ends)>,
    /// What an edge is entered as.
    unknown: Entry,
    /// The share of its size by which a price falls at one level more.
    savings: Average,
}

impl Prices {
    /// All edges, none of them judged; each is supposed to cost `guess` until it is.
    pub fn new(mesh: &EditMesh, guess: i64) -> Self {
        let mut this = Self {
            entries: BTreeMap::new(),
            order: BTreeSet::new(),
            unknown: Entry { cost: guess, level: 0, place: None, is_stale: true },
            savings: Average::default(),
        };
        for face in mesh.faces() {
            let [a, b, c] = mesh.vertices_of(face);
            for ends in [ascending(a, b), ascending(b, c), ascending(c, a)] {
                this.set(ends, this.unknown);
            }
        }
        this
    }

    /// Enters an edge, or changes its entry.
    pub fn set(&mut self, ends: Ends, entry: Entry) {
        if let Some(old) = self.entries.insert(ends, entry) {
            self.order.remove(&(old.cost, ends));
        }
        self.order.insert((entry.cost, ends));
    }

    /// Takes an edge out: it is gone, or may not collapse until its surroundings change.
    pub fn remove(&mut self, ends: Ends) {
        if let Some(old) = self.entries.remove(&ends) {
            self.order.remove(&(old.cost, ends));
        }
    }

    /// Makes all entries stale.
    pub fn doubt(&mut self) {
        self.entries.values_mut().for_each(|entry| entry.is_stale = true);
    }

    /// The cheapest edges, cheapest first.
    pub fn cheapest(&self) -> impl Iterator<Item = (Ends, Entry)> + '_ {
        self.order.iter().filter_map(|(_, ends)| Some((*ends, *self.entries.get(ends)?)))
    }

    /// Marks the edges of the triangles at a vertex as stale; new ones are entered.
    pub fn disturb(&mut self, mesh: &EditMesh, v: VertexId) {
        for &face in mesh.faces_around(v) {
            let [a, b, c] = mesh.vertices_of(face);
            for ends in [ascending(a, b), ascending(b, c), ascending(c, a)] {
                match self.entries.get_mut(&ends) {
                    Some(entry) => entry.is_stale = true,
                    None => self.set(ends, self.unknown),
                }
            }
        }
    }

    /// The cheapest edges of as many triangles as `fits` says; those that are gone leave the queue.
    pub fn front(
        &mut self,
        mesh: &EditMesh,
        n: usize,
        fits: impl Fn(usize) -> bool,
    ) -> Vec<(Ends, Entry)> {
        // A vertex of a split that was taken back is no slot at all.
        let exists = |ends: &Ends| ends[1].index() < mesh.n_vertex_slots();
        let n_faces = |ends: &Ends| {
            if exists(ends) { mesh.edge_faces(ends[0], ends[1]).len() } else { 0 }
        };
        let mut gone = Vec::new();
        let mut front = Vec::new();
        for (ends, entry) in self.cheapest() {
            match n_faces(&ends) {
                0 => gone.push(ends),
                n_faces if fits(n_faces) => front.push((ends, entry)),
                _ => {}
            }
            if front.len() == n {
                break;
            }
        }
        gone.into_iter().for_each(|ends| self.remove(ends));
        front
    }

    /// Learns what one level more has saved.
    pub fn learn(&mut self, before: i64, after: i64) {
        if before != 0 {
            self.savings.add((before - after) as f64 / before.abs() as f64);
        }
    }

    /// The least that a price may fall to by one level more, but for a chance of 0.3%.
    pub fn hope(&self, cost: i64) -> f64 {
        let share = (self.savings.mean() + 3.0 * self.savings.deviation()).max(0.1);
        cost as f64 - share * cost.abs() as f64
    }
}

/// An edge's key.
pub fn ascending(a: VertexId, b: VertexId) -> Ends {
    if a < b { [a, b] } else { [b, a] }
}
