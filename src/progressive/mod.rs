//! The progressive mesh: every edit as a record, and any level extracted from the records.
//!
//! Simplification is a chain of collapses from the original to the coarsest mesh. Some meshes of
//! the chain are *levels* with names. A level may go on in a branch of its own: edits of any kind
//! (`mesh::Edit`), from the mesh that the collapses left, with ids of that mesh, to the final mesh
//! of the level. No edit of one level touches another level or the chain.
//!
//! - [`Replay`] is a mesh on plain arrays to which records are applied and from which they are
//!   undone, exactly: collapses (`replay`) and other edits (`replay_edits`).
//! - [`encode_edit`] and [`decode_edit`] turn one record into bytes that stand alone, for streams
//!   (`edits`; collapses `record`, also by themselves as [`encode_collapse`]).
//! - [`Writer`] takes the original mesh and the records as they happen, and makes the file
//!   `progressive.lkpm`: the coarsest mesh, the collapses from coarse to fine, each coded relative
//!   to the mesh it refines (`linked`), so that a prefix of the file gives every coarse level by
//!   collapses alone; then the edits of levels, each coded relative to the mesh it changes
//!   (`linked_edits`). [`Reader`] extracts levels and iterates both ways.
//!
//! A mesh that another tool simplified is recorded as a chain without collapses: the original,
//! marked as a level, and its edits.
//!
//! Invariants:
//! 1. what comes out is bit-equal to what went in: positions, wedge values, ids, order of faces;
//! 2. with all records undone the mesh equals the original, with all edits of a level undone the
//!    mesh that the collapses left; after an edit a mesh holds what its faces use and no more;
//! 3. decoding is total: any bytes give a result or an error, and nothing is allocated by a count
//!    that [`ReadLimits`] or the bytes that are there do not bear out;
//! 4. the same mesh and records give the same bytes.
//!
//! Materials, textures, images (`images`) and the tree of parts (`parts`) are the same at every
//! level; decoded images are not stored.
//!
//! Based on progressive meshes (Hoppe, "Progressive Meshes", 1996, and the record of `PMesh.h` in
//! his Mesh-processing-library); differs in keeping the ids of the original mesh and full
//! precision, so that a level is the very mesh that the simplifier had.
//!
//! Knows nothing of how edits are chosen, of files on disk, pictures or jobs.

mod base;
mod bytes;
mod coder;
mod edits;
mod error;
mod header;
mod images;
mod linked;
mod linked_edits;
mod log;
mod parts;
mod reader;
mod reader_edits;
mod record;
mod replay;
mod replay_edits;
mod rings;
mod section;
mod writer;
mod writer_edits;

#[cfg(test)]
mod tests;

pub use edits::{decode_edit, encode_edit};
pub use error::ProgressiveError;
pub use header::{Block, Header, Layer, Level, LevelEdits};
pub use reader::{CoarseToFine, FineToCoarse, ReadLimits, Reader};
pub use reader_edits::{EditsBackward, EditsForward};
pub use record::{decode_collapse, encode_collapse};
pub use replay::Replay;
pub use section::Section;
pub use writer::Writer;
