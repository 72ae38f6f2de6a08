//! Image-driven optimization of the levels, one after the other, finest first.

use std::ops::ControlFlow;

use crate::{
    memoryless,
    mesh::{EditMesh, Marks, Mesh, Stage, Step},
    metric::d2_percent,
    optimize::{Outcome, alternate},
};

use super::{
    branch::Branch,
    budget::{Budget, budgets},
    critic::Critic,
    levels::{Level, Levels, Optimized},
    params,
    pipeline::{Job, PipelineError, editable},
    recorder::{Recorder, counts},
    results::StageFigures,
    stopped::StoppedBy,
};

/// Optimizes every level that is not the original; `None` where there is nothing to do.
pub(super) fn run<'j>(
    job: &mut Job<'j>,
    levels: &mut Levels,
    recorder: &mut Recorder<'j>,
    before: &[StageFigures],
) -> Result<Option<StageFigures>, PipelineError> {
    let triangles: Vec<usize> = levels.simplified().map(|l| l.mesh.faces.len()).collect();
    let n_spent = before.iter().filter(|f| f.stage == Stage::Image.name()).map(|f| f.evaluations);
    let budgets = budgets(job.spec, &triangles, n_spent.sum());
    if triangles.iter().all(|n| *n == 0) || recorder.is_out_of_time() {
        return Ok(None);
    }
    let mut figures = StageFigures::prepare(Stage::Optimize, recorder.clock().read());
    recorder.enter(Stage::Optimize, 0, 0);
    if job.spec.optimize.normals {
        job.studio.use_own_normals();
    }
    let total = triangles.iter().sum::<usize>() as f64;
    let mut done = 0.0;
    for (level, budget) in levels.simplified().zip(budgets) {
        let share = level.mesh.faces.len() as f64 / total;
        if !budget.is_nothing() && !level.mesh.faces.is_empty() && !recorder.is_out_of_time() {
            optimize(job, level, (budget, (done, done + share)), recorder, &mut figures)?;
        }
        done += share;
    }
    Ok(Some(figures.end(recorder.clock().read())))
}

/// Optimizes one level.
fn optimize<'j>(
    job: &mut Job<'j>,
    level: &mut Level,
    (budget, span): (Budget, (f64, f64)),
    recorder: &mut Recorder<'j>,
    figures: &mut StageFigures,
) -> Result<(), PipelineError> {
    let start_secs = recorder.clock().read();
    let mut mesh = editable(&level.mesh, &level.marks)?;
    let critic = job.critic.get_or_init(|| Critic::new(job.spec, job.original));
    let begun = (level.mesh.clone(), editable(&level.mesh, &Marks::default())?);
    let branch = Branch::new(
        level.index as u32,
        begun,
        critic,
        budget,
        (figures.evaluations, span),
        start_secs,
    );
    let evaluator = job.studio.evaluator(&mesh, recorder)?;
    figures.start(&evaluator, recorder.clock().read());
    recorder.begin_branch(&level.name(), branch)?;
    let mut outcome = optimize_mesh(job, &mut mesh, &budget, recorder)?;
    if !recorder.is_out_of_time() {
        recorder.check()?;
    }
    if trim(job, &mut mesh, level, recorder)? {
        outcome.energy_after = job.studio.energy(&mesh);
    }
    let energy = outcome.energy_after;
    let d2 = d2_percent(energy, params::n_counted_pixels(job.spec));
    let (branch, edits) = recorder.end_branch(energy, d2)?;
    figures.evaluations += outcome.evaluations;
    figures.edits += u64::from(edits);
    level.mesh = mesh.snapshot();
    level.energy = Some(energy);
    level.d2 = Some(d2);
    level.optimized = Some(Optimized {
        seconds: recorder.clock().read() - start_secs,
        edits,
        d2_unseen_percent: branch.and_then(|b| b.d2_unseen),
        ..optimized(&outcome)
    });
    Ok(())
}

/// Optimization may have moved a few vertices to where a file needs more bytes for them. Collapses edges as long
/// as the file is too large, by geometry; whether any had to go.
fn trim(
    job: &Job<'_>,
    mesh: &mut EditMesh,
    level: &Level,
    recorder: &mut Recorder<'_>,
) -> Result<bool, PipelineError> {
    let Some((most, _)) = job.gauge.max_bytes(&level.budget)? else { return Ok(false) };
    let n_bytes = |mesh: &Mesh| job.gauge.glb(mesh).map(|glb| glb.len() as u64);
    // One that could not be made small enough is not made smaller here.
    let is_held = n_bytes(&level.mesh)? <= most;
    let params = params::memoryless(job.spec);
    let mut is_trimmed = false;
    while is_held && n_bytes(&mesh.snapshot())? > most {
        let target = mesh.n_faces().saturating_sub(1) as u32;
        let mut on = |step: Step<'_>| match step {
            Step::Edit(_) => recorder.step(&step),
            _ => ControlFlow::Continue(()),
        };
        let outcome = memoryless::simplify(mesh, target, &params, &mut on);
        if outcome.collapses == 0 {
            break;
        }
        is_trimmed = true;
    }
    Ok(is_trimmed)
}

/// Against many view sets where that pays, so that the mesh fits the model and not twenty pictures of
/// it; else against the run-time views alone.
fn optimize_mesh(
    job: &mut Job<'_>,
    mesh: &mut EditMesh,
    budget: &Budget,
    recorder: &mut Recorder<'_>,
) -> Result<Outcome, PipelineError> {
    let params = params::optimization(job.spec, budget, mesh.n_faces());
    let turns = params::turns(job.spec, budget, mesh.n_faces());
    let n_sets = params::n_view_sets(job.spec, budget, mesh.n_faces());
    let studio = &mut job.studio;
    while studio.sets().len() < n_sets {
        recorder.check()?;
        studio.add_set();
    }
    let studio = &*studio;
    let mut show = |set: usize, mesh: &EditMesh| Ok(studio.show(set, mesh)?);
    let mut on = |step: Step<'_>| recorder.step(&step);
    let known = (&studio.sets()[..n_sets], studio.tape());
    alternate(mesh, &params, turns, known, &mut show, &mut on)
}

fn optimized(outcome: &Outcome) -> Optimized {
    let (before, after) = (outcome.energy_before, outcome.energy_after);
    Optimized {
        evaluations: outcome.evaluations,
        seconds: 0.0,
        energy_before: before,
        energy_after: after,
        energy_ratio: if before == 0 { 1.0 } else { after as f64 / before as f64 },
        d2_unseen_percent: None,
        edits: 0,
        moves: counts(&outcome.moves),
        stopped_by: StoppedBy::of_optimization(outcome.stopped_by),
    }
}
