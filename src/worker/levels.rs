//! The levels of detail of a job: how far each goes, and their meshes as they are reached.

use serde::Serialize;

use crate::{
    jobs::{
        event::MoveCount,
        spec::{LevelBudget, Spec, Topology},
    },
    mesh::{EditMesh, Marks, Mesh},
};

use super::{pipeline::PipelineError, recorder::Recorder, stopped::StoppedBy};

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
    /// What was asked for.
    pub budget: LevelBudget,
    /// Its place in the order asked for, from 0.
    pub index: usize,
    /// The mesh.
    pub mesh: Mesh,
    /// What is said of its vertices.
    pub marks: Marks,
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

/// A level that is not reached yet.
#[derive(Clone, Debug)]
pub struct Pending {
    /// Its place in the order asked for, from 0.
    pub index: usize,
    /// How far it goes.
    pub budget: LevelBudget,
    /// Highest energy that it may have, by `max_d2`.
    pub max_energy: Option<u64>,
    /// The next collapse would lift the energy above that.
    pub is_at_max_energy: bool,
}

impl Pending {
    /// Whether a stage cannot know by itself where the level ends.
    pub fn is_measured(&self) -> bool {
        self.budget.max_bytes.is_some() || self.budget.screen_size.is_some()
    }
}

/// Where a level ended.
#[derive(Clone, Copy, Debug)]
pub struct End {
    /// Why.
    pub stopped_by: StoppedBy,
    /// Energy and d2 there, if pictures were drawn.
    pub energy: Option<(u64, f64)>,
}

/// All levels of a job.
pub struct Levels {
    /// As asked for.
    asked: Vec<LevelBudget>,
    /// Distinct ones still to reach.
    pending: Vec<Pending>,
    done: Vec<Level>,
    n_original: usize,
    /// The one level came with the job.
    is_given: bool,
}

impl Levels {
    /// The levels a job asks for; `max_energy` is what a d2 in percent means.
    pub fn new(spec: &Spec, n_original: usize, max_energy: impl Fn(f64) -> u64) -> Self {
        let asked = spec.level_budgets();
        let is_first = |(i, budget): &(usize, &LevelBudget)| !asked[..*i].contains(budget);
        let pending = |(index, budget): (usize, &LevelBudget)| Pending {
            index,
            budget: *budget,
            max_energy: budget.max_d2.map(&max_energy),
            is_at_max_energy: false,
        };
        let pending = asked.iter().enumerate().filter(is_first).map(pending).collect();
        Self { asked, pending, done: Vec::new(), n_original, is_given: false }
    }

    /// The one level of a mesh that is simplified already.
    pub fn of_simplified(n_triangles: usize, n_original: usize) -> Self {
        let budget = LevelBudget { triangles: Some(n_triangles as u32), ..LevelBudget::default() };
        let pending = Pending { index: 0, budget, max_energy: None, is_at_max_energy: false };
        Self {
            asked: vec![budget],
            pending: vec![pending],
            done: Vec::new(),
            n_original,
            is_given: true,
        }
    }

    /// Says which levels cannot be coarser than the original.
    pub fn announce(&self, recorder: &mut Recorder<'_>) -> Result<(), PipelineError> {
        if self.is_given {
            return Ok(());
        }
        let targets = self.asked.iter().filter_map(|budget| budget.triangles);
        for target in targets.filter(|t| *t as usize >= self.n_original) {
            let text = format!(
                "{target} triangles were asked for and the model has {}: this level is the \
                 original, unchanged; ask for fewer",
                self.n_original
            );
            recorder.note("TARGET_NOT_BELOW_INPUT", &text)?;
        }
        Ok(())
    }

    /// Says which levels are not as small as asked for, why, and what may help.
    pub fn explain(&self, spec: &Spec, recorder: &mut Recorder<'_>) -> Result<(), PipelineError> {
        for level in &self.done {
            let Some(wanted) = wanted(&level.budget) else { continue };
            let Some(why) = why(level.stopped_by, spec.topology) else { continue };
            let (name, n) = (level.name(), level.mesh.faces.len());
            let text = format!("{name}: {wanted} were asked for, {n} triangles are left: {why}");
            let is_images = level.stopped_by == StoppedBy::Images;
            let code = if is_images { "IMAGES_EXCEED_BYTES" } else { "TARGET_NOT_REACHED" };
            recorder.note(code, &text)?;
        }
        Ok(())
    }

    /// The levels still to reach.
    pub fn pending(&self) -> &[Pending] {
        &self.pending
    }

    /// Whether every level is reached.
    pub fn is_complete(&self) -> bool {
        self.pending.is_empty()
    }

    /// The most triangles below so many that a level has asked for.
    pub fn next_target(&self, below: usize) -> Option<usize> {
        let targets = self.pending.iter().filter_map(|p| p.budget.triangles);
        targets.map(|t| t as usize).filter(|t| *t < below).max()
    }

    /// Energy that no pending level may exceed.
    pub fn max_energy(&self) -> Option<u64> {
        self.pending.iter().filter_map(|p| p.max_energy).min()
    }

    /// The next collapse would lift the energy above [`Self::max_energy`].
    pub fn set_at_max_energy(&mut self) {
        let most = self.max_energy();
        let is_strictest = |p: &&mut Pending| p.max_energy == most && most.is_some();
        self.pending.iter_mut().filter(is_strictest).for_each(|p| p.is_at_max_energy = true);
    }

    /// Takes a mesh as the pending level of this number.
    pub fn take(&mut self, index: usize, mesh: &EditMesh, end: End, recorder: &mut Recorder<'_>) {
        let Some(at) = self.pending.iter().position(|p| p.index == index) else { return };
        let budget = self.pending.remove(at).budget;
        recorder.mark_level(&level_name(index));
        let snapshot = mesh.snapshot_with_ids();
        self.done.push(Level {
            budget,
            index,
            mesh: snapshot.mesh,
            marks: mesh.marks().of(&snapshot.vertex_ids),
            energy: end.energy.map(|e| e.0),
            d2: end.energy.map(|e| e.1),
            stopped_by: end.stopped_by,
            optimized: None,
            n_unseen: None,
        });
    }

    /// Gives every level that was not reached the coarsest mesh there is.
    pub fn close(&mut self, mesh: &EditMesh, end: End, recorder: &mut Recorder<'_>) {
        while let Some(first) = self.pending.first() {
            let stopped_by = if first.is_at_max_energy { StoppedBy::D2 } else { end.stopped_by };
            self.take(first.index, mesh, End { stopped_by, ..end }, recorder);
        }
    }

    /// The levels that optimization can change, finest first: all but those that are the original.
    pub fn simplified(&mut self) -> impl Iterator<Item = &mut Level> {
        let (is_given, n_original) = (self.is_given, self.n_original);
        self.done.iter_mut().filter(move |l| is_given || l.mesh.faces.len() < n_original)
    }

    /// Counts what the run-time views do not see of the levels as they are now.
    pub fn look(&mut self, n_unseen: impl Fn(&Mesh) -> Option<usize>) {
        self.done.iter_mut().for_each(|level| level.n_unseen = n_unseen(&level.mesh));
    }

    /// Levels in the order asked for.
    pub fn in_order(&self) -> impl Iterator<Item = &Level> {
        self.asked.iter().filter_map(|asked| self.done.iter().find(|l| l.budget == *asked))
    }
}

/// What a level should be as small as.
fn wanted(budget: &LevelBudget) -> Option<String> {
    let triangles = budget.triangles.map(|n| format!("{n} triangles"));
    let bytes = budget.max_bytes.map(|n| format!("{n} bytes"));
    match (triangles, bytes) {
        (Some(triangles), Some(bytes)) => Some(format!("{triangles} and {bytes}")),
        (triangles, bytes) => triangles.or(bytes),
    }
}

/// Why a level is not as small as it should be, where it is not.
fn why(stopped_by: StoppedBy, topology: Topology) -> Option<&'static str> {
    match (stopped_by, topology) {
        (StoppedBy::NoLegalCollapse, Topology::Preserve | Topology::Auto) => Some(
            "no collapse is left that keeps its parts and holes; ask for more, or for free topology",
        ),
        (StoppedBy::NoLegalCollapse, Topology::Free) => {
            Some("no collapse is left that leaves a triangle")
        }
        (StoppedBy::Locks, _) => Some(
            "no collapse is left that leaves the locked vertices where they are; ask for more, or lock \
             fewer",
        ),
        (StoppedBy::Evaluations, _) => Some("the evaluations allowed are spent; allow more"),
        (StoppedBy::D2, _) => Some(
            "the next collapse would leave d2 above the limit; allow more (optimization may bring it \
             below)",
        ),
        (StoppedBy::ScreenSize, _) => Some(
            "the next mesh would be off by more than half a pixel; allow a smaller screen size",
        ),
        (StoppedBy::Seconds, _) => Some("the seconds allowed are over; allow more"),
        (StoppedBy::Images, _) => Some(
            "images alone are more, so the rest of the file is held to that; make the images smaller \
             first, or allow more",
        ),
        _ => None,
    }
}
