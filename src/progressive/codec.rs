//! Collapse records as bytes: what jobs stream while they run.
//!
//! One record, in order (`uint` is LEB128, `vec3` three little-endian f64, bit-exact):
//!
//! | field | encoding |
//! |---|---|
//! | keep, drop | uint, uint |
//! | keep_from, drop_from, to | vec3 × 3 |
//! | removed triangles | uint count; each: uint face, uint × 3 vertices, and uint × 3 wedges if the record has wedges |
//! | moved corners | uint count; uint differences, ascending (corner = 3 · face + k) |
//! | has wedges | one byte, 0 or 1; the rest only if 1 |
//! | rewedged corners | uint count; each: uint corner difference, uint from, uint to − first_new_wedge |
//! | first_new_wedge | uint |
//! | new wedge values | uint count; f32 each, little-endian |

use smallvec::SmallVec;

use super::bytes::{CodecError, Cursor, put_uint, put_vec3};
use crate::mesh::{Collapse, Corner, FaceId, RemovedFace, Rewedged, VertexId, WedgeId};

/// The bytes of a run of records, finest first.
pub fn encode_records(records: &[Collapse]) -> Vec<u8> {
    let mut out = Vec::with_capacity(records.len() * 128);
    for r in records {
        encode(r, &mut out);
    }
    out
}

/// The records of a run of bytes.
pub fn decode_records(bytes: &[u8]) -> Result<Vec<Collapse>, CodecError> {
    let mut cursor = Cursor::new(bytes, "collapse records");
    let mut records = Vec::new();
    while !cursor.is_at_end() {
        records.push(decode(&mut cursor)?);
    }
    Ok(records)
}

/// Appends one record.
pub fn encode(r: &Collapse, out: &mut Vec<u8>) {
    put_uint(out, r.keep.0.into());
    put_uint(out, r.drop.0.into());
    for p in [r.keep_from, r.drop_from, r.to] {
        put_vec3(out, p);
    }
    let has_wedges = !r.rewedged.is_empty()
        || !r.new_wedges.is_empty()
        || r.first_new_wedge.0 != 0
        || r.removed.iter().any(|f| f.wedges != [WedgeId(0); 3]);
    put_uint(out, r.removed.len() as u64);
    for f in &r.removed {
        put_uint(out, f.face.0.into());
        f.vertices.iter().for_each(|v| put_uint(out, v.0.into()));
    }
    put_ascending(out, r.moved.iter().map(|c| c.0));
    out.push(u8::from(has_wedges));
    if has_wedges {
        encode_wedges(r, out);
    }
}

fn encode_wedges(r: &Collapse, out: &mut Vec<u8>) {
    for f in &r.removed {
        f.wedges.iter().for_each(|w| put_uint(out, w.0.into()));
    }
    put_ascending(out, r.rewedged.iter().map(|w| w.corner.0));
    put_uint(out, r.first_new_wedge.0.into());
    for w in &r.rewedged {
        put_uint(out, w.from.0.into());
        put_uint(out, w.to.0.wrapping_sub(r.first_new_wedge.0).into());
    }
    put_uint(out, r.new_wedges.len() as u64);
    for v in &r.new_wedges {
        out.extend_from_slice(&v.to_bits().to_le_bytes());
    }
}

/// Reads one record.
pub fn decode(c: &mut Cursor<'_>) -> Result<Collapse, CodecError> {
    let (keep, drop) = (VertexId(c.id()?), VertexId(c.id()?));
    let (keep_from, drop_from, to) = (c.vec3()?, c.vec3()?, c.vec3()?);
    let mut removed = SmallVec::new();
    for _ in 0..c.count(4)? {
        let face = FaceId(c.id()?);
        let vertices = [VertexId(c.id()?), VertexId(c.id()?), VertexId(c.id()?)];
        removed.push(RemovedFace { face, vertices, wedges: [WedgeId(0); 3] });
    }
    let moved = ascending(c)?.into_iter().map(Corner).collect();
    let mut record = Collapse {
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
    match c.array::<1>()? {
        [0] => {}
        [1] => decode_wedges(c, &mut record)?,
        [flag] => return Err(c.malformed(format!("wedge flag {flag}"))),
    }
    Ok(record)
}

fn decode_wedges(c: &mut Cursor<'_>, r: &mut Collapse) -> Result<(), CodecError> {
    for f in &mut r.removed {
        f.wedges = [WedgeId(c.id()?), WedgeId(c.id()?), WedgeId(c.id()?)];
    }
    let corners = ascending(c)?;
    r.first_new_wedge = WedgeId(c.id()?);
    for corner in corners {
        let from = WedgeId(c.id()?);
        let to = WedgeId(r.first_new_wedge.0.wrapping_add(c.id()?));
        r.rewedged.push(Rewedged { corner: Corner(corner), from, to });
    }
    for _ in 0..c.count(4)? {
        r.new_wedges.push(c.f32()?);
    }
    Ok(())
}

/// Ascending ids as a count and differences.
fn put_ascending(out: &mut Vec<u8>, ids: impl ExactSizeIterator<Item = u32>) {
    put_uint(out, ids.len() as u64);
    let mut last = 0;
    for id in ids {
        put_uint(out, id.wrapping_sub(last).into());
        last = id;
    }
}

fn ascending(c: &mut Cursor<'_>) -> Result<Vec<u32>, CodecError> {
    let count = c.count(1)?;
    let mut ids = Vec::with_capacity(count);
    let mut last = 0_u32;
    for _ in 0..count {
        last = last.wrapping_add(c.id()?);
        ids.push(last);
    }
    Ok(ids)
}
