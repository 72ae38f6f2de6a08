//! `lookalike extract`: any level of detail of a progressive mesh, without running anything again.

use std::path::PathBuf;

use clap::Args;
use lookalike::progressive::Reader;

use super::{
    compare::write_mesh,
    exit::{Exit, Failure},
    show,
    submit::read_input,
};

/// Flags of `lookalike extract`.
#[derive(Args, Debug)]
pub(crate) struct ExtractArgs {
    /// A progressive mesh, such as `progressive.lkpm`.
    file: PathBuf,
    /// The most triangles the level may have.
    #[arg(long, value_name = "N")]
    triangles: u32,
    /// Where to write it: .glb, .ply or .obj.
    #[arg(long, value_name = "FILE", default_value = "level.glb")]
    out: PathBuf,
}

pub(crate) fn run(args: &ExtractArgs) -> Result<(), Failure> {
    let bytes = read_input(&args.file)?;
    let fault = |e: lookalike::progressive::ProgressiveError| {
        Failure::new(Exit::Failed, format!("{}: {e}", args.file.display()))
    };
    let reader = Reader::open(&bytes).map_err(fault)?;
    let mesh = reader.extract(args.triangles).map_err(fault)?;
    write_mesh(&args.out, &mesh)?;
    let header = reader.header();
    show::print(&format!(
        "{}: {} triangles (the file holds {} to {})\n",
        args.out.display(),
        mesh.faces.len(),
        header.n_base_faces,
        header.n_faces
    ));
    Ok(())
}
