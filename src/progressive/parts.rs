//! The parts of triangles and the tree that they come from, in the file.
//!
//! ```text
//! shape        JSON of the tree
//! ids          runs of triangles of one part, in the order of the ids of the original mesh: varint
//!              part, varint number of triangles. None where all are of part 0
//! ```
//!
//! A triangle never changes its part and the halves of a split have the part of the whole, so that
//! no record tells of parts. The section follows the images: a prefix of the file has it.

use std::sync::Arc;

use super::{
    bytes::put_varint,
    error::{Damage, ProgressiveError},
    replay::Replay,
    section::{Section, Streams},
};
use crate::mesh::Tree;

const PLACE: &str = "parts";

/// Appends the section to `body`; `None` for a mesh without parts and tree. `replay` may be at any
/// level.
pub(super) fn put_parts(
    replay: &Replay,
    body: &mut Vec<u8>,
) -> Result<Option<Section>, ProgressiveError> {
    if replay.face_parts.is_empty() && *replay.tree == Tree::default() {
        return Ok(None);
    }
    let failed = |e: serde_json::Error| ProgressiveError::Compression { problem: e.to_string() };
    let shape = serde_json::to_vec(&*replay.tree).map_err(failed)?;
    let mut streams = Streams { shape, ..Streams::default() };
    for run in replay.face_parts.chunk_by(|a, b| a == b) {
        put_varint(&mut streams.ids, run[0].into());
        put_varint(&mut streams.ids, run.len() as u64);
    }
    streams.pack(body).map(Some)
}

/// Reads what [`put_parts`] put: the tree, and the part of each of the `n_faces` triangles.
pub(super) fn take_parts(
    section: Option<&Section>,
    body: &[u8],
    n_faces: usize,
) -> Result<(Arc<Tree>, Vec<u32>), ProgressiveError> {
    let Some(section) = section else { return Ok(Default::default()) };
    let streams = Streams::unpack(section, body, PLACE)?;
    let tree: Tree = serde_json::from_slice(&streams.shape).map_err(|e| {
        ProgressiveError::Damaged { place: PLACE.to_owned(), problem: e.to_string() }
    })?;
    let mut face_parts = Vec::new();
    let mut ids = streams.cursors().ids;
    while ids.n_left() > 0 {
        let (part, n) = ids.varint().and_then(|part| Ok((part, ids.varint()?))).map_err(at)?;
        if part >= tree.parts.len().max(1) as u64 {
            return Err(at(Damage("a triangle names a part that is not there")));
        }
        if n > (n_faces - face_parts.len()) as u64 {
            return Err(at(Damage("more parts than triangles")));
        }
        face_parts.resize(face_parts.len() + n as usize, part as u32);
    }
    match face_parts.len() {
        0 => {}
        n if n == n_faces => {}
        _ => return Err(at(Damage("fewer parts than triangles"))),
    }
    Ok((Arc::new(tree), face_parts))
}

fn at(damage: Damage) -> ProgressiveError {
    damage.at(PLACE)
}
