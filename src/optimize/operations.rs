//! The operations that are tried on an edge: a change of connectivity, and the vertices whose
//! places are searched with it (Lindstrom & Turk 2000, table 2).
//!
//! An operation only proposes: the mesh is not touched here.

use std::f64::consts::TAU;

use glam::DVec3;

use crate::{
    mesh::{Collapse, EditMesh, Split, Swap, VertexId},
    metric::{Change, Free, Objective, stored_normal},
};

use super::{
    params::{Params, Solver},
    quadratic::Quadratic,
    rng::Rng,
    simplex::{Simplex, Stop},
    trial::{Search, Trial},
};

/// The changes of connectivity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// None.
    NoOp,
    /// The edge turns.
    Swap,
    /// The edge gets a vertex; with a collapse elsewhere, a teleport.
    Split,
    /// The edge becomes a vertex.
    Collapse,
}

/// A change of connectivity and how many vertices around it are free.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Operation {
    /// What changes.
    pub kind: Kind,
    /// 0: nothing is searched, to 3: the whole neighbourhood is.
    pub level: u8,
}

/// All operations, in the order they are tried on an edge. The paper has 13; single vertices
/// (no-op at level 0) and swaps without a search (level 0) are ours, for sweeps.
pub const OPERATIONS: [Operation; 15] = [
    Operation { kind: Kind::NoOp, level: 0 },
    Operation { kind: Kind::NoOp, level: 1 },
    Operation { kind: Kind::NoOp, level: 2 },
    Operation { kind: Kind::NoOp, level: 3 },
    Operation { kind: Kind::Swap, level: 0 },
    Operation { kind: Kind::Swap, level: 1 },
    Operation { kind: Kind::Swap, level: 2 },
    Operation { kind: Kind::Swap, level: 3 },
    Operation { kind: Kind::Split, level: 1 },
    Operation { kind: Kind::Split, level: 2 },
    Operation { kind: Kind::Split, level: 3 },
    Operation { kind: Kind::Collapse, level: 0 },
    Operation { kind: Kind::Collapse, level: 1 },
    Operation { kind: Kind::Collapse, level: 2 },
    Operation { kind: Kind::Collapse, level: 3 },
];

const NAMES: [&str; OPERATIONS.len()] = [
    "vertex",
    "no-op 1",
    "no-op 2",
    "no-op 3",
    "swap 0",
    "swap 1",
    "swap 2",
    "swap 3",
    "split 1",
    "split 2",
    "split 3",
    "collapse 0",
    "collapse 1",
    "collapse 2",
    "collapse 3",
];

impl Operation {
    /// The place in [`OPERATIONS`].
    pub fn index(self) -> usize {
        OPERATIONS.iter().position(|o| *o == self).unwrap_or(0)
    }

    /// What it is called in statistics.
    pub fn name(self) -> &'static str {
        NAMES[self.index()]
    }
}

/// A planned change of connectivity.
#[derive(Clone, Debug)]
pub enum Plan {
    /// None.
    Nothing,
    /// An edge turns.
    Swap(Swap),
    /// An edge gets a vertex, the first free one.
    Split(Split),
    /// An edge becomes a vertex, the first free one.
    Collapse(Collapse),
}

impl Plan {
    fn change(&self) -> Change<'_> {
        match self {
            Self::Nothing => Change::Nothing,
            Self::Swap(plan) => Change::Swap(plan),
            Self::Split(plan) => Change::Split(plan),
            Self::Collapse(plan) => Change::Collapse(plan),
        }
    }
}

/// A candidate edit: what changes, and the search for where its vertices go.
#[derive(Clone, Debug)]
pub struct Proposal {
    /// The operation.
    pub operation: Operation,
    /// The edge (for a single vertex: that vertex twice).
    pub edge: [VertexId; 2],
    /// The change of connectivity.
    pub plan: Plan,
    /// The search.
    pub trial: Trial,
}

/// Makes proposals for the mesh as it is now.
pub struct Proposer<'a> {
    /// The mesh.
    pub mesh: &'a EditMesh,
    /// What judges.
    pub objective: &'a Objective,
    /// How to search.
    pub params: &'a Params,
    /// First steps of each vertex, as a share of the mean length of its edges.
    pub steps: &'a [f64],
}

impl Proposer<'_> {
    /// An operation on an edge; `None` where it cannot be done. `place` is where a collapse puts
    /// its vertex (the midpoint otherwise).
    pub fn propose(
        &self,
        operation: Operation,
        edge: [VertexId; 2],
        place: Option<DVec3>,
    ) -> Option<Proposal> {
        let edge = self.mesh.survivor_first(edge);
        let [a, b] = edge;
        let middle = self.mesh.position(a).midpoint(self.mesh.position(b));
        let (plan, free) = match operation.kind {
            Kind::NoOp => {
                let free = self.around_edge(edge, operation.level);
                // All of them may be locked.
                free.first()?;
                (Plan::Nothing, free)
            }
            Kind::Swap => {
                let plan = self.mesh.plan_swap(a, b)?;
                (Plan::Swap(plan), self.around_swap(&plan, operation.level))
            }
            Kind::Split => {
                let plan = self.mesh.plan_split(a, b, middle)?;
                let free = self.around_split(&plan, operation.level);
                (Plan::Split(plan), free)
            }
            Kind::Collapse => {
                let place = self.mesh.fixed_place(edge).or(place).unwrap_or(middle);
                let plan = self.mesh.plan_collapse(a, b, place);
                let free = self.around_collapse(&plan, operation.level);
                (Plan::Collapse(plan), free)
            }
        };
        let trial = self.trial(operation, edge, plan.change(), free)?;
        Some(Proposal { operation, edge, plan, trial })
    }

    fn around_edge(&self, edge: [VertexId; 2], level: u8) -> Vec<Free> {
        let vertices = match level {
            0 => vec![edge[0]],
            1 => edge.to_vec(),
            2 => with(&edge, &self.apexes(edge)),
            _ => with(&edge, &self.ring(edge)),
        };
        self.at_rest(&vertices)
    }

    fn around_swap(&self, plan: &Swap, level: u8) -> Vec<Free> {
        let vertices = match level {
            0 => Vec::new(),
            1 => plan.apexes.to_vec(),
            2 => with(&plan.apexes, &plan.ends),
            _ => with(&plan.apexes, &self.ring(plan.apexes)),
        };
        self.at_rest(&vertices)
    }

    fn around_split(&self, plan: &Split, level: u8) -> Vec<Free> {
        let edge = [plan.a, plan.b];
        let others = match level {
            0 | 1 => Vec::new(),
            2 => with(&edge, &self.apexes(edge)),
            _ => with(&edge, &self.ring(edge)),
        };
        let normal = self.normal(plan.a).midpoint(self.normal(plan.b));
        let mut free = vec![Free { vertex: plan.vertex, at: plan.at, normal }];
        free.extend(self.at_rest(&others));
        free
    }

    fn around_collapse(&self, plan: &Collapse, level: u8) -> Vec<Free> {
        let edge = [plan.keep, plan.drop];
        let others = match level {
            0 | 1 => Vec::new(),
            2 => self.apexes(edge),
            _ => self.ring(edge),
        };
        let normal = self.normal(plan.keep).midpoint(self.normal(plan.drop));
        let mut free = vec![Free { vertex: plan.keep, at: plan.to, normal }];
        let others: Vec<VertexId> = others.into_iter().filter(|v| !edge.contains(v)).collect();
        free.extend(self.at_rest(&others));
        free
    }

    /// The third vertices of the triangles at an edge.
    fn apexes(&self, edge: [VertexId; 2]) -> Vec<VertexId> {
        let faces = self.mesh.edge_faces(edge[0], edge[1]);
        let vertices = faces.iter().flat_map(|f| self.mesh.vertices_of(*f));
        vertices.filter(|v| !edge.contains(v)).collect()
    }

    /// The neighbours of both vertices.
    fn ring(&self, edge: [VertexId; 2]) -> Vec<VertexId> {
        let mut of_a = Vec::new();
        let mut of_b = Vec::new();
        self.mesh.neighbours(edge[0], &mut of_a);
        self.mesh.neighbours(edge[1], &mut of_b);
        with(&of_a, &of_b)
    }

    /// Those that are not locked.
    fn at_rest(&self, vertices: &[VertexId]) -> Vec<Free> {
        let free =
            |&v: &VertexId| Free { vertex: v, at: self.mesh.position(v), normal: self.normal(v) };
        vertices.iter().filter(|v| !self.mesh.is_locked(**v)).map(free).collect()
    }

    fn normal(&self, v: VertexId) -> DVec3 {
        if self.objective.has_own_normals() {
            stored_normal(self.mesh, v).unwrap_or_default()
        } else {
            DVec3::ZERO
        }
    }

    fn trial(
        &self,
        operation: Operation,
        edge: [VertexId; 2],
        change: Change<'_>,
        free: Vec<Free>,
    ) -> Option<Trial> {
        let template = self.objective.template(self.mesh, change, &free)?;
        let has_normals = self.params.optimizes_normals && self.objective.has_own_normals();
        let start = (operation.kind == Kind::NoOp).then_some(0);
        let search = if operation.level == 0 && operation.kind != Kind::NoOp || free.is_empty() {
            Search::Start(start)
        } else {
            self.search(self.first_steps(operation, change, &free, has_normals), start)
        };
        let frames = free.iter().map(|f| self.frame(edge, f.vertex)).collect();
        Some(Trial { template, free, frames, has_normals, search })
    }

    fn search(&self, steps: Vec<f64>, start: Option<i64>) -> Search {
        match self.params.solver {
            Solver::Quadratic => {
                Search::Quadratic(Quadratic::new(steps, start, self.params.quadratic_rounds))
            }
            Solver::Simplex => {
                let stop = Stop {
                    bits: self.params.simplex_bits,
                    evaluations_per_dimension: 32,
                    is_speculative: self.params.is_speculative,
                };
                Search::Simplex(Simplex::new(vec![0.0; steps.len()], start, &steps, stop))
            }
        }
    }

    /// One step for each coordinate of each place, then of each normal.
    fn first_steps(
        &self,
        operation: Operation,
        change: Change<'_>,
        free: &[Free],
        has_normals: bool,
    ) -> Vec<f64> {
        // The vertex of a split or collapse starts from a guess, so it looks farther.
        let edge = match change {
            Change::Split(plan) => Some([plan.a, plan.b]),
            Change::Collapse(plan) => Some([plan.keep, plan.drop]),
            Change::Nothing | Change::Swap(_) => None,
        };
        let of = |(i, f): (usize, &Free)| match edge {
            Some([a, b]) if i == 0 => {
                self.params.delta * self.mesh.position(a).distance(self.mesh.position(b))
            }
            _ => {
                let adapted = self.steps.get(f.vertex.index()).copied();
                let share = if operation.kind == Kind::NoOp { adapted } else { None };
                share.unwrap_or(self.params.delta) * self.mesh.mean_edge_length(f.vertex)
            }
        };
        let places = free.iter().enumerate().flat_map(|f| [of(f); 3]);
        let normals = free.iter().filter(|_| has_normals);
        let shrinkage = self.shrinkage(free);
        let all = places.chain(normals.flat_map(|f| [self.normal_step(f); 3]));
        all.map(|step| shrinkage * step).collect()
    }

    /// By how much the first steps are shorter than usual.
    fn shrinkage(&self, free: &[Free]) -> f64 {
        match (self.params.solver, free.first()) {
            (Solver::Quadratic, Some(f)) => {
                let [_, share] = self.chance(f.vertex);
                libm::exp2(-self.params.step_bits * share)
            }
            _ => 1.0,
        }
    }

    /// Two numbers from 0 to 1 that are a vertex's until something else was evaluated.
    fn chance(&self, v: VertexId) -> [f64; 2] {
        let seed = self.params.seed ^ self.objective.evaluations() << 32 ^ u64::from(v.0);
        let mut rng = Rng::new(seed);
        [rng.share(), rng.share()]
    }

    /// A share of the mean difference to the neighbours' normals.
    fn normal_step(&self, f: &Free) -> f64 {
        if f.vertex.index() >= self.mesh.n_vertex_slots() {
            return 0.05;
        }
        let mut ring = Vec::new();
        self.mesh.neighbours(f.vertex, &mut ring);
        let sum: f64 = ring.iter().map(|w| f.normal.distance(self.normal(*w))).sum();
        (0.25 * sum / ring.len().max(1) as f64).max(0.02)
    }

    /// Normal and two tangents; the axes of space for a simplex, as in the paper; none for a locked vertex
    /// into which an edge collapses.
    fn frame(&self, edge: [VertexId; 2], v: VertexId) -> [DVec3; 3] {
        if self.mesh.is_locked(v) {
            return [DVec3::ZERO; 3];
        }
        if self.params.solver == Solver::Simplex {
            return DVec3::AXES;
        }
        // A split's new vertex lies on the triangles of its edge.
        let is_old = v.index() < self.mesh.n_vertex_slots();
        let at_edge = self.mesh.edge_faces(edge[0], edge[1]);
        let faces = if is_old { self.mesh.faces_around(v) } else { &at_edge };
        let sum: DVec3 = faces.iter().map(|f| self.mesh.area_normal(*f)).sum();
        let normal = sum.normalize_or_zero();
        if normal == DVec3::ZERO {
            return DVec3::AXES;
        }
        let (tangent, bitangent) = normal.any_orthonormal_pair();
        if self.params.step_bits == 0.0 {
            return [normal, tangent, bitangent];
        }
        let [share, _] = self.chance(v);
        let (sin, cos) = libm::sincos(TAU * share);
        [normal, cos * tangent + sin * bitangent, cos * bitangent - sin * tangent]
    }
}

/// Both lists without repetition, the first one's order first.
fn with(first: &[VertexId], others: &[VertexId]) -> Vec<VertexId> {
    let mut all = first.to_vec();
    for v in others {
        if !all.contains(v) {
            all.push(*v);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        optimize::tests::{models, pictures, show},
        render::Shading,
    };

    #[test]
    fn random_searches_keep_the_normal_and_shrink_within_their_bits() {
        let (original, simplified) = models();
        let mesh = EditMesh::new(simplified).unwrap();
        let objective = show(&original, &pictures(&original, Shading::Flat), &mesh, false);
        let steps = vec![0.1; mesh.n_vertex_slots()];
        let search = |step_bits: f64, v: VertexId| {
            let params = Params { step_bits, ..Params::default() };
            let (mesh, objective) = (&mesh, &objective);
            let proposer = Proposer { mesh, objective, params: &params, steps: &steps };
            let no_op = Operation { kind: Kind::NoOp, level: 0 };
            let trial = proposer.propose(no_op, [v, v], None).unwrap().trial;
            let Search::Quadratic(probes) = &trial.search else { panic!("{:?}", trial.search) };
            (trial.frames[0], probes.asks()[0][0])
        };
        let vertices = (0..mesh.n_vertex_slots() as u32).map(VertexId);
        let mut shares = Vec::new();
        for v in vertices.filter(|v| mesh.is_used(*v)) {
            let (usual, step) = search(0.0, v);
            assert_eq!(search(0.0, v), (usual, step));
            let (frame, finer) = search(3.0, v);
            assert_eq!(search(3.0, v), (frame, finer), "the same as long as nothing was evaluated");
            assert_eq!(frame[0], usual[0]);
            assert!(frame[1] != usual[1], "{v:?}");
            assert!((frame[1].cross(frame[2]) - frame[0]).length() < 1e-12, "{frame:?}");
            assert!((0.125..=1.0).contains(&(finer / step)), "{finer} of {step}");
            shares.push(finer / step);
        }
        shares.sort_by(f64::total_cmp);
        // 2⁻³ᵘ, u even: half of them are below 2⁻¹·⁵.
        let median = shares[shares.len() / 2];
        assert!((0.25..0.5).contains(&median), "{median} of {}", shares.len());
    }
}
