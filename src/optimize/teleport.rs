//! The vertex teleport: a split where a vertex is missed, paid for by the cheapest collapse
//! (Lindstrom & Turk 2000, section 7.1.5).

use glam::DVec3;

use crate::{
    memoryless,
    mesh::Topology,
    render::{Move, RenderError},
};

use super::{
    operations::{Kind, Operation, Proposal},
    prices::{Ends, Entry},
    run::{Done, Run},
    trial,
};

/// Edges whose collapse is judged at once.
const BATCH: usize = 16;
/// Rounds of judging before a search for a collapse gives up.
const MAX_ROUNDS: usize = 24;
/// Most levels of a collapse.
const MAX_LEVEL: u8 = 3;

/// Splits that are judged at once.
const SPLIT_BATCH: usize = 64;
/// Most teleports of a pass.
const MAX_PER_PASS: usize = 32;
/// Most levels of a split in a pass: at the third, ten vertices and more are free.
const MAX_SPLIT_LEVEL: u8 = 2;

/// A pass of teleports: the splits that bring most, each with the collapse that costs least, as
/// long as they pay. Beyond the paper, which splits the edges that an iteration happens to be at.
/// Returns the energy taken off.
pub fn pair(run: &mut Run<'_>) -> Result<i64, RenderError> {
    let mut sum = 0;
    let mut n_left = MAX_PER_PASS;
    while n_left > 0 && !run.is_over() {
        let front = run.memory.splits.front(run.mesh, SPLIT_BATCH);
        let Some((ends, first)) = front.first().copied() else { break };
        if first.is_stale {
            search_splits(run, &fit(&front, |e| e.is_stale), 1)?;
            continue;
        }
        n_left -= 1;
        if !is_affordable(run, -first.cost)? {
            if !raise(run, &front)? {
                break;
            }
            continue;
        }
        let found = search_splits(run, &[(ends, first)], first.level)?.pop();
        let reduction = match &found {
            Some(split) => complete(run, split)?,
            None => 0,
        };
        if let (Some(split), true) = (&found, reduction == 0) {
            // Not to come up again before its surroundings change.
            let entry = Entry { cost: 0, is_stale: false, ..first };
            run.memory.splits.set(ends, entry);
            run.memory.statistics.count(split.operation, 0, 0);
        }
        sum += reduction;
    }
    Ok(sum)
}

fn fit(front: &[(Ends, Entry)], test: impl Fn(&Entry) -> bool) -> Vec<(Ends, Entry)> {
    front.iter().copied().filter(|(_, e)| test(e)).collect()
}

/// Searches promising splits one level higher; false if none is promising.
fn raise(run: &mut Run<'_>, front: &[(Ends, Entry)]) -> Result<bool, RenderError> {
    let cheapest = run.memory.collapses.cheapest().next();
    let Some((_, collapse)) = cheapest else { return Ok(false) };
    let least = run.memory.collapses.hope(collapse.cost);
    let hope = |e: &Entry| -run.memory.splits.hope(e.cost);
    let hopeful =
        fit(front, |e| !e.is_stale && e.level < MAX_SPLIT_LEVEL && hope(e) > least);
    let Some(level) = hopeful.iter().map(|(_, e)| e.level + 1).min() else { return Ok(false) };
    let raised: Vec<_> = hopeful.into_iter().filter(|(_, e)| e.level + 1 == level).collect();
    search_splits(run, &raised, level)?;
    Ok(true)
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

/// Finishes a split whose search is over: makes it, and the collapse that pays for it. Returns the
/// energy taken off by both, 0 if they were not worth it.
pub fn complete(run: &mut Run<'_>, split: &Proposal) -> Result<i64, RenderError> {
    let gain = -split.trial.best().1;
    if gain <= 0 || run.is_over() || !is_affordable(run, gain)? {
        return Ok(0);
    }
    // Teleports made since it was planned may have taken its ids, or its triangles.
    let (point, _) = split.trial.best();
    let (places, normals) = split.trial.unpack(&point);
    let Some(fresh) = run.proposer().propose(split.operation, split.edge, None) else {
        return Ok(0);
    };
    if fresh.trial.template.touched() != split.trial.template.touched() {
        return Ok(0);
    }
    let mv = fresh.trial.template.at(&places, &normals);
    let back = run.objective.inverse(run.mesh, &mv);
    let gain = -run.objective.commit(&mv)?;
    let mut done = run.perform(&fresh, &places, &normals);
    let reduction = pay(run, gain, &mut done)?;
    if reduction == 0 {
        run.take_back(&done, &back)?;
    }
    Ok(reduction)
}

/// Collapses an edge for less than `gain`; the energy taken off by both, 0 for neither.
fn pay(run: &mut Run<'_>, gain: i64, done: &mut Vec<Done>) -> Result<i64, RenderError> {
    if gain <= 0 {
        return Ok(0);
    }
    let found = find(run, gain)?;
    let Some(collapse) = found else { return Ok(0) };
    let (point, _) = collapse.trial.best();
    let (places, normals) = collapse.trial.unpack(&point);
    let mv: Move = collapse.trial.template.at(&places, &normals);
    let cost = run.objective.commit(&mv)?;
    let made = run.perform(&collapse, &places, &normals);
    debug_assert!(cost < gain);
    done.extend(made);
    let told = std::mem::take(done);
    run.tell(&told);
    run.memory.statistics.count(collapse.operation, -cost, 0);
    Ok(gain - cost)
}

/// Whether some collapse may be had for less than `gain`.
fn is_affordable(run: &mut Run<'_>, gain: i64) -> Result<bool, RenderError> {
    for _ in 0..MAX_ROUNDS {
        let front = run.memory.collapses.front(run.mesh, BATCH);
        let Some((_, first)) = front.first() else { return Ok(false) };
        if !first.is_stale || first.cost > gain {
            return Ok(run.memory.collapses.hope(first.cost) < gain as f64);
        }
        judge(run, &stale(&front))?;
    }
    Ok(false)
}

fn stale(front: &[(Ends, Entry)]) -> Vec<Ends> {
    front.iter().filter(|(_, e)| e.is_stale).map(|(ends, _)| *ends).collect()
}

/// The cheapest collapse, searched at the level that makes it cheap enough.
fn find(run: &mut Run<'_>, gain: i64) -> Result<Option<Proposal>, RenderError> {
    for _ in 0..MAX_ROUNDS {
        let front = run.memory.collapses.front(run.mesh, BATCH);
        let Some((ends, first)) = front.first().copied() else { return Ok(None) };
        if first.is_stale {
            judge(run, &stale(&front))?;
            continue;
        }
        if first.cost < gain {
            let found = search(run, &[(ends, first)], first.level.max(1))?.pop();
            match found.filter(|p| p.trial.best().1 < gain) {
                Some(proposal) => return Ok(Some(proposal)),
                None => continue,
            }
        }
        let hope = |e: &Entry| run.memory.collapses.hope(e.cost);
        let is_hopeful = |e: &Entry| !e.is_stale && e.level < MAX_LEVEL && hope(e) < gain as f64;
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
        if run.mesh.may_collapse(ends[0], ends[1], Topology::Preserve) {
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

/// The memoryless optimum, the midpoint and the ends.
fn places(run: &Run<'_>, ends: Ends, scratch: &mut memoryless::Scratch) -> Vec<DVec3> {
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
        if !run.mesh.may_collapse(ends[0], ends[1], Topology::Preserve) {
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
