//! What can be chosen, and how a run ends.

use crate::mesh::Topology;

/// How places (and normals) of free vertices are searched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Solver {
    /// Downhill simplex from steps along the axes, as the paper does.
    Simplex,
    /// Parabolas along each vertex's normal and two tangents.
    Quadratic,
}

/// Parameters of image-driven optimization.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::struct_excessive_bools, reason = "independent switches of one algorithm")]
pub struct Params {
    /// Chooses the random edges and the order of sweeps.
    pub seed: u64,
    /// Stop after so many evaluations of this run; 0 means never.
    pub max_evaluations: u64,
    /// Stop when the energy has fallen to this share of its start; 0 means never.
    pub until: f64,
    /// First steps of a search, as a share of the mean length of a vertex's edges.
    pub delta: f64,
    /// The search.
    pub solver: Solver,
    /// A simplex ends when its volume has fallen by so many bits for each dimension.
    pub simplex_bits: i32,
    /// A simplex asks for reflection, expansion and contraction at once: fewer rounds, more
    /// evaluations. A constant of the algorithm, never of the device.
    pub is_speculative: bool,
    /// First steps of a quadratic search are made smaller at random by up to so many bits, and its tangents turn at
    /// random about the normal, so that what is tried again is tried differently; 0: neither.
    pub step_bits: f64,
    /// Rounds of quadratic steps.
    pub quadratic_rounds: u32,
    /// Edges of an iteration (64: Lindstrom & Turk 2000, section 7.1.6).
    pub edges_per_iteration: usize,
    /// Sweeps of single vertices and of swaps between iterations.
    pub has_sweeps: bool,
    /// Vertices are searched for better places, alone and with their edges; otherwise they move with
    /// discrete moves only.
    pub has_vertex_moves: bool,
    /// Vertices may move from one part of the model to another.
    pub has_teleports: bool,
    /// A split for which no collapse is cheap enough keeps, as in the paper, the cheapest one,
    /// though the energy rises; otherwise it is taken back.
    pub allows_uphill: bool,
    /// Collapses may close triangular holes, and in cycles change the topology as they like; otherwise they keep it.
    pub closes_holes: bool,
    /// Vertex normals are unknowns too (only where the objective has normals of its own).
    pub optimizes_normals: bool,
    /// Texture coordinates and vertex colours are unknowns of descents (only where pictures show some).
    pub optimizes_attributes: bool,
    /// Samples of the energy curve are so many evaluations apart.
    pub sample_every: u64,
}

impl Params {
    /// Which collapses are legal.
    pub fn topology(&self) -> Topology {
        if self.closes_holes { Topology::CloseHoles } else { Topology::Preserve }
    }

    /// Which are in the simplification that ends a cycle.
    pub fn topology_of_cycles(&self) -> Topology {
        if self.closes_holes { Topology::Free } else { Topology::Preserve }
    }
}

impl Default for Params {
    fn default() -> Self {
        Self {
            seed: 0,
            max_evaluations: 0,
            until: 0.0,
            delta: 0.1,
            solver: Solver::Quadratic,
            simplex_bits: 1,
            is_speculative: false,
            step_bits: 0.0,
            quadratic_rounds: 1,
            edges_per_iteration: 64,
            has_sweeps: true,
            has_vertex_moves: true,
            has_teleports: true,
            allows_uphill: false,
            closes_holes: false,
            optimizes_normals: false,
            optimizes_attributes: false,
            sample_every: 4096,
        }
    }
}

/// What ended a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoppedBy {
    /// The budget of evaluations is spent.
    Evaluations,
    /// The energy has fallen as far as was asked.
    Energy,
    /// Nothing that was tried helps any more.
    Converged,
    /// The caller broke off.
    Caller,
}
