//! What a long-running stage tells its caller while it works.
//!
//! Every stage takes `&mut dyn FnMut(Step<'_>) -> ControlFlow<()>`: one callback for edits,
//! progress and cancellation. `Break` ends the stage after the step it was told of.

use super::edit::Edit;

/// The stages of a job, in the order they run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Geometric pre-simplification.
    Memoryless,
    /// Image-driven simplification.
    Image,
    /// Image-driven optimization.
    Optimize,
}

impl Stage {
    /// The name that files and the wire use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Memoryless => "memoryless",
            Self::Image => "image",
            Self::Optimize => "optimize",
        }
    }
}

/// A point of the energy curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// The stage that took it.
    pub stage: Stage,
    /// Energy evaluations of the stage so far (candidate moves judged).
    pub evaluations: u64,
    /// Triangles of the mesh now.
    pub triangles: u32,
    /// Sum over all views and pixels of the squared luminance difference, luminance in 0..=255.
    /// `None` where no pictures are kept (memoryless).
    pub energy: Option<u64>,
    /// Root of the mean squared luminance difference in percent of full scale (the papers' d2).
    pub d2: Option<f64>,
    /// Where view sets take turns, which turn it was taken in; else 0. The energy falls within a
    /// turn; from one to another it may rise, since other views were looked at in between.
    pub turn: u32,
}

/// What a kind of move has done in a stage so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MoveCount {
    /// The kind.
    pub name: &'static str,
    /// Times it was tried.
    pub tried: u64,
    /// Times it was accepted.
    pub accepted: u64,
    /// Energy evaluations spent on it.
    pub evaluations: u64,
    /// Energy that it has taken off.
    pub reduction: i64,
}

/// One step of a stage.
#[derive(Debug)]
pub enum Step<'a> {
    /// An edit was applied to the mesh.
    Edit(Edit<'a>),
    /// A point of the energy curve.
    Sample(Sample),
    /// What the kinds of moves have done, right after a sample.
    Moves(&'a [MoveCount]),
    /// `done` of `total` units of work; units are the stage's own.
    Progress {
        /// Units done.
        done: u64,
        /// Units in all.
        total: u64,
    },
}
