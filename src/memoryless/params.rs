//! What can be chosen, and the eight placement schemes as a table.

use crate::mesh::Topology;

/// Where a collapsed edge's vertex goes before volume preservation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Start {
    /// One of the two ends, by a hash of their ids and the seed.
    RandomEnd,
    /// The end with the smaller cost.
    BetterEnd,
    /// The middle of the edge.
    Midpoint,
    /// The minimum of the cost.
    Optimum,
}

/// A placement scheme (Lindstrom & Turk 1999, section 5.1). All are ordered by the same cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Scheme {
    /// The position to start from.
    pub start: Start,
    /// Whether the enclosed volume is kept: the start is projected on the plane of constant
    /// volume; the optimum is sought within it.
    pub keeps_volume: bool,
}

impl Scheme {
    /// The paper's eight, in its order (number n at index n − 1).
    pub const ALL: [Self; 8] = [
        Self { start: Start::RandomEnd, keeps_volume: false },
        Self { start: Start::BetterEnd, keeps_volume: false },
        Self { start: Start::Midpoint, keeps_volume: false },
        Self { start: Start::Optimum, keeps_volume: false },
        Self { start: Start::RandomEnd, keeps_volume: true },
        Self { start: Start::BetterEnd, keeps_volume: true },
        Self { start: Start::Midpoint, keeps_volume: true },
        Self { start: Start::Optimum, keeps_volume: true },
    ];

    /// Number 8, the method of the paper.
    pub const MEMORYLESS: Self = Self::ALL[7];
}

/// Parameters of memoryless simplification.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Weight λ of the volume term against the boundary term, in 0..=1 (equation 11).
    pub lambda: f64,
    /// Where vertices go.
    pub scheme: Scheme,
    /// Whether collapses must keep the topology.
    pub topology: Topology,
    /// Most that a surviving triangle may turn in one collapse, degrees; 180 allows all.
    pub max_turn_degrees: f64,
    /// Chooses the ends of [`Start::RandomEnd`].
    pub seed: u64,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            lambda: 0.5,
            scheme: Scheme::MEMORYLESS,
            topology: Topology::Preserve,
            max_turn_degrees: 75.0,
            seed: 0,
        }
    }
}
