//! The progressive mesh: every collapse as a record, and any level extracted from the records.
//!
//! - [`Replay`] is a mesh on plain arrays to which records are applied (fine to coarse) and from
//!   which they are undone (coarse to fine), exactly.
//! - [`encode_collapse`] and [`decode_collapse`] turn one record into bytes that stand alone, for
//!   streams (`record`).
//! - [`Writer`] takes the original mesh and the records as they happen, and makes the file
//!   `progressive.lkpm`: the coarsest mesh and the records from coarse to fine, each coded
//!   relative to the mesh it refines (`linked`), so that a prefix of the file gives every coarse
//!   level. [`Reader`] extracts levels and iterates both ways.
//!
//! Invariants:
//! 1. what comes out is bit-equal to what went in: positions, wedge values, ids, order of faces;
//! 2. with all records undone the mesh equals the original;
//! 3. decoding is total: any bytes give a result or an error, and nothing is allocated by a count
//!    that [`ReadLimits`] or the bytes that are there do not bear out;
//! 4. the same mesh and records give the same bytes.
//!
//! Based on progressive meshes (Hoppe, "Progressive Meshes", 1996, and the record of `PMesh.h` in
//! his Mesh-processing-library); differs in keeping the ids of the original mesh and full
//! precision, so that a level is the very mesh that the simplifier had.
//!
//! Knows nothing of how collapses are chosen, of files on disk, pictures or jobs.

mod base;
mod bytes;
mod coder;
mod error;
mod header;
mod linked;
mod log;
mod reader;
mod record;
mod replay;
mod rings;
mod section;
mod writer;

#[cfg(test)]
mod tests;

pub use error::ProgressiveError;
pub use header::{Block, Header, Layer, Level};
pub use reader::{CoarseToFine, FineToCoarse, ReadLimits, Reader};
pub use record::{decode_collapse, encode_collapse};
pub use replay::Replay;
pub use section::Section;
pub use writer::Writer;
