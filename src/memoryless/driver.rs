//! The greedy loop: always the cheapest edge next.
//!
//! Costs are kept lazily. A collapse makes the edges at the new vertex and at its neighbours
//! out of date (the set U(v)), which is recorded as a time stamp on those vertices alone; an
//! edge keeps its old key and is re-evaluated only when it comes up. Edges that may not be
//! collapsed when they come up leave the queue and return when U(v) touches them.
//!
//! The keys may be on a tape: then only the edges that are collapsed are judged, which is one of about seven.
//!
//! Time is near-linear in the triangles: what a step costs depends on the triangles at the ends of
//! its edge, and hubs, which have very many, are left for later ([`MAX_VALENCE`]). The rest of its
//! cost is waiting for memory, which [`Ahead`] shortens.

use std::ops::ControlFlow;

use glam::DVec3;

use super::ahead::{Ahead, is_fresh};
use super::gather::Fan;
use super::params::Params;
use super::placement::{Placement, Scratch, placement_between, turns_too_far};
use super::queue::{Entry, Queue};
use crate::mesh::{Collapse, EdgeId, EdgeTable, EditMesh, Sample, Stage, Step, Topology, VertexId};
use crate::tape::{Question, Tape};

/// How many samples and progress reports a run gives, about.
const N_REPORTS: usize = 200;

/// In flat regions every collapse costs nothing; this share of L⁶, far below the cost of any
/// visible bend, sends short edges first, so that such regions thin out evenly.
const FLAT_SHARE: f64 = 1e-12;

/// What the tape is asked: the key of an edge. (0 to 7 and 9: `render`, `optimize`, `worker`.)
const KEY: u8 = 8;

/// A vertex of more triangles is a hub. Every collapse at it costs time in proportion to them, so its
/// edges wait until collapses around it have left it fewer, or nothing else can be collapsed.
const MAX_VALENCE: usize = 512;

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
    Simplifier::new(mesh, params, &Tape::off()).run_to(target_faces, on)
}

/// Memoryless simplification in progress: run it to one target after another, coarser each time.
pub struct Simplifier<'a>(Run<'a>);

impl<'a> Simplifier<'a> {
    /// Gets ready: judges every edge, but for those whose keys are on the tape.
    pub fn new(mesh: &'a mut EditMesh, params: &'a Params, tape: &'a Tape) -> Self {
        Self(Run::new(mesh, params, tape))
    }

    /// The mesh as it is now.
    pub fn mesh(&self) -> &EditMesh {
        self.0.mesh
    }

    /// As [`simplify`], from where the run before ended.
    pub fn run_to(
        &mut self,
        target_faces: u32,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Outcome {
        let run = &mut self.0;
        let before = (run.now, run.n_told);
        let reporter = Reporter::new(run.mesh.n_faces(), target_faces as usize);
        let stopped_by = run.collapse_until(target_faces as usize, reporter, on);
        run.n_told = run.evaluations;
        Outcome {
            reached: run.mesh.n_faces() <= target_faces as usize,
            faces: run.mesh.n_faces() as u32,
            collapses: u64::from(run.now - before.0),
            evaluations: run.evaluations - before.1,
            stopped_by,
        }
    }
}

/// Whether the topology switch lets the edge (a, b) go, and some triangle would be left: a level of
/// detail of nothing helps nobody.
pub fn may_collapse(mesh: &EditMesh, a: VertexId, b: VertexId, topology: Topology) -> bool {
    // A legal collapse always leaves some.
    let leaves_some =
        || topology == Topology::Preserve || mesh.edge_faces(a, b).len() < mesh.n_faces();
    mesh.may_collapse(a, b, topology) && leaves_some()
}

/// The state of a run.
struct Run<'a> {
    mesh: &'a mut EditMesh,
    params: &'a Params,
    tape: &'a Tape,
    min_cos: f64,
    edges: EdgeTable,
    queue: Queue,
    /// Collapses so far: the time.
    now: u32,
    vertices: Vec<VertexState>,
    /// The sums over the triangles at each vertex.
    fans: Vec<Fan>,
    /// When an edge was last evaluated; [`ASIDE`], [`DEAD`].
    evaluated_at: Vec<u32>,
    evaluations: u64,
    /// Evaluations of the runs before.
    n_told: u64,
    /// Edges wait at vertices of more triangles.
    max_valence: usize,
    scratch: Scratch,
}

/// Instead of a time: the edge left the queue because it could not be collapsed.
const ASIDE: u32 = u32::MAX;
/// Instead of a time: the edge exists no longer.
const DEAD: u32 = u32::MAX - 1;

/// What a run remembers of a vertex.
#[derive(Clone, Copy, Default)]
pub(super) struct VertexState {
    /// When one of its triangles last changed.
    pub(super) changed_at: u32,
    /// Whether its sums are as of then.
    pub(super) is_summed: bool,
    /// Whether one of its edges may be set aside.
    has_aside: bool,
}

impl<'a> Run<'a> {
    fn new(mesh: &'a mut EditMesh, params: &'a Params, tape: &'a Tape) -> Self {
        let edges = EdgeTable::new(mesh);
        let (n_edges, n_vertices) = (edges.n_slots(), mesh.n_vertex_slots());
        let mut run = Self {
            mesh,
            params,
            tape,
            min_cos: libm::cos(params.max_turn_degrees.to_radians()),
            edges,
            queue: Queue::new(Vec::new()),
            now: 0,
            vertices: vec![VertexState::default(); n_vertices],
            fans: vec![Fan::default(); n_vertices],
            evaluated_at: vec![0; n_edges],
            evaluations: 0,
            n_told: 0,
            max_valence: MAX_VALENCE,
            scratch: Scratch::default(),
        };
        let entries = (0..n_edges as u32).filter_map(|e| run.first_entry(EdgeId(e)));
        run.queue = Queue::new(entries.collect());
        run
    }

    fn first_entry(&mut self, edge: EdgeId) -> Option<Entry> {
        if self.must_wait(edge) {
            self.set_aside(edge);
            return None;
        }
        Some(self.judge(edge).0)
    }

    fn collapse_until(
        &mut self,
        target: usize,
        mut reporter: Reporter,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> StoppedBy {
        while self.mesh.n_faces() > target {
            let Some((edge, to)) = self.next_candidate() else {
                if self.admit_hubs() {
                    continue;
                }
                return StoppedBy::NoLegalCollapse;
            };
            if !self.may_collapse(edge, to) {
                self.set_aside(edge);
                continue;
            }
            let collapse = self.collapse(edge, to);
            self.bring_back(collapse.keep);
            if on(Step::Edit((&collapse).into())).is_break() || reporter.report(self, on).is_break()
            {
                return StoppedBy::Caller;
            }
        }
        StoppedBy::Target
    }

    /// Takes the cheapest edge whose cost is up to date out of the queue.
    fn next_candidate(&mut self) -> Option<(EdgeId, DVec3)> {
        loop {
            let edge = self.queue.peek()?.edge();
            if self.evaluated_at[edge.index()] == DEAD {
                self.replace_top(None);
                continue;
            }
            if self.must_wait(edge) {
                self.replace_top(None);
                self.set_aside(edge);
                continue;
            }
            let found = if self.is_fresh(edge) {
                self.evaluations += 1;
                None
            } else {
                let (entry, found) = self.judge(edge);
                self.replace_top(Some(entry));
                if self.queue.peek() != Some(entry) {
                    continue;
                }
                found
            };
            let found = found.unwrap_or_else(|| self.place(edge));
            self.replace_top(None);
            return Some((edge, found.to));
        }
    }

    /// Exchanges the cheapest entry for another one, or takes it out.
    fn replace_top(&mut self, entry: Option<Entry>) {
        let Self { mesh, edges, evaluated_at, vertices, fans, queue, .. } = self;
        let ahead = Ahead { mesh, edges, evaluated_at, fans, vertices };
        queue.replace_top(entry, |level, entry| ahead.rises(level, entry));
    }

    fn is_hub(&self, vertex: VertexId) -> bool {
        self.mesh.faces_around(vertex).len() > self.max_valence
    }

    fn must_wait(&self, edge: EdgeId) -> bool {
        self.edges.ends(edge).iter().any(|&end| self.is_hub(end))
    }

    /// Lets edges at hubs into the queue, for good; false if there are none.
    #[cold]
    fn admit_hubs(&mut self) -> bool {
        let is_aside = |&e: &EdgeId| self.evaluated_at[e.index()] == ASIDE && self.must_wait(e);
        let waiting: Vec<EdgeId> = self.edges.edges().filter(is_aside).collect();
        self.max_valence = usize::MAX;
        waiting.iter().for_each(|&edge| self.requeue(edge));
        !waiting.is_empty()
    }

    fn is_fresh(&self, edge: EdgeId) -> bool {
        is_fresh(&self.edges, &self.evaluated_at, &self.vertices, edge)
    }

    /// The queue entry of an edge as things are now, and its placement if that had to be found.
    fn judge(&mut self, edge: EdgeId) -> (Entry, Option<Placement>) {
        self.evaluations += 1;
        self.evaluated_at[edge.index()] = self.now;
        let mut found = None;
        let question = Question { kind: KEY, print: edge.0.into() };
        let key = self.tape.known(question, || {
            let placement = self.place(edge);
            let key = Entry::new(self.cost(edge, &placement), edge).key();
            found = Some(placement);
            key.to_le_bytes()
        });
        (Entry::with_key(u32::from_le_bytes(key), edge), found)
    }

    /// The placement of an edge as things are now.
    fn place(&mut self, edge: EdgeId) -> Placement {
        let ends = self.edges.ends(edge);
        self.sum(ends[0]);
        self.sum(ends[1]);
        let fans = ends.map(|v| &self.fans[v.index()]);
        placement_between(self.mesh, ends, fans, self.params, &mut self.scratch)
    }

    fn cost(&self, edge: EdgeId, found: &Placement) -> f64 {
        let ends = self.edges.ends(edge);
        let length2 = self.mesh.position(ends[0]).distance_squared(self.mesh.position(ends[1]));
        found.cost * self.mesh.weight_around(ends) + FLAT_SHARE * length2 * length2 * length2
    }

    /// Brings the sums at a vertex up to date.
    #[inline]
    fn sum(&mut self, vertex: VertexId) {
        let state = &mut self.vertices[vertex.index()];
        if !state.is_summed {
            state.is_summed = true;
            self.fans[vertex.index()] = Fan::new(self.mesh, vertex);
        }
    }

    fn may_collapse(&self, edge: EdgeId, to: DVec3) -> bool {
        let [a, b] = self.edges.ends(edge);
        may_collapse(self.mesh, a, b, self.params.topology)
            && !turns_too_far(self.mesh, [a, b], to, self.min_cos)
    }

    fn set_aside(&mut self, edge: EdgeId) {
        self.evaluated_at[edge.index()] = ASIDE;
        for end in self.edges.ends(edge) {
            self.vertices[end.index()].has_aside = true;
        }
    }

    fn collapse(&mut self, edge: EdgeId, to: DVec3) -> Collapse {
        let [keep, drop] = self.mesh.survivor_first(self.edges.ends(edge));
        let collapse = self.mesh.collapse(keep, drop, to);
        for dead in self.edges.apply(self.mesh, &collapse).died {
            self.evaluated_at[dead.index()] = DEAD;
        }
        self.vertices[keep.index()].has_aside |= self.vertices[drop.index()].has_aside;
        self.now += 1;
        collapse
    }

    /// Marks U(v) as changed and returns its edges that were set aside to the queue.
    fn bring_back(&mut self, v: VertexId) {
        self.touch(v);
        // Around a closed fan every neighbour follows v in one triangle.
        let is_closed = self.mesh.is_closed_fan(v);
        for i in 0..self.mesh.faces_around(v).len() {
            let [next, last] = self.mesh.turned_to(self.mesh.faces_around(v)[i], v);
            self.touch(next);
            if !is_closed {
                self.touch(last);
            }
        }
    }

    fn touch(&mut self, vertex: VertexId) {
        let state = &mut self.vertices[vertex.index()];
        state.changed_at = self.now;
        state.is_summed = false;
        if state.has_aside && !self.is_hub(vertex) {
            self.queue_again(vertex);
        }
    }

    /// Returns the edges at a vertex that were set aside to the queue, those that must wait apart.
    #[cold]
    fn queue_again(&mut self, vertex: VertexId) {
        self.vertices[vertex.index()].has_aside = false;
        for i in 0..self.edges.edges_around(vertex).len() {
            let edge = self.edges.edges_around(vertex)[i];
            if self.evaluated_at[edge.index()] != ASIDE {
                continue;
            }
            if self.must_wait(edge) {
                self.vertices[vertex.index()].has_aside = true;
            } else {
                self.requeue(edge);
            }
        }
    }

    fn requeue(&mut self, edge: EdgeId) {
        self.evaluated_at[edge.index()] = 0;
        // The lowest key there is: evaluated at once, when the next edge is sought.
        self.queue.push(Entry::new(0.0, edge));
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
            turn: 0,
        }))
    }
}
