//! A run in progress: the mesh, the pictures, what is remembered of both, and how edits are made.
//!
//! Invariants:
//! 1. mesh and pictures show the same model between calls: every edit is made in both;
//! 2. every edit that stays is told to the caller, in order, and none that was taken back;
//! 3. after the caller broke off, no edit is made.

use std::{collections::BTreeMap, ops::ControlFlow};

use glam::DVec3;

use crate::{
    mesh::{
        Collapse, EditMesh, EditRecord, FaceId, Sample, Semantic, Split, Stage, Step, VertexId,
    },
    metric::Objective,
    render::{Move, RenderError},
};

use super::{
    operations::{Plan, Proposal, Proposer},
    params::{Params, StoppedBy},
    prices::Prices,
    rng::Rng,
    statistics::Statistics,
};

/// Edits that stay or go together.
#[derive(Debug, Default)]
pub struct Transaction {
    done: Vec<EditRecord>,
    /// What takes each step back in the pictures, in the order of the steps.
    backs: Vec<Move>,
    /// The change of energy so far.
    pub delta: i64,
}

/// What is remembered between the passes of a run.
pub struct Memory {
    /// Random choices.
    pub rng: Rng,
    /// First steps of each vertex, as a share of the mean length of its edges.
    pub steps: Vec<f64>,
    /// What the operations have brought.
    pub statistics: Statistics,
    /// What collapses would cost.
    pub collapses: Prices,
    /// What splits would cost (less than nothing, as a rule).
    pub splits: Prices,
    /// Edges whose swap was searched in vain, and when.
    pub searched_swaps: BTreeMap<[VertexId; 2], u64>,
    /// Edits so far: the age of everything that was found out.
    pub now: u64,
    /// When each triangle last changed.
    pub changed_at: Vec<u64>,
    /// Triangles of the present wave (see [`Run::claim`]).
    claims: Vec<u64>,
    n_waves: u64,
    /// Teleports that raised the energy.
    pub n_uphill: u64,
    /// Evaluations spent on the prices of collapses.
    pub n_pricing: u64,
    /// Triangles at first.
    pub n_faces: usize,
    next_sample: u64,
}

impl Memory {
    /// Of a mesh that nothing is known of.
    pub fn new(mesh: &EditMesh, params: &Params) -> Self {
        Self {
            rng: Rng::new(params.seed),
            steps: vec![params.delta; mesh.n_vertex_slots()],
            statistics: Statistics::default(),
            collapses: Prices::new(mesh, 0),
            splits: Prices::new(mesh, i64::MIN / 4),
            searched_swaps: BTreeMap::new(),
            now: 1,
            changed_at: vec![0; mesh.n_face_slots()],
            claims: vec![0; mesh.n_face_slots()],
            n_waves: 0,
            n_uphill: 0,
            n_pricing: 0,
            n_faces: mesh.n_faces(),
            next_sample: 0,
        }
    }
}

impl Memory {
    /// The same for a mesh that has nothing to do with the one it was of: what remains are the random
    /// numbers and what the operations have brought. It may have up to `n_faces` triangles.
    #[must_use]
    pub fn elsewhere(self, mesh: &EditMesh, n_faces: usize, params: &Params) -> Self {
        let Self { rng, statistics, n_uphill, .. } = self;
        Self { rng, statistics, n_uphill, n_faces, ..Self::new(mesh, params) }
    }

    /// Other pictures are looked at, or vertices were moved: what was found out is doubtful.
    #[must_use]
    pub fn seen_anew(mut self) -> Self {
        self.collapses.doubt();
        self.splits.doubt();
        self.steps.iter_mut().for_each(|step| *step = step.max(STIRRED));
        self
    }
}

/// See the module.
pub struct Run<'r> {
    /// The mesh being optimized.
    pub mesh: &'r mut EditMesh,
    /// Its pictures.
    pub objective: &'r mut Objective,
    /// What was asked for.
    pub params: &'r Params,
    /// What is remembered.
    pub memory: &'r mut Memory,
    /// Whom to tell.
    pub on: &'r mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    /// Evaluations when the run began.
    pub first_evaluation: u64,
    /// Energy when the run began.
    pub first_energy: u64,
    /// What ended the run, once something has.
    pub stopped_by: Option<StoppedBy>,
}

/// Smallest step, as a share of the mean edge length, at which a vertex counts as settled.
pub const SETTLED: f64 = 0.01;
/// A vertex with a neighbour that moved is worth another look at this step.
const STIRRED: f64 = 0.02;

impl Run<'_> {
    /// Makes proposals for the mesh as it is now.
    pub fn proposer(&self) -> Proposer<'_> {
        Proposer {
            mesh: self.mesh,
            objective: self.objective,
            params: self.params,
            steps: &self.memory.steps,
        }
    }

    /// Evaluations of this run so far.
    pub fn evaluations(&self) -> u64 {
        self.objective.evaluations() - self.first_evaluation
    }

    /// Whether the run should end.
    pub fn is_over(&mut self) -> bool {
        let most = self.params.max_evaluations;
        if self.stopped_by.is_none() {
            if most > 0 && self.evaluations() >= most {
                self.stopped_by = Some(StoppedBy::Evaluations);
            } else if (self.objective.energy() as f64)
                <= self.params.until * self.first_energy as f64
            {
                self.stopped_by = Some(StoppedBy::Energy);
            }
        }
        self.stopped_by.is_some()
    }

    /// Begins a wave: a set of proposals that share no triangle.
    pub fn begin_wave(&mut self) {
        self.memory.n_waves += 1;
    }

    /// Adds a proposal to the wave unless it shares a triangle with one that is in it.
    pub fn claim(&mut self, touched: &[u32]) -> bool {
        let memory = &mut *self.memory;
        memory.claims.resize(self.mesh.n_face_slots(), 0);
        if touched.iter().any(|f| memory.claims[*f as usize] == memory.n_waves) {
            return false;
        }
        for f in touched {
            memory.claims[*f as usize] = memory.n_waves;
        }
        true
    }

    /// Whether no triangle has changed since the given age.
    pub fn is_unchanged(&self, touched: &[u32], since: u64) -> bool {
        let changed = |f: &u32| self.memory.changed_at[*f as usize] > since;
        touched.iter().all(|f| self.mesh.is_alive(FaceId(*f))) && !touched.iter().any(changed)
    }

    /// Makes the best edit that a proposal's search has found, if it lowers the energy. Returns
    /// the energy taken off, 0 if it was rejected.
    pub fn accept(&mut self, proposal: &Proposal) -> Result<i64, RenderError> {
        let mut step = Transaction::default();
        self.improve(proposal, &mut step)?;
        let reduction = -step.delta;
        self.keep(step);
        Ok(reduction)
    }

    /// The same as a step of a transaction.
    pub fn improve(
        &mut self,
        proposal: &Proposal,
        within: &mut Transaction,
    ) -> Result<(), RenderError> {
        let (point, value) = proposal.trial.best();
        if value >= 0 || self.is_over() {
            return Ok(());
        }
        let (places, normals) = proposal.trial.unpack(&point);
        let mv = proposal.trial.template.at(&places, &normals);
        let back = self.objective.inverse(self.mesh, &mv);
        let delta = self.objective.commit(&mv)?;
        if delta < 0 {
            self.enter(proposal, (&places, &normals), (delta, back), within);
        } else {
            self.objective.commit(&back)?;
        }
        Ok(())
    }

    /// Makes the edit of a proposal with its vertices at the given places, whatever it does to
    /// the energy, as a step of a transaction.
    pub fn make(
        &mut self,
        proposal: &Proposal,
        (places, normals): (&[DVec3], &[DVec3]),
        within: &mut Transaction,
    ) -> Result<(), RenderError> {
        let mv = proposal.trial.template.at(places, normals);
        let back = self.objective.inverse(self.mesh, &mv);
        let delta = self.objective.commit(&mv)?;
        self.enter(proposal, (places, normals), (delta, back), within);
        Ok(())
    }

    /// Follows in the mesh what the pictures show already.
    fn enter(
        &mut self,
        proposal: &Proposal,
        (places, normals): (&[DVec3], &[DVec3]),
        (delta, back): (i64, Move),
        within: &mut Transaction,
    ) {
        within.done.extend(self.perform(proposal, places, normals));
        within.backs.push(back);
        within.delta += delta;
    }

    /// Ends a transaction: its edits stay, and the caller is told.
    pub fn keep(&mut self, ended: Transaction) {
        if !ended.done.is_empty() {
            self.tell(&ended.done);
        }
    }

    /// Ends a transaction: mesh and pictures are as they were before it.
    pub fn roll_back(&mut self, mut ended: Transaction) -> Result<(), RenderError> {
        for back in ended.backs.iter().rev() {
            self.objective.commit(back)?;
        }
        while let Some(one) = ended.done.pop() {
            self.mesh.undo(one.edit());
        }
        self.objective.follow(self.mesh);
        // What was found out about slots that are gone would be taken for their successors'.
        self.memory.changed_at.truncate(self.mesh.n_face_slots());
        self.memory.steps.truncate(self.mesh.n_vertex_slots());
        Ok(())
    }

    /// Makes the edits of a proposal in the mesh; the pictures show them already.
    fn perform(
        &mut self,
        proposal: &Proposal,
        places: &[DVec3],
        normals: &[DVec3],
    ) -> Vec<EditRecord> {
        let mut done = Vec::new();
        let mut placed = 0;
        match (&proposal.plan, places.first()) {
            (Plan::Swap(plan), _) => done.push(EditRecord::Swap(*plan)),
            (Plan::Split(plan), Some(&at)) => {
                done.push(EditRecord::Split(Split { at, ..plan.clone() }));
                placed = 1;
            }
            (Plan::Collapse(plan), Some(&to)) => {
                done.push(EditRecord::Collapse(Collapse { to, ..plan.clone() }));
                placed = 1;
            }
            _ => {}
        }
        for one in &done {
            self.mesh.redo(one.edit());
        }
        let free = &proposal.trial.free;
        for (f, to) in free.iter().zip(places).skip(placed).filter(|(f, to)| f.at != **to) {
            done.push(EditRecord::Displacement(self.mesh.displace(f.vertex, *to)));
        }
        if self.objective.has_own_normals() {
            let value = |(f, n): (&_, &DVec3)| {
                let f: &crate::metric::Free = f;
                (f.vertex, n.as_vec3().to_array())
            };
            let values: Vec<_> = free.iter().zip(normals).map(value).collect();
            done.extend(self.mesh.revalue(Semantic::Normal, &values).map(EditRecord::Revalue));
        }
        self.objective.follow(self.mesh);
        self.remember(proposal);
        done
    }

    /// Notes what an edit makes out of date.
    fn remember(&mut self, proposal: &Proposal) {
        let memory = &mut *self.memory;
        memory.now += 1;
        memory.changed_at.resize(self.mesh.n_face_slots(), memory.now);
        for f in proposal.trial.template.touched() {
            memory.changed_at[*f as usize] = memory.now;
        }
        let delta = self.params.delta;
        memory.steps.resize(self.mesh.n_vertex_slots(), delta);
        let is_new = proposal.operation.kind != super::operations::Kind::NoOp;
        let centers = proposal.trial.free.iter().map(|f| f.vertex);
        let mut ring = Vec::new();
        for v in centers.chain(proposal.edge) {
            memory.collapses.disturb(self.mesh, v);
            memory.splits.disturb(self.mesh, v);
            self.mesh.neighbours(v, &mut ring);
            for w in ring.iter().chain([&v]) {
                let step = &mut memory.steps[w.index()];
                *step = step.max(if is_new { 0.5 * delta } else { STIRRED });
            }
        }
    }

    /// Tells the caller of edits that stay, and how things are now and then.
    pub fn tell(&mut self, done: &[EditRecord]) {
        for one in done {
            if (self.on)(Step::Edit(one.edit())).is_break() {
                self.stopped_by = Some(StoppedBy::Caller);
            }
        }
        self.sample_if_due();
    }

    /// A point of the energy curve, if one is due. Not within a transaction.
    pub fn sample_if_due(&mut self) {
        if self.evaluations() >= self.memory.next_sample {
            self.sample();
        }
    }

    /// A point of the energy curve.
    pub fn sample(&mut self) {
        let every = self.params.sample_every.max(1);
        self.memory.next_sample = (self.evaluations() / every + 1) * every;
        let sample = Sample {
            stage: Stage::Optimize,
            evaluations: self.evaluations(),
            triangles: self.mesh.n_faces() as u32,
            energy: Some(self.objective.energy()),
            d2: Some(self.objective.d2_percent()),
            turn: 0,
        };
        let counts = self.memory.statistics.counts(self.memory.n_uphill);
        let is_broken = (self.on)(Step::Sample(sample)).is_break()
            || (self.on)(Step::Moves(&counts)).is_break();
        if is_broken {
            self.stopped_by = Some(StoppedBy::Caller);
        }
    }
}
