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
    triangles: usize,
    /// Where to write it: .glb, .ply or .obj.
    #[arg(long, value_name = "FILE", default_value = "level.glb")]
    out: PathBuf,
}

pub(crate) fn run(args: &ExtractArgs) -> Result<(), Failure> {
    let bytes = read_input(&args.file)?;
    let fault = |e: lookalike::progressive::CodecError| {
        Failure::new(Exit::Failed, format!("{}: {e}", args.file.display()))
    };
    let reader = Reader::open(&bytes).map_err(fault)?;
    let mesh = reader.extract(args.triangles).map_err(fault)?;
    write_mesh(&args.out, &mesh)?;
    let (least, most) = reader.face_range();
    show::print(&format!(
        "{}: {} triangles (the file holds {least} to {most})\n",
        args.out.display(),
        mesh.faces.len()
    ));
    Ok(())
}
