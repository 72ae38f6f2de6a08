//! Passes over the whole mesh that need no choosing: every unsettled vertex alone, every edge that
//! would rather lie the other way. Beyond the paper: they bring most of the energy down in the
//! first seconds, several times faster than edges one by one.

use crate::{
    mesh::{EdgeTable, VertexId},
    render::RenderError,
};

use super::{
    operations::{Kind, Operation, Proposal},
    run::{Run, SETTLED, Transaction},
    trial,
};

const VERTEX: Operation = Operation { kind: Kind::NoOp, level: 0 };
const SWAP: Operation = Operation { kind: Kind::Swap, level: 0 };

const SEARCHED_SWAP: Operation = Operation { kind: Kind::Swap, level: 2 };
/// Swaps of a sweep that are tried again with free vertices.
const N_SEARCHED_SWAPS: usize = 32;

/// Growth of a vertex's step when it moved, and its shrinkage when it did not.
const GROW: f64 = 1.1;
const SHRINK: f64 = 0.5;

/// Searches a better place for every unsettled vertex, in waves of vertices without a common
/// triangle. Returns the energy taken off.
pub fn vertices(run: &mut Run<'_>) -> Result<i64, RenderError> {
    let mut todo: Vec<VertexId> = (0..run.mesh.n_vertex_slots() as u32)
        .map(VertexId)
        .filter(|v| run.mesh.is_used(*v) && run.memory.steps[v.index()] > SETTLED)
        .collect();
    for i in (1..todo.len()).rev() {
        todo.swap(i, run.memory.rng.below(i + 1));
    }
    let mut reduction = 0;
    while !todo.is_empty() && !run.is_over() {
        let (wave, later) = vertex_wave(run, &todo);
        reduction += finish_wave(run, wave)?;
        todo = later;
    }
    Ok(reduction)
}

/// Searches better places for a few vertices, one after the other where they touch, in so many
/// rounds, as steps of a transaction.
pub fn relax(
    run: &mut Run<'_>,
    vertices: &[VertexId],
    n_rounds: u32,
    within: &mut Transaction,
) -> Result<(), RenderError> {
    for _ in 0..n_rounds {
        let mut todo = vertices.to_vec();
        while !todo.is_empty() {
            let (mut wave, later) = vertex_wave(run, &todo);
            trial::run(run.objective, wave.iter_mut().map(|p| &mut p.trial))?;
            for proposal in &wave {
                run.improve(proposal, within)?;
                let spent = u64::from(proposal.trial.evaluations());
                run.memory.statistics.count(VERTEX, 0, spent);
            }
            todo = later;
        }
    }
    Ok(())
}

fn vertex_wave(run: &mut Run<'_>, todo: &[VertexId]) -> (Vec<Proposal>, Vec<VertexId>) {
    run.begin_wave();
    let (mut wave, mut later) = (Vec::new(), Vec::new());
    for &v in todo {
        let Some(proposal) = run.proposer().propose(VERTEX, [v, v], None) else { continue };
        if run.claim(proposal.trial.template.touched()) {
            wave.push(proposal);
        } else {
            later.push(v);
        }
    }
    (wave, later)
}

fn finish_wave(run: &mut Run<'_>, mut wave: Vec<Proposal>) -> Result<i64, RenderError> {
    trial::run(run.objective, wave.iter_mut().map(|p| &mut p.trial))?;
    let mut sum = 0;
    for proposal in &wave {
        let reduction = run.accept(proposal)?;
        let v = proposal.edge[0].index();
        let step = run.memory.steps[v];
        let most = 2.0 * run.params.delta;
        run.memory.steps[v] = if reduction > 0 { (step * GROW).min(most) } else { step * SHRINK };
        let evaluations = u64::from(proposal.trial.evaluations());
        run.memory.statistics.count(VERTEX, reduction, evaluations);
        sum += reduction;
    }
    Ok(sum)
}

/// Judges the swap of every edge without moving a vertex, and makes the best ones that do not
/// touch. Returns the energy taken off.
pub fn swaps(run: &mut Run<'_>) -> Result<i64, RenderError> {
    let edges = EdgeTable::new(run.mesh);
    let proposer = run.proposer();
    let mut all: Vec<Proposal> =
        edges.edges().filter_map(|e| proposer.propose(SWAP, edges.ends(e), None)).collect();
    trial::run(run.objective, all.iter_mut().map(|p| &mut p.trial))?;
    let since = run.memory.now;
    all.sort_by_key(|p| (p.trial.best().1, p.edge));
    let n_better = all.partition_point(|p| p.trial.best().1 < 0);
    let mut sum = 0;
    for proposal in all.drain(..n_better) {
        let is_fresh = run.is_unchanged(proposal.trial.template.touched(), since);
        let [a, b] = proposal.edge;
        // A swap elsewhere may have joined the two vertices that this one would join.
        let is_legal = is_fresh && run.mesh.plan_swap(a, b).is_some();
        let reduction = if is_legal { run.accept(&proposal)? } else { 0 };
        run.memory.statistics.count(SWAP, reduction, 1);
        sum += reduction;
    }
    // What was searched in vain comes up again when its surroundings have changed.
    let is_due = |p: &Proposal| {
        let since = run.memory.searched_swaps.get(&p.edge).copied();
        since.is_none_or(|since| !run.is_unchanged(p.trial.template.touched(), since))
    };
    let edges: Vec<_> =
        all.iter().filter(|p| is_due(p)).map(|p| p.edge).take(N_SEARCHED_SWAPS).collect();
    Ok(sum + searched_swaps(run, &edges)?)
}

/// Swaps that raise the energy least, tried again with their four vertices free.
fn searched_swaps(run: &mut Run<'_>, edges: &[[VertexId; 2]]) -> Result<i64, RenderError> {
    run.begin_wave();
    let mut wave = Vec::new();
    for edge in edges {
        let proposal = run.proposer().propose(SEARCHED_SWAP, *edge, None);
        wave.extend(proposal.filter(|p| run.claim(p.trial.template.touched())));
    }
    trial::run(run.objective, wave.iter_mut().map(|p| &mut p.trial))?;
    let mut sum = 0;
    for proposal in &wave {
        run.memory.searched_swaps.insert(proposal.edge, run.memory.now);
        let [a, b] = proposal.edge;
        let is_legal = run.mesh.plan_swap(a, b).is_some();
        let reduction = if is_legal { run.accept(proposal)? } else { 0 };
        let spent = u64::from(proposal.trial.evaluations());
        run.memory.statistics.count(SEARCHED_SWAP, reduction, spent);
        sum += reduction;
    }
    Ok(sum)
}
