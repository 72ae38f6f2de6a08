//! Any local edit as bytes that stand alone.
//!
//! The first byte of a record holds flags and, in its bits 5..8, the kind: 0 collapse (its bytes
//! are those of `record`), 1 split, 2 swap, 3 displacement, 4 revalue; 5 to 7 are unknown. Flags
//! that a kind does not have are 0. Byte by byte (alphabet in `bytes`, *signed* is a difference):
//!
//! ```text
//! split
//!   flags        bits 0..2  number of triangles that were cut; 3: a varint with the number follows
//!                bit 2      the wedge part is there (else: wedges all 0, none new)
//!   a            varint
//!   b            signed, from a
//!   vertex       varint
//!   at           3 × 8 bytes, little endian
//!   cut          per triangle as a removed face of a collapse, with keep = a and drop = b
//!   new          per triangle: the new one, signed from the new one before plus 1 (the first:
//!                from 2 · vertex)
//!   wedge part   if bit 2:
//!     cut          per triangle its three wedges and the new one, each signed from the wedge
//!                  before (or 0)
//!     first new    varint
//!     new          varint number of values; each 4 bytes, little endian
//! swap
//!   flags        bit 2      the wedge part is there (else: wedges all 0)
//!   a            varint
//!   b, c, d      each signed, from a
//!   corners      two, signed: from 6 · a; from the first
//!   wedge part   if bit 2: the two before and the two after, each signed from the wedge before
//!                (or 0)
//! displacement
//!   flags        bit 0      from has the bits of to
//!   vertex       varint
//!   to           3 × 8 bytes, little endian
//!   from         unless bit 0: 3 × (code byte and payload of a double, predicted by to)
//! revalue
//!   flags        none
//!   rewedged     varint number; each: corner signed from the corner before (or 0), from and to,
//!                signed from the wedge before (or 0)
//!   first new    varint
//!   new          varint number of values; each 4 bytes, little endian
//! ```
//!
//! On an optimized mesh without wedges a displacement takes about 49 bytes, a swap 8, a split 38,
//! a collapse 76; a revalue of normals 47.

use smallvec::SmallVec;

use super::{
    bytes::{Cursor, delta, put_signed, put_varint},
    error::{Damage, ProgressiveError},
    record::{self, KIND_SHIFT, same_bits},
};
use crate::mesh::{
    Corner, Displacement, Edit, EditRecord, FaceId, RemovedFace, Revalue, Split, SplitFace, Swap,
    VertexId, WedgeId,
};

pub(super) const COLLAPSE: u8 = 0;
pub(super) const SPLIT: u8 = 1;
pub(super) const SWAP: u8 = 2;
pub(super) const DISPLACEMENT: u8 = 3;
pub(super) const REVALUE: u8 = 4;

const STAYS: u8 = 1;
const HAS_WEDGES: u8 = 4;
const MANY_CUT: u8 = 3;

/// Appends the record to `out`. Collapses get the bytes of [`super::encode_collapse`].
pub fn encode_edit<'a>(edit: impl Into<Edit<'a>>, out: &mut Vec<u8>) {
    match edit.into() {
        Edit::Collapse(c) => record::encode_collapse(c, out),
        Edit::Split(s) => put_split(out, s),
        Edit::Swap(s) => put_swap(out, s),
        Edit::Displacement(d) => put_displacement(out, d),
        Edit::Revalue(r) => {
            out.push(REVALUE << KIND_SHIFT);
            record::put_rewedged(out, 0, 0, &r.rewedged);
            record::put_new_wedges(out, r.first_new_wedge, &r.new_wedges);
        }
    }
}

/// Reads one record of any kind from the start of `bytes`; returns it and the number of bytes it
/// took.
///
/// # Errors
/// [`ProgressiveError::Damaged`] when the bytes are no record. Whether a record fits a mesh is
/// for [`super::Replay`] to say.
pub fn decode_edit(bytes: &[u8]) -> Result<(EditRecord, usize), ProgressiveError> {
    let mut cursor = Cursor::new(bytes);
    let record = decode(&mut cursor).map_err(|damage| damage.at("record"))?;
    Ok((record, bytes.len() - cursor.n_left()))
}

type Decoded = Result<EditRecord, Damage>;

fn decode(cursor: &mut Cursor<'_>) -> Decoded {
    // A collapse reads its flags itself.
    let mut ahead = *cursor;
    let kind = ahead.byte()? >> KIND_SHIFT;
    if kind == COLLAPSE {
        return record::decode(cursor).map(EditRecord::Collapse);
    }
    let flags = cursor.byte()? & ((1 << KIND_SHIFT) - 1);
    let (known, record): (u8, Decoded) = match kind {
        SPLIT => (MANY_CUT | HAS_WEDGES, split(cursor, flags).map(EditRecord::Split)),
        SWAP => (HAS_WEDGES, swap(cursor, flags).map(EditRecord::Swap)),
        DISPLACEMENT => (STAYS, displacement(cursor, flags).map(EditRecord::Displacement)),
        REVALUE => (0, revalue(cursor).map(EditRecord::Revalue)),
        _ => return Err(Damage("unknown kind of a record")),
    };
    if flags & !known != 0 {
        return Err(Damage("unknown flags of a record"));
    }
    record
}

fn put_split(out: &mut Vec<u8>, s: &Split) {
    let has_wedges = s.first_new_wedge.0 != 0
        || !s.new_wedges.is_empty()
        || s.halves.iter().any(|h| h.wedges != [WedgeId(0); 3] || h.new_wedge.0 != 0);
    let n_cut = (s.halves.len() as u64).min(MANY_CUT.into()) as u8;
    out.push(SPLIT << KIND_SHIFT | n_cut | if has_wedges { HAS_WEDGES } else { 0 });
    if n_cut == MANY_CUT {
        put_varint(out, s.halves.len() as u64);
    }
    put_varint(out, s.a.0.into());
    put_signed(out, delta(s.a.0, s.b.0));
    put_varint(out, s.vertex.0.into());
    record::put_place(out, s.at);
    let cut = s.halves.iter();
    let cut = cut.map(|h| RemovedFace { face: h.face, vertices: h.vertices, wedges: h.wedges });
    record::put_faces(out, [s.a, s.b], cut);
    let mut next = s.vertex.0.wrapping_mul(2);
    for half in &s.halves {
        put_signed(out, delta(next, half.new_face.0));
        next = half.new_face.0.wrapping_add(1);
    }
    if has_wedges {
        let mut before = 0;
        for wedge in s.halves.iter().flat_map(|h| h.wedges.into_iter().chain([h.new_wedge])) {
            record::put_wedge(out, &mut before, wedge);
        }
        record::put_new_wedges(out, s.first_new_wedge, &s.new_wedges);
    }
}

fn split(cursor: &mut Cursor<'_>, flags: u8) -> Result<Split, Damage> {
    let n_cut = match flags & MANY_CUT {
        MANY_CUT => cursor.count()?,
        n => n.into(),
    };
    let a = VertexId(cursor.id()?);
    let b = VertexId(cursor.id_near(a.0)?);
    let vertex = VertexId(cursor.id()?);
    let at = record::place(cursor)?;
    let cut = record::faces(cursor, n_cut, [a, b])?;
    let mut next = vertex.0.wrapping_mul(2);
    let mut halves = SmallVec::new();
    for RemovedFace { face, vertices, wedges } in cut {
        let new_face = FaceId(cursor.id_near(next)?);
        next = new_face.0.wrapping_add(1);
        halves.push(SplitFace { face, new_face, vertices, wedges, new_wedge: WedgeId(0) });
    }
    let first_new_wedge = WedgeId(0);
    let mut s = Split { a, b, vertex, at, halves, first_new_wedge, new_wedges: Vec::new() };
    if flags & HAS_WEDGES != 0 {
        let mut before = 0;
        for half in &mut s.halves {
            for wedge in half.wedges.iter_mut().chain([&mut half.new_wedge]) {
                *wedge = record::next_wedge(cursor, &mut before)?;
            }
        }
        (s.first_new_wedge, s.new_wedges) = record::new_wedges(cursor)?;
    }
    Ok(s)
}

fn put_swap(out: &mut Vec<u8>, s: &Swap) {
    let wedges = || s.wedges_from.into_iter().chain(s.wedges_to);
    let has_wedges = wedges().any(|w| w.0 != 0);
    out.push(SWAP << KIND_SHIFT | if has_wedges { HAS_WEDGES } else { 0 });
    let ([a, b], [c, d]) = (s.ends, s.apexes);
    put_varint(out, a.0.into());
    for v in [b, c, d] {
        put_signed(out, delta(a.0, v.0));
    }
    let [first, second] = s.corners;
    put_signed(out, delta(a.0.wrapping_mul(6), first.0));
    put_signed(out, delta(first.0, second.0));
    if has_wedges {
        let mut before = 0;
        wedges().for_each(|wedge| record::put_wedge(out, &mut before, wedge));
    }
}

fn swap(cursor: &mut Cursor<'_>, flags: u8) -> Result<Swap, Damage> {
    let a = VertexId(cursor.id()?);
    let mut others = [a; 3];
    for v in &mut others {
        *v = VertexId(cursor.id_near(a.0)?);
    }
    let [b, c, d] = others;
    let first = cursor.id_near(a.0.wrapping_mul(6))?;
    let corners = [Corner(first), Corner(cursor.id_near(first)?)];
    let mut wedges = [WedgeId(0); 4];
    let mut before = 0;
    for wedge in wedges.iter_mut().filter(|_| flags & HAS_WEDGES != 0) {
        *wedge = record::next_wedge(cursor, &mut before)?;
    }
    let [from_b, from_a, to_d, to_c] = wedges;
    Ok(Swap {
        ends: [a, b],
        apexes: [c, d],
        corners,
        wedges_from: [from_b, from_a],
        wedges_to: [to_d, to_c],
    })
}

fn put_displacement(out: &mut Vec<u8>, d: &Displacement) {
    let stays = same_bits(d.from, d.to);
    out.push(DISPLACEMENT << KIND_SHIFT | if stays { STAYS } else { 0 });
    put_varint(out, d.vertex.0.into());
    record::put_place(out, d.to);
    if !stays {
        record::put_point(out, d.to, d.from);
    }
}

fn displacement(cursor: &mut Cursor<'_>, flags: u8) -> Result<Displacement, Damage> {
    let vertex = VertexId(cursor.id()?);
    let to = record::place(cursor)?;
    let from = if flags & STAYS == 0 { record::point(cursor, to)? } else { to };
    Ok(Displacement { vertex, from, to })
}

fn revalue(cursor: &mut Cursor<'_>) -> Result<Revalue, Damage> {
    let mut rewedged = SmallVec::new();
    record::rewedged(cursor, 0, 0, |r| rewedged.push(r))?;
    let (first_new_wedge, new_wedges) = record::new_wedges(cursor)?;
    Ok(Revalue { rewedged, first_new_wedge, new_wedges })
}
