//! `lookalike extract`: any level of detail of a progressive mesh, without running anything again.

use std::path::PathBuf;

use clap::Args;
use lookalike::{
    mesh::Mesh,
    progressive::{Header, ProgressiveError, Reader},
};

use super::{
    exit::{Exit, Failure},
    out_file::{MeshFile, mesh_file},
    output_args::OutputArgs,
    show,
    submit::read_input,
};

/// Flags of `lookalike extract`.
#[derive(Args, Debug)]
pub(crate) struct ExtractArgs {
    /// A progressive mesh, such as `progressive.lkpm`.
    file: PathBuf,
    /// The most triangles the level may have.
    #[arg(long, value_name = "N", conflicts_with_all = ["level", "list"])]
    triangles: Option<u32>,
    /// The level of this name, such as `lod-0`.
    #[arg(long, value_name = "NAME", conflicts_with = "list")]
    level: Option<String>,
    /// By collapses alone, even where a level was optimized after them.
    #[arg(long, conflicts_with = "list")]
    plain: bool,
    /// List the levels that have names.
    #[arg(long)]
    list: bool,
    /// Where to write it: .glb, .ply or .obj.
    #[arg(long, value_name = "FILE", default_value = "level.glb", value_parser = mesh_file())]
    out: MeshFile,
    #[command(flatten)]
    output: OutputArgs,
}

pub(crate) fn run(args: &ExtractArgs) -> Result<(), Failure> {
    args.out.check(args.output.glb_options())?;
    let bytes = read_input(&args.file)?;
    let fault =
        |e: ProgressiveError| Failure::new(Exit::Failed, format!("{}: {e}", args.file.display()));
    let reader = Reader::open(&bytes).map_err(fault)?;
    if args.list {
        show::print(&table(reader.header()));
        return Ok(());
    }
    let Some((mesh, what)) = extract(args, &reader).map_err(fault)? else {
        let text = format!(
            "{}: which level? Give --triangles N, or --level NAME of these:\n{}",
            args.file.display(),
            table(reader.header())
        );
        return Err(Failure::new(Exit::Usage, text));
    };
    args.out.write(&mesh, args.output.glb_options())?;
    let (out, n) = (args.out.path.display(), mesh.faces.len());
    show::print(&format!("{out}: {n} triangles, {what}\n"));
    Ok(())
}

/// The mesh asked for and what it is; `None` when nothing is asked for.
fn extract(
    args: &ExtractArgs,
    reader: &Reader<'_>,
) -> Result<Option<(Mesh, String)>, ProgressiveError> {
    let header = reader.header();
    let chain =
        format!("by collapses (the file holds {} to {})", header.n_base_faces, header.n_faces);
    let optimized =
        |name: &str, n_edits: u32| format!("level '{name}', optimized by {n_edits} edits");
    if let Some(name) = &args.level {
        let n_edits = reader.level(name)?.n_edits();
        return Ok(Some(if args.plain || n_edits == 0 {
            let mesh = reader.extract_level_before_edits(name)?;
            (mesh, format!("level '{name}', by collapses"))
        } else {
            (reader.extract_level(name)?, optimized(name, n_edits))
        }));
    }
    let Some(target) = args.triangles else { return Ok(None) };
    if args.plain {
        return Ok(Some((reader.extract(target)?, chain)));
    }
    let (mesh, level) = reader.extract_nearest(target)?;
    let what = level.map_or(chain, |level| {
        format!("{} (--plain gives it without them)", optimized(&level.name, level.n_edits()))
    });
    Ok(Some((mesh, what)))
}

/// The levels with names, one a line.
fn table(header: &Header) -> String {
    let row = |name: &str, cells: [&str; 4]| {
        let [faces, vertices, record, edits] = cells;
        format!("{name:<12} {faces:>10} {vertices:>10} {record:>10} {edits:>10}\n")
    };
    let mut text = row("level", ["triangles", "vertices", "record", "edits"]);
    for level in &header.levels {
        let numbers =
            [level.n_final_faces(), level.n_final_vertices(), level.record, level.n_edits()];
        let cells = numbers.map(|n| n.to_string());
        text += &row(&level.name, cells.each_ref().map(String::as_str));
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use lookalike::{
        io,
        mesh::{EditMesh, VertexId, shapes},
        progressive::Writer,
    };

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: ExtractArgs,
    }

    /// An octahedron, collapsed to 6 triangles ("lod-0", with an edit), then to 4 ("lod-1").
    fn file() -> Vec<u8> {
        let original = shapes::octahedron();
        let mut mesh = EditMesh::new(original.clone()).unwrap();
        let mut writer = Writer::new(&original).unwrap();
        let at = mesh.position(VertexId(0));
        writer.push(&mesh.collapse(VertexId(0), VertexId(1), at)).unwrap();
        writer.mark_level("lod-0");
        let level = mesh.snapshot();
        writer.push(&mesh.collapse(VertexId(0), VertexId(2), at)).unwrap();
        writer.mark_level("lod-1");
        writer.begin_edits("lod-0", &level).unwrap();
        let mut edited = EditMesh::new(level).unwrap();
        writer.push_edit(&edited.displace(VertexId(0), glam::DVec3::splat(9.0))).unwrap();
        writer.finish().unwrap()
    }

    /// Runs with these flags; returns the triangles written and whether the edit is among them.
    fn check(flags: &[&str]) -> Result<(usize, bool), Failure> {
        let dir = tempfile::tempdir().unwrap();
        let [input, out] = ["a.lkpm", "a.ply"].map(|n| dir.path().join(n));
        std::fs::write(&input, file()).unwrap();
        let paths = [input.to_str().unwrap(), "--out", out.to_str().unwrap()];
        let line = ["extract"].iter().chain(&paths).chain(flags).copied();
        run(&Line::try_parse_from(line).unwrap().args)?;
        let bytes = std::fs::read(&out).unwrap_or_default();
        let ingest = io::read("a.ply", &bytes, &io::Limits::default());
        let mesh = ingest.map(|i| i.mesh).unwrap_or_default();
        Ok((mesh.faces.len(), mesh.positions.contains(&glam::DVec3::splat(9.0))))
    }

    #[test]
    fn levels_are_found_by_size_and_by_name() {
        for (flags, n_faces, is_edited) in [
            (&["--triangles", "8"][..], 8, false),
            (&["--triangles", "7"], 6, true),
            (&["--triangles", "6", "--plain"], 6, false),
            (&["--triangles", "5"], 4, false),
            (&["--level", "lod-0"], 6, true),
            (&["--level", "lod-0", "--plain"], 6, false),
            (&["--level", "lod-1"], 4, false),
        ] {
            let found = check(flags).map_err(|f| f.error.to_string());
            assert_eq!(found, Ok((n_faces, is_edited)), "{flags:?}");
        }
        assert!(check(&["--list"]).is_ok_and(|found| found == (0, false)));
    }

    #[test]
    fn whoever_asks_for_nothing_learns_what_there_is() {
        let failure = check(&[]).unwrap_err();
        assert_eq!(failure.exit, Exit::Usage);
        let text = failure.error.to_string();
        assert!(text.contains("which level?") && text.contains("lod-1"), "{text}");
        let text = check(&["--level", "lod-9"]).unwrap_err().error.to_string();
        assert!(text.ends_with("no level is named 'lod-9'; there are: lod-0, lod-1"), "{text}");
    }

    #[test]
    fn the_table_tells_what_levels_are() {
        let bytes = file();
        let wanted = "\
level         triangles   vertices     record      edits
lod-0                 6          5          1          1
lod-1                 4          4          2          0
";
        assert_eq!(table(Reader::open(&bytes).unwrap().header()), wanted);
    }
}
