//! What the collapse of each edge would cost: the queue that teleports are paid from.
//!
//! Invariants:
//! 1. an edge is in the queue once, under its ends ascending, or set aside, or unknown to it;
//! 2. an entry that is not stale holds what an evaluation has said since its surroundings last
//!    changed; a stale one keeps its key until it comes up (the simplifier's lazy queue). The
//!    paper resets such entries to zero, which judges every edge of a lively region again.
//!
//! Source: Lindstrom & Turk 2000, section 7.1.5.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use crate::mesh::{EditMesh, VertexId};

use super::statistics::Average;

/// An edge by its ends, ascending.
pub type Ends = [VertexId; 2];

/// What is known of an edge's collapse.
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

/// Never judged: comes up at once.
const UNKNOWN: Entry = Entry { cost: 0, level: 0, place: None, is_stale: true };

/// See the module.
pub struct Collapses {
    entries: BTreeMap<Ends, Entry>,
    order: BTreeSet<(i64, Ends)>,
    /// The share of its cost that an edge saves by one level more.
    savings: Average,
}

impl Collapses {
    /// All edges, unknown.
    pub fn new(mesh: &EditMesh) -> Self {
        let mut this = Self {
            entries: BTreeMap::new(),
            order: BTreeSet::new(),
            savings: Average::default(),
        };
        for face in mesh.faces() {
            let [a, b, c] = mesh.vertices_of(face);
            for ends in [ascending(a, b), ascending(b, c), ascending(c, a)] {
                this.set(ends, UNKNOWN);
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
                    None => self.set(ends, UNKNOWN),
                }
            }
        }
    }

    /// Learns what one level more has saved.
    pub fn learn(&mut self, before: i64, after: i64) {
        if before > 0 {
            self.savings.add((before - after) as f64 / before as f64);
        }
    }

    /// The least that a cost may fall to by one level more, but for a chance of 0.3%.
    pub fn hope(&self, cost: i64) -> f64 {
        let share = (self.savings.mean() + 3.0 * self.savings.deviation()).clamp(0.1, 1.0);
        cost as f64 * (1.0 - share)
    }
}

/// An edge's key.
pub fn ascending(a: VertexId, b: VertexId) -> Ends {
    if a < b { [a, b] } else { [b, a] }
}
