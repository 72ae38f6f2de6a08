//! Moments between one durable step and the next, by name: where crashes are rehearsed.
//!
//! In the program [`pass`] is nothing. In the tests of this crate it ends the process, where the rehearsal
//! (`tests/crashes.rs`) wants that. What is `Written` is in a transaction that is about to be committed.

/// A moment at which a crash must leave what can be gone on with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Point {
    UploadStaged,
    UploadNamed,
    UploadListed,
    UploadOwned,
    CreateWritten,
    CreateCommitted,
    ClaimWritten,
    ClaimCommitted,
    SegmentStored,
    AppendWritten,
    AppendCommitted,
    ArtifactStaged,
    ArtifactNamed,
    ArtifactWritten,
    ArtifactCommitted,
    CompleteWritten,
    CompleteCommitted,
    DeleteWritten,
    DeleteCommitted,
    ResultsForgotten,
    ResultsRemoved,
    MeshesForgotten,
}

/// This point is reached.
#[cfg(not(test))]
#[inline(always)]
pub(super) const fn pass(_: Point) {}

#[cfg(test)]
pub(super) use super::tests::crashes::pass;
