//! What can be wrong with records and files.

/// Why a record does not fit, or a file cannot be written or read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ProgressiveError {
    /// Not this format.
    #[error("not a progressive mesh: it does not begin with the signature of a .lkpm file")]
    NotProgressive,
    /// Another version of the format.
    #[error("version {found} of the format; this build reads version {known}, use another build")]
    Version {
        /// The file's version.
        found: u32,
        /// The version that is read.
        known: u32,
    },
    /// The file ends too early.
    #[error("{place}: {need} bytes are needed but {have} are there; fetch the file again")]
    Truncated {
        /// Part of the file.
        place: String,
        /// Bytes needed.
        need: u64,
        /// Bytes there.
        have: u64,
    },
    /// The bytes are not those that were written.
    #[error("{place}: the checksum does not agree; fetch the file again")]
    Checksum {
        /// Part of the file.
        place: String,
    },
    /// The bytes make no sense (with a right checksum: written by something else).
    #[error("{place}: {problem}; the file is damaged")]
    Damaged {
        /// Part of the file or record, counted from the coarsest mesh.
        place: String,
        /// What is wrong.
        problem: String,
    },
    /// Over one of the [`super::ReadLimits`].
    #[error("{count} {what} are over the limit of {limit}; raise the limit to read the file")]
    OverLimit {
        /// What is counted, in the plural.
        what: &'static str,
        /// How many there are.
        count: u64,
        /// How many may be.
        limit: u64,
    },
    /// A record that does not fit the mesh it is applied to.
    #[error("the record does not fit the mesh: {problem}")]
    Misfit {
        /// What does not fit.
        problem: &'static str,
    },
    /// A mesh that breaks its invariants.
    #[error("the mesh cannot be recorded: {problem}")]
    Mesh {
        /// What is wrong.
        problem: &'static str,
    },
    /// Edits of a level at the wrong moment.
    #[error("edits of level '{level}' cannot be recorded: {problem}")]
    Edits {
        /// The level.
        level: String,
        /// What is wrong.
        problem: &'static str,
    },
    /// A level below the coarsest.
    #[error("no level has {target} triangles or fewer: the coarsest has {coarsest}")]
    TooCoarse {
        /// Triangles asked for.
        target: u64,
        /// Triangles of the coarsest level.
        coarsest: u64,
    },
    /// A level by a name that is not there.
    #[error("no level is named '{name}'; there are: {known}")]
    UnknownLevel {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: String,
    },
    /// The compressor failed.
    #[error("compression failed: {problem}")]
    Compression {
        /// What the library says.
        problem: String,
    },
}

/// Bytes that make no sense, before it is known where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Damage(pub(super) &'static str);

impl Damage {
    pub(super) fn at(self, place: impl Into<String>) -> ProgressiveError {
        ProgressiveError::Damaged { place: place.into(), problem: self.0.to_owned() }
    }
}
