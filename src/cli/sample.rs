//! `lookalike sample`: a model of the project's own to try things on.

use clap::{Args, ValueEnum};
use lookalike::{
    compare::{sample_mesh, textured_torus},
    io::GlbOptions,
};

use super::{
    exit::Failure,
    out_file::{MeshFile, mesh_file},
    show,
};

/// Flags of `lookalike sample`.
#[derive(Args, Debug)]
pub(crate) struct SampleArgs {
    /// Where to write it: .glb, .ply or .obj.
    #[arg(value_parser = mesh_file())]
    out: MeshFile,
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
    args.out.write(&mesh, GlbOptions::default())?;
    show::print(&format!("{}: {} triangles\n", args.out.path.display(), mesh.faces.len()));
    Ok(())
}
