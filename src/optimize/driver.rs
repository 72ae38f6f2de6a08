//! The optimizer: passes over the mesh, the one that has lately paid best first.

use std::ops::ControlFlow;

use crate::{
    mesh::{EditMesh, Step},
    metric::Objective,
    render::RenderError,
    simplify::SimplifyError,
};

use super::{
    edges::{self, Sources},
    params::{Params, StoppedBy},
    run::{Memory, Run},
    sweeps, teleport,
};

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Evaluations of this run.
    pub evaluations: u64,
    /// Energy when it began.
    pub energy_before: u64,
    /// Energy when it ended.
    pub energy_after: u64,
    /// What each kind of move has done.
    pub moves: Vec<crate::mesh::MoveCount>,
    /// What ended it.
    pub stopped_by: StoppedBy,
}

/// Why optimization cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum OptimizeError {
    /// The evaluator failed.
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl From<SimplifyError> for OptimizeError {
    fn from(error: SimplifyError) -> Self {
        match error {
            SimplifyError::Render(error) => Self::Render(error),
        }
    }
}

/// Image-driven optimization of a mesh at a fixed number of vertices. May be run again and again.
pub struct Optimizer<'a> {
    mesh: &'a mut EditMesh,
    objective: &'a mut Objective,
    params: Params,
    memory: Memory,
    sources: Sources,
}

/// The passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pass {
    Vertices,
    Swaps,
    Teleports,
    Edges,
}

const PASSES: [Pass; 4] = [Pass::Vertices, Pass::Swaps, Pass::Teleports, Pass::Edges];

/// A pass that was not chosen seems better by this factor each time, so that none is forgotten.
const LONGING: f64 = 1.3;
/// No pass counts for less than this share of the best one.
const LEAST_RATE: f64 = 0.02;
/// Ends when so many passes in a row have brought nothing.
const MAX_FRUITLESS: u32 = 24;

impl<'a> Optimizer<'a> {
    /// Gets ready to optimize `mesh`, which `objective` shows as it is now.
    pub fn new(mesh: &'a mut EditMesh, objective: &'a mut Objective, params: Params) -> Self {
        let memory = Memory::new(mesh, &params);
        Self { mesh, objective, params, memory, sources: Sources::default() }
    }

    /// Goes on where another optimizer of the same mesh left off.
    pub fn resume(
        mesh: &'a mut EditMesh,
        objective: &'a mut Objective,
        params: Params,
        memory: Memory,
    ) -> Self {
        Self { mesh, objective, params, memory, sources: Sources::default() }
    }

    /// What is remembered of the mesh, for [`Self::resume`].
    pub fn into_memory(self) -> Memory {
        self.memory
    }

    /// The mesh as it is now.
    pub fn mesh(&self) -> &EditMesh {
        self.mesh
    }

    /// The objective as it is now.
    pub fn objective(&self) -> &Objective {
        self.objective
    }

    /// Optimizes until the budget is spent, the energy is low enough, nothing helps any more, or
    /// the caller breaks off.
    pub fn run(
        &mut self,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<Outcome, OptimizeError> {
        let (first_evaluation, first_energy) =
            (self.objective.evaluations(), self.objective.energy());
        let mut run = Run {
            mesh: self.mesh,
            objective: self.objective,
            params: &self.params,
            memory: &mut self.memory,
            on,
            first_evaluation,
            first_energy,
            stopped_by: None,
        };
        run.sample();
        passes(&mut run, &mut self.sources)?;
        run.sample();
        Ok(Outcome {
            evaluations: run.evaluations(),
            energy_before: first_energy,
            energy_after: run.objective.energy(),
            moves: run.memory.statistics.counts(run.memory.n_uphill),
            stopped_by: run.stopped_by.unwrap_or(StoppedBy::Converged),
        })
    }
}

/// Runs passes until the run is over.
fn passes(run: &mut Run<'_>, sources: &mut Sources) -> Result<(), RenderError> {
    let is_allowed = |p: &Pass| match p {
        Pass::Vertices => run.params.has_sweeps && run.params.has_vertex_moves,
        Pass::Swaps => run.params.has_sweeps,
        Pass::Teleports => run.params.has_sweeps && run.params.has_teleports,
        Pass::Edges => run.params.has_vertex_moves,
    };
    let allowed: Vec<Pass> = PASSES.into_iter().filter(is_allowed).collect();
    let mut rates = vec![f64::INFINITY; allowed.len()];
    let mut n_fruitless = 0;
    while !run.is_over() && n_fruitless < MAX_FRUITLESS {
        // The first of equals: passes that were never run come in order.
        let best = (0..rates.len()).fold(0, |a, b| if rates[b] > rates[a] { b } else { a });
        let before = run.evaluations();
        let reduction = match allowed[best] {
            Pass::Vertices => sweeps::vertices(run)?,
            Pass::Swaps => sweeps::swaps(run)?,
            Pass::Teleports => teleport::pair(run)?,
            Pass::Edges => edges::iterate(run, sources)?,
        };
        let spent = (run.evaluations() - before).max(1);
        rates.iter_mut().for_each(|rate| *rate *= LONGING);
        rates[best] = reduction as f64 / spent as f64;
        let most = rates.iter().copied().filter(|r| r.is_finite()).fold(0.0, f64::max);
        rates.iter_mut().for_each(|rate| *rate = rate.max(LEAST_RATE * most));
        n_fruitless = if reduction > 0 { 0 } else { n_fruitless + 1 };
        run.sample_if_due();
        let (done, total) = (run.evaluations(), run.params.max_evaluations);
        if (run.on)(Step::Progress { done, total: total.max(done) }).is_break() {
            run.stopped_by = Some(StoppedBy::Caller);
        }
    }
    Ok(())
}
