//! How large a file may be.

/// What a reader refuses before it allocates. Counts are those of the whole file, instances
/// placed and polygons split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bytes of the file.
    pub max_bytes: u64,
    /// Triangles.
    pub max_triangles: u64,
    /// Vertices as the file stores them, before coincident points are joined.
    pub max_vertices: u64,
    /// Objects (`{`) in the JSON of a glTF: a few bytes of text become hundreds in memory.
    pub max_json_objects: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_bytes: 4 << 30,
            max_triangles: 20_000_000,
            max_vertices: 60_000_000,
            max_json_objects: 500_000,
        }
    }
}
