//! `lookalike compare`: the papers' off-line evaluation of two files, in this process or on a server.

use std::path::{Path, PathBuf};

use clap::Args;
use lookalike::{
    compare::{self, Comparison, SheetParams},
    io,
    jobs::spec::{Evaluate, Input, Metric, Shading, Spec},
    mesh::Mesh,
    metric::is_grey,
    service::{convert, proto::v1},
    worker::evaluating,
};
use uuid::Uuid;

use super::{
    exit::{Exit, Failure},
    job_args::word,
    out_file::{png_file, write_file},
    remote::{Remote, ServerArgs},
    show,
    submit::{create, file_name, read_input, wait},
    watch::verdict,
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
    /// Compare on the server, which --server names, instead of in this process: one job a mesh.
    #[arg(long)]
    remote: bool,
    /// One JSON object instead of text; of several meshes, an array of them.
    #[arg(long)]
    json: bool,
    /// Also draw a contact sheet: original, simplified, difference; several side by side. A .png file.
    #[arg(long, value_name = "PNG", value_parser = png_file())]
    sheet: Option<PathBuf>,
    /// Flat or smooth (Gouraud) shading.
    #[arg(long, default_value = "flat", value_parser = word::<Shading>(&["flat", "smooth"]))]
    shading: Shading,
    /// Draw material and vertex colours instead of white.
    #[arg(long)]
    colours: bool,
    /// Leave out back faces of single-sided materials, as glTF viewers do.
    #[arg(long)]
    hide_back_faces: bool,
    /// In smooth shading, draw the simplified mesh with the normals of its file.
    #[arg(long)]
    stored_normals: bool,
    /// By what pictures are compared: luminance; red, green and blue (with --colours); or luminance that counts less
    /// where the original is busy.
    #[arg(
        long,
        default_value = "luminance",
        value_parser = word::<Metric>(&["luminance", "rgb", "perceptual"])
    )]
    metric: Metric,
    /// Leave the distance between the surfaces out.
    #[arg(long)]
    no_distance: bool,
    #[command(flatten)]
    server: ServerArgs,
}

impl CompareArgs {
    fn evaluate(&self) -> Evaluate {
        Evaluate {
            shading: self.shading,
            colours: self.colours,
            hide_back_faces: self.hide_back_faces,
            stored_normals: self.stored_normals,
            distance: !self.no_distance,
            metric: self.metric,
        }
    }

    /// Says what a person should know before they believe the figures.
    fn remark(&self, original: &Mesh, simplified: &[Mesh]) {
        if !self.colours && !is_grey(original) {
            eprintln!("colours and textures are not compared: --colours does that");
        }
        for (path, mesh) in self.simplified.iter().zip(simplified) {
            for (_, text) in compare::mismatches(original, mesh) {
                eprintln!("{}: {text}", path.display());
            }
        }
    }
}

pub(crate) async fn run(args: CompareArgs) -> Result<(), Failure> {
    let (comparisons, sheet) = if args.remote { there(&args).await? } else { here(&args)? };
    if args.json {
        let json = match comparisons.as_slice() {
            [one] => compare::json(one),
            all => compare::json(&all),
        };
        show::print(&json.map_err(|e| Failure::new(Exit::Failed, e.to_string()))?);
    } else {
        for (path, comparison) in args.simplified.iter().zip(&comparisons) {
            if comparisons.len() > 1 {
                show::print(&format!("{}\n", path.display()));
            }
            show::print(&compare::report_text(comparison));
        }
    }
    match args.sheet.as_deref().zip(sheet) {
        Some((path, png)) => write_file(path, &png),
        None => Ok(()),
    }
}

/// A comparison for each mesh, and a contact sheet where one is asked for.
type Compared = (Vec<Comparison>, Option<Vec<u8>>);

fn here(args: &CompareArgs) -> Result<Compared, Failure> {
    let original = read_mesh(&args.original)?;
    let simplified: Vec<Mesh> =
        args.simplified.iter().map(|path| read_mesh(path)).collect::<Result<_, _>>()?;
    args.remark(&original, &simplified);
    let params = evaluating::params(&args.evaluate());
    let reference = compare::Reference::new(&original, &params);
    let comparisons = simplified.iter().map(|mesh| reference.compare(mesh)).collect();
    let draws = args.sheet.is_some();
    Ok((comparisons, draws.then(|| sheet(&original, &simplified, &params))))
}

/// One mesh seen from many sides, or several from two.
fn sheet(original: &Mesh, simplified: &[Mesh], params: &compare::Params) -> Vec<u8> {
    let like = |sheet: SheetParams| {
        sheet.of_surface(&params.look).with_stored_normals(params.stored_normals)
    };
    match simplified {
        [one] => compare::sheet(original, one, &like(SheetParams::default())),
        several => {
            let chain: Vec<&Mesh> = several.iter().collect();
            compare::sheet_multi(original, &chain, &like(SheetParams::chain(compare::Axis::Y)))
        }
    }
}

/// The same on a server, where each mesh is a job of its own.
async fn there(args: &CompareArgs) -> Result<Compared, Failure> {
    if args.simplified.len() > 1 && args.sheet.is_some() {
        let text = "--sheet: with --remote there is a sheet of one mesh alone: name one, or leave --remote out";
        return Err(Failure::new(Exit::Usage, text));
    }
    let original = read_input(&args.original)?;
    let simplified: Vec<_> =
        args.simplified.iter().map(|path| read_input(path)).collect::<Result<_, _>>()?;
    let remote = Remote::connect(&args.server).await?;
    let mesh = remote.upload(original.into()).await?;
    let mut compared = Compared::default();
    for (path, bytes) in args.simplified.iter().zip(simplified) {
        let uploaded = convert::mesh_hash(&remote.upload(bytes.into()).await?);
        let input = Input { mesh: uploaded, file_name: file_name(path) };
        let wanted = v1::CreateJobRequest {
            request_id: Uuid::new_v4().to_string(),
            mesh: mesh.clone(),
            file_name: file_name(&args.original),
            spec: Some(convert::spec_to_wire(&Spec::evaluating(input, args.evaluate()))),
            ..v1::CreateJobRequest::default()
        };
        let job = create(&remote, wanted).await?.name;
        wait(&remote, &job).await?;
        verdict(&remote, &job).await?;
        let figures = serde_json::from_slice(&remote.file(&job, "comparison.json").await?);
        let figures = figures.map_err(|e| {
            let text = format!("comparison.json of {job}: {e}: run the same version as the server");
            Failure::new(Exit::Failed, text)
        });
        compared.0.push(figures?);
        if args.sheet.is_some() {
            compared.1 = Some(remote.file(&job, "contact-0.png").await?);
        }
    }
    Ok(compared)
}

/// Reads a model file into a mesh.
pub(crate) fn read_mesh(path: &Path) -> Result<Mesh, Failure> {
    let bytes = read_input(path)?;
    let ingest = io::read(&file_name(path), &bytes, &io::Limits::default());
    ingest.map(|i| i.mesh).map_err(|e| Failure::new(Exit::Failed, e.to_string()))
}
