//! The part of a specification that is about the files of levels.

use serde::{Deserialize, Serialize};

/// How GLB files of levels are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Output {
    /// Integers instead of singles (KHR_mesh_quantization).
    pub quantize: bool,
    /// Compressed (EXT_meshopt_compression), and quantized.
    pub compress: bool,
}

impl Output {
    /// Whether files are written as they are by default.
    pub fn is_plain(&self) -> bool {
        *self == Self::default()
    }
}
