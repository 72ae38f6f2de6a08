//! The greedy loop: always the cheapest edge next.
//!
//! Costs are kept lazily. A collapse makes the edges at the new vertex and at its neighbours
//! out of date (the set U(v)), which is recorded as a time stamp on those vertices alone; an
//! edge keeps its old key and is re-evaluated only when it comes up. Edges that may not be
//! collapsed when they come up leave the queue and return when U(v) touches them.

use std::ops::ControlFlow;

use glam::DVec3;

use super::params::Params;
use super::gather::Fan;
use super::placement::{Placement, Scratch, placement_between, turns_too_far};
use super::queue::{Entry, Queue};
use crate::mesh::{Collapse, EdgeId, EdgeTable, EditMesh, Sample, Stage, Step, VertexId};

/// How many samples and progress reports a run gives, about.
const N_REPORTS: usize = 200;

/// In flat regions every collapse costs nothing; this share of L⁶, far below the cost of any
/// visible bend, sends short edges first, so that such regions thin out evenly.
const FLAT_SHARE: f64 = 1e-12;

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoppedBy {
    /// The target was reached.
    Target,
    /// No edge is left that may be collapsed.
    NoLegalCollapse,
    /// The caller said so.
    Caller,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Whether at most the target number of triangles is left.
    pub reached: bool,
    /// Triangles now.
    pub faces: u32,
    /// Collapses made.
    pub collapses: u64,
    /// Placements computed.
    pub evaluations: u64,
    /// Why it ended.
    pub stopped_by: StoppedBy,
}

/// Collapses edges, cheapest first, until at most `target_faces` triangles are left (one less
/// than asked where the last collapse removes two). `on` hears every edit and, at a steady pace,
/// progress and samples; `Break` ends the run.
pub fn simplify(
    mesh: &mut EditMesh,
    target_faces: u32,
    params: &Params,
    on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
) -> Outcome {
    let mut run = Run::new(mesh, params);
    let reporter = Reporter::new(run.mesh.n_faces(), target_faces as usize);
    let stopped_by = run.collapse_until(target_faces as usize, reporter, on);
    Outcome {
        reached: run.mesh.n_faces() <= target_faces as usize,
        faces: run.mesh.n_faces() as u32,
        collapses: u64::from(run.now),
        evaluations: run.evaluations,
        stopped_by,
    }
}

/// The state of a run.
struct Run<'a> {
    mesh: &'a mut EditMesh,
    params: &'a Params,
    min_cos: f64,
    edges: EdgeTable,
    queue: Queue,
    /// Collapses so far: the time.
    now: u32,
    /// When the triangles at a vertex last changed.
    changed_at: Vec<u32>,
    /// When an edge was last evaluated.
    evaluated_at: Vec<u32>,
    /// Edges set aside because they could not be collapsed.
    is_aside: Vec<bool>,
    /// Vertices with an edge that was set aside.
    has_aside: Vec<bool>,
    evaluations: u64,
    /// The sums over the triangles at a vertex, and when they were taken.
    fans: Vec<Fan>,
    summed_at: Vec<u32>,
    scratch: Scratch,
}

/// Of sums that were never taken.
const NEVER: u32 = u32::MAX;

impl<'a> Run<'a> {
    fn new(mesh: &'a mut EditMesh, params: &'a Params) -> Self {
        let edges = EdgeTable::new(mesh);
        let (n_edges, n_vertices) = (edges.n_slots(), mesh.n_vertex_slots());
        let mut run = Self {
            mesh,
            params,
            min_cos: params.max_turn_degrees.to_radians().cos(),
            edges,
            queue: Queue::new(Vec::new()),
            now: 0,
            changed_at: vec![0; n_vertices],
            evaluated_at: vec![0; n_edges],
            is_aside: vec![false; n_edges],
            has_aside: vec![false; n_vertices],
            evaluations: 0,
            fans: vec![Fan::default(); n_vertices],
            summed_at: vec![NEVER; n_vertices],
            scratch: Scratch::default(),
        };
        let entries = (0..n_edges as u32).map(|e| run.evaluate(EdgeId(e)).0);
        run.queue = Queue::new(entries.collect());
        run
    }

    fn collapse_until(
        &mut self,
        target: usize,
        mut reporter: Reporter,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> StoppedBy {
        while self.mesh.n_faces() > target {
            let Some((edge, to)) = self.next_candidate() else { return StoppedBy::NoLegalCollapse };
            if !self.may_collapse(edge, to) {
                self.set_aside(edge);
                continue;
            }
            let collapse = self.collapse(edge, to);
            self.bring_back(collapse.keep);
            if on(Step::Edit(&collapse)).is_break() || reporter.report(self, on).is_break() {
                return StoppedBy::Caller;
            }
        }
        StoppedBy::Target
    }

    /// Takes the cheapest edge whose cost is up to date out of the queue.
    fn next_candidate(&mut self) -> Option<(EdgeId, DVec3)> {
        loop {
            let edge = self.queue.peek()?.edge();
            if !self.edges.is_alive(edge) {
                self.queue.pop();
                continue;
            }
            let was_fresh = self.is_fresh(edge);
            let (entry, found) = self.evaluate(edge);
            if was_fresh {
                self.queue.pop();
                return Some((edge, found.to));
            }
            self.queue.replace_top(entry);
            if self.queue.peek() == Some(entry) {
                self.queue.pop();
                return Some((edge, found.to));
            }
        }
    }

    fn is_fresh(&self, edge: EdgeId) -> bool {
        let since = self.evaluated_at[edge.index()];
        self.edges.ends(edge).iter().all(|v| self.changed_at[v.index()] <= since)
    }

    /// The queue entry and placement of an edge as things are now.
    fn evaluate(&mut self, edge: EdgeId) -> (Entry, Placement) {
        let ends = self.edges.ends(edge);
        self.sum(ends[0]);
        self.sum(ends[1]);
        let fans = ends.map(|v| &self.fans[v.index()]);
        let found = placement_between(self.mesh, ends, fans, self.params, &mut self.scratch);
        self.evaluations += 1;
        self.evaluated_at[edge.index()] = self.now;
        let length2 = self.mesh.position(ends[0]).distance_squared(self.mesh.position(ends[1]));
        let cost = found.cost + FLAT_SHARE * length2 * length2 * length2;
        (Entry::new(cost, edge), found)
    }

    /// Brings the sums at a vertex up to date.
    #[inline]
    fn sum(&mut self, vertex: VertexId) {
        let summed_at = &mut self.summed_at[vertex.index()];
        if *summed_at == NEVER || *summed_at < self.changed_at[vertex.index()] {
            *summed_at = self.now;
            self.fans[vertex.index()] = Fan::new(self.mesh, vertex);
        }
    }

    fn may_collapse(&self, edge: EdgeId, to: DVec3) -> bool {
        let [a, b] = self.edges.ends(edge);
        self.mesh.may_collapse(a, b, self.params.topology)
            && !turns_too_far(self.mesh, [a, b], to, self.min_cos)
    }

    fn set_aside(&mut self, edge: EdgeId) {
        self.is_aside[edge.index()] = true;
        for end in self.edges.ends(edge) {
            self.has_aside[end.index()] = true;
        }
    }

    fn collapse(&mut self, edge: EdgeId, to: DVec3) -> Collapse {
        let [keep, drop] = self.edges.ends(edge);
        let collapse = self.mesh.collapse(keep, drop, to);
        self.edges.apply(self.mesh, &collapse);
        self.has_aside[keep.index()] |= self.has_aside[drop.index()];
        self.now += 1;
        collapse
    }

    /// Marks U(v) as changed and returns its edges that were set aside to the queue.
    fn bring_back(&mut self, v: VertexId) {
        self.touch(v);
        for i in 0..self.mesh.faces_around(v).len() {
            let face = self.mesh.faces_around(v)[i];
            for vertex in self.mesh.vertices_of(face) {
                self.touch(vertex);
            }
        }
    }

    fn touch(&mut self, vertex: VertexId) {
        if std::mem::replace(&mut self.changed_at[vertex.index()], self.now) == self.now {
            return;
        }
        if !std::mem::take(&mut self.has_aside[vertex.index()]) {
            return;
        }
        for i in 0..self.edges.edges_around(vertex).len() {
            let edge = self.edges.edges_around(vertex)[i];
            if std::mem::take(&mut self.is_aside[edge.index()]) {
                // The lowest key there is: evaluated at once, when the next edge is sought.
                self.queue.push(Entry::new(0.0, edge));
            }
        }
    }
}

/// Says how far a run is, every so many triangles.
struct Reporter {
    start: usize,
    target: usize,
    every: usize,
    next: usize,
}

impl Reporter {
    fn new(start: usize, target: usize) -> Self {
        let every = (start.saturating_sub(target) / N_REPORTS).max(1);
        Self { start, target, every, next: start.saturating_sub(every) }
    }

    fn report(
        &mut self,
        run: &Run<'_>,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let faces = run.mesh.n_faces();
        if faces > self.next {
            return ControlFlow::Continue(());
        }
        self.next = faces.saturating_sub(self.every);
        let total = (self.start - self.target.min(self.start)) as u64;
        let done = ((self.start - faces) as u64).min(total);
        on(Step::Progress { done, total })?;
        on(Step::Sample(Sample {
            stage: Stage::Memoryless,
            evaluations: run.evaluations,
            triangles: faces as u32,
            energy: None,
            d2: None,
        }))
    }
}
