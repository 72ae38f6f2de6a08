//! The levels of detail of a job: targets in descending order, meshes as they are reached.

use serde::Serialize;

use crate::{
    jobs::{
        event::MoveCount,
        spec::{Spec, Topology},
    },
    memoryless,
    mesh::{EditMesh, Mesh},
    optimize, simplify,
};

use super::{pipeline::PipelineError, recorder::Recorder};

/// What ended the work on a level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StoppedBy {
    /// The original has no more triangles than asked for.
    #[default]
    Input,
    /// The target is reached.
    Triangles,
    /// No collapse is left that keeps the topology (or, where it is free, any triangle).
    NoLegalCollapse,
    /// The budget of evaluations is spent.
    Evaluations,
    /// The next collapse would have lifted d2 above what is allowed.
    D2,
    /// The cap on wall-clock time is reached.
    Seconds,
    /// The energy has fallen as far as was asked (optimization).
    Energy,
    /// Nothing that was tried helps any more (optimization).
    Converged,
}

impl StoppedBy {
    /// Of a memoryless run.
    pub(super) fn of_memoryless(by: memoryless::StoppedBy) -> Self {
        match by {
            memoryless::StoppedBy::Target => Self::Triangles,
            memoryless::StoppedBy::NoLegalCollapse => Self::NoLegalCollapse,
            memoryless::StoppedBy::Caller => Self::Seconds,
        }
    }

    /// Of an image-driven run.
    pub(super) fn of_image(by: simplify::StoppedBy) -> Self {
        match by {
            simplify::StoppedBy::Target => Self::Triangles,
            simplify::StoppedBy::NoLegalCollapse => Self::NoLegalCollapse,
            simplify::StoppedBy::Evaluations => Self::Evaluations,
            simplify::StoppedBy::Energy => Self::D2,
            simplify::StoppedBy::Caller => Self::Seconds,
        }
    }

    /// Of an optimization.
    pub(super) fn of_optimization(by: optimize::StoppedBy) -> Self {
        match by {
            optimize::StoppedBy::Evaluations => Self::Evaluations,
            optimize::StoppedBy::Energy => Self::Energy,
            optimize::StoppedBy::Converged => Self::Converged,
            optimize::StoppedBy::Caller => Self::Seconds,
        }
    }
}

/// What optimization has done to a level.
#[derive(Clone, Debug, Serialize)]
pub struct Optimized {
    /// Energy evaluations.
    pub evaluations: u64,
    /// Seconds.
    pub seconds: f64,
    /// Sum of squared luminance differences on the run-time views before.
    pub energy_before: u64,
    /// The same after.
    pub energy_after: u64,
    /// After as a share of before.
    pub energy_ratio: f64,
    /// d2 before and after on 24 views that the job did not work with, percent of full scale.
    pub d2_unseen_percent: Option<[f64; 2]>,
    /// Edits made.
    pub edits: u32,
    /// What each kind of move has done.
    pub moves: Vec<MoveCount>,
    /// What ended it.
    pub stopped_by: StoppedBy,
}

/// One finished level.
#[derive(Clone, Debug)]
pub struct Level {
    /// Triangles asked for.
    pub target: usize,
    /// Its place in the order asked for, from 0.
    pub index: usize,
    /// The mesh.
    pub mesh: Mesh,
    /// Sum of squared luminance differences on the run-time views, if they were drawn.
    pub energy: Option<u64>,
    /// d2 on the run-time views, percent.
    pub d2: Option<f64>,
    /// What ended its simplification.
    pub stopped_by: StoppedBy,
    /// What optimization has done to it.
    pub optimized: Option<Optimized>,
    /// Triangles that no run-time view sees, if they were drawn.
    pub n_unseen: Option<usize>,
}

impl Level {
    /// Its name in the progressive mesh.
    pub fn name(&self) -> String {
        level_name(self.index)
    }
}

fn level_name(index: usize) -> String {
    format!("lod-{index}")
}

/// All levels of a job.
pub struct Levels {
    /// Targets as asked for.
    asked: Vec<usize>,
    /// Distinct targets still to reach, the last one being the next.
    pending: Vec<usize>,
    done: Vec<Level>,
    n_original: usize,
    /// The one level came with the job.
    is_given: bool,
    stop: StoppedBy,
    energy: Option<u64>,
    d2: Option<f64>,
}

impl Levels {
    /// The levels a job asks for.
    pub fn new(spec: &Spec, n_original: usize) -> Self {
        let asked = spec.triangles.iter().map(|t| *t as usize).collect();
        Self::of_targets(asked, n_original, false)
    }

    /// The one level of a mesh that is simplified already.
    pub fn of_simplified(n_triangles: usize, n_original: usize) -> Self {
        Self::of_targets(vec![n_triangles], n_original, true)
    }

    fn of_targets(asked: Vec<usize>, n_original: usize, is_given: bool) -> Self {
        let mut pending = asked.clone();
        pending.sort_unstable();
        pending.dedup();
        Self {
            asked,
            pending,
            done: Vec::new(),
            n_original,
            is_given,
            stop: StoppedBy::Input,
            energy: None,
            d2: None,
        }
    }

    /// Says which levels cannot be coarser than the original.
    pub fn announce(&self, recorder: &mut Recorder<'_>) -> Result<(), PipelineError> {
        for target in self.asked.iter().filter(|t| **t >= self.n_original) {
            let text = format!(
                "{target} triangles were asked for and the model has {}: this level is the \
                 original, unchanged; ask for fewer",
                self.n_original
            );
            recorder.note("TARGET_NOT_BELOW_INPUT", &text)?;
        }
        Ok(())
    }

    /// Says which levels have more triangles than asked for, why, and what may help.
    pub fn explain(&self, spec: &Spec, recorder: &mut Recorder<'_>) -> Result<(), PipelineError> {
        for level in self.done.iter().filter(|l| l.mesh.faces.len() > l.target) {
            let why = match (level.stopped_by, spec.topology) {
                (StoppedBy::NoLegalCollapse, Topology::Preserve | Topology::Auto) => {
                    "no collapse is left that keeps its parts and holes; ask for more, or for free \
                     topology"
                }
                (StoppedBy::NoLegalCollapse, Topology::Free) => {
                    "no collapse is left that leaves a triangle"
                }
                (StoppedBy::Evaluations, _) => "the evaluations allowed are spent; allow more",
                (StoppedBy::D2, _) => {
                    "the next collapse would leave d2 above the limit; allow more (optimization may \
                     bring it below)"
                }
                (StoppedBy::Seconds, _) => "the seconds allowed are over; allow more",
                _ => continue,
            };
            let (name, target, n) = (level.name(), level.target, level.mesh.faces.len());
            let text = format!("{name}: {target} triangles were asked for, {n} are left: {why}");
            recorder.note("TARGET_NOT_REACHED", &text)?;
        }
        Ok(())
    }

    /// The next target, finest first.
    pub fn next_target(&self) -> Option<usize> {
        self.pending.last().copied()
    }

    /// The coarsest target.
    pub fn least(&self) -> usize {
        self.asked.iter().copied().min().unwrap_or(0)
    }

    /// Whether every level is reached.
    pub fn is_complete(&self) -> bool {
        self.pending.is_empty()
    }

    /// Triangles at which the image-driven stage takes over: a multiple of the finest level that
    /// is below the original.
    pub fn image_start(&self, factor: f64) -> usize {
        let finest = self.pending.iter().rev().find(|t| **t < self.n_original);
        finest.map_or(self.n_original, |t| (*t as f64 * factor).ceil() as usize)
    }

    /// Remembers why the work on the next level ended.
    pub fn set_stop(&mut self, by: StoppedBy) {
        self.stop = by;
    }

    /// Remembers the energy of the current mesh.
    pub fn set_energy(&mut self, energy: u64, d2: f64) {
        self.energy = Some(energy);
        self.d2 = Some(d2);
    }

    /// Takes the current mesh as the next level. False when no later level can be reached.
    pub fn take(&mut self, mesh: &EditMesh, recorder: &mut Recorder<'_>) -> bool {
        let Some(target) = self.pending.pop() else { return false };
        let index = self.asked.iter().position(|t| *t == target).unwrap_or(0);
        recorder.mark_level(&level_name(index));
        self.done.push(Level {
            target,
            index,
            mesh: mesh.snapshot(),
            energy: self.energy,
            d2: self.d2,
            stopped_by: self.stop,
            optimized: None,
            n_unseen: None,
        });
        matches!(self.stop, StoppedBy::Input | StoppedBy::Triangles) && !self.pending.is_empty()
    }

    /// Gives every level that was not reached the coarsest mesh there is.
    pub fn close(&mut self, mesh: &EditMesh, recorder: &mut Recorder<'_>) {
        while !self.pending.is_empty() {
            self.take(mesh, recorder);
        }
    }

    /// The levels that optimization can change, finest first: all but those that are the original.
    pub fn simplified(&mut self) -> impl Iterator<Item = &mut Level> {
        let is_given = self.is_given;
        self.done.iter_mut().filter(move |l| is_given || l.stopped_by != StoppedBy::Input)
    }

    /// Counts what the run-time views do not see of the levels as they are now.
    pub fn look(&mut self, n_unseen: impl Fn(&Mesh) -> Option<usize>) {
        self.done.iter_mut().for_each(|level| level.n_unseen = n_unseen(&level.mesh));
    }

    /// Levels in the order asked for.
    pub fn in_order(&self) -> impl Iterator<Item = &Level> {
        self.asked.iter().filter_map(|t| self.done.iter().find(|l| l.target == *t))
    }
}
