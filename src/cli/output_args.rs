//! The flags that say how levels are written.

use clap::Args;
use lookalike::{io::GlbOptions, jobs::spec::Output};

/// How GLB files are written.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct OutputArgs {
    /// Write integers into GLB files: positions and texture coordinates of 16 bits, normals of 8
    /// (KHR_mesh_quantization).
    #[arg(long)]
    quantize: bool,
    /// Compress GLB files (EXT_meshopt_compression); quantizes too.
    #[arg(long)]
    compress: bool,
}

impl OutputArgs {
    /// The same as a part of a specification.
    pub(crate) fn output(self) -> Output {
        Output { quantize: self.quantize, compress: self.compress }
    }

    /// The same for a file that is written here.
    pub(crate) fn glb_options(self) -> GlbOptions {
        GlbOptions { quantize: self.quantize, compress: self.compress }
    }
}
