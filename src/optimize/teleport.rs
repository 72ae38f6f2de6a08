//! The vertex teleport: a split where a vertex is missed, paid for by the cheapest collapse
//! (Lindstrom & Turk 2000, section 7.1.5).

use glam::DVec3;

use crate::{memoryless, mesh::VertexId, render::RenderError};

use super::{
    operations::{Kind, Operation, Proposal},
    prices::{Ends, Entry},
    run::{Run, Transaction},
    sweeps, trial,
};

/// Edges whose collapse is judged at once.
const BATCH: usize = 24;
/// Triangles that the mesh may have fewer than at first; it never has more.
const MOST_OFF: usize = 2;
/// Rounds of judging before a search for a collapse gives up.
const MAX_ROUNDS: usize = 24;
/// Most levels of a collapse.
const MAX_LEVEL: u8 = 3;

/// Splits that are judged at once.
const SPLIT_BATCH: usize = 64;
/// Most teleports that a pass tries, and how many may fail in a row.
const MAX_PER_PASS: usize = 48;
const MAX_FAILURES: usize = 8;
/// Rounds in which the neighbours of a new vertex find their places.
const RELAX_ROUNDS: u32 = 2;
/// A split must bring this share of what a collapse costs: the relaxing that follows may save the
/// rest.
const LEAST_SHARE: f64 = 0.7;

/// A pass of teleports: the splits that bring most, each with the collapse that costs least, as
/// long as they pay. Beyond the paper, which splits the edges that an iteration happens to be at.
/// Returns the energy taken off.
pub fn pair(run: &mut Run<'_>) -> Result<i64, RenderError> {
    let (mut sum, mut n_tried, mut n_failed) = (0, 0, 0);
    while n_tried < MAX_PER_PASS && n_failed < MAX_FAILURES && !run.is_over() {
        run.sample_if_due();
        let front = run.memory.splits.front(run.mesh, SPLIT_BATCH, |_| true);
        let Some((ends, first)) = front.first().copied() else { break };
        if first.is_stale {
            let stale: Vec<_> = front.into_iter().filter(|(_, e)| e.is_stale).collect();
            search_splits(run, &stale, 1)?;
            continue;
        }
        n_tried += 1;
        let found = search_splits(run, &[(ends, first)], first.level)?.pop();
        let reduction = match &found {
            Some(split) => complete(run, split)?,
            None => 0,
        };
        n_failed = if reduction > 0 { 0 } else { n_failed + 1 };
        if reduction == 0 {
            // Not to come up again before its surroundings change.
            run.memory.splits.set(ends, Entry { cost: 0, is_stale: false, ..first });
        }
        sum += reduction;
    }
    Ok(sum)
}

/// Searches splits at a level and enters what they bring.
fn search_splits(
    run: &mut Run<'_>,
    edges: &[(Ends, Entry)],
    level: u8,
) -> Result<Vec<Proposal>, RenderError> {
    let operation = Operation { kind: Kind::Split, level };
    let mut found: Vec<(Ends, Entry, Proposal)> = Vec::new();
    for &(ends, entry) in edges {
        match run.proposer().propose(operation, ends, None) {
            Some(proposal) => found.push((ends, entry, proposal)),
            None => run.memory.splits.remove(ends),
        }
    }
    trial::run(run.objective, found.iter_mut().map(|(_, _, p)| &mut p.trial))?;
    for (ends, old, proposal) in &found {
        let cost = proposal.trial.best().1;
        if !old.is_stale && old.level < level {
            run.memory.splits.learn(old.cost, cost.min(old.cost));
        }
        let place = None;
        run.memory.splits.set(*ends, Entry { cost, level, place, is_stale: false });
        let spent = u64::from(proposal.trial.evaluations());
        run.memory.statistics.count(operation, 0, spent);
    }
    Ok(found.into_iter().map(|(_, _, p)| p).collect())
}

/// Finishes a split whose search is over: makes it, and the collapse that pays for it, and lets
/// the neighbours of both find new places. Returns the energy taken off by all of it; if there is
/// none, everything is taken back and 0 returned.
pub fn complete(run: &mut Run<'_>, split: &Proposal) -> Result<i64, RenderError> {
    let (point, value) = split.trial.best();
    if value >= 0 || run.is_over() {
        return Ok(0);
    }
    // Teleports made since it was planned may have taken its ids, or its triangles.
    let fresh = run.proposer().propose(split.operation, split.edge, None);
    let is_same = |f: &Proposal| f.trial.template.touched() == split.trial.template.touched();
    let Some(fresh) = fresh.filter(is_same) else { return Ok(0) };
    let (places, normals) = split.trial.unpack(&point);
    let mut teleport = Transaction::default();
    run.make(&fresh, (&places, &normals), &mut teleport)?;
    let Some(new) = fresh.trial.free.first().map(|f| f.vertex) else { return Ok(0) };
    relax_around(run, new, &mut teleport)?;
    let is_paid = pay(run, &mut teleport)?;
    let reduction = -teleport.delta;
    if is_paid && (reduction > 0 || run.params.allows_uphill) {
        run.memory.n_uphill += u64::from(reduction < 0);
        run.keep(teleport);
        return Ok(reduction);
    }
    run.roll_back(teleport)?;
    Ok(0)
}

/// Collapses the cheapest edge, as a step of a teleport whose split is made; false if there is
/// none, or none cheap enough.
fn pay(run: &mut Run<'_>, teleport: &mut Transaction) -> Result<bool, RenderError> {
    let gain = -teleport.delta;
    let found = if gain > 0 { find(run, gain)? } else { None };
    let Some(collapse) = found else { return Ok(false) };
    let (point, cost) = collapse.trial.best();
    let (places, normals) = collapse.trial.unpack(&point);
    run.make(&collapse, (&places, &normals), teleport)?;
    run.memory.statistics.count(collapse.operation, -cost, 0);
    relax_around(run, collapse.edge[0], teleport)?;
    Ok(true)
}

/// Lets a vertex and its neighbours find better places.
fn relax_around(
    run: &mut Run<'_>,
    v: VertexId,
    within: &mut Transaction,
) -> Result<(), RenderError> {
    let mut vertices = Vec::new();
    run.mesh.neighbours(v, &mut vertices);
    vertices.insert(0, v);
    sweeps::relax(run, &vertices, RELAX_ROUNDS, within)
}

/// The cheapest collapses that bring the number of triangles back to where it was, or at most
/// [`MOST_OFF`] below: a boundary edge takes one triangle with it, any other two.
fn fitting(run: &mut Run<'_>) -> Vec<(Ends, Entry)> {
    let (now, most) = (run.mesh.n_faces(), run.memory.n_faces);
    let fits = |n: usize| now - n <= most && now - n + MOST_OFF >= most;
    run.memory.collapses.front(run.mesh, BATCH, fits)
}

fn stale(front: &[(Ends, Entry)]) -> Vec<Ends> {
    front.iter().filter(|(_, e)| e.is_stale).map(|(ends, _)| *ends).collect()
}

/// The cheapest collapse, searched at the level that makes it cheap enough.
fn find(run: &mut Run<'_>, gain: i64) -> Result<Option<Proposal>, RenderError> {
    // What the relaxing after the collapse will save is not known yet.
    let most = (gain as f64 / LEAST_SHARE) as i64;
    for _ in 0..MAX_ROUNDS {
        let front = fitting(run);
        let Some((ends, first)) = front.first().copied() else { return Ok(None) };
        if first.is_stale {
            judge(run, &stale(&front))?;
            continue;
        }
        if first.cost < most || run.params.allows_uphill {
            let found = search(run, &[(ends, first)], first.level.max(1))?.pop();
            match found.filter(|p| p.trial.best().1 < most || run.params.allows_uphill) {
                Some(proposal) => return Ok(Some(proposal)),
                None => continue,
            }
        }
        let hope = |e: &Entry| run.memory.collapses.hope(e.cost);
        let is_hopeful = |e: &Entry| !e.is_stale && e.level < MAX_LEVEL && hope(e) < most as f64;
        let hopeful = front.iter().copied().filter(|(_, e)| is_hopeful(e));
        let level = hopeful.clone().map(|(_, e)| e.level + 1).min();
        let Some(level) = level else { return Ok(None) };
        let raised: Vec<_> = hopeful.filter(|(_, e)| e.level + 1 == level).collect();
        search(run, &raised, level)?;
    }
    Ok(None)
}

/// Judges collapses without a search, at the best of four places.
fn judge(run: &mut Run<'_>, edges: &[Ends]) -> Result<(), RenderError> {
    let operation = Operation { kind: Kind::Collapse, level: 0 };
    let mut scratch = memoryless::Scratch::default();
    let mut proposals: Vec<(Ends, DVec3, Proposal)> = Vec::new();
    for &ends in edges {
        run.memory.collapses.remove(ends);
        if run.mesh.may_collapse(ends[0], ends[1], run.params.topology()) {
            for place in places(run, ends, &mut scratch) {
                let proposal = run.proposer().propose(operation, ends, Some(place));
                proposals.extend(proposal.map(|p| (ends, place, p)));
            }
        }
    }
    trial::run(run.objective, proposals.iter_mut().map(|(_, _, p)| &mut p.trial))?;
    for of_edge in proposals.chunk_by(|a, b| a.0 == b.0) {
        if let Some((ends, place, best)) = of_edge.iter().min_by_key(|(_, _, p)| p.trial.best().1) {
            let cost = best.trial.best().1;
            let entry = Entry { cost, level: 0, place: Some(*place), is_stale: false };
            run.memory.collapses.set(*ends, entry);
            run.memory.statistics.count(operation, 0, of_edge.len() as u64);
            run.memory.n_pricing += of_edge.len() as u64;
        }
    }
    Ok(())
}

/// The memoryless optimum, the midpoint and the ends; the end that is locked, if one is.
fn places(run: &Run<'_>, ends: Ends, scratch: &mut memoryless::Scratch) -> Vec<DVec3> {
    if let Some(fixed) = run.mesh.fixed_place(ends) {
        return vec![fixed];
    }
    let [a, b] = ends.map(|v| run.mesh.position(v));
    let params = memoryless::Params::default();
    let optimum = memoryless::placement(run.mesh, ends[0], ends[1], &params, scratch);
    let mut places: Vec<DVec3> = optimum.map(|p| p.to).into_iter().collect();
    for p in [a.midpoint(b), a, b] {
        if !places.contains(&p) {
            places.push(p);
        }
    }
    places
}

/// Searches collapses at a level and enters what they cost now.
fn search(
    run: &mut Run<'_>,
    edges: &[(Ends, Entry)],
    level: u8,
) -> Result<Vec<Proposal>, RenderError> {
    let operation = Operation { kind: Kind::Collapse, level };
    let mut found: Vec<(Ends, Entry, Proposal)> = Vec::new();
    for &(ends, entry) in edges {
        if !run.mesh.may_collapse(ends[0], ends[1], run.params.topology()) {
            run.memory.collapses.remove(ends);
            continue;
        }
        match run.proposer().propose(operation, ends, entry.place) {
            Some(proposal) => found.push((ends, entry, proposal)),
            None => run.memory.collapses.remove(ends),
        }
    }
    trial::run(run.objective, found.iter_mut().map(|(_, _, p)| &mut p.trial))?;
    for (ends, old, proposal) in &found {
        let (point, cost) = proposal.trial.best();
        let place = proposal.trial.unpack(&point).0.first().copied();
        run.memory.collapses.learn(old.cost, cost.min(old.cost));
        run.memory.collapses.set(*ends, Entry { cost, level, place, is_stale: false });
        let spent = u64::from(proposal.trial.evaluations());
        run.memory.statistics.count(operation, 0, spent);
    }
    Ok(found.into_iter().map(|(_, _, p)| p).collect())
}
