//! One collapse as the file stores it: relative to the mesh it leads to.
//!
//! Whoever reads the file coarse to fine has the mesh after the collapse, so the record leaves out
//! what that mesh tells: where `keep` is, the wedges that corners have now, the values of wedges
//! that are in use. What follows is coded by the *ring* of `keep`: its corners in ascending order.
//!
//! A record, in three streams (alphabet in `bytes`; `shape` unless said otherwise):
//!
//! ```text
//! flags        byte: bits 0..2  number of removed faces; 3: a varint with the number follows
//!                    bit 2      keep_from has the bits of to
//!                    bit 3      drop_from has the bits of to
//!                    bit 4      wedges were replaced or appended
//! keep, drop   ids: varint; signed from keep
//! keep_from    unless bit 2: 3 doubles predicted by to; codes in shape, payloads in digits
//! drop_from    unless bit 3: likewise
//! moved        which corners of the ring belong to drop: a bit each, bytes from the lowest bit;
//!              in a ring of more than 32: varint number, then varint gaps between their places
//! removed      per face:
//!   order        byte, as in a stand-alone record (0..6)
//!   third        varint: 0: ids: the vertex, signed from keep; else 1 + its place among the
//!                other vertices of the ring's faces, those on both sides of the split first
//!   face         ids: signed from the first face of the ring with the third vertex
//!                (else from the face before, else from 0)
//!   material     in a mesh with materials per face: varint: 0: that of the ring's first face
//!                (or 0); else 1 + material
//! changes      if bit 4:
//!   new          varint: number of wedges that the collapse appended
//!   per corner of the ring: varint: 0: its wedge stays; else 1 + wedge code of its old wedge
//!   others       varint: number of changed corners outside the ring; each: ids: the corner,
//!                signed from the ring's first (or 0); wedge code of its old wedge
//! wedges       in a mesh with layers, per removed face: three wedge codes
//! new values   of appended wedges that no corner has shown yet
//!
//! wedge code   varint: 0: ids: the wedge, signed from the id of its vertex; 1: the wedge last
//!              coded on the same side of the split (else the first on that side of the ring);
//!              else 2 + place in the palette: the wedges of the ring's faces, then those coded by 0
//! values       follow the code of a wedge that the file shows for the first time: a single per
//!              value, predicted by the first wedge of the palette; codes in shape, payloads in
//!              digits
//! ```
//!
//! In rings of more than 32 corners no third vertex has a place, and the palette begins with the
//! wedges of the first corner's face alone. The palette holds 64 wedges at most.
//!
//! A record of a scanned surface takes about 37 bytes after compression (bunny 37.3, frog 35.8,
//! without wedges), of which 26 are digits of positions.
//!
//! Encoder and decoder are one walk over the record with two [`Coder`]s, so they cannot differ.

use glam::DVec3;
use smallvec::SmallVec;

use super::{
    coder::Coder,
    error::Damage,
    record::{GENERAL_ORDER, in_order, order_of, same_bits, third_corner},
    replay::Replay,
    section::{Cursors, Streams},
};
use crate::mesh::{Collapse, Corner, FaceId, RemovedFace, Rewedged, VertexId, WedgeId};

const KEEP_STAYS: u8 = 4;
const DROP_STAYS: u8 = 8;
const HAS_CHANGES: u8 = 16;
const MANY_REMOVED: u8 = 3;
/// Rings up to this size are looked through; larger ones would take square time.
const MAX_RING: usize = 32;
const MAX_PALETTE: usize = 64;

/// Puts the record that led to the mesh of `replay`. `is_known` says which wedges the file has
/// shown before.
pub(super) fn encode(
    streams: &mut Streams,
    replay: &mut Replay,
    is_known: &mut [bool],
    collapse: &Collapse,
) -> Result<(), Damage> {
    let mut collapse = collapse.clone();
    Walk { coder: streams, replay, is_known, work: 0 }.record(&mut collapse)
}

/// Reads the record that led to the mesh of `replay`, and fills in the values of wedges that it
/// shows. Returns it and the corners visited. Undoing it checks it.
pub(super) fn decode(
    cursors: &mut Cursors<'_>,
    replay: &mut Replay,
    is_known: &mut [bool],
) -> Result<(Collapse, u64), Damage> {
    let mut collapse = blank_collapse();
    let mut walk = Walk { coder: cursors, replay, is_known, work: 0 };
    walk.record(&mut collapse)?;
    let work = walk.work;
    Ok((collapse, work))
}

/// A record to be filled in.
pub(super) fn blank_collapse() -> Collapse {
    Collapse {
        keep: VertexId(0),
        drop: VertexId(0),
        keep_from: DVec3::ZERO,
        drop_from: DVec3::ZERO,
        to: DVec3::ZERO,
        removed: SmallVec::new(),
        moved: SmallVec::new(),
        rewedged: SmallVec::new(),
        first_new_wedge: WedgeId(0),
        new_wedges: Vec::new(),
    }
}

struct Walk<'a, C> {
    coder: &'a mut C,
    replay: &'a mut Replay,
    is_known: &'a mut [bool],
    work: u64,
}

/// The corners at keep, and what has been coded about them.
struct Ring {
    /// Ascending.
    corners: SmallVec<[u32; 16]>,
    is_moved: SmallVec<[bool; 16]>,
    palette: SmallVec<[u32; 32]>,
    /// The wedge last coded for a corner of keep and of drop.
    last: [Option<u32>; 2],
}

impl Ring {
    /// The code of a wedge (a decoder calls it with nonsense and overwrites the result).
    fn code_of(&self, side: Option<usize>, wedge: u32) -> u64 {
        if side.is_some_and(|s| self.last[s] == Some(wedge)) {
            return 1;
        }
        self.palette.iter().position(|w| *w == wedge).map_or(0, |i| i as u64 + 2)
    }
}

impl<C: Coder> Walk<'_, C> {
    fn record(&mut self, c: &mut Collapse) -> Result<(), Damage> {
        let flags = self.flags(c)?;
        self.coder.id(&mut c.keep.0)?;
        self.coder.near(c.keep.0, &mut c.drop.0)?;
        let Some(position) = self.replay.positions.get(c.keep.index()) else {
            return Err(Damage("keep is not there"));
        };
        c.to = DVec3::from_array(*position);
        self.point(flags & KEEP_STAYS != 0, c.to, &mut c.keep_from)?;
        self.point(flags & DROP_STAYS != 0, c.to, &mut c.drop_from)?;
        let mut ring = self.ring(c);
        self.moved(&mut ring, c)?;
        self.removed(&ring, flags, c)?;
        if self.replay.layers.is_empty() {
            return Ok(());
        }
        self.fill_palette(&mut ring);
        c.first_new_wedge = WedgeId(self.replay.n_wedges);
        if flags & HAS_CHANGES != 0 {
            self.changes(&mut ring, c)?;
        }
        self.removed_wedges(&mut ring, c)?;
        self.new_values(&ring, c)
    }

    fn flags(&mut self, c: &Collapse) -> Result<u8, Damage> {
        let mut flags = c.removed.len().min(MANY_REMOVED.into()) as u8;
        for (bit, is_set) in [
            (KEEP_STAYS, same_bits(c.keep_from, c.to)),
            (DROP_STAYS, same_bits(c.drop_from, c.to)),
            (HAS_CHANGES, !(c.rewedged.is_empty() && c.new_wedges.is_empty())),
        ] {
            flags |= if is_set { bit } else { 0 };
        }
        self.coder.byte(&mut flags)?;
        if flags >> 5 != 0 {
            return Err(Damage("unknown flags of a record"));
        }
        Ok(flags)
    }

    fn point(&mut self, stays: bool, to: DVec3, p: &mut DVec3) -> Result<(), Damage> {
        if stays {
            *p = to;
            return Ok(());
        }
        let mut x = p.to_array();
        for (x, guess) in x.iter_mut().zip(to.to_array()) {
            self.coder.double(guess, x)?;
        }
        *p = DVec3::from_array(x);
        Ok(())
    }

    fn ring(&mut self, c: &Collapse) -> Ring {
        let mut corners: SmallVec<[u32; 16]> = self.replay.rings.of(c.keep.0).collect();
        corners.sort_unstable();
        self.work += corners.len() as u64;
        let is_moved = corners.iter().map(|x| c.moved.binary_search(&Corner(*x)).is_ok()).collect();
        Ring { corners, is_moved, palette: SmallVec::new(), last: [None; 2] }
    }

    fn moved(&mut self, ring: &mut Ring, c: &mut Collapse) -> Result<(), Damage> {
        if ring.corners.len() <= MAX_RING {
            for bits in ring.is_moved.chunks_mut(8) {
                let mut byte = 0;
                for (i, bit) in bits.iter().enumerate() {
                    byte |= u8::from(*bit) << i;
                }
                self.coder.byte(&mut byte)?;
                for (i, bit) in bits.iter_mut().enumerate() {
                    *bit = byte >> i & 1 == 1;
                }
            }
        } else {
            self.moved_list(ring)?;
        }
        let moved = ring.corners.iter().zip(&ring.is_moved).filter(|(_, m)| **m);
        c.moved = moved.map(|(x, _)| Corner(*x)).collect();
        Ok(())
    }

    fn moved_list(&mut self, ring: &mut Ring) -> Result<(), Damage> {
        let places: Vec<u64> =
            (0..ring.is_moved.len()).filter(|i| ring.is_moved[*i]).map(|i| i as u64).collect();
        let mut n = places.len() as u64;
        self.coder.small(&mut n)?;
        if n > ring.is_moved.len() as u64 {
            return Err(Damage("more corners move than there are"));
        }
        ring.is_moved.fill(false);
        let mut next = 0;
        for i in 0..n as usize {
            let mut gap = places.get(i).map_or(0, |place| place - next);
            self.coder.small(&mut gap)?;
            let place = usize::try_from(gap).ok().and_then(|gap| gap.checked_add(next as usize));
            match place.and_then(|place| ring.is_moved.get_mut(place)) {
                Some(bit) => *bit = true,
                None => return Err(Damage("a moved corner is not in the ring")),
            }
            next += gap + 1;
        }
        Ok(())
    }

    fn removed(&mut self, ring: &Ring, flags: u8, c: &mut Collapse) -> Result<(), Damage> {
        let mut n = u64::from(flags & MANY_REMOVED);
        if n == u64::from(MANY_REMOVED) {
            n = c.removed.len() as u64;
            self.coder.small(&mut n)?;
        }
        let thirds = self.thirds(ring);
        let given = std::mem::take(&mut c.removed);
        for i in 0..n as usize {
            let blank = RemovedFace {
                face: FaceId(0),
                vertices: [VertexId(0); 3],
                wedges: [WedgeId(0); 3],
            };
            let mut face = given.get(i).copied().unwrap_or(blank);
            let before = c.removed.last().map(|f| f.face.0);
            self.removed_face(ring, &thirds, before, c, &mut face)?;
            c.removed.push(face);
        }
        Ok(())
    }

    fn removed_face(
        &mut self,
        ring: &Ring,
        thirds: &[u32],
        before: Option<u32>,
        c: &Collapse,
        face: &mut RemovedFace,
    ) -> Result<(), Damage> {
        let mut order = order_of(face.vertices, c.keep, c.drop);
        self.coder.byte(&mut order)?;
        if order >= GENERAL_ORDER {
            return Err(Damage("unknown order of a face"));
        }
        let mut third = third_corner(order).map_or(0, |k| face.vertices[k].0);
        let place = thirds.iter().position(|v| *v == third);
        let mut code = place.map_or(0, |i| i as u64 + 1);
        self.coder.small(&mut code)?;
        match code {
            0 => self.coder.near(c.keep.0, &mut third)?,
            code => match thirds.get(code as usize - 1) {
                Some(v) => third = *v,
                None => return Err(Damage("the third vertex of a face is not in the ring")),
            },
        }
        face.vertices = in_order(order, c.keep, c.drop, VertexId(third));
        let faces = ring.corners.iter().map(|x| x / 3);
        let beside = faces.clone().find(|f| self.replay.faces[*f as usize].contains(&third));
        self.coder.near(beside.or(before).unwrap_or(0), &mut face.face.0)?;
        self.material(ring, face)
    }

    fn material(&mut self, ring: &Ring, face: &RemovedFace) -> Result<(), Damage> {
        let materials = &mut self.replay.face_materials;
        if materials.is_empty() {
            return Ok(());
        }
        let guess = ring.corners.first().map_or(0, |x| materials[*x as usize / 3]);
        let Some(material) = materials.get_mut(face.face.index()) else {
            return Err(Damage("a removed face is not there"));
        };
        let mut code = if *material == guess { 0 } else { u64::from(*material) + 1 };
        self.coder.small(&mut code)?;
        *material = match code {
            0 => guess,
            code => u32::try_from(code - 1).map_err(|_| Damage("a material is over 32 bits"))?,
        };
        Ok(())
    }

    /// The other vertices of the ring's faces in order of appearance, those on both sides of the
    /// split first: in a manifold these are the third vertices of the removed faces.
    fn thirds(&self, ring: &Ring) -> SmallVec<[u32; 16]> {
        let mut seen: SmallVec<[(u32, [bool; 2]); 16]> = SmallVec::new();
        let n = if ring.corners.len() <= MAX_RING { ring.corners.len() } else { 0 };
        for (corner, moved) in ring.corners.iter().zip(&ring.is_moved).take(n) {
            let face = self.replay.faces[*corner as usize / 3];
            for step in [1, 2] {
                let vertex = face[(*corner as usize + step) % 3];
                let at = seen.iter().position(|s| s.0 == vertex).unwrap_or_else(|| {
                    seen.push((vertex, [false; 2]));
                    seen.len() - 1
                });
                seen[at].1[usize::from(*moved)] = true;
            }
        }
        let both = seen.iter().filter(|s| s.1 == [true; 2]);
        let rest = seen.iter().filter(|s| s.1 != [true; 2]);
        both.chain(rest).map(|s| s.0).collect()
    }

    fn fill_palette(&mut self, ring: &mut Ring) {
        let n = if ring.corners.len() <= MAX_RING { ring.corners.len() } else { 1 };
        for (i, corner) in ring.corners.iter().take(n).enumerate() {
            let wedges = self.replay.face_wedges[*corner as usize / 3];
            for step in 0..3 {
                let wedge = wedges[(*corner as usize + step) % 3];
                if !ring.palette.contains(&wedge) {
                    ring.palette.push(wedge);
                }
                if step == 0 {
                    ring.last[usize::from(ring.is_moved[i])].get_or_insert(wedge);
                }
            }
        }
    }

    fn changes(&mut self, ring: &mut Ring, c: &mut Collapse) -> Result<(), Damage> {
        let mut n_new = u64::from(self.replay.n_wedges_of(&c.new_wedges));
        self.coder.small(&mut n_new)?;
        let first = u64::from(self.replay.n_wedges).checked_sub(n_new);
        c.first_new_wedge = WedgeId(first.ok_or(Damage("more new wedges than there are"))? as u32);
        let given = std::mem::take(&mut c.rewedged);
        let ends = [c.keep.0, c.drop.0];
        for i in 0..ring.corners.len() {
            let corner = Corner(ring.corners[i]);
            let found = given.binary_search_by_key(&corner, |r| r.corner).ok().map(|i| given[i]);
            let side = usize::from(ring.is_moved[i]);
            let mut from = found.map_or(0, |r| r.from.0);
            let code = found.map(|_| ring.code_of(Some(side), from));
            let mut symbol = code.map_or(0, |code| code + 1);
            self.coder.small(&mut symbol)?;
            if symbol > 0 {
                self.wedge_of_code(ring, Some(side), symbol - 1, ends[side], &mut from)?;
                self.push_change(c, corner, from)?;
            }
        }
        self.other_changes(ring, &given, c)?;
        c.rewedged.sort_unstable_by_key(|r| r.corner);
        Ok(())
    }

    /// Changed corners outside the ring.
    fn other_changes(
        &mut self,
        ring: &mut Ring,
        given: &[Rewedged],
        c: &mut Collapse,
    ) -> Result<(), Damage> {
        let is_other = |r: &&Rewedged| ring.corners.binary_search(&r.corner.0).is_err();
        let others: Vec<Rewedged> = given.iter().filter(is_other).copied().collect();
        let mut n = others.len() as u64;
        self.coder.small(&mut n)?;
        let first = ring.corners.first().copied().unwrap_or(0);
        for i in 0..n as usize {
            let mut corner = others.get(i).map_or(0, |r| r.corner.0);
            let mut from = others.get(i).map_or(0, |r| r.from.0);
            self.coder.near(first, &mut corner)?;
            let mut code = ring.code_of(None, from);
            self.coder.small(&mut code)?;
            self.wedge_of_code(ring, None, code, c.keep.0, &mut from)?;
            self.push_change(c, Corner(corner), from)?;
        }
        Ok(())
    }

    fn push_change(&self, c: &mut Collapse, corner: Corner, from: u32) -> Result<(), Damage> {
        let Some(wedges) = self.replay.face_wedges.get(corner.face().index()) else {
            return Err(Damage("a changed corner is not there"));
        };
        let (from, to) = (WedgeId(from), WedgeId(wedges[corner.k()]));
        c.rewedged.push(Rewedged { corner, from, to });
        Ok(())
    }

    fn removed_wedges(&mut self, ring: &mut Ring, c: &mut Collapse) -> Result<(), Damage> {
        let (keep, drop) = (c.keep, c.drop);
        for face in &mut c.removed {
            for (vertex, wedge) in face.vertices.iter().zip(&mut face.wedges) {
                let side = match *vertex {
                    v if v == keep => Some(0),
                    v if v == drop => Some(1),
                    _ => None,
                };
                let mut code = ring.code_of(side, wedge.0);
                self.coder.small(&mut code)?;
                self.wedge_of_code(ring, side, code, vertex.0, &mut wedge.0)?;
            }
        }
        Ok(())
    }

    /// The wedge of a code, with its values if it is new to the file.
    fn wedge_of_code(
        &mut self,
        ring: &mut Ring,
        side: Option<usize>,
        code: u64,
        vertex: u32,
        wedge: &mut u32,
    ) -> Result<(), Damage> {
        match code {
            0 => {
                self.coder.near(vertex, wedge)?;
                if ring.palette.len() < MAX_PALETTE {
                    ring.palette.push(*wedge);
                }
            }
            1 => {
                let last = side.and_then(|s| ring.last[s]);
                *wedge = last.ok_or(Damage("no wedge was coded before"))?;
            }
            code => {
                let place = usize::try_from(code - 2).unwrap_or(usize::MAX);
                let Some(found) = ring.palette.get(place) else {
                    return Err(Damage("a wedge is not in the palette"));
                };
                *wedge = *found;
            }
        }
        if let Some(side) = side {
            ring.last[side] = Some(*wedge);
        }
        self.show(ring, *wedge)
    }

    /// Codes the values of a wedge unless the file has shown them.
    fn show(&mut self, ring: &Ring, wedge: u32) -> Result<(), Damage> {
        match self.is_known.get_mut(wedge as usize) {
            None => return Err(Damage("a wedge is not there")),
            Some(true) => return Ok(()),
            Some(is_known) => *is_known = true,
        }
        let width = self.replay.width();
        let guess = ring.palette.first().copied().filter(|w| *w != wedge);
        let (at, guess_at) = (wedge as usize * width, guess.map(|w| w as usize * width));
        for i in 0..width {
            let guess = guess_at.map_or(0.0, |g| self.replay.wedge_values[g + i]);
            self.coder.single(guess, &mut self.replay.wedge_values[at + i])?;
        }
        Ok(())
    }

    /// Values of appended wedges that no corner has shown, then the values of all appended ones.
    fn new_values(&mut self, ring: &Ring, c: &mut Collapse) -> Result<(), Damage> {
        let (first, end) = (c.first_new_wedge.0, self.replay.n_wedges);
        for wedge in first..end {
            self.show(ring, wedge)?;
        }
        let width = self.replay.width();
        let values = first as usize * width..end as usize * width;
        c.new_wedges = self.replay.wedge_values.get(values).unwrap_or_default().to_vec();
        Ok(())
    }
}
