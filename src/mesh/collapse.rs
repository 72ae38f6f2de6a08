//! The edge collapse: plan it, do it, undo it.
//!
//! Triangles that hold both ends go; in the others `drop` is replaced by `keep` in place, so
//! corners keep their order.
//!
//! Wedges: in each removed triangle the wedge of `keep` and the wedge of `drop` merge into one
//! new wedge. Every surviving corner of either vertex that used one of the pair gets the new wedge
//! (the first pair that names it, when a seam ends here). A wedge of a vertex that moves and that no
//! removed triangle has is replaced by one of its own, so that seams which cross the edge survive and
//! the attributes on their other side stay where they are. What new wedges hold: `wedges.rs`.

use glam::DVec3;
use smallvec::SmallVec;

use super::edit::{Collapse, RemovedFace, Rewedged};
use super::edit_mesh::EditMesh;
use super::model::{Corner, FaceId, VertexId, WedgeId};
use super::wedges::{Pair, add_pair};

impl EditMesh {
    /// Collapses (keep, drop) into `keep`, placed at `to`, whatever the topology (see
    /// [`Self::legality`]). Two vertices without a common edge are joined.
    pub fn collapse(&mut self, keep: VertexId, drop: VertexId, to: DVec3) -> Collapse {
        let record = self.plan_collapse(keep, drop, to);
        self.recollapse(&record);
        self.join_weights(keep, drop);
        record
    }

    /// What collapsing (keep, drop) would do, without doing it.
    pub fn plan_collapse(&self, keep: VertexId, drop: VertexId, to: DVec3) -> Collapse {
        debug_assert_ne!(keep, drop);
        let mut record = Collapse {
            keep,
            drop,
            keep_from: self.position(keep),
            drop_from: self.position(drop),
            to,
            removed: SmallVec::new(),
            moved: SmallVec::new(),
            rewedged: SmallVec::new(),
            first_new_wedge: self.next_wedge(),
            new_wedges: Vec::new(),
        };
        for &face in self.faces_around(drop) {
            let vertices = self.vertices_of(face);
            if vertices.contains(&keep) {
                record.removed.push(RemovedFace { face, vertices, wedges: self.wedges_of(face) });
            } else {
                record.moved.push(Corner::new(face, corner_of(vertices, drop)));
            }
        }
        if !self.mesh.layers.is_empty() {
            self.plan_wedges(&mut record);
        }
        record
    }

    /// Fills in the wedges of a planned collapse.
    fn plan_wedges(&self, record: &mut Collapse) {
        let mut pairs: SmallVec<[Pair; 2]> = SmallVec::new();
        for removed in &record.removed {
            let wedge_of = |v| removed.wedges[corner_of(removed.vertices, v)];
            add_pair(&mut pairs, [wedge_of(record.keep), wedge_of(record.drop)]);
        }
        let at_keep = self.faces_around(record.keep).iter().filter_map(|&face| {
            let vertices = self.vertices_of(face);
            let survives = !vertices.contains(&record.drop);
            survives.then(|| Corner::new(face, corner_of(vertices, record.keep)))
        });
        for corner in at_keep.chain(record.moved.iter().copied()) {
            let from = self.wedges_of(corner.face())[corner.k()];
            let at = match pairs.iter().position(|pair| pair.contains(&from)) {
                Some(at) => at,
                None if self.position(self.vertices_of(corner.face())[corner.k()]) == record.to => {
                    continue;
                }
                None => add_pair(&mut pairs, [from; 2]),
            };
            let to = WedgeId(record.first_new_wedge.0 + at as u32);
            record.rewedged.push(Rewedged { corner, from, to });
        }
        record.rewedged.sort_unstable_by_key(|r| r.corner);
        record.new_wedges = self.fit_wedges(record, &pairs);
    }

    /// Applies a collapse that was planned, or undone, in exactly this state.
    pub fn recollapse(&mut self, record: &Collapse) {
        let (keep, drop) = (record.keep, record.drop);
        for removed in &record.removed {
            self.alive[removed.face.index()] = false;
            self.weigh(removed.vertices.map(|v| v.0), false);
            for v in removed.vertices.into_iter().filter(|&v| v != keep && v != drop) {
                self.detach(v, removed.face);
            }
        }
        self.n_faces -= record.removed.len();
        for &corner in &record.moved {
            self.set_vertex(corner, keep);
        }
        let joined = join(self.faces_around(keep), record);
        self.set_faces_around(keep, &joined);
        self.set_faces_around(drop, &[]);
        self.append_wedges(&record.new_wedges);
        for r in &record.rewedged {
            self.set_wedge(r.corner, r.to);
        }
        self.put(keep, record.to);
        self.refresh_normals(keep);
    }

    /// Takes back the last edit, a collapse: the state is bit-equal to the one before it.
    pub fn uncollapse(&mut self, record: &Collapse) {
        let (keep, drop) = (record.keep, record.drop);
        for r in &record.rewedged {
            self.set_wedge(r.corner, r.from);
        }
        self.truncate_wedges(record.first_new_wedge);
        for &corner in &record.moved {
            self.set_vertex(corner, drop);
        }
        let [at_keep, at_drop] = part(self.faces_around(keep), record);
        self.set_faces_around(keep, &at_keep);
        self.set_faces_around(drop, &at_drop);
        for removed in &record.removed {
            self.alive[removed.face.index()] = true;
            self.weigh(removed.vertices.map(|v| v.0), true);
            for v in removed.vertices.into_iter().filter(|&v| v != keep && v != drop) {
                self.attach(v, removed.face);
            }
        }
        self.n_faces += record.removed.len();
        self.put(keep, record.keep_from);
        self.put(drop, record.drop_from);
        self.refresh_normals(keep);
        self.refresh_normals(drop);
    }

    pub(super) fn set_wedge(&mut self, corner: Corner, wedge: WedgeId) {
        self.mesh.face_wedges[corner.face().index()][corner.k()] = wedge.0;
    }
}

/// Which corner of a triangle is at `vertex`; 0 if none is.
pub(super) fn corner_of(vertices: [VertexId; 3], vertex: VertexId) -> usize {
    vertices.iter().position(|&v| v == vertex).unwrap_or(0)
}

/// An ascending list of triangles while it is put together.
type FaceList = SmallVec<[FaceId; 24]>;

/// The list of `keep` after the collapse: its own without the removed, merged with the moved.
fn join(at_keep: &[FaceId], record: &Collapse) -> FaceList {
    let is_removed = |f: FaceId| record.removed.iter().any(|r| r.face == f);
    let mut joined = FaceList::new();
    let mut moved = record.moved.iter().map(|c| c.face()).peekable();
    for &face in at_keep.iter().filter(|&&f| !is_removed(f)) {
        while let Some(earlier) = moved.next_if(|&m| m < face) {
            joined.push(earlier);
        }
        joined.push(face);
    }
    joined.extend(moved);
    joined
}

/// The lists of `keep` and `drop` before the collapse.
fn part(joined: &[FaceId], record: &Collapse) -> [FaceList; 2] {
    let moved: FaceList = record.moved.iter().map(|c| c.face()).collect();
    let removed = record.removed.iter().map(|r| r.face);
    let stayed = joined.iter().copied().filter(|f| moved.binary_search(f).is_err());
    let mut at_keep: FaceList = stayed.chain(removed.clone()).collect();
    let mut at_drop: FaceList = moved.iter().copied().chain(removed).collect();
    at_keep.sort_unstable();
    at_drop.sort_unstable();
    [at_keep, at_drop]
}
