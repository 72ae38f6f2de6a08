//! Candidate collapses: for each edge a few places for the vertex that stays.
//!
//! The memoryless optimum is always among them; the others are the paper's stated future work
//! ("image-driven choice among several placements").

use glam::DVec3;
use smallvec::SmallVec;

use crate::{
    memoryless,
    mesh::{EdgeId, EdgeTable, EditMesh, Topology, VertexId},
    metric::Objective,
    render::Move,
};

/// Which places an edge is tried at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Placements {
    /// The memoryless optimum.
    Optimum,
    /// The optimum, the midpoint and both ends.
    OptimumMidpointEnds,
}

/// One candidate collapse.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// The edge.
    pub edge: EdgeId,
    /// Where its vertex goes.
    pub to: DVec3,
    /// The edit, as the evaluator sees it.
    pub mv: Move,
}

/// Collects candidates of a set of edges; working memory is kept between calls.
#[derive(Default)]
pub struct Collector {
    scratch: memoryless::Scratch,
}

impl Collector {
    /// All candidates of `edge`; none when the edge may not collapse now.
    pub fn collect(
        &mut self,
        mesh: &EditMesh,
        edges: &EdgeTable,
        objective: &Objective,
        rules: &Rules,
        edge: EdgeId,
        out: &mut Vec<Candidate>,
    ) {
        let [a, b] = edges.ends(edge);
        if !memoryless::may_collapse(mesh, a, b, rules.topology) {
            return;
        }
        for to in self.places(mesh, rules, a, b) {
            let plan = mesh.plan_collapse(a, b, to);
            if let Some(mv) = objective.collapse_move(mesh, &plan) {
                out.push(Candidate { edge, to, mv });
            }
        }
    }

    /// Distinct places, the memoryless optimum first.
    fn places(
        &mut self,
        mesh: &EditMesh,
        rules: &Rules,
        a: VertexId,
        b: VertexId,
    ) -> SmallVec<[DVec3; 4]> {
        let mut places = SmallVec::new();
        let optimum = memoryless::placement(mesh, a, b, &rules.memoryless, &mut self.scratch);
        places.extend(optimum.map(|p| p.to));
        if rules.placements == Placements::OptimumMidpointEnds {
            let (pa, pb) = (mesh.position(a), mesh.position(b));
            for p in [(pa + pb) * 0.5, pa, pb] {
                if !places.contains(&p) {
                    places.push(p);
                }
            }
        }
        places
    }
}

/// What makes a candidate.
#[derive(Clone, Debug)]
pub struct Rules {
    /// Places to try.
    pub placements: Placements,
    /// Whether the link condition holds edges back.
    pub topology: Topology,
    /// Memoryless placement.
    pub memoryless: memoryless::Params,
}
