//! Down the chain of collapses, and where on it each level ends.
//!
//! Triangles and d2 end a level while a stage runs. Bytes and distances are measured now and then: on the way
//! down each time that a share of the triangles is gone ([`STEP`]), and where one such stretch has led past the
//! end of a level, bisection finds the last mesh that the level may be (or the first that is small enough).
//! So that it can be a mesh of the past, the edits of a stretch are told when its levels are known.

use std::{borrow::Cow, ops::ControlFlow};

use crate::mesh::{Collapse, Edit, EditMesh, Step, Topology};

use super::{
    gauge::{Gauge, Measured},
    levels::{End, Levels, Pending},
    pipeline::PipelineError,
    recorder::Recorder,
    stopped::StoppedBy,
};

/// A stretch between two measurements leaves this share of the triangles.
const STEP: f64 = 0.84;

/// A stage that goes down the chain.
pub(super) trait Descent {
    /// The mesh as it is now.
    fn mesh(&self) -> &EditMesh;

    /// Goes on to so many triangles, but not above an energy, where it knows of energies.
    fn run_to(
        &mut self,
        target: usize,
        max_energy: Option<u64>,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<StoppedBy, PipelineError>;

    /// Energy and d2 of the mesh as it is now or, if one is given, of a mesh of the past; none of a stage
    /// without pictures.
    fn energy(&mut self, past: Option<&EditMesh>) -> Option<(u64, f64)>;
}

/// The collapses since the levels were last looked for, where some level is measured.
#[derive(Default)]
struct Trail {
    /// The mesh as it was then.
    start: Option<EditMesh>,
    collapses: Vec<Collapse>,
}

impl Trail {
    fn restart(&mut self, mesh: &EditMesh, levels: &Levels) {
        let is_measured = levels.pending().iter().any(Pending::is_measured);
        self.start = is_measured.then(|| mesh.clone());
        self.collapses.clear();
    }

    /// Keeps a collapse, or passes a step on.
    fn step(&mut self, step: Step<'_>, recorder: &mut Recorder<'_>) -> ControlFlow<()> {
        match step {
            Step::Edit(Edit::Collapse(collapse)) if self.start.is_some() => {
                self.collapses.push(collapse.clone());
                ControlFlow::Continue(())
            }
            step => recorder.step(&step),
        }
    }

    /// The mesh after so many collapses; none where that is the mesh as it is now.
    fn past(&self, n: usize) -> Option<EditMesh> {
        let mut mesh = self.start.as_ref().filter(|_| n < self.collapses.len())?.clone();
        self.collapses[..n].iter().for_each(|collapse| mesh.redo(collapse));
        Some(mesh)
    }
}

/// See the module.
pub(super) struct Course<'c, 'r> {
    pub levels: &'c mut Levels,
    pub gauge: &'c Gauge<'c>,
    pub recorder: &'c mut Recorder<'r>,
    /// Whether collapses must keep the topology.
    pub topology: Topology,
    /// Nothing is measured before so few triangles are left.
    pub measure_from: usize,
}

impl Course<'_, '_> {
    /// Takes the levels that the mesh is small enough for before any collapse.
    pub fn begin(&mut self, mesh: &EditMesh) -> Result<(), PipelineError> {
        let gauge = self.gauge;
        let start = gauge.measure(Cow::Borrowed(mesh));
        let mut ended = Vec::new();
        for pending in self.levels.pending() {
            if start.is_above(&pending.budget)?.is_none() {
                ended.push(pending.index);
            }
        }
        let end = End { stopped_by: StoppedBy::Input, energy: None };
        ended.into_iter().for_each(|index| self.levels.take(index, mesh, end, self.recorder));
        Ok(())
    }

    /// Runs a stage until all levels are reached, `floor` triangles are left, or it can go no further: then
    /// levels are given what there is.
    pub fn follow(&mut self, stage: &mut dyn Descent, floor: usize) -> Result<(), PipelineError> {
        let mut trail = Trail::default();
        trail.restart(stage.mesh(), self.levels);
        while !self.levels.is_complete() && stage.mesh().n_faces() > floor {
            let target = self.next_stop(stage.mesh().n_faces()).max(floor);
            let (recorder, most) = (&mut *self.recorder, self.levels.max_energy());
            let stopped_by = stage.run_to(target, most, &mut |step| trail.step(step, recorder))?;
            if stopped_by == StoppedBy::D2 {
                self.levels.set_at_max_energy();
            }
            self.settle(stage, &mut trail)?;
            if !matches!(stopped_by, StoppedBy::Triangles | StoppedBy::D2) {
                let stopped_by = self.blame_locks(stopped_by, stage.mesh());
                let end = End { stopped_by, energy: stage.energy(None) };
                self.levels.close(stage.mesh(), end, self.recorder);
            }
        }
        Ok(())
    }

    /// Where no collapse is left, whether locks are why.
    fn blame_locks(&self, by: StoppedBy, mesh: &EditMesh) -> StoppedBy {
        let is_held = by == StoppedBy::NoLegalCollapse && mesh.is_held_by_locks(self.topology);
        if is_held { StoppedBy::Locks } else { by }
    }

    /// Triangles at which levels are to be looked for.
    fn next_stop(&self, n_faces: usize) -> usize {
        let target = self.levels.next_target(n_faces).unwrap_or(0);
        if !self.levels.pending().iter().any(Pending::is_measured) {
            return target;
        }
        let step = (STEP * n_faces as f64) as usize;
        target.max(if n_faces > self.measure_from { self.measure_from } else { step })
    }

    /// Takes the levels that end between the start of the trail and now, and tells of its edits.
    fn settle(&mut self, stage: &mut dyn Descent, trail: &mut Trail) -> Result<(), PipelineError> {
        let gauge = self.gauge;
        let now = gauge.measure(Cow::Borrowed(stage.mesh()));
        let mut ended = Vec::new();
        for pending in self.levels.pending() {
            let end = self.end_of(pending, &now, trail, stage.mesh())?;
            ended.extend(end.map(|(n, by)| (n, pending.index, by)));
        }
        ended.sort_by_key(|(n, index, _)| (*n, *index));
        let mut n_told = 0;
        for (n, index, stopped_by) in ended {
            self.tell(&trail.collapses[n_told..n])?;
            n_told = n;
            let past = trail.past(n);
            let energy = stage.energy(past.as_ref());
            let mesh = past.as_ref().unwrap_or_else(|| stage.mesh());
            self.levels.take(index, mesh, End { stopped_by, energy }, self.recorder);
        }
        self.tell(&trail.collapses[n_told..])?;
        trail.restart(stage.mesh(), self.levels);
        Ok(())
    }

    fn tell(&mut self, collapses: &[Collapse]) -> Result<(), PipelineError> {
        for collapse in collapses {
            // Whatever the caller says, the mesh has them.
            let _ = self.recorder.step(&Step::Edit(collapse.into()));
        }
        if self.recorder.is_out_of_time() { Ok(()) } else { self.recorder.check() }
    }

    /// After how many collapses of the trail a level ends, if it does, and why.
    fn end_of(
        &self,
        pending: &Pending,
        now: &Measured<'_>,
        trail: &Trail,
        mesh: &EditMesh,
    ) -> Result<Option<(usize, StoppedBy)>, PipelineError> {
        let (gauge, budget, last) = (self.gauge, &pending.budget, trail.collapses.len());
        let at = |n: usize| match trail.past(n) {
            Some(past) => gauge.measure(Cow::Owned(past)),
            None => gauge.measure(Cow::Borrowed(mesh)),
        };
        let mut ends = Vec::new();
        if now.is_above(budget)?.is_none() {
            let is_small = |n: usize| Ok(at(n).is_above(budget)?.is_none());
            let n = if pending.is_measured() { first_of(last, is_small)? } else { last };
            let by_count = if budget.is_ratio { StoppedBy::Ratio } else { StoppedBy::Triangles };
            let above = if n > 0 { at(n - 1).is_above(budget)? } else { None };
            ends.push((n, above.unwrap_or(by_count)));
        }
        if now.is_too_far(budget) {
            let first = first_of(last, |n| Ok(at(n).is_too_far(budget)))?;
            ends.push((first.saturating_sub(1), StoppedBy::ScreenSize));
        }
        if pending.is_at_max_energy {
            ends.push((last, StoppedBy::D2));
        }
        // Of equals the first.
        Ok(ends.into_iter().min_by_key(|(n, _)| *n))
    }
}

/// The first number at which something is so that is so at `last`, and from some number on.
fn first_of(
    last: usize,
    mut is_so: impl FnMut(usize) -> Result<bool, PipelineError>,
) -> Result<usize, PipelineError> {
    let (mut low, mut high) = (0, last);
    while low < high {
        let middle = usize::midpoint(low, high);
        if is_so(middle)? {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    Ok(high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bisection_finds_the_first() {
        for last in 0..20 {
            for wanted in 0..=last {
                let found = first_of(last, |n| Ok(n >= wanted)).unwrap();
                assert_eq!(found, wanted);
            }
        }
    }
}
