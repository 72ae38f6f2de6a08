//! The greedy loop.

use std::ops::ControlFlow;

use glam::DVec3;

use crate::{
    memoryless::{self, may_collapse},
    mesh::{EdgeId, EdgeTable, EditMesh, Sample, Stage, Step, Topology, VertexId},
    metric::Objective,
    render::{Move, RenderError},
};

use super::{
    candidates::{Candidate, Judge, Rules},
    queue::{Queue, Standing},
};

/// When the neighbours of a collapse are judged again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Policy {
    /// When they come up: an edge that may have changed keeps its old key until then.
    Lazy,
    /// Edges at the new vertex at once, the rest of U(v) when they come up.
    Mixed,
    /// All of U(v), the edges that touch the new vertex or a neighbour of it, at once.
    Eager,
}

/// A good [`Params::batch`] (spec: evaluator.md, speculation table).
pub const BATCH: usize = 32;

/// Parameters of image-driven simplification.
#[derive(Clone, Debug)]
pub struct Params {
    /// When to judge again.
    pub policy: Policy,
    /// Placement and legality.
    pub rules: Rules,
    /// Stale edges judged in one batch (a constant of the algorithm, never of the device).
    pub batch: usize,
    /// So many edges at the front of the queue search for better places before the first of them
    /// collapses; the more, the closer the order is to one by what each does at its best. 0: none.
    pub ahead: usize,
    /// Rounds of each search, one at least.
    pub search_rounds: u32,
    /// Stop after so many evaluations; 0 means never.
    pub max_evaluations: u64,
    /// Stop before a collapse that would raise the energy to more than this.
    pub max_energy: Option<u64>,
}

/// What ended a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoppedBy {
    /// The triangle target is reached.
    Target,
    /// No legal collapse is left.
    NoLegalCollapse,
    /// The budget of evaluations is spent.
    Evaluations,
    /// The next collapse would have raised the energy too far.
    Energy,
    /// The caller broke off.
    Caller,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Triangles left.
    pub n_faces: usize,
    /// Collapses made in this run.
    pub collapses: u64,
    /// What ended it.
    pub stopped_by: StoppedBy,
}

/// Why simplification cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SimplifyError {
    /// The evaluator failed.
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// Image-driven simplification in progress: run it to one target after another, coarser each time.
pub struct Simplifier<'a> {
    mesh: &'a mut EditMesh,
    objective: &'a mut Objective,
    params: Params,
    edges: EdgeTable,
    queue: Queue,
    /// The best place of each queued edge.
    places: Vec<DVec3>,
    scratch: memoryless::Scratch,
    is_primed: bool,
    collapses_since_sample: u64,
}

/// Samples of the energy curve are this far apart, as a share of the triangles.
const SAMPLES_PER_HALVING: usize = 40;
/// The most edges judged in one call of the evaluator.
const CHUNK: usize = 1024;

/// The key of an edge: the change of energy, more where that matters more.
fn weighed(delta: i64, weight: f64) -> i64 {
    if weight == 1.0 { delta } else { (delta as f64 * weight) as i64 }
}

impl<'a> Simplifier<'a> {
    /// Gets ready to simplify `mesh`, which `objective` shows as it is now.
    pub fn new(mesh: &'a mut EditMesh, objective: &'a mut Objective, params: Params) -> Self {
        let edges = EdgeTable::new(mesh);
        let n = edges.n_slots();
        Self {
            mesh,
            objective,
            params,
            edges,
            queue: Queue::new(n),
            places: vec![DVec3::ZERO; n],
            scratch: memoryless::Scratch::default(),
            is_primed: false,
            collapses_since_sample: 0,
        }
    }

    /// The mesh as it is now.
    pub fn mesh(&self) -> &EditMesh {
        self.mesh
    }

    /// From now on, stop before a collapse that would raise the energy to more than this.
    pub fn set_max_energy(&mut self, most: Option<u64>) {
        self.params.max_energy = most;
    }

    /// The objective as it is now.
    pub fn objective(&mut self) -> &mut Objective {
        self.objective
    }

    /// Collapses edges until at most `target` triangles are left.
    pub fn run_to(
        &mut self,
        target: usize,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<Outcome, SimplifyError> {
        let start = self.mesh.n_faces();
        let mut collapses = 0;
        let mut stopped_by = StoppedBy::Target;
        if start > target && self.prime(on)?.is_break() {
            return Ok(Outcome { n_faces: start, collapses, stopped_by: StoppedBy::Caller });
        }
        while self.mesh.n_faces() > target {
            let edge = match self.show_next()? {
                Ok(edge) => edge,
                Err(reason) => {
                    stopped_by = reason;
                    break;
                }
            };
            let flow = self.collapse(edge, on)?;
            collapses += 1;
            if flow.is_break() || self.tell_progress(start, target, on).is_break() {
                stopped_by = StoppedBy::Caller;
                break;
            }
        }
        let _ = on(Step::Sample(self.sample()));
        Ok(Outcome { n_faces: self.mesh.n_faces(), collapses, stopped_by })
    }

    /// Judges every edge once.
    fn prime(
        &mut self,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, SimplifyError> {
        if self.is_primed {
            return Ok(ControlFlow::Continue(()));
        }
        if on(Step::Sample(self.sample())).is_break() {
            return Ok(ControlFlow::Break(()));
        }
        let all: Vec<EdgeId> = self.edges.edges().collect();
        for chunk in all.chunks(CHUNK) {
            self.judge(chunk)?;
            if on(Step::Progress { done: 0, total: 1 }).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        self.is_primed = true;
        Ok(ControlFlow::Continue(()))
    }

    /// The edge to collapse next: the first, once it and those that follow are up to date.
    fn next_edge(&mut self) -> Result<Option<EdgeId>, SimplifyError> {
        let Params { batch, ahead, .. } = self.params;
        while let Some((edge, standing)) = self.queue.first() {
            if standing == Standing::Stale {
                let stale = self.queue.first_of(Standing::Stale, batch, batch * 4);
                self.judge(&stale)?;
                continue;
            }
            let unsearched = self.queue.first_of(Standing::Judged, ahead, ahead);
            if !unsearched.is_empty() {
                self.search(&unsearched)?;
                continue;
            }
            let [a, b] = self.edges.ends(edge);
            if may_collapse(self.mesh, a, b, self.params.rules.topology) {
                return Ok(Some(edge));
            }
            self.queue.remove(edge);
        }
        Ok(None)
    }

    /// Judges edges at their memoryless optimum.
    fn judge(&mut self, edges: &[EdgeId]) -> Result<(), SimplifyError> {
        let found = self.judge_of_edges().optima(edges)?;
        self.enter(edges, &found, Standing::Judged);
        Ok(())
    }

    /// Searches for better places.
    fn search(&mut self, edges: &[EdgeId]) -> Result<(), SimplifyError> {
        let starts: Vec<_> = edges.iter().map(|e| (*e, self.places[e.index()])).collect();
        let rounds = self.params.search_rounds;
        let found = self.judge_of_edges().search(&starts, rounds)?;
        self.enter(edges, &found, Standing::Searched);
        Ok(())
    }

    fn judge_of_edges(&mut self) -> Judge<'_> {
        Judge {
            mesh: self.mesh,
            edges: &self.edges,
            objective: self.objective,
            rules: &self.params.rules,
            scratch: &mut self.scratch,
        }
    }

    /// Enters edges in the queue with the place found for each; those without one, which may not
    /// collapse, leave it.
    fn enter(&mut self, edges: &[EdgeId], found: &[Candidate], standing: Standing) {
        for edge in edges {
            self.queue.remove(*edge);
        }
        for candidate in found {
            let weight = self.mesh.weight_around(self.edges.ends(candidate.edge));
            let weight = weight * self.per_triangle(candidate);
            self.queue.set(candidate.edge, weighed(candidate.delta, weight), standing);
            self.places[candidate.edge.index()] = candidate.to;
        }
    }

    /// By how much more a rise counts that takes fewer triangles away than two, or less for more of
    /// them. Where topology is free; else nearly all collapses take two.
    pub(super) fn per_triangle(&self, candidate: &Candidate) -> f64 {
        if candidate.delta <= 0 || self.params.rules.topology != Topology::Free {
            return 1.0;
        }
        let [a, b] = self.edges.ends(candidate.edge);
        2.0 / self.mesh.edge_faces(a, b).len().max(1) as f64
    }

    /// Makes the next collapse in the pictures, which are ahead of the mesh then; or says why there
    /// is none.
    fn show_next(&mut self) -> Result<Result<EdgeId, StoppedBy>, SimplifyError> {
        loop {
            if self.is_budget_spent() {
                return Ok(Err(StoppedBy::Evaluations));
            }
            let Some(edge) = self.next_edge()? else {
                return Ok(Err(StoppedBy::NoLegalCollapse));
            };
            let [keep, drop] = self.mesh.survivor_first(self.edges.ends(edge));
            let plan = self.mesh.plan_collapse(keep, drop, self.places[edge.index()]);
            let Some(mv) = self.objective.collapse_move(self.mesh, &plan) else {
                self.queue.remove(edge);
                continue;
            };
            let is_within = self.commit_within(&mv)?;
            return Ok(if is_within { Ok(edge) } else { Err(StoppedBy::Energy) });
        }
    }

    /// Makes a move, unless it raises the energy to more than is allowed: then nothing has changed.
    /// Keys of the queue would not do, which do not know what happened to a pixel elsewhere.
    fn commit_within(&mut self, mv: &Move) -> Result<bool, SimplifyError> {
        let Some(most) = self.params.max_energy else {
            self.objective.commit(mv)?;
            return Ok(true);
        };
        let back = self.objective.inverse(self.mesh, mv);
        let delta = self.objective.commit(mv)?;
        if delta <= 0 || self.objective.energy() <= most {
            return Ok(true);
        }
        self.objective.commit(&back)?;
        Ok(false)
    }

    /// Follows a collapse that the pictures show already, everywhere, and tells the caller.
    fn collapse(
        &mut self,
        edge: EdgeId,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, SimplifyError> {
        let [keep, drop] = self.mesh.survivor_first(self.edges.ends(edge));
        let to = self.places[edge.index()];
        let record = self.mesh.collapse(keep, drop, to);
        self.objective.follow(self.mesh);
        let change = self.edges.apply(self.mesh, &record);
        for dead in change.died {
            self.queue.remove(dead);
        }
        self.refresh_around(keep)?;
        Ok(on(Step::Edit((&record).into())))
    }

    /// Marks the edges round a new vertex as stale, or judges them again, as the policy says.
    fn refresh_around(&mut self, v: VertexId) -> Result<(), SimplifyError> {
        let at_vertex = self.edges.edges_around(v).to_vec();
        let update_set = self.update_set(v);
        for edge in &update_set {
            self.queue.mark_stale(*edge);
        }
        match self.params.policy {
            Policy::Lazy => Ok(()),
            Policy::Mixed => self.judge(&at_vertex),
            Policy::Eager => self.judge(&update_set),
        }
    }

    /// U(v): the edges that touch `v` or a neighbour of it, by id.
    fn update_set(&self, v: VertexId) -> Vec<EdgeId> {
        let mut neighbours = Vec::new();
        self.mesh.neighbours(v, &mut neighbours);
        neighbours.push(v);
        let mut set: Vec<EdgeId> =
            neighbours.iter().flat_map(|n| self.edges.edges_around(*n)).copied().collect();
        set.sort_unstable();
        set.dedup();
        set
    }

    fn is_budget_spent(&self) -> bool {
        let most = self.params.max_evaluations;
        most > 0 && self.objective.evaluations() >= most
    }

    /// Progress now and then, and samples at a steady cadence.
    fn tell_progress(
        &mut self,
        start: usize,
        target: usize,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        self.collapses_since_sample += 1;
        let n_faces = self.mesh.n_faces();
        if self.collapses_since_sample as usize * SAMPLES_PER_HALVING < n_faces / 2 {
            return ControlFlow::Continue(());
        }
        self.collapses_since_sample = 0;
        on(Step::Sample(self.sample()))?;
        let (done, total) = (start.saturating_sub(n_faces), start.saturating_sub(target));
        on(Step::Progress { done: done as u64, total: total as u64 })
    }

    fn sample(&self) -> Sample {
        Sample {
            stage: Stage::Image,
            evaluations: self.objective.evaluations(),
            triangles: self.mesh.n_faces() as u32,
            energy: Some(self.objective.energy()),
            d2: Some(self.objective.d2_percent()),
            turn: 0,
        }
    }
}
