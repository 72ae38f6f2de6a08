//! Bytes in, bytes out: GLB, glTF, PLY, OBJ and STL files, alone or in a ZIP archive with the files
//! that they name, become a [`Mesh`] and back.
//!
//! Reading has three steps: a reader turns bytes into a *soup* (patches of indexed triangles with
//! attributes, in world space), [`weld`] joins bit-equal positions into vertices and equal
//! attribute vectors into wedges, [`report`] counts what there is. Images are carried as they are;
//! those that pictures show (base colours) are decoded too ([`picture`]).
//!
//! Invariants:
//! 1. whatever the bytes, a reader returns a mesh or an error that names file, place and remedy;
//! 2. nothing is allocated by a count that a file states before that count is held against the
//!    bytes that are there and against [`Limits`];
//! 3. a mesh that was read obeys the invariants of [`crate::mesh::Mesh`] and has no unreferenced
//!    vertex, wedge or repeated-vertex triangle;
//! 4. the same bytes give the same mesh, and the same mesh gives the same bytes.
//!
//! Of the borrowed parsers only `gltf` (its JSON schema) is used. Its accessor iterators compute
//! `count - 1` and `stride * count` unchecked, so buffers are read here. `ply-rs-bw` keeps each
//! element as an object of its own and loops over elements without properties as often as the
//! header says; `tobj` and `stl_io` report no line, so an error could not name its place, and
//! `stl_io` takes every file that begins with `solid ` for text. The readers here are small.
//! `meshopt` decodes compressed buffer views, after the checks that its assertions would stop the
//! process at, and encodes them. `rawzip` walks archives without allocating, so that what a file
//! states is checked here first.
//!
//! Knows nothing of files on disk, networks, pictures or jobs.

mod archive;
mod error;
mod format;
mod gltf;
mod intern;
mod ktx2;
mod limits;
mod mtl;
mod obj;
mod picture;
mod ply;
mod polygon;
mod report;
mod soup;
mod source;
mod stl;
mod texture_info;
mod weld;
mod write;

#[cfg(test)]
mod tests;

pub use error::IoError;
pub use limits::Limits;
pub use report::{BoundingBox, IngestReport, Note};
pub use write::{
    GlbLevel, GlbOptions, PlyPositions, write_glb, write_glb_with, write_lods, write_obj, write_ply,
};

use crate::mesh::{Marks, Mesh};
use source::Source;

/// A mesh and what was found and done while reading it.
#[derive(Clone, Debug, PartialEq)]
pub struct Ingest {
    /// World space, instances placed, coincident points joined.
    pub mesh: Mesh,
    /// What the file says of single vertices: `_LOCK` and `_WEIGHT`, in PLY `lock` and `weight`.
    pub marks: Marks,
    /// Counts and notes.
    pub report: IngestReport,
}

/// Reads a model. `name` names the file in errors and its extension suggests the format; the
/// content decides (see `format`).
///
/// # Errors
/// [`IoError`] names file, place and remedy; [`IoError::code`] is stable.
pub fn read(name: &str, bytes: &[u8], limits: &Limits) -> Result<Ingest, IoError> {
    let source = Source { file: name, bytes, limits, beside: None };
    source.check_size()?;
    let format = format::detect(&source)?;
    let mut soup = (format.read)(&source)?;
    if !format.has_extension_of(name) {
        soup.notes.add(
            "format_by_content",
            format!("read as {} by its content, whatever its extension", format.name),
        );
    }
    let mut welded = weld::weld(&source, soup)?;
    picture::decode_shown_textures(&mut welded.mesh, limits, &mut welded.notes);
    let report = report::survey(format.name, &mut welded);
    Ok(Ingest { mesh: welded.mesh, marks: welded.marks, report })
}
