//! `lookalike sample`: a model of the project's own to try things on.

use std::path::PathBuf;

use clap::Args;
use lookalike::compare::sample_mesh;

use super::{compare::write_mesh, exit::Failure, show};

/// Flags of `lookalike sample`.
#[derive(Args, Debug)]
pub(crate) struct SampleArgs {
    /// Where to write it: .glb, .ply or .obj.
    out: PathBuf,
    /// About how many triangles.
    #[arg(long, default_value_t = 80_000)]
    triangles: usize,
    /// Which one.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

pub(crate) fn run(args: &SampleArgs) -> Result<(), Failure> {
    let mesh = sample_mesh(args.seed, args.triangles);
    write_mesh(&args.out, &mesh)?;
    show::print(&format!("{}: {} triangles\n", args.out.display(), mesh.faces.len()));
    Ok(())
}
