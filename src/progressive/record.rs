//! One collapse as bytes that stand alone: for streams, and for the writer's memory.
//!
//! A record, byte by byte (alphabet in `bytes`):
//!
//! ```text
//! flags        bit 0      keep_from has the bits of to
//!              bit 1      drop_from has the bits of to
//!              bit 2      the wedge part is there (else: wedges all 0, none replaced or new)
//!              bits 3..5  number of removed faces; 3: a varint with the number follows
//!              bits 5..8  0 (other edits have other numbers there, see `edits`)
//! keep         varint
//! drop         signed, from keep
//! to           3 × 8 bytes, little endian
//! keep_from    unless bit 0: 3 × (code byte and payload of a double, predicted by to)
//! drop_from    unless bit 1: likewise
//! removed      per face:
//!   face         signed, from the face before (the first: from 2 · keep)
//!   order        byte: 2 · (corner of keep) + (0 if drop follows keep, 1 if it precedes it);
//!                6: the face is not made of keep, drop and a third vertex
//!   vertices     the third vertex, signed from keep; for order 6 all three
//! moved        varint number; each signed, from the corner before (the first: from 6 · keep)
//! wedge part   if bit 2:
//!   removed      per face three wedges, each signed from the wedge before in this part (or 0)
//!   rewedged     varint number; each: corner signed from the corner before (or 6 · keep),
//!                from and to, signed likewise from the wedge before
//!   first new    varint
//!   new          varint number of values; each 4 bytes, little endian
//! ```
//!
//! A record of a scanned surface takes about 80 bytes (bunny 81, frog 76, without wedges).

use glam::DVec3;
use smallvec::SmallVec;

use super::{
    bytes::{Cursor, delta, put_double, put_signed, put_varint},
    error::{Damage, ProgressiveError},
};
use crate::mesh::{Collapse, Corner, FaceId, RemovedFace, Rewedged, VertexId, WedgeId};

const KEEP_STAYS: u8 = 1;
const DROP_STAYS: u8 = 2;
const HAS_WEDGES: u8 = 4;
const MANY_REMOVED: u8 = 3;
/// Where the kind of an edit begins in its flags.
pub(super) const KIND_SHIFT: u8 = 5;
pub(super) const GENERAL_ORDER: u8 = 6;

/// Appends the record to `out`.
pub fn encode_collapse(c: &Collapse, out: &mut Vec<u8>) {
    let has_wedges = c.first_new_wedge.0 != 0
        || !c.new_wedges.is_empty()
        || !c.rewedged.is_empty()
        || c.removed.iter().any(|f| f.wedges != [WedgeId(0); 3]);
    let (keep_stays, drop_stays) = (same_bits(c.keep_from, c.to), same_bits(c.drop_from, c.to));
    let n_removed = (c.removed.len() as u64).min(MANY_REMOVED.into()) as u8;
    let mut flags = n_removed << 3;
    for (bit, is_set) in
        [(KEEP_STAYS, keep_stays), (DROP_STAYS, drop_stays), (HAS_WEDGES, has_wedges)]
    {
        flags |= if is_set { bit } else { 0 };
    }
    out.push(flags);
    if n_removed == MANY_REMOVED {
        put_varint(out, c.removed.len() as u64);
    }
    put_varint(out, c.keep.0.into());
    put_signed(out, delta(c.keep.0, c.drop.0));
    put_place(out, c.to);
    if !keep_stays {
        put_point(out, c.to, c.keep_from);
    }
    if !drop_stays {
        put_point(out, c.to, c.drop_from);
    }
    put_faces(out, [c.keep, c.drop], c.removed.iter().copied());
    put_varint(out, c.moved.len() as u64);
    let mut before = c.keep.0.wrapping_mul(6);
    for corner in &c.moved {
        put_signed(out, delta(before, corner.0));
        before = corner.0;
    }
    if has_wedges {
        put_wedges(out, c);
    }
}

/// A place as it is.
pub(super) fn put_place(out: &mut Vec<u8>, p: DVec3) {
    out.extend(p.to_array().iter().flat_map(|x| x.to_le_bytes()));
}

/// A place by a prediction.
pub(super) fn put_point(out: &mut Vec<u8>, prediction: DVec3, p: DVec3) {
    for (guess, x) in prediction.to_array().into_iter().zip(p.to_array()) {
        let at = out.len();
        out.push(0);
        out[at] = put_double(out, guess, x);
    }
}

/// Faces at the edge (keep, drop), without their wedges.
pub(super) fn put_faces(
    out: &mut Vec<u8>,
    [keep, drop]: [VertexId; 2],
    faces: impl Iterator<Item = RemovedFace>,
) {
    let mut before = keep.0.wrapping_mul(2);
    for face in faces {
        put_signed(out, delta(before, face.face.0));
        before = face.face.0;
        let order = order_of(face.vertices, keep, drop);
        out.push(order);
        match third_corner(order) {
            Some(third) => put_signed(out, delta(keep.0, face.vertices[third].0)),
            None => face.vertices.iter().for_each(|v| put_signed(out, delta(keep.0, v.0))),
        }
    }
}

fn put_wedges(out: &mut Vec<u8>, c: &Collapse) {
    let mut before = 0;
    for wedge in c.removed.iter().flat_map(|f| f.wedges) {
        put_wedge(out, &mut before, wedge);
    }
    put_rewedged(out, before, c.keep.0.wrapping_mul(6), &c.rewedged);
    put_new_wedges(out, c.first_new_wedge, &c.new_wedges);
}

/// A wedge by the one before.
pub(super) fn put_wedge(out: &mut Vec<u8>, before: &mut u32, wedge: WedgeId) {
    put_signed(out, delta(*before, wedge.0));
    *before = wedge.0;
}

/// Corners that changed wedge, from a wedge and a corner before.
pub(super) fn put_rewedged(
    out: &mut Vec<u8>,
    mut wedge: u32,
    mut corner: u32,
    rewedged: &[Rewedged],
) {
    put_varint(out, rewedged.len() as u64);
    for r in rewedged {
        put_signed(out, delta(corner, r.corner.0));
        corner = r.corner.0;
        put_wedge(out, &mut wedge, r.from);
        put_wedge(out, &mut wedge, r.to);
    }
}

/// Appended wedges.
pub(super) fn put_new_wedges(out: &mut Vec<u8>, first: WedgeId, values: &[f32]) {
    put_varint(out, first.0.into());
    put_varint(out, values.len() as u64);
    out.extend(values.iter().flat_map(|v| v.to_bits().to_le_bytes()));
}

/// Reads one record from the start of `bytes`; returns it and the number of bytes it took.
///
/// # Errors
/// [`ProgressiveError::Damaged`] when the bytes are no record. Whether a record fits a mesh is
/// for [`super::Replay`] to say.
pub fn decode_collapse(bytes: &[u8]) -> Result<(Collapse, usize), ProgressiveError> {
    let mut cursor = Cursor::new(bytes);
    let collapse = decode(&mut cursor).map_err(|damage| damage.at("record"))?;
    Ok((collapse, bytes.len() - cursor.n_left()))
}

pub(super) fn decode(cursor: &mut Cursor<'_>) -> Result<Collapse, Damage> {
    let flags = cursor.byte()?;
    if flags >> KIND_SHIFT != 0 {
        return Err(Damage("unknown flags of a record"));
    }
    let n_removed = match flags >> 3 {
        MANY_REMOVED => cursor.count()?,
        n => n.into(),
    };
    let keep = VertexId(cursor.id()?);
    let drop = VertexId(cursor.id_near(keep.0)?);
    let to = place(cursor)?;
    let keep_from = if flags & KEEP_STAYS == 0 { point(cursor, to)? } else { to };
    let drop_from = if flags & DROP_STAYS == 0 { point(cursor, to)? } else { to };
    let removed = faces(cursor, n_removed, [keep, drop])?;
    let mut before = keep.0.wrapping_mul(6);
    let mut moved = SmallVec::new();
    for _ in 0..cursor.count()? {
        before = cursor.id_near(before)?;
        moved.push(Corner(before));
    }
    let mut collapse = Collapse {
        keep,
        drop,
        keep_from,
        drop_from,
        to,
        removed,
        moved,
        rewedged: SmallVec::new(),
        first_new_wedge: WedgeId(0),
        new_wedges: Vec::new(),
    };
    if flags & HAS_WEDGES != 0 {
        wedges(cursor, &mut collapse)?;
    }
    Ok(collapse)
}

/// What [`put_place`] put.
pub(super) fn place(cursor: &mut Cursor<'_>) -> Result<DVec3, Damage> {
    let mut p = [0.0; 3];
    for x in &mut p {
        *x = f64::from_le_bytes(cursor.array()?);
    }
    Ok(DVec3::from_array(p))
}

/// What [`put_point`] put.
pub(super) fn point(cursor: &mut Cursor<'_>, prediction: DVec3) -> Result<DVec3, Damage> {
    let mut p = prediction.to_array();
    for x in &mut p {
        let code = cursor.byte()?;
        *x = cursor.double(code, *x)?;
    }
    Ok(DVec3::from_array(p))
}

/// What [`put_faces`] put; all their wedges are 0.
pub(super) fn faces(
    cursor: &mut Cursor<'_>,
    n: usize,
    [keep, drop]: [VertexId; 2],
) -> Result<SmallVec<[RemovedFace; 2]>, Damage> {
    let mut before = keep.0.wrapping_mul(2);
    let mut removed = SmallVec::new();
    for _ in 0..n {
        before = cursor.id_near(before)?;
        let order = cursor.byte()?;
        let vertices = match order {
            0..GENERAL_ORDER => in_order(order, keep, drop, VertexId(cursor.id_near(keep.0)?)),
            GENERAL_ORDER => {
                let mut vertices = [keep; 3];
                for v in &mut vertices {
                    *v = VertexId(cursor.id_near(keep.0)?);
                }
                vertices
            }
            _ => return Err(Damage("unknown order of a face")),
        };
        removed.push(RemovedFace { face: FaceId(before), vertices, wedges: [WedgeId(0); 3] });
    }
    Ok(removed)
}

fn wedges(cursor: &mut Cursor<'_>, collapse: &mut Collapse) -> Result<(), Damage> {
    let mut before = 0;
    for wedge in collapse.removed.iter_mut().flat_map(|f| &mut f.wedges) {
        *wedge = next_wedge(cursor, &mut before)?;
    }
    let corner = collapse.keep.0.wrapping_mul(6);
    rewedged(cursor, before, corner, |r| collapse.rewedged.push(r))?;
    (collapse.first_new_wedge, collapse.new_wedges) = new_wedges(cursor)?;
    Ok(())
}

/// What [`put_wedge`] put.
pub(super) fn next_wedge(cursor: &mut Cursor<'_>, before: &mut u32) -> Result<WedgeId, Damage> {
    *before = cursor.id_near(*before)?;
    Ok(WedgeId(*before))
}

/// What [`put_rewedged`] put, one by one.
pub(super) fn rewedged(
    cursor: &mut Cursor<'_>,
    mut wedge: u32,
    mut corner: u32,
    mut take: impl FnMut(Rewedged),
) -> Result<(), Damage> {
    for _ in 0..cursor.count()? {
        corner = cursor.id_near(corner)?;
        let from = next_wedge(cursor, &mut wedge)?;
        let to = next_wedge(cursor, &mut wedge)?;
        take(Rewedged { corner: Corner(corner), from, to });
    }
    Ok(())
}

/// What [`put_new_wedges`] put.
pub(super) fn new_wedges(cursor: &mut Cursor<'_>) -> Result<(WedgeId, Vec<f32>), Damage> {
    let first = WedgeId(cursor.id()?);
    let mut values = Vec::new();
    for _ in 0..cursor.count()? {
        values.push(f32::from_bits(u32::from_le_bytes(cursor.array()?)));
    }
    Ok((first, values))
}

/// Whether two points are the same bit by bit (−0 is not 0, NaN equals itself).
pub(super) fn same_bits(a: DVec3, b: DVec3) -> bool {
    a.to_array().map(f64::to_bits) == b.to_array().map(f64::to_bits)
}

/// Where keep and drop are in a face, as a number in 0..6; [`GENERAL_ORDER`] where they are not
/// both in it.
pub(super) fn order_of(vertices: [VertexId; 3], keep: VertexId, drop: VertexId) -> u8 {
    let place = |v| vertices.iter().position(|x| *x == v);
    match (place(keep), place(drop)) {
        (Some(k), Some(d)) if k != d => 2 * k as u8 + u8::from((k + 1) % 3 != d),
        _ => GENERAL_ORDER,
    }
}

/// The corner that is neither keep nor drop.
pub(super) fn third_corner(order: u8) -> Option<usize> {
    (order < GENERAL_ORDER).then(|| (usize::from(order / 2) + 2 - usize::from(order % 2)) % 3)
}

/// The face of an order below [`GENERAL_ORDER`].
pub(super) fn in_order(
    order: u8,
    keep: VertexId,
    drop: VertexId,
    third: VertexId,
) -> [VertexId; 3] {
    let k = usize::from(order / 2);
    let mut vertices = [third; 3];
    vertices[k % 3] = keep;
    vertices[(k + 1 + usize::from(order % 2)) % 3] = drop;
    vertices
}
