//! An iteration: 64 edges, half of them recommended by the oracle, on which the operations are
//! tried from the simplest to the most expensive (Lindstrom & Turk 2000, sections 7.1.5, 7.1.6).
//!
//! The paper finishes one edge before it takes the next. Here one operation is tried on all the
//! edges that deserve it, in waves of edges whose neighbourhoods share no triangle, so that their
//! searches run side by side; what is found is made in the order of the edges, each judged again.

use crate::{
    mesh::{EdgeTable, VertexId},
    render::RenderError,
};

use super::{
    operations::{Kind, OPERATIONS, Operation, Proposal},
    oracle,
    run::Run,
    teleport, trial,
};

/// A ranking serves so many iterations.
const RANKING_PERIOD: u64 = 8;
/// Least share of the edges that either source gets.
const LEAST_SHARE: f64 = 0.2;

/// Where edges come from, and what came of it.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// The oracle's edges that were not taken yet, the most promising last.
    ranking: Vec<[VertexId; 2]>,
    n_iterations: u64,
    /// Energy taken off by an edge of the oracle and by a random one, in the last iteration.
    progress: [f64; 2],
}

/// An edge of an iteration.
struct Chosen {
    ends: [VertexId; 2],
    is_from_oracle: bool,
    /// Energy taken off on it so far.
    reduction: i64,
}

/// Runs one iteration; returns the energy taken off.
pub fn iterate(run: &mut Run<'_>, sources: &mut Sources) -> Result<i64, RenderError> {
    let mut chosen = choose(run, sources)?;
    for operation in OPERATIONS.into_iter().filter(|o| o.level > 0 && o.kind != Kind::Collapse) {
        if operation.kind != Kind::Split || run.params.has_teleports {
            try_on_all(run, operation, &mut chosen)?;
        }
    }
    for (is_from_oracle, progress) in [true, false].into_iter().zip(&mut sources.progress) {
        let own = chosen.iter().filter(|c| c.is_from_oracle == is_from_oracle);
        let (n, sum) = own.fold((0, 0), |(n, sum), c| (n + 1, sum + c.reduction));
        if n > 0 {
            *progress = sum as f64 / f64::from(n);
        }
    }
    Ok(chosen.iter().map(|c| c.reduction).sum())
}

/// The edges of an iteration: the oracle's first, then random ones, none twice.
fn choose(run: &mut Run<'_>, sources: &mut Sources) -> Result<Vec<Chosen>, RenderError> {
    let edges = EdgeTable::new(run.mesh);
    if sources.n_iterations.is_multiple_of(RANKING_PERIOD) {
        sources.ranking = oracle::ranking(run.mesh, &edges, run.objective)?;
        sources.ranking.reverse();
    }
    sources.n_iterations += 1;
    let wanted = run.params.edges_per_iteration.min(edges.n_slots());
    let [by_oracle, by_chance] = sources.progress;
    let share = if by_oracle + by_chance > 0.0 { by_oracle / (by_oracle + by_chance) } else { 0.5 };
    let share = share.clamp(LEAST_SHARE, 1.0 - LEAST_SHARE);
    let from_oracle = (share * wanted as f64) as usize;
    let mut chosen: Vec<Chosen> = Vec::with_capacity(wanted);
    while chosen.len() < from_oracle {
        let Some(ends) = sources.ranking.pop() else { break };
        if edges.find(ends[0], ends[1]).is_some() {
            chosen.push(Chosen { ends, is_from_oracle: true, reduction: 0 });
        }
    }
    let mut all: Vec<_> = edges.edges().map(|e| edges.ends(e)).collect();
    while chosen.len() < wanted && !all.is_empty() {
        let ends = all.swap_remove(run.memory.rng.below(all.len()));
        if chosen.iter().all(|c| c.ends != ends) {
            chosen.push(Chosen { ends, is_from_oracle: false, reduction: 0 });
        }
    }
    Ok(chosen)
}

/// Tries an operation on the edges that deserve it, wave by wave.
fn try_on_all(
    run: &mut Run<'_>,
    operation: Operation,
    chosen: &mut [Chosen],
) -> Result<(), RenderError> {
    let mut todo = Vec::new();
    for (i, c) in chosen.iter().enumerate() {
        if run.memory.statistics.deserves_try(operation, c.reduction) {
            run.memory.statistics.use_once(operation);
            todo.push(i);
        }
    }
    while !todo.is_empty() && !run.is_over() {
        let (mut wave, later) = next_wave(run, operation, chosen, &todo);
        trial::run(run.objective, wave.iter_mut().map(|(_, p)| &mut p.trial))?;
        for (i, proposal) in wave {
            let (before, n_pricing) = (run.evaluations(), run.memory.n_pricing);
            let reduction = match operation.kind {
                Kind::Split => teleport::complete(run, &proposal)?,
                _ => run.accept(&proposal)?,
            };
            // Prices once found serve many teleports, so they are not charged to this one.
            let pricing = run.memory.n_pricing - n_pricing;
            let own = u64::from(proposal.trial.evaluations());
            let spent = run.evaluations() - before - pricing + own;
            run.memory.statistics.log(operation, reduction, spent);
            chosen[i].reduction += reduction;
        }
        todo = later;
    }
    Ok(())
}

/// Proposals for edges without a common triangle, and the edges that must wait.
fn next_wave(
    run: &mut Run<'_>,
    operation: Operation,
    chosen: &[Chosen],
    todo: &[usize],
) -> (Vec<(usize, Proposal)>, Vec<usize>) {
    run.begin_wave();
    let (mut wave, mut later) = (Vec::new(), Vec::new());
    for &i in todo {
        let [a, b] = chosen[i].ends;
        if run.mesh.edge_faces(a, b).is_empty() {
            continue;
        }
        let Some(proposal) = run.proposer().propose(operation, [a, b], None) else { continue };
        if run.claim(proposal.trial.template.touched()) {
            wave.push((i, proposal));
        } else {
            later.push(i);
        }
    }
    (wave, later)
}
