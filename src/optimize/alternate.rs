//! Optimization against many view sets, so that the mesh fits the model and not twenty pictures of it.
//! Beyond the paper.
//!
//! A turn is a descent of all vertices by the slopes in view after view, then discrete moves judged by
//! the evaluator in one set of views; the next turn takes another set. What the discrete moves have
//! spoilt for other views, the next descent mends.
//!
//! Invariants:
//! 1. turn 0 and every (n + 1)-th one after it show the views that the run is judged by; the n turns
//!    between show the others, one set after the other; the last word has a descent in all views;
//! 2. samples come from the turns of 1 and from the end, with the evaluations of all turns;
//! 3. a descent counts as the evaluations that draw as many triangles.
//!
//! A sample may lie above one of an earlier turn: what other turns do is judged by other views. Samples
//! name their turn, counted from 1; the first sample of all is of turn 0, the last one of a turn of its own.
//!
//! Measured, unseen d2 as a share of the start, bunny from memoryless simplification to 1,336 triangles:
//! at 200 evaluations a triangle .840 in the run-time views alone, .811 with 2 view sets, .803 with 8,
//! .798 with 16; at 40 .837 with 16. Not kept: several view sets at once in the discrete moves (80 views;
//! no gain at four times the cost), pictures of 512² (.003 better at twice the cost), splitting and
//! collapsing a tenth of the vertices between descents (.005 better after 500 evaluations a triangle),
//! a last turn of vertex moves in the run-time views (their energy falls by a tenth, unseen d2 rises by .015).

use std::ops::ControlFlow;

use crate::{
    mesh::{EditMesh, Sample, Stage, Step},
    metric::{Objective, ViewSet, d2_percent},
};

use super::{
    descent::{self, Unknowns},
    driver::{OptimizeError, Optimizer, Outcome},
    params::{Params, StoppedBy},
    run::Memory,
};

/// Shows the mesh as it is now, in a view set; number 0 is the one that the run is judged by.
pub type Shower<'a, E> = dyn FnMut(usize, &EditMesh) -> Result<Objective, E> + 'a;

/// How view sets take turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turns {
    /// Evaluations of a turn's moves.
    pub evaluations: u64,
    /// Turns with other views between two that count.
    pub n_others: usize,
    /// Steps of descents: the first, those between, the last.
    pub steps: [usize; 3],
}

/// Optimizes in turns, each with the objective that `show` makes for it; descents see all of `sets`.
/// `params.max_evaluations` must not be 0, and is for all turns together; `params.until` does not
/// count.
pub fn alternate<E: From<OptimizeError>>(
    mesh: &mut EditMesh,
    params: &Params,
    turns: Turns,
    sets: &[ViewSet],
    show: &mut Shower<'_, E>,
    on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
) -> Result<Outcome, E> {
    let mut run = Alternation::new(&show(0, mesh)?, params, turns, sets);
    let mut flow = run.sample(mesh, 0, on);
    while flow.is_continue() {
        let Some(turn) = run.next_turn(mesh) else { break };
        flow = run.descend(mesh, turn.n_steps, on);
        if flow.is_continue() {
            flow = run.make_moves(mesh, &turn, &mut show(turn.set, mesh)?, on)?;
        }
    }
    if flow.is_continue() {
        flow = run.descend(mesh, run.affordable(mesh), on);
    }
    run.outcome.energy_after = show(0, mesh)?.energy();
    if flow.is_break() || run.sample(mesh, run.n_turns + 1, on).is_break() {
        run.outcome.stopped_by = StoppedBy::Caller;
    }
    Ok(run.outcome)
}

/// One turn.
struct Turn {
    /// From 1 on: samples of turn 0 come before any.
    number: usize,
    set: usize,
    n_steps: usize,
}

/// See [`alternate`].
struct Alternation<'a> {
    params: &'a Params,
    turns: Turns,
    sets: &'a [ViewSet],
    n_turns: usize,
    /// Descents so far, in steps: where the next one goes on in the view sets.
    n_steps: usize,
    has_own_normals: bool,
    memory: Option<Memory>,
    /// In the views that count.
    n_pixels: u64,
    outcome: Outcome,
}

impl<'a> Alternation<'a> {
    fn new(objective: &Objective, params: &'a Params, turns: Turns, sets: &'a [ViewSet]) -> Self {
        let energy = objective.energy();
        let outcome = Outcome {
            evaluations: 0,
            energy_before: energy,
            energy_after: energy,
            moves: Vec::new(),
            stopped_by: StoppedBy::Evaluations,
        };
        Self {
            params,
            turns,
            sets,
            n_turns: 0,
            n_steps: 0,
            has_own_normals: objective.has_own_normals(),
            memory: None,
            n_pixels: objective.scene().n_pixels(),
            outcome,
        }
    }

    /// A point of the energy curve between turns.
    fn sample(
        &self,
        mesh: &EditMesh,
        turn: usize,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        on(Step::Sample(Sample {
            stage: Stage::Optimize,
            evaluations: self.outcome.evaluations,
            triangles: mesh.n_faces() as u32,
            energy: Some(self.outcome.energy_after),
            d2: Some(d2_percent(self.outcome.energy_after, self.n_pixels)),
            turn: turn as u32,
        }))
    }

    /// What is left of the budget when the last descent is paid for.
    fn left(&self, mesh: &EditMesh) -> u64 {
        let reserved = descent::cost(mesh, self.turns.steps[2]);
        self.params.max_evaluations.saturating_sub(self.outcome.evaluations + reserved)
    }

    /// The next turn; `None` when there is no budget left for one.
    fn next_turn(&mut self, mesh: &EditMesh) -> Option<Turn> {
        let (number, n_others) = (self.n_turns, self.sets.len() - 1);
        let n_steps = self.turns.steps[usize::from(number > 0)];
        if self.left(mesh) <= descent::cost(mesh, n_steps) {
            return None;
        }
        self.n_turns += 1;
        let counts = n_others == 0 || number.is_multiple_of(self.turns.n_others + 1);
        let n_before = number - number.div_ceil(self.turns.n_others + 1);
        Some(Turn {
            number: self.n_turns,
            set: if counts { 0 } else { 1 + n_before % n_others },
            n_steps,
        })
    }

    /// Steps of the last descent that the budget allows.
    fn affordable(&self, mesh: &EditMesh) -> usize {
        let left = self.params.max_evaluations.saturating_sub(self.outcome.evaluations);
        let mut n_steps = self.turns.steps[2];
        while n_steps > 0 && descent::cost(mesh, n_steps) > left {
            n_steps -= 1;
        }
        n_steps
    }

    /// A descent in so many steps.
    fn descend(
        &mut self,
        mesh: &mut EditMesh,
        n_steps: usize,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let unknowns = Unknowns {
            has_own_normals: self.has_own_normals,
            normals: self.has_own_normals && self.params.optimizes_normals,
        };
        let (spent, total) = (self.outcome.evaluations, self.params.max_evaluations);
        if n_steps == 0 {
            return ControlFlow::Continue(());
        }
        let cost = descent::cost(mesh, n_steps);
        let mut on_step = |k: usize| {
            let done = spent + cost * k as u64 / n_steps as u64;
            on(Step::Progress { done: done.min(total), total })
        };
        let steps = (self.n_steps, n_steps);
        self.n_steps += n_steps;
        self.outcome.evaluations += cost;
        match descent::descend(mesh, self.sets, steps, unknowns, &mut on_step) {
            ControlFlow::Continue(edits) => edits.iter().try_for_each(|e| on(Step::Edit(e.edit()))),
            ControlFlow::Break(()) => ControlFlow::Break(()),
        }
    }

    /// The discrete moves of a turn.
    fn make_moves<E: From<OptimizeError>>(
        &mut self,
        mesh: &mut EditMesh,
        turn: &Turn,
        objective: &mut Objective,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, E> {
        let (spent, total) = (self.outcome.evaluations, self.params.max_evaluations);
        let params = Params {
            max_evaluations: self.left(mesh).min(self.turns.evaluations).max(1),
            until: 0.0,
            has_vertex_moves: false,
            ..self.params.clone()
        };
        let mut optimizer = match self.memory.take() {
            Some(known) => Optimizer::resume(mesh, objective, params, known),
            None => Optimizer::new(mesh, objective, params),
        };
        let outcome = optimizer.run(&mut |step| match told(step, turn, (spent, total)) {
            Some(step) => on(step),
            None => ControlFlow::Continue(()),
        })?;
        self.memory = Some(optimizer.into_memory());
        self.outcome.evaluations += outcome.evaluations;
        self.outcome.moves = outcome.moves;
        let is_broken = outcome.stopped_by == StoppedBy::Caller;
        Ok(if is_broken { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

/// What the caller hears of a step in a turn: samples only where they can be compared, with what was
/// spent before.
fn told<'s>(step: Step<'s>, turn: &Turn, (spent, total): (u64, u64)) -> Option<Step<'s>> {
    match step {
        Step::Sample(_) | Step::Moves(_) if turn.set != 0 => None,
        Step::Sample(sample) => Some(Step::Sample(Sample {
            evaluations: spent + sample.evaluations,
            turn: turn.number as u32,
            ..sample
        })),
        Step::Progress { done, .. } => {
            Some(Step::Progress { done: (spent + done).min(total), total })
        }
        edit => Some(edit),
    }
}
