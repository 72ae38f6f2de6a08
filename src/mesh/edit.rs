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

/// A triangle that a split cut in two, as it was just before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SplitFace {
    /// The triangle, which keeps the side of `a`.
    pub face: FaceId,
    /// The new triangle, on the side of `b`.
    pub new_face: FaceId,
    /// Vertices of `face` before.
    pub vertices: [VertexId; 3],
    /// Wedges of `face` before.
    pub wedges: [WedgeId; 3],
    /// The wedge of the new vertex in both (zero when the mesh has no attribute layers).
    pub new_wedge: WedgeId,
}

/// The split of the edge (a, b) at a new vertex.
///
/// Redo: `vertex` is appended at `at`, `new_wedges` are appended; in each of `halves` the corner
/// of `b` moves to `vertex`, and a copy of the triangle as it was, but with the corner of `a` at
/// `vertex`, is appended. Undo: the reverse, as the last edit.
#[derive(Clone, Debug, PartialEq)]
pub struct Split {
    /// One end.
    pub a: VertexId,
    /// The other end.
    pub b: VertexId,
    /// The new vertex: the last slot.
    pub vertex: VertexId,
    /// Where it is.
    pub at: DVec3,
    /// Triangles that held both ends, ascending by id.
    pub halves: SmallVec<[SplitFace; 2]>,
    /// The first id of the wedges that this split appended.
    pub first_new_wedge: WedgeId,
    /// Their values: wedge after wedge, all layers of a wedge in layer order.
    pub new_wedges: Vec<f32>,
}

/// The swap of the edge (a, b) between triangles (a, b, c) and (b, a, d) for the edge (c, d).
///
/// Redo: the corner of `b` in the first triangle moves to `d`, the corner of `a` in the second
/// moves to `c`, and both change wedge. Undo: the reverse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Swap {
    /// The ends a, b of the edge that went.
    pub ends: [VertexId; 2],
    /// The ends c, d of the edge that came.
    pub apexes: [VertexId; 2],
    /// The corner of `b` in (a, b, c) and the corner of `a` in (b, a, d).
    pub corners: [Corner; 2],
    /// Their wedges before.
    pub wedges_from: [WedgeId; 2],
    /// Their wedges after.
    pub wedges_to: [WedgeId; 2],
}

/// The displacement of a vertex. Redo: `vertex` moves to `to`. Undo: back to `from`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Displacement {
    /// The vertex.
    pub vertex: VertexId,
    /// Where it was.
    pub from: DVec3,
    /// Where it is now.
    pub to: DVec3,
}

/// New attribute values for corners. Wedges are append-only, so the corners get new wedges.
///
/// Redo: `new_wedges` are appended, corners in `rewedged` change wedge. Undo: the reverse, as the
/// last edit.
#[derive(Clone, Debug, PartialEq)]
pub struct Revalue {
    /// Corners that changed wedge, ascending.
    pub rewedged: SmallVec<[Rewedged; 8]>,
    /// The first id of the wedges that this edit appended.
    pub first_new_wedge: WedgeId,
    /// Their values: wedge after wedge, all layers of a wedge in layer order.
    pub new_wedges: Vec<f32>,
}

/// Any local edit, by reference to its record.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Edit<'a> {
    /// Two vertices became one.
    Collapse(&'a Collapse),
    /// An edge got a vertex in its middle.
    Split(&'a Split),
    /// An edge was turned.
    Swap(&'a Swap),
    /// A vertex moved.
    Displacement(&'a Displacement),
    /// Corners got new attribute values.
    Revalue(&'a Revalue),
}

impl Edit<'_> {
    /// A copy to keep.
    pub fn to_record(self) -> EditRecord {
        match self {
            Self::Collapse(record) => EditRecord::Collapse(record.clone()),
            Self::Split(record) => EditRecord::Split(record.clone()),
            Self::Swap(record) => EditRecord::Swap(*record),
            Self::Displacement(record) => EditRecord::Displacement(*record),
            Self::Revalue(record) => EditRecord::Revalue(record.clone()),
        }
    }
}

macro_rules! edit_from {
    ($($kind:ident),*) => {$(
        impl<'a> From<&'a $kind> for Edit<'a> {
            fn from(record: &'a $kind) -> Self {
                Self::$kind(record)
            }
        }
    )*};
}
edit_from!(Collapse, Split, Swap, Displacement, Revalue);

/// Any local edit, by its own record.
#[derive(Clone, Debug, PartialEq)]
pub enum EditRecord {
    /// Two vertices became one.
    Collapse(Collapse),
    /// An edge got a vertex in its middle.
    Split(Split),
    /// An edge was turned.
    Swap(Swap),
    /// A vertex moved.
    Displacement(Displacement),
    /// Corners got new attribute values.
    Revalue(Revalue),
}

impl EditRecord {
    /// The record by reference.
    pub fn edit(&self) -> Edit<'_> {
        match self {
            Self::Collapse(record) => record.into(),
            Self::Split(record) => record.into(),
            Self::Swap(record) => record.into(),
            Self::Displacement(record) => record.into(),
            Self::Revalue(record) => record.into(),
        }
    }
}
