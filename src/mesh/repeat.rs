//! Edits of a copy of a mesh, made again in the mesh itself, where only some of them are wanted.
//!
//! Invariant: an edit whose surroundings are as they were in the copy does the same here, but for the ids of what
//! is new.

use std::collections::HashMap;

use super::edit::{Edit, EditRecord, Revalue, Rewedged};
use super::edit_mesh::EditMesh;
use super::model::{Corner, FaceId, VertexId, WedgeId};

/// What the new vertices and triangles of the copy are called here; all others have the same names.
#[derive(Debug, Default)]
pub struct Names {
    vertices: HashMap<VertexId, VertexId>,
    faces: HashMap<FaceId, FaceId>,
}

impl Names {
    fn vertex(&self, v: VertexId) -> VertexId {
        self.vertices.get(&v).copied().unwrap_or(v)
    }

    fn face(&self, f: FaceId) -> FaceId {
        self.faces.get(&f).copied().unwrap_or(f)
    }
}

impl EditMesh {
    /// Makes an edit that was made in a copy of this mesh, after those before it. Of new attribute values, which may be
    /// those of many places at once, the corners of wanted triangles of the copy get theirs. `None` if there is
    /// no such edge, or no wanted corner, and nothing is done then.
    pub fn repeat(
        &mut self,
        edit: Edit<'_>,
        names: &mut Names,
        is_wanted: impl Fn(FaceId) -> bool,
    ) -> Option<EditRecord> {
        match edit {
            Edit::Displacement(d) => {
                Some(EditRecord::Displacement(self.displace(names.vertex(d.vertex), d.to)))
            }
            Edit::Swap(s) => {
                let [a, b] = s.ends.map(|v| names.vertex(v));
                self.swap(a, b).map(EditRecord::Swap)
            }
            Edit::Split(s) => {
                let done = self.split(names.vertex(s.a), names.vertex(s.b), s.at)?;
                names.vertices.insert(s.vertex, done.vertex);
                for half in &s.halves {
                    let face = names.face(half.face);
                    let new = done.halves.iter().find(|other| other.face == face);
                    names.faces.extend(new.map(|other| (half.new_face, other.new_face)));
                }
                Some(EditRecord::Split(done))
            }
            Edit::Collapse(c) => {
                let [keep, drop] = [c.keep, c.drop].map(|v| names.vertex(v));
                let is_edge = self.has_edge(keep, drop);
                is_edge.then(|| EditRecord::Collapse(self.collapse(keep, drop, c.to)))
            }
            Edit::Revalue(r) => {
                let record = self.renamed(r, names, is_wanted);
                let is_something = !record.rewedged.is_empty();
                self.redo(&record);
                is_something.then_some(EditRecord::Revalue(record))
            }
        }
    }

    /// New values of a copy's wedges as values of wedges here.
    fn renamed(
        &self,
        revalue: &Revalue,
        names: &Names,
        is_wanted: impl Fn(FaceId) -> bool,
    ) -> Revalue {
        let stride: usize = self.mesh.layers.iter().map(|layer| layer.width).sum();
        let first_new_wedge = self.next_wedge();
        let mut record =
            Revalue { rewedged: <_>::default(), first_new_wedge, new_wedges: Vec::new() };
        let mut wedges: HashMap<WedgeId, WedgeId> = HashMap::new();
        for r in revalue.rewedged.iter().filter(|r| is_wanted(r.corner.face())) {
            let corner = Corner::new(names.face(r.corner.face()), r.corner.k());
            let n_wedges = wedges.len() as u32;
            let to = *wedges.entry(r.to).or_insert_with(|| {
                let at = stride * (r.to.index() - revalue.first_new_wedge.index());
                record.new_wedges.extend(&revalue.new_wedges[at..at + stride]);
                WedgeId(first_new_wedge.0 + n_wedges)
            });
            let from = self.wedges_of(corner.face())[corner.k()];
            record.rewedged.push(Rewedged { corner, from, to });
        }
        record.rewedged.sort_unstable_by_key(|r| r.corner);
        record
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::mesh::{AttributeLayer, Mesh, Semantic, Topology, shapes};

    /// A torus with a value at every vertex.
    fn model() -> Mesh {
        let mut mesh = shapes::torus(32, 12, 0.1);
        mesh.face_wedges.clone_from(&mesh.faces);
        let values = (0..mesh.positions.len()).map(|v| v as f32).collect();
        mesh.layers = vec![AttributeLayer { semantic: Semantic::Color(0), width: 1, values }];
        mesh
    }

    /// Where a triangle's corners are, and their values: what it is, whatever it is called.
    type Triangle = [[u64; 4]; 3];

    fn triangles(mesh: &EditMesh, is_wanted: impl Fn(FaceId) -> bool) -> Vec<Triangle> {
        let corner = |v: VertexId, w: WedgeId| {
            let [x, y, z] = mesh.position(v).to_array().map(f64::to_bits);
            [x, y, z, mesh.mesh().layers[0].get(w)[0].to_bits().into()]
        };
        let triangle = |f: FaceId| {
            let (vertices, wedges) = (mesh.vertices_of(f), mesh.wedges_of(f));
            std::array::from_fn(|k| corner(vertices[k], wedges[k]))
        };
        let mut all: Vec<Triangle> = mesh.faces().filter(|f| is_wanted(*f)).map(triangle).collect();
        all.sort_unstable();
        all
    }

    /// Edits on both sides of a mesh in turns, far enough from each other; the side of each, and of each triangle.
    fn edited(mesh: &mut EditMesh) -> (Vec<(bool, EditRecord)>, Vec<bool>) {
        let sides: Vec<VertexId> = (0..mesh.n_vertex_slots() as u32).map(VertexId).collect();
        let mut is_left: Vec<bool> =
            mesh.faces().map(|f| mesh.position(mesh.vertices_of(f)[0]).x < 0.0).collect();
        let mut edits = Vec::new();
        for (i, v) in sides.into_iter().enumerate().filter(|(i, _)| i % 3 != 1) {
            let mut ring = Vec::new();
            mesh.neighbours(v, &mut ring);
            let x = mesh.position(v).x;
            let is_apart =
                |w: &VertexId| mesh.position(*w).x * x > 0.0 && mesh.position(*w).x.abs() > 0.4;
            let Some(w) = ring.iter().copied().find(|_| x.abs() > 0.7 && ring.iter().all(is_apart))
            else {
                continue;
            };
            let middle = 0.5 * (mesh.position(v) + mesh.position(w));
            let edit = match i % 5 {
                0 => mesh.split(v, w, middle).map(EditRecord::Split),
                1 => mesh.swap(v, w).map(EditRecord::Swap),
                2 => Some(EditRecord::Displacement(mesh.displace(v, middle))),
                3 => mesh
                    .may_collapse(v, w, Topology::Preserve)
                    .then(|| EditRecord::Collapse(mesh.collapse(v, w, middle + 0.01 * DVec3::Z))),
                _ => mesh
                    .revalue(Semantic::Color(0), &[(v, [0.5]), (w, [i as f32])])
                    .map(EditRecord::Revalue),
            };
            if let Some(EditRecord::Split(split)) = &edit {
                is_left.extend(split.halves.iter().map(|_| x < 0.0));
            }
            edits.extend(edit.map(|edit| (x < 0.0, edit)));
        }
        (edits, is_left)
    }

    #[test]
    fn one_side_becomes_what_it_is_in_the_copy_and_the_other_stays() {
        let mut copy = EditMesh::new(model()).unwrap();
        let (edits, is_left) = edited(&mut copy);
        let before = EditMesh::new(model()).unwrap();
        for side in [true, false] {
            let mut mesh = before.clone();
            let mut names = Names::default();
            let is_wanted = |f: FaceId| is_left[f.index()] == side;
            let mut n_kinds = [0; 5];
            for (_, edit) in edits.iter().filter(|(is_left, _)| *is_left == side) {
                let done = mesh.repeat(edit.edit(), &mut names, is_wanted).unwrap();
                mesh.validate().unwrap();
                n_kinds[match done {
                    EditRecord::Collapse(_) => 0,
                    EditRecord::Split(_) => 1,
                    EditRecord::Swap(_) => 2,
                    EditRecord::Displacement(_) => 3,
                    EditRecord::Revalue(_) => 4,
                }] += 1;
            }
            assert!(n_kinds.iter().all(|n| *n > 0), "{n_kinds:?}");
            let mut wanted = triangles(&copy, is_wanted);
            wanted.extend(triangles(&before, |f| !is_wanted(f)));
            wanted.sort_unstable();
            assert!(triangles(&mesh, |_| true) == wanted, "side {side}");
        }
    }

    #[test]
    fn values_of_many_places_are_taken_where_they_are_wanted() {
        let mut copy = EditMesh::new(model()).unwrap();
        let values = [0, 40, 80].map(|v| (VertexId(v), [-1.0]));
        let record = copy.revalue(Semantic::Color(0), &values).unwrap();
        let mut mesh = EditMesh::new(model()).unwrap();
        let at_40 = |f: FaceId| copy.faces_around(VertexId(40)).contains(&f);
        let mut repeat = |is_wanted: &dyn Fn(FaceId) -> bool| {
            mesh.repeat((&record).into(), &mut Names::default(), is_wanted)
        };
        assert_eq!(repeat(&|_| false), None);
        assert!(repeat(&at_40).is_some());
        mesh.validate().unwrap();
        let value = |v: u32| {
            let face = mesh.faces_around(VertexId(v))[0];
            let k = mesh.vertices_of(face).iter().position(|w| w.0 == v).unwrap();
            mesh.mesh().layers[0].get(mesh.wedges_of(face)[k])[0]
        };
        assert_eq!([0, 40, 80].map(value), [0.0, -1.0, 80.0]);
    }

    #[test]
    fn what_cannot_be_made_here_is_not() {
        let mut copy = EditMesh::new(model()).unwrap();
        let ends = copy.vertices_of(FaceId(0));
        let split = copy.split(ends[0], ends[1], DVec3::X).unwrap();
        let mut mesh = EditMesh::new(model()).unwrap();
        mesh.collapse(ends[0], ends[1], DVec3::X);
        let before = mesh.snapshot();
        assert_eq!(mesh.repeat((&split).into(), &mut Names::default(), |_| true), None);
        assert_eq!(mesh.snapshot(), before);
    }
}
