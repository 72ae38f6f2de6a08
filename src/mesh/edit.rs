//! What a local edit did: enough to undo it, to redo it and to write it to a file.

use glam::DVec3;
use smallvec::SmallVec;

use super::model::{Corner, FaceId, VertexId, WedgeId};

/// A triangle that a collapse removed, as it was just before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RemovedFace {
    /// Its id; the slot stays reserved, so an undo restores the same id.
    pub face: FaceId,
    /// Its vertices.
    pub vertices: [VertexId; 3],
    /// Its wedges (all zero when the mesh has no attribute layers).
    pub wedges: [WedgeId; 3],
}

/// A corner of a surviving triangle whose wedge a collapse replaced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rewedged {
    /// The corner.
    pub corner: Corner,
    /// Its wedge before.
    pub from: WedgeId,
    /// Its wedge after.
    pub to: WedgeId,
}

/// The edge collapse (keep, drop) → keep, placed at `to`.
///
/// Redo: corners in `moved` change their vertex from `drop` to `keep`, faces in `removed` go,
/// `keep` moves to `to`, `new_wedges` are appended, corners in `rewedged` change wedge.
/// Undo: the reverse. Wedges are append-only: a collapse never changes the values of a wedge that
/// existed before it, it appends new ones, so that earlier levels stay exact.
#[derive(Clone, Debug, PartialEq)]
pub struct Collapse {
    /// The vertex that survives.
    pub keep: VertexId,
    /// The vertex that goes.
    pub drop: VertexId,
    /// Where `keep` was.
    pub keep_from: DVec3,
    /// Where `drop` was.
    pub drop_from: DVec3,
    /// Where `keep` is now.
    pub to: DVec3,
    /// Triangles that held both ends, ascending by id.
    pub removed: SmallVec<[RemovedFace; 2]>,
    /// Corners of surviving triangles that changed from `drop` to `keep`, ascending.
    pub moved: SmallVec<[Corner; 8]>,
    /// Corners of surviving triangles that changed wedge, ascending.
    pub rewedged: SmallVec<[Rewedged; 4]>,
    /// The first id of the wedges that this collapse appended.
    pub first_new_wedge: WedgeId,
    /// Their values: wedge after wedge, all layers of a wedge in layer order.
    pub new_wedges: Vec<f32>,
}
