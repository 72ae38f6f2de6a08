//! Optimization against several view sets in turn, so that the mesh fits the model and not twenty
//! pictures of it. Beyond the paper.
//!
//! Invariants:
//! 1. even turns, the first and the last among them, show the views that the run is judged by;
//!    every odd turn shows others;
//! 2. samples come from even turns alone, with the evaluations of all turns.
//!
//! A sample may lie above one of an earlier turn: what an odd turn does is judged by other views.

use std::ops::ControlFlow;

use crate::{
    mesh::{EditMesh, Step},
    metric::Objective,
};

use super::{
    driver::{OptimizeError, Optimizer, Outcome},
    params::{Params, StoppedBy},
};

/// Shows the mesh as it is now, in the views of a turn.
pub type Shower<'a, E> = dyn FnMut(u64, &EditMesh) -> Result<Objective, E> + 'a;

/// Optimizes in turns of so many evaluations, each with the objective that `show` makes for it.
/// `params.max_evaluations` must not be 0, and is for all turns together; `params.until` counts
/// from the energy of the first turn and is looked at in even turns.
pub fn alternate<E: From<OptimizeError>>(
    mesh: &mut EditMesh,
    params: &Params,
    turn_evaluations: u64,
    show: &mut Shower<'_, E>,
    on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
) -> Result<Outcome, E> {
    let turn_evaluations = turn_evaluations.max(1);
    let mut total: Option<Outcome> = None;
    let mut memory = None;
    let mut turn = 0;
    loop {
        let spent = total.as_ref().map_or(0, |t| t.evaluations);
        let left = params.max_evaluations.saturating_sub(spent);
        // The last turn is an even one and at least as long as any.
        let is_last = left < 2 * turn_evaluations;
        let number = if is_last { 0 } else { turn };
        let mut objective = show(if number % 2 == 0 { 0 } else { number }, mesh)?;
        let budget = if is_last { left } else { turn_evaluations };
        let until = match &total {
            Some(t) if number % 2 == 0 => {
                params.until * t.energy_before as f64 / objective.energy().max(1) as f64
            }
            Some(_) => 0.0,
            None => params.until,
        };
        let of_turn = Params { max_evaluations: budget.max(1), until, ..params.clone() };
        let mut optimizer = match memory.take() {
            Some(known) => Optimizer::resume(mesh, &mut objective, of_turn, known),
            None => Optimizer::new(mesh, &mut objective, of_turn),
        };
        let outcome = optimizer.run(&mut |step| tell(step, number, spent, on))?;
        memory = Some(optimizer.into_memory());
        let stopped_by = outcome.stopped_by;
        let all = join(total.take(), outcome, number % 2 == 0);
        let is_over = matches!(stopped_by, StoppedBy::Energy | StoppedBy::Caller);
        if is_last || is_over {
            return Ok(Outcome { stopped_by, ..all });
        }
        total = Some(all);
        turn += 1;
    }
}

/// Passes a step on: edits always, samples of even turns with the evaluations of those before.
fn tell(
    step: Step<'_>,
    turn: u64,
    spent: u64,
    on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
) -> ControlFlow<()> {
    match step {
        Step::Sample(_) | Step::Moves(_) if turn % 2 == 1 => ControlFlow::Continue(()),
        Step::Sample(mut sample) => {
            sample.evaluations += spent;
            on(Step::Sample(sample))
        }
        Step::Progress { done, total } => {
            on(Step::Progress { done: done + spent, total: total + spent })
        }
        other => on(other),
    }
}

/// The outcome of all turns so far.
fn join(before: Option<Outcome>, last: Outcome, is_even: bool) -> Outcome {
    let Some(before) = before else { return last };
    let energy_after = if is_even { last.energy_after } else { before.energy_after };
    Outcome {
        evaluations: before.evaluations + last.evaluations,
        energy_before: before.energy_before,
        energy_after,
        ..last
    }
}
