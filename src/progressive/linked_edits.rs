//! One edit of a level as the file stores it: relative to the mesh before it.
//!
//! Edits of a level are read forward, so the mesh before an edit is there and the record leaves out
//! what that mesh tells: where vertices were, which triangles and corners an edge has, the wedges
//! before, the ids that come next. That a record says the same as the mesh is for
//! [`Replay::check_edit`] to make sure, before encoding.
//!
//! A record, in three streams (alphabet in `bytes`; `shape` unless said otherwise):
//!
//! ```text
//! kind          byte: 0 collapse, 1 split, 2 swap, 3 displacement, 4 revalue
//!
//! collapse      ids: keep; drop, signed from keep
//!   to            3 doubles, predicted by the midpoint of keep and drop
//!   wedges        in a mesh with layers: changes
//! split         ids: a; b, signed from a
//!   at            3 doubles, predicted by the midpoint of a and b
//!   wedges        in a mesh with layers: ids: per cut triangle in ascending order the wedge of the
//!                 new vertex, signed from the first new one; new values
//! swap          ids: the corner of b in (a, b, c); the corner of a in (b, a, d), signed from it
//!   wedges        in a mesh with layers: ids: the wedges after, signed from those of d and c in
//!                 the other triangle
//! displacement  ids: the vertex
//!   to            3 doubles, predicted by where it is
//! revalue
//!   wedges        changes
//!
//! changes       varint: number of corners; each: ids: the corner, signed from the corner before
//!               (or 0); the wedge after, signed from the first new one; then new values
//! new values    varint: number of new wedges; each: a single per value, predicted by the wedge
//!               that the new one replaces at its first corner (in a split: by that of a), or 0
//! ```
//!
//! On an optimized mesh without wedges a displacement takes about 25 bytes before compression, a
//! swap 4, a split 26, a collapse 28, all together 21 after it; a revalue of normals 28 before.
//!
//! Encoder and decoder are one walk over the record with two [`Coder`]s, so they cannot differ.

use std::collections::BTreeMap;

use glam::DVec3;
use smallvec::{Array, SmallVec};

use super::{
    coder::Coder,
    edits::{COLLAPSE, DISPLACEMENT, REVALUE, SPLIT, SWAP},
    error::Damage,
    linked::blank_collapse,
    replay::Replay,
    section::{Cursors, Streams},
};
use crate::mesh::{
    Collapse, Corner, Displacement, Edit, EditRecord, FaceId, RemovedFace, Revalue, Rewedged,
    Split, SplitFace, Swap, VertexId, WedgeId,
};

/// Puts an edit that describes the mesh of `replay`.
pub(super) fn encode(streams: &mut Streams, replay: &Replay, edit: Edit<'_>) -> Result<(), Damage> {
    let mut record = edit.to_record();
    let mut kind = match &record {
        EditRecord::Collapse(_) => COLLAPSE,
        EditRecord::Split(_) => SPLIT,
        EditRecord::Swap(_) => SWAP,
        EditRecord::Displacement(_) => DISPLACEMENT,
        EditRecord::Revalue(_) => REVALUE,
    };
    streams.byte(&mut kind)?;
    Walk { coder: streams, replay, work: 0 }.record(&mut record)
}

/// Reads an edit of the mesh of `replay`. Returns it and the corners visited. Applying it checks
/// it.
pub(super) fn decode(
    cursors: &mut Cursors<'_>,
    replay: &Replay,
) -> Result<(EditRecord, u64), Damage> {
    let mut kind = 0;
    cursors.byte(&mut kind)?;
    let mut record = blank(kind)?;
    let mut walk = Walk { coder: cursors, replay, work: 0 };
    walk.record(&mut record)?;
    let work = walk.work;
    Ok((record, work))
}

/// A record to be filled in.
fn blank(kind: u8) -> Result<EditRecord, Damage> {
    let (vertex, wedge, place) = (VertexId(0), WedgeId(0), DVec3::ZERO);
    Ok(match kind {
        COLLAPSE => EditRecord::Collapse(blank_collapse()),
        SPLIT => EditRecord::Split(Split {
            a: vertex,
            b: vertex,
            vertex,
            at: place,
            halves: SmallVec::new(),
            first_new_wedge: wedge,
            new_wedges: Vec::new(),
        }),
        SWAP => EditRecord::Swap(Swap {
            ends: [vertex; 2],
            apexes: [vertex; 2],
            corners: [Corner(0); 2],
            wedges_from: [wedge; 2],
            wedges_to: [wedge; 2],
        }),
        DISPLACEMENT => EditRecord::Displacement(Displacement { vertex, from: place, to: place }),
        REVALUE => EditRecord::Revalue(Revalue {
            rewedged: SmallVec::new(),
            first_new_wedge: wedge,
            new_wedges: Vec::new(),
        }),
        _ => return Err(Damage("unknown kind of an edit")),
    })
}

struct Walk<'a, C> {
    coder: &'a mut C,
    replay: &'a Replay,
    work: u64,
}

/// The wedge that a new one is like.
type Likes = BTreeMap<u32, WedgeId>;

impl<C: Coder> Walk<'_, C> {
    fn record(&mut self, record: &mut EditRecord) -> Result<(), Damage> {
        match record {
            EditRecord::Collapse(c) => self.collapse(c),
            EditRecord::Split(s) => self.split(s),
            EditRecord::Swap(s) => self.swap(s),
            EditRecord::Displacement(d) => self.displacement(d),
            EditRecord::Revalue(r) => {
                self.changes(&mut r.rewedged, &mut r.first_new_wedge, &mut r.new_wedges)
            }
        }
    }

    fn collapse(&mut self, c: &mut Collapse) -> Result<(), Damage> {
        [c.keep_from, c.drop_from] = self.ends(&mut c.keep, &mut c.drop)?;
        self.place(c.keep_from.midpoint(c.drop_from), &mut c.to)?;
        (c.removed, c.moved) = (SmallVec::new(), SmallVec::new());
        for corner in self.corners_at(c.drop) {
            let face = self.face(corner.face());
            if face.vertices.contains(&c.keep) {
                c.removed.push(face);
            } else {
                c.moved.push(corner);
            }
        }
        self.changes(&mut c.rewedged, &mut c.first_new_wedge, &mut c.new_wedges)
    }

    fn split(&mut self, s: &mut Split) -> Result<(), Damage> {
        let [a, b] = self.ends(&mut s.a, &mut s.b)?;
        self.place(a.midpoint(b), &mut s.at)?;
        s.vertex = VertexId(self.replay.positions.len() as u32);
        let given = std::mem::take(&mut s.halves);
        let mut likes = Likes::new();
        let has_layers = !self.replay.layers.is_empty();
        s.first_new_wedge = WedgeId(if has_layers { self.replay.n_wedges } else { 0 });
        for corner in self.corners_at(s.a) {
            let RemovedFace { face, vertices, wedges } = self.face(corner.face());
            if !vertices.contains(&s.b) {
                continue;
            }
            let i = s.halves.len();
            let mut new_wedge = given.get(i).map_or(WedgeId(0), |half| half.new_wedge);
            if has_layers {
                self.coder.near(s.first_new_wedge.0, &mut new_wedge.0)?;
                likes.entry(new_wedge.0).or_insert(wedges[corner.k()]);
            }
            let new_face = FaceId((self.replay.faces.len() + i) as u32);
            s.halves.push(SplitFace { face, new_face, vertices, wedges, new_wedge });
        }
        if has_layers {
            self.new_values(s.first_new_wedge, &likes, &mut s.new_wedges)
        } else {
            Ok(())
        }
    }

    fn swap(&mut self, s: &mut Swap) -> Result<(), Damage> {
        let [left, right] = &mut s.corners;
        self.coder.id(&mut left.0)?;
        self.coder.near(left.0, &mut right.0)?;
        if s.corners.iter().any(|c| c.face().index() >= self.replay.faces.len()) {
            return Err(Damage("a turned corner is not there"));
        }
        let [[(b, from_b), (c, at_c)], [(a, from_a), (d, at_d)]] = s.corners.map(|corner| {
            let face = self.face(corner.face());
            let next = (corner.k() + 1) % 3;
            [corner.k(), next].map(|k| (face.vertices[k], face.wedges[k]))
        });
        (s.ends, s.apexes) = ([a, b], [c, d]);
        s.wedges_from = [from_b, from_a];
        if !self.replay.layers.is_empty() {
            let [to_d, to_c] = &mut s.wedges_to;
            self.coder.near(at_d.0, &mut to_d.0)?;
            self.coder.near(at_c.0, &mut to_c.0)?;
        }
        Ok(())
    }

    fn displacement(&mut self, d: &mut Displacement) -> Result<(), Damage> {
        self.coder.id(&mut d.vertex.0)?;
        d.from = self.position(d.vertex)?;
        self.place(d.from, &mut d.to)
    }

    /// Codes the ends of an edge; returns where they are.
    fn ends(&mut self, a: &mut VertexId, b: &mut VertexId) -> Result<[DVec3; 2], Damage> {
        self.coder.id(&mut a.0)?;
        self.coder.near(a.0, &mut b.0)?;
        Ok([self.position(*a)?, self.position(*b)?])
    }

    fn place(&mut self, prediction: DVec3, p: &mut DVec3) -> Result<(), Damage> {
        let mut x = p.to_array();
        for (x, guess) in x.iter_mut().zip(prediction.to_array()) {
            self.coder.double(guess, x)?;
        }
        *p = DVec3::from_array(x);
        Ok(())
    }

    fn changes<A: Array<Item = Rewedged>>(
        &mut self,
        rewedged: &mut SmallVec<A>,
        first: &mut WedgeId,
        values: &mut Vec<f32>,
    ) -> Result<(), Damage> {
        if self.replay.layers.is_empty() {
            return Ok(());
        }
        *first = WedgeId(self.replay.n_wedges);
        let given = std::mem::take(rewedged);
        let mut n = given.len() as u64;
        self.coder.small(&mut n)?;
        let (mut before, mut likes) = (0, Likes::new());
        for i in 0..n as usize {
            let (mut corner, mut to) = given.get(i).map_or((0, 0), |r| (r.corner.0, r.to.0));
            self.coder.near(before, &mut corner)?;
            self.coder.near(first.0, &mut to)?;
            before = corner;
            let corner = Corner(corner);
            let Some(wedges) = self.replay.face_wedges.get(corner.face().index()) else {
                return Err(Damage("a changed corner is not there"));
            };
            let from = WedgeId(wedges[corner.k()]);
            likes.entry(to).or_insert(from);
            rewedged.push(Rewedged { corner, from, to: WedgeId(to) });
        }
        self.new_values(*first, &likes, values)
    }

    fn new_values(
        &mut self,
        first: WedgeId,
        likes: &Likes,
        values: &mut Vec<f32>,
    ) -> Result<(), Damage> {
        let mut n = u64::from(self.replay.n_wedges_of(values));
        self.coder.small(&mut n)?;
        let given = std::mem::take(values);
        let mut given = given.into_iter();
        for i in 0..n {
            let id = u32::try_from(u64::from(first.0).saturating_add(i));
            let like = id.ok().and_then(|id| likes.get(&id));
            let guesses = like.map_or(&[][..], |like| self.replay.wedge(like.0));
            for k in 0..self.replay.width() {
                let mut value = given.next().unwrap_or(0.0);
                self.coder.single(guesses.get(k).copied().unwrap_or(0.0), &mut value)?;
                values.push(value);
            }
        }
        Ok(())
    }

    /// The corners at a vertex that is there, ascending.
    fn corners_at(&mut self, vertex: VertexId) -> SmallVec<[Corner; 16]> {
        let mut corners: SmallVec<[Corner; 16]> =
            self.replay.rings.of(vertex.0).map(Corner).collect();
        corners.sort_unstable();
        self.work += corners.len() as u64;
        corners
    }

    /// A face that is there, as it is.
    fn face(&self, face: FaceId) -> RemovedFace {
        let wedges = self.replay.face_wedges.get(face.index()).copied().unwrap_or_default();
        let vertices = self.replay.faces[face.index()].map(VertexId);
        RemovedFace { face, vertices, wedges: wedges.map(WedgeId) }
    }

    fn position(&self, vertex: VertexId) -> Result<DVec3, Damage> {
        let place = self.replay.positions.get(vertex.index());
        Ok(DVec3::from_array(*place.ok_or(Damage("a vertex is not there"))?))
    }
}
