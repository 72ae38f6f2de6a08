//! About how many triangles each level will have, before the chain is begun.
//!
//! Where image-driven simplification should take over depends on the finest level. If that is not given by
//! triangles, memoryless simplification of a copy, halving after halving, says how far it may go about.

use std::{borrow::Cow, ops::ControlFlow};

use crate::{
    memoryless,
    mesh::{EditMesh, Step},
};

use super::{
    gauge::Gauge,
    levels::{Levels, Pending},
    params,
    pipeline::{Job, PipelineError},
    recorder::Recorder,
};

/// No halving goes below so many triangles.
const FEWEST: usize = 8;

/// Triangles of each pending level, about.
pub(super) fn estimates(
    job: &mut Job<'_>,
    mesh: &EditMesh,
    (levels, gauge): (&Levels, &Gauge<'_>),
    recorder: &mut Recorder<'_>,
) -> Result<Vec<usize>, PipelineError> {
    let n_faces = mesh.n_faces();
    let start = |p: &Pending| Guess { n_held: n_faces, is_final: false, pending: p.clone() };
    let mut guesses: Vec<Guess> = levels.pending().iter().map(start).collect();
    for guess in &mut guesses {
        guess.take_triangles();
    }
    if guesses.iter().any(|guess| !guess.is_final) {
        let mut copy = mesh.clone();
        survey(job, &mut copy, (&mut guesses, gauge), recorder)?;
    }
    Ok(guesses.iter().map(|guess| guess.n_held).collect())
}

/// What is known of a level.
struct Guess {
    /// The fewest triangles at which it has not gone too far.
    n_held: usize,
    is_final: bool,
    pending: Pending,
}

impl Guess {
    /// A level that is given by triangles alone has as many.
    fn take_triangles(&mut self) {
        let is_free = !self.pending.is_measured() && self.pending.max_energy.is_none();
        if let Some(n) = self.pending.budget.triangles.filter(|_| is_free) {
            self.n_held = n as usize;
            self.is_final = true;
        }
    }
}

fn survey(
    job: &mut Job<'_>,
    copy: &mut EditMesh,
    (guesses, gauge): (&mut [Guess], &Gauge<'_>),
    recorder: &mut Recorder<'_>,
) -> Result<(), PipelineError> {
    let (params, tape) = (params::memoryless(job.spec), job.studio.tape().clone());
    let looks = guesses.iter().any(|guess| guess.pending.max_energy.is_some());
    let mut simplifier = memoryless::Simplifier::new(copy, &params, &tape);
    while guesses.iter().any(|guess| !guess.is_final) {
        let target = simplifier.mesh().n_faces() / 2;
        let outcome = simplifier.run_to(target as u32, &mut |step| match step {
            Step::Progress { .. } => recorder.step(&step),
            _ => ControlFlow::Continue(()),
        });
        if recorder.is_out_of_time() {
            return Ok(());
        }
        recorder.check()?;
        let mesh = simplifier.mesh();
        let energy = if looks { job.studio.energy(mesh) } else { 0 };
        let now = gauge.measure(Cow::Borrowed(mesh));
        for guess in guesses.iter_mut().filter(|guess| !guess.is_final) {
            let Pending { budget, max_energy, .. } = &guess.pending;
            guess.is_final = now.is_too_far(budget) || max_energy.is_some_and(|most| energy > most);
            if !guess.is_final {
                guess.n_held = mesh.n_faces();
                guess.is_final = now.is_above(budget)?.is_none();
            }
        }
        if !outcome.reached || target <= FEWEST {
            break;
        }
    }
    Ok(())
}
