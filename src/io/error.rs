//! What can be wrong with a file, always with its name, the place in it and what to do.

/// Why a file could not be read or a mesh not be written.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum IoError {
    /// No bytes at all.
    #[error(
        "{file}: the file is empty; send the bytes of a GLB, glTF, PLY, OBJ or STL model, or a ZIP of one"
    )]
    Empty {
        /// Name of the file.
        file: String,
    },
    /// Neither extension nor content say what it is.
    #[error(
        "{file}: {problem}; send a GLB, glTF, PLY, OBJ or STL file with its \
             usual extension, or a ZIP of one"
    )]
    UnknownFormat {
        /// Name of the file.
        file: String,
        /// What was found instead.
        problem: String,
    },
    /// The file ends before what it announces.
    #[error(
        "{file}: {place}: {need} bytes are needed but {have} are there; the file was cut short, \
         export or fetch it again"
    )]
    Truncated {
        /// Name of the file.
        file: String,
        /// Where in the file.
        place: String,
        /// Bytes needed.
        need: u64,
        /// Bytes there.
        have: u64,
    },
    /// The file breaks the rules of its format.
    #[error("{file}: {place}: {problem}; {remedy}")]
    Malformed {
        /// Name of the file.
        file: String,
        /// Where in the file.
        place: String,
        /// What is wrong.
        problem: String,
        /// What to do.
        remedy: &'static str,
    },
    /// A position is NaN or infinite.
    #[error(
        "{file}: {place}: vertex {vertex} is at ({x}, {y}, {z}), which is not finite; \
         repair or remove it and export again"
    )]
    NonFinite {
        /// Name of the file.
        file: String,
        /// Primitive, element or line.
        place: String,
        /// Index of the vertex in that place.
        vertex: u64,
        /// First coordinate.
        x: f64,
        /// Second coordinate.
        y: f64,
        /// Third coordinate.
        z: f64,
    },
    /// A reference to something that is not there.
    #[error(
        "{file}: {place}: index {index} is out of range, there are {len} {what}; \
         the file is damaged, export it again"
    )]
    IndexOutOfRange {
        /// Name of the file.
        file: String,
        /// Where in the file.
        place: String,
        /// What is indexed, in the plural.
        what: &'static str,
        /// The index found.
        index: i64,
        /// How many there are.
        len: u64,
    },
    /// Legal, but this build cannot read it.
    #[error("{file}: {feature} is not supported by this build; {remedy}")]
    Unsupported {
        /// Name of the file.
        file: String,
        /// What is needed.
        feature: String,
        /// What to do.
        remedy: &'static str,
    },
    /// Over one of the [`super::Limits`].
    #[error(
        "{file}: {place}: {count} {what} are over the limit of {limit}; \
         split or reduce the model, or raise the limit"
    )]
    TooLarge {
        /// Name of the file.
        file: String,
        /// Where in the file.
        place: String,
        /// What is counted, in the plural.
        what: &'static str,
        /// How many there are, or at least this many.
        count: u64,
        /// How many may be.
        limit: u64,
    },
    /// Nothing to simplify.
    #[error("{file}: no triangles: {reason}; send a model with a triangulated surface")]
    NoTriangles {
        /// Name of the file.
        file: String,
        /// Why there are none.
        reason: String,
    },
    /// A mesh that breaks its invariants, or is too large for the format.
    #[error("cannot write {format}: {problem}")]
    Unwritable {
        /// The format.
        format: &'static str,
        /// What is wrong.
        problem: String,
    },
}

impl IoError {
    /// Stable upper-snake-case code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Empty { .. } => "EMPTY_FILE",
            Self::UnknownFormat { .. } => "UNKNOWN_FORMAT",
            Self::Truncated { .. } => "TRUNCATED_FILE",
            Self::Malformed { .. } => "MALFORMED_FILE",
            Self::NonFinite { .. } => "NON_FINITE_POSITION",
            Self::IndexOutOfRange { .. } => "INDEX_OUT_OF_RANGE",
            Self::Unsupported { .. } => "UNSUPPORTED_FEATURE",
            Self::TooLarge { .. } => "OVER_LIMIT",
            Self::NoTriangles { .. } => "NO_TRIANGLES",
            Self::Unwritable { .. } => "UNWRITABLE_MESH",
        }
    }
}
