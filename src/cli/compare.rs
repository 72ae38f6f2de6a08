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
#[expect(clippy::struct_excessive_bools, reason = "independent flags of a command")]
pub(crate) struct CompareArgs {
    /// The original: .glb, .gltf, .ply, .obj or .stl, or a .zip of one with its materials and images.
    original: PathBuf,
    /// The simplified mesh, or several.
    #[arg(required = true)]
    simplified: Vec<PathBuf>,
    /// One JSON object instead of text; of several meshes, an array of them.
    #[arg(long)]
    json: bool,
    /// Also draw a contact sheet: original, simplified, difference; several side by side.
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
    /// Flat or smooth (Gouraud) shading.
    #[arg(long, value_enum, default_value = "flat")]
    shading: ShadingArg,
    /// Draw material and vertex colours instead of white.
    #[arg(long)]
    colours: bool,
    /// Leave out back faces of single-sided materials, as glTF viewers do.
    #[arg(long)]
    hide_back_faces: bool,
    /// In smooth shading, draw the simplified mesh with the normals of its file.
    #[arg(long)]
    stored_normals: bool,
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
    let original = read_mesh(&args.original)?;
    let simplified: Vec<Mesh> =
        args.simplified.iter().map(|path| read_mesh(path)).collect::<Result<_, _>>()?;
    let look = Look {
        shading: match args.shading {
            ShadingArg::Flat => compare::Shading::Flat,
            ShadingArg::Smooth => compare::Shading::Smooth,
        },
        appearance: if args.colours { Appearance::Coloured } else { Appearance::White },
        hides_back_faces: args.hide_back_faces,
        ..Look::default()
    };
    let surface = (!args.no_distance).then(SurfaceParams::default);
    let stored_normals = args.stored_normals;
    let params = compare::Params { look, surface, stored_normals, ..compare::Params::default() };
    let reference = compare::Reference::new(&original, &params);
    let comparisons: Vec<_> = simplified.iter().map(|mesh| reference.compare(mesh)).collect();
    if args.json {
        let json = match comparisons.as_slice() {
            [one] => serde_json::to_string_pretty(one),
            all => serde_json::to_string_pretty(all),
        };
        let json = json.map_err(|e| Failure::new(Exit::Failed, e.to_string()))?;
        show::print(&format!("{json}\n"));
    } else {
        for (path, comparison) in args.simplified.iter().zip(&comparisons) {
            if comparisons.len() > 1 {
                show::print(&format!("{}\n", path.display()));
            }
            show::print(&compare::report_text(comparison));
        }
    }
    match &args.sheet {
        Some(path) => write_file(path, &sheet(&original, &simplified, look)),
        None => Ok(()),
    }
}

/// One mesh seen from many sides, or several from two.
fn sheet(original: &Mesh, simplified: &[Mesh], look: Look) -> Vec<u8> {
    let with_look = |mut params: SheetParams| {
        (params.look.shading, params.look.appearance) = (look.shading, look.appearance);
        params
    };
    match simplified {
        [one] => compare::sheet(original, one, &with_look(SheetParams::default())),
        several => {
            let chain: Vec<&Mesh> = several.iter().collect();
            let params = SheetParams::chain(compare::Axis::Y);
            compare::sheet_multi(original, &chain, &with_look(params))
        }
    }
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
pub(crate) fn write_mesh(path: &Path, mesh: &Mesh, options: io::GlbOptions) -> Result<(), Failure> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let fault = |e: io::IoError| Failure::new(Exit::Failed, e.to_string());
    let bytes = match extension {
        "ply" => io::write_ply(mesh, io::PlyPositions::Double).map_err(fault)?,
        "obj" => io::write_obj(mesh).map_err(fault)?,
        _ => io::write_glb_with(mesh, options).map_err(fault)?,
    };
    write_file(path, &bytes)
}
