//! Files that a command writes, by their extensions: what cannot be written is refused before the work.

use std::path::{Path, PathBuf};

use clap::builder::{PathBufValueParser, TypedValueParser};
use lookalike::{io, mesh::Mesh};

use super::exit::{Exit, Failure};

/// Formats of meshes, by extension.
const FORMATS: [(&str, Format); 3] =
    [("glb", Format::Glb), ("ply", Format::Ply), ("obj", Format::Obj)];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Glb,
    Ply,
    Obj,
}

/// A file for a mesh.
#[derive(Clone, Debug)]
pub(crate) struct MeshFile {
    pub(crate) path: PathBuf,
    format: Format,
}

impl MeshFile {
    fn new(path: PathBuf) -> Result<Self, String> {
        let row = FORMATS.iter().find(|(extension, _)| has_extension(&path, extension));
        let (_, format) = row.ok_or("use the extension .glb, .ply or .obj")?;
        Ok(Self { format: *format, path })
    }

    /// Refuses options that would have no effect.
    pub(crate) fn check(&self, options: io::GlbOptions) -> Result<(), Failure> {
        if self.format == Format::Glb || options == io::GlbOptions::default() {
            return Ok(());
        }
        let text = format!(
            "{}: --quantize and --compress are for .glb: leave them out, or use that extension",
            self.path.display()
        );
        Err(Failure::new(Exit::Usage, text))
    }

    /// Writes the mesh.
    pub(crate) fn write(&self, mesh: &Mesh, options: io::GlbOptions) -> Result<(), Failure> {
        let bytes = match self.format {
            Format::Glb => io::write_glb_with(mesh, options),
            Format::Ply => io::write_ply(mesh, io::PlyPositions::Double),
            Format::Obj => io::write_obj(mesh),
        };
        let fault = |e: io::IoError| Failure::new(Exit::Failed, e.to_string());
        write_file(&self.path, &bytes.map_err(fault)?)
    }
}

/// Reads the name of a file for a mesh.
pub(crate) fn mesh_file() -> impl TypedValueParser<Value = MeshFile> {
    PathBufValueParser::new().try_map(MeshFile::new)
}

/// Reads the name of a file for a picture.
pub(crate) fn png_file() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        if has_extension(&path, "png") { Ok(path) } else { Err("use the extension .png") }
    })
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// Writes a result.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| {
        let text = format!("{} cannot be written ({e}): choose another place", path.display());
        Failure::new(Exit::Failed, text)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extensions_name_formats_in_any_case() {
        for (name, format) in
            [("a.glb", Format::Glb), ("a.PLY", Format::Ply), ("a.b/c.Obj", Format::Obj)]
        {
            let file = MeshFile::new(name.into());
            assert!(file.is_ok_and(|file| file.format == format), "{name}");
        }
        for name in ["a.stl", "a.fbx", "glb", ".glb", "a.glb/b"] {
            assert!(MeshFile::new(name.into()).is_err(), "{name}");
        }
    }

    #[test]
    fn options_of_glb_are_for_glb() {
        let compressed = io::GlbOptions { compress: true, ..io::GlbOptions::default() };
        for (name, is_fine) in [("a.glb", true), ("a.ply", false), ("a.obj", false)] {
            let file = MeshFile::new(name.into()).unwrap();
            assert_eq!(file.check(compressed).is_ok(), is_fine, "{name}");
            assert!(file.check(io::GlbOptions::default()).is_ok(), "{name}");
        }
    }
}
