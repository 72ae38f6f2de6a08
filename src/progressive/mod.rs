//! Progressive meshes: the record of every collapse, a file of them, and any level extracted.
//!
//! A job's collapses, in order, lead from the original to the coarsest level; undone in reverse they
//! lead back (Hoppe 1996: vertex splits). Both ways are exact: positions bit-equal, triangles and
//! wedges with the same ids.
//!
//! Knows nothing of why an edge was collapsed.

mod bytes;
mod codec;
mod file;
mod replay;
#[cfg(test)]
mod tests;

pub use bytes::CodecError;
pub use codec::{decode_records, encode_records};
pub use file::{LevelEntry, Reader, write};
pub use replay::Level;
