//! What can be wrong with a mesh: with one that comes in, and with one that was edited.

use thiserror::Error;

/// Most triangles a mesh may have: corner numbers and list pools are 32 bits wide.
pub const MAX_FACES: usize = 1 << 29;

/// A fault of an input mesh.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum MeshError {
    /// Ids would not fit 32 bits.
    #[error(
        "{faces} triangles and {vertices} vertices: at most {MAX_FACES} of each; split the model"
    )]
    TooLarge {
        /// Triangles given.
        faces: usize,
        /// Vertices given.
        vertices: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("vertex {vertex} is not finite; remove it or repair the file")]
    NotFinite {
        /// Index of the vertex.
        vertex: usize,
    },
    /// A triangle names a vertex that does not exist.
    #[error("triangle {face} names vertex {vertex} of {n_vertices}; repair the file's indices")]
    VertexOutOfRange {
        /// Index of the triangle.
        face: usize,
        /// The vertex it names.
        vertex: u32,
        /// Vertices there are.
        n_vertices: usize,
    },
    /// A triangle names one vertex twice.
    #[error("triangle {face} names vertex {vertex} twice; drop degenerate triangles first")]
    RepeatedVertex {
        /// Index of the triangle.
        face: usize,
        /// The vertex it repeats.
        vertex: u32,
    },
    /// A corner names a wedge that does not exist.
    #[error("triangle {face} names wedge {wedge} of {n_wedges}; repair the attribute indices")]
    WedgeOutOfRange {
        /// Index of the triangle.
        face: usize,
        /// The wedge it names.
        wedge: u32,
        /// Wedges there are.
        n_wedges: usize,
    },
    /// A triangle names a part that does not exist.
    #[error("triangle {face} names part {part} of {n_parts}; repair the tree of parts")]
    PartOutOfRange {
        /// Index of the triangle.
        face: usize,
        /// The part it names.
        part: u32,
        /// Parts there are.
        n_parts: usize,
    },
    /// An array is not as long as the array it goes with.
    #[error("{what} has {len} entries where {expected} were expected")]
    WrongLength {
        /// Which array.
        what: &'static str,
        /// Its length.
        len: usize,
        /// The length it should have.
        expected: usize,
    },
}

/// An invariant of an edited mesh that does not hold: a defect of this program.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum Violation {
    /// Invariant 1: the mesh itself.
    #[error("invariant 1: {0}")]
    Mesh(#[from] MeshError),
    /// Invariant 2: incidence lists name exactly the living triangles at a vertex.
    #[error("invariant 2: the list of vertex {vertex} does not name its living triangles")]
    Incidence {
        /// The vertex.
        vertex: usize,
    },
    /// Invariant 3: counts of living triangles and used vertices.
    #[error("invariant 3: {what} counted {actual}, kept {kept}")]
    Count {
        /// What is counted.
        what: &'static str,
        /// What there is.
        actual: usize,
        /// What the counter says.
        kept: usize,
    },
    /// Invariant 4: the cached area normal of a living triangle.
    #[error("invariant 4: the area normal of triangle {face} is out of date")]
    Normal {
        /// The triangle.
        face: usize,
    },
    /// Invariant 6: what is kept beside the list of a vertex.
    #[error("invariant 6: the position or balance beside vertex {vertex} is out of date")]
    Site {
        /// The vertex.
        vertex: usize,
    },
    /// Invariant 5: the pool of lists.
    #[error("invariant 5: lists overlap, are out of order or miscounted")]
    Pool,
    /// An edge table does not agree with its mesh.
    #[error("edge {edge}: {what}")]
    Edge {
        /// The edge slot.
        edge: usize,
        /// What is wrong with it.
        what: &'static str,
    },
}
