//! How large a file may be.

/// What a reader refuses before it allocates. Counts are those of the whole file, instances
/// placed and polygons split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bytes of the file; of an archive also those of all files that are unpacked.
    pub max_bytes: u64,
    /// Files in an archive.
    pub max_archive_entries: u64,
    /// Triangles.
    pub max_triangles: u64,
    /// Vertices as the file stores them, before coincident points are joined.
    pub max_vertices: u64,
    /// Objects (`{`) in the JSON of a glTF: a few bytes of text become hundreds in memory.
    pub max_json_objects: u64,
    /// Values (`,`, `[` and `{`) in the JSON of a glTF: materials are kept word for word.
    pub max_json_values: u64,
    /// Columns or rows of an image that pictures show.
    pub max_image_side: u32,
    /// Pixels of such an image.
    pub max_image_pixels: u64,
    /// Pixels of all such images.
    pub max_all_image_pixels: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_bytes: 4 << 30,
            max_archive_entries: 4096,
            max_triangles: 20_000_000,
            max_vertices: 60_000_000,
            max_json_objects: 500_000,
            max_json_values: 8_000_000,
            max_image_side: 16_384,
            max_image_pixels: 64 << 20,
            max_all_image_pixels: 256 << 20,
        }
    }
}
