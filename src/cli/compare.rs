//! `lookalike compare`: the papers' off-line evaluation of two files.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use lookalike::{
    compare::{self, Appearance, Look, SheetParams},
    io,
    mesh::Mesh,
    metric::surface::SurfaceParams,
};

use super::{
    exit::{Exit, Failure},
    show,
    submit::{file_name, read_input},
};

/// Flags of `lookalike compare`.
#[derive(Args, Debug)]
pub(crate) struct CompareArgs {
    /// The original: .glb, .gltf, .ply, .obj or .stl.
    original: PathBuf,
    /// The simplified mesh.
    simplified: PathBuf,
    /// One JSON object instead of text.
    #[arg(long)]
    json: bool,
    /// Also draw a contact sheet: original, simplified, difference.
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
    /// Flat or smooth (Gouraud) shading.
    #[arg(long, value_enum, default_value = "flat")]
    shading: ShadingArg,
    /// Draw material and vertex colours instead of white.
    #[arg(long)]
    colours: bool,
    /// Leave the distance between the surfaces out.
    #[arg(long)]
    no_distance: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ShadingArg {
    Flat,
    Smooth,
}

pub(crate) fn run(args: &CompareArgs) -> Result<(), Failure> {
    let (original, simplified) = (read_mesh(&args.original)?, read_mesh(&args.simplified)?);
    let look = Look {
        shading: match args.shading {
            ShadingArg::Flat => compare::Shading::Flat,
            ShadingArg::Smooth => compare::Shading::Smooth,
        },
        appearance: if args.colours { Appearance::Coloured } else { Appearance::White },
        ..Look::default()
    };
    let surface = (!args.no_distance).then(SurfaceParams::default);
    let params = compare::Params { look, surface, ..compare::Params::default() };
    let comparison = compare::compare(&original, &simplified, &params);
    if args.json {
        let json = serde_json::to_string_pretty(&comparison)
            .map_err(|e| Failure::new(Exit::Failed, e.to_string()))?;
        show::print(&format!("{json}\n"));
    } else {
        show::print(&compare::report_text(&comparison));
    }
    if let Some(path) = &args.sheet {
        let mut sheet_params = SheetParams::default();
        (sheet_params.look.shading, sheet_params.look.appearance) = (look.shading, look.appearance);
        write_file(path, &compare::sheet(&original, &simplified, &sheet_params))?;
    }
    Ok(())
}

/// Reads a model file into a mesh.
pub(crate) fn read_mesh(path: &Path) -> Result<Mesh, Failure> {
    let bytes = read_input(path)?;
    let ingest = io::read(&file_name(path), &bytes, &io::Limits::default());
    ingest.map(|i| i.mesh).map_err(|e| Failure::new(Exit::Failed, e.to_string()))
}

/// Writes a result.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| {
        let text = format!("{} cannot be written ({e}): choose another place", path.display());
        Failure::new(Exit::Failed, text)
    })
}

/// Writes a mesh in the format that the extension names: .ply, .obj, else GLB.
pub(crate) fn write_mesh(path: &Path, mesh: &Mesh) -> Result<(), Failure> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let fault = |e: io::IoError| Failure::new(Exit::Failed, e.to_string());
    let bytes = match extension {
        "ply" => io::write_ply(mesh, io::PlyPositions::Double).map_err(fault)?,
        "obj" => io::write_obj(mesh).map_err(fault)?,
        _ => io::write_glb(mesh).map_err(fault)?,
    };
    write_file(path, &bytes)
}
