//! `lookalike sample`: a model of the project's own to try things on.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use lookalike::{
    compare::{sample_mesh, textured_torus},
    io::GlbOptions,
};

use super::{compare::write_mesh, exit::Failure, show};

/// Flags of `lookalike sample`.
#[derive(Args, Debug)]
pub(crate) struct SampleArgs {
    /// Where to write it: .glb, .ply or .obj.
    out: PathBuf,
    /// A jellyfish of four colours, or a torus with numbers and lines for a texture.
    #[arg(long, value_enum, default_value_t = Model::Jellyfish)]
    model: Model,
    /// About how many triangles the jellyfish has.
    #[arg(long, default_value_t = 80_000)]
    triangles: usize,
    /// Which jellyfish.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Model {
    Jellyfish,
    Torus,
}

pub(crate) fn run(args: &SampleArgs) -> Result<(), Failure> {
    let mesh = match args.model {
        Model::Jellyfish => sample_mesh(args.seed, args.triangles),
        Model::Torus => textured_torus(),
    };
    write_mesh(&args.out, &mesh, GlbOptions::default())?;
    show::print(&format!("{}: {} triangles\n", args.out.display(), mesh.faces.len()));
    Ok(())
}
