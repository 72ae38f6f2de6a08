//! What ended the work on a level.

use serde::Serialize;

use crate::{memoryless, optimize, simplify};

/// What ended the work on a level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StoppedBy {
    /// The original has no more triangles than asked for.
    #[default]
    Input,
    /// As few triangles as asked for are left.
    Triangles,
    /// The share of the original's triangles that was asked for is left.
    Ratio,
    /// The file is as small as asked for.
    Bytes,
    /// Without its images, which alone are more than asked for, the file is as small as that.
    Images,
    /// The next mesh would be too far from the original for the screen size asked for.
    ScreenSize,
    /// No collapse is left that keeps the topology (or, where it is free, any triangle).
    NoLegalCollapse,
    /// No collapse is left that leaves locked vertices where they are.
    Locks,
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
