//! Candidate collapses: where the vertex that stays goes.
//!
//! An edge is judged at its memoryless optimum. Those that come up next try other places as well: a
//! pattern search by what the pictures say, the paper's stated future work ("image-driven choice among
//! several placements").
//!
//! Knows nothing of the queue.

use glam::DVec3;

use crate::{
    memoryless::{self, may_collapse},
    mesh::{EdgeId, EdgeTable, EditMesh, Topology},
    metric::Objective,
    render::{Move, RenderError},
};

/// What makes a candidate.
#[derive(Clone, Debug)]
pub struct Rules {
    /// Whether the link condition holds edges back.
    pub topology: Topology,
    /// Memoryless placement.
    pub memoryless: memoryless::Params,
}

/// A place for the collapse of an edge, and by how much that changes the energy.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    /// The edge.
    pub edge: EdgeId,
    /// Where its vertex goes.
    pub to: DVec3,
    /// The change of energy.
    pub delta: i64,
}

/// What candidates are of, and who judges them.
pub struct Judge<'a> {
    pub mesh: &'a EditMesh,
    pub edges: &'a EdgeTable,
    pub objective: &'a mut Objective,
    pub rules: &'a Rules,
    pub scratch: &'a mut memoryless::Scratch,
}

/// A search under way.
struct Search {
    edge: EdgeId,
    to: DVec3,
    /// Of `to`, once it was judged.
    delta: Option<i64>,
    step: f64,
    /// There is no other place: one end is locked.
    is_fixed: bool,
}

impl Search {
    /// Where to look now.
    fn places(&self) -> impl Iterator<Item = DVec3> {
        let &Self { to, step, is_fixed, .. } = self;
        let here = self.delta.is_none().then_some(to);
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().filter(move |_| !is_fixed);
        here.into_iter().chain(axes.flat_map(move |d| [to + d * step, to - d * step]))
    }

    /// Hears of the best of those places.
    fn learn(&mut self, to: DVec3, delta: i64) {
        let is_better = self.delta.map_or(to != self.to, |old| delta < old);
        if !is_better {
            self.step *= 0.5;
        }
        if is_better || self.delta.is_none() {
            (self.to, self.delta) = (to, Some(delta));
        }
    }
}

impl Judge<'_> {
    /// The edges that may collapse now, each at its memoryless optimum.
    pub fn optima(&mut self, edges: &[EdgeId]) -> Result<Vec<Candidate>, RenderError> {
        let mut found = Vec::with_capacity(edges.len());
        let mut moves = Vec::with_capacity(edges.len());
        for &edge in edges {
            if !self.may_collapse(edge) {
                continue;
            }
            let [a, b] = self.edges.ends(edge);
            let optimum =
                memoryless::placement(self.mesh, a, b, &self.rules.memoryless, self.scratch);
            let Some(to) = optimum.map(|p| p.to) else { continue };
            if let Some(mv) = self.as_move(edge, to) {
                found.push(Candidate { edge, to, delta: 0 });
                moves.push(mv);
            }
        }
        for (candidate, delta) in found.iter_mut().zip(self.objective.evaluate(&moves)?) {
            candidate.delta = delta;
        }
        Ok(found)
    }

    /// Looks for better places for collapses: pattern searches along the axes, steps halved from a
    /// quarter of the edge's length. Leaves out edges that may not collapse now.
    pub fn search(
        &mut self,
        starts: &[(EdgeId, DVec3)],
        rounds: u32,
    ) -> Result<Vec<Candidate>, RenderError> {
        let may_start = starts.iter().filter(|(edge, _)| self.may_collapse(*edge));
        let mut searches: Vec<Search> = may_start.map(|&(e, to)| self.start(e, to)).collect();
        for _ in 0..rounds.max(1) {
            self.round(&mut searches)?;
        }
        let found = |s: &Search| s.delta.map(|delta| Candidate { edge: s.edge, to: s.to, delta });
        Ok(searches.iter().filter_map(found).collect())
    }

    fn start(&self, edge: EdgeId, to: DVec3) -> Search {
        let ends = self.edges.ends(edge);
        let [a, b] = ends.map(|v| self.mesh.position(v));
        let is_fixed = self.mesh.fixed_place(ends).is_some();
        Search { edge, to, delta: None, step: 0.25 * a.distance(b), is_fixed }
    }

    /// Each search looks around once.
    fn round(&mut self, searches: &mut [Search]) -> Result<(), RenderError> {
        let mut tries = Vec::new();
        let mut moves = Vec::new();
        for (i, search) in searches.iter().enumerate() {
            for to in search.places() {
                if let Some(mv) = self.as_move(search.edge, to) {
                    tries.push((i, to));
                    moves.push(mv);
                }
            }
        }
        let deltas = self.objective.evaluate(&moves)?;
        let judged: Vec<_> = tries.into_iter().zip(deltas).collect();
        for of_one in judged.chunk_by(|a, b| a.0.0 == b.0.0) {
            // The first of equals wins.
            if let Some(&((i, to), delta)) = of_one.iter().min_by_key(|(_, delta)| *delta) {
                searches[i].learn(to, delta);
            }
        }
        Ok(())
    }

    fn may_collapse(&self, edge: EdgeId) -> bool {
        let [a, b] = self.edges.ends(edge);
        may_collapse(self.mesh, a, b, self.rules.topology)
    }

    fn as_move(&self, edge: EdgeId, to: DVec3) -> Option<Move> {
        let [keep, drop] = self.mesh.survivor_first(self.edges.ends(edge));
        self.objective.collapse_move(self.mesh, &self.mesh.plan_collapse(keep, drop, to))
    }
}
