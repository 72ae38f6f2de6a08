//! The edge split and the edge swap: do and undo.
//!
//! Both keep the corner order of the triangles they change. Wedges: a split interpolates one new
//! wedge per different pair of end wedges; a swap moves wedges across the edge and is therefore
//! refused on an attribute border.

use glam::DVec3;
use smallvec::SmallVec;

use super::collapse::corner_of;
use super::edit::{Split, SplitFace, Swap};
use super::edit_mesh::{EditMesh, area_normal};
use super::model::{Corner, FaceId, VertexId, WedgeId};
use super::wedges::{Pair, add_pair, edge_parameter};

impl EditMesh {
    /// Splits the edge (a, b) at a new vertex placed at `at`: each triangle (a, b, c) at it keeps
    /// the side of `a` and a new one takes the side of `b`. `None` if there is no such edge.
    pub fn split(&mut self, a: VertexId, b: VertexId, at: DVec3) -> Option<Split> {
        let record = self.plan_split(a, b, at)?;
        self.resplit(&record);
        Some(record)
    }

    /// What splitting the edge (a, b) would do, without doing it. `None` too if both ends are locked.
    pub fn plan_split(&self, a: VertexId, b: VertexId, at: DVec3) -> Option<Split> {
        if self.is_locked(a) && self.is_locked(b) {
            return None;
        }
        let faces = self.edge_faces(a, b);
        let first_new_wedge = self.next_wedge();
        let mut pairs: SmallVec<[Pair; 2]> = SmallVec::new();
        let mut halves = SmallVec::new();
        for (i, &face) in faces.iter().enumerate() {
            let (vertices, wedges) = (self.vertices_of(face), self.wedges_of(face));
            let [at_a, at_b] = [a, b].map(|end| corner_of(vertices, end));
            let pair = add_pair(&mut pairs, [wedges[at_a], wedges[at_b]]);
            let has_wedges = !self.mesh.layers.is_empty();
            halves.push(SplitFace {
                face,
                new_face: FaceId((self.n_face_slots() + i) as u32),
                vertices,
                wedges,
                new_wedge: WedgeId(if has_wedges { first_new_wedge.0 + pair as u32 } else { 0 }),
            });
        }
        let t = edge_parameter(self.position(a), self.position(b), at);
        let new_wedges = self.blend_wedges(&pairs, t);
        let vertex = VertexId(self.n_vertex_slots() as u32);
        let record = Split { a, b, vertex, at, halves, first_new_wedge, new_wedges };
        (!faces.is_empty()).then_some(record)
    }

    /// Applies a split that was undone in exactly this state.
    pub fn resplit(&mut self, record: &Split) {
        let v = record.vertex;
        self.push_vertex(record.at);
        self.push_weight([record.a, record.b]);
        self.append_wedges(&record.new_wedges);
        for half in &record.halves {
            let [at_a, at_b] = [record.a, record.b].map(|end| corner_of(half.vertices, end));
            self.push_face(half, at_a, v);
            let corner = Corner::new(half.face, at_b);
            self.set_vertex(corner, v);
            if !self.mesh.layers.is_empty() {
                self.set_wedge(corner, half.new_wedge);
            }
            self.detach(record.b, half.face);
            self.attach(v, half.face);
        }
        self.refresh_normals(v);
    }

    /// Appends the new triangle of a split: as the old one, but `v` at corner `k`.
    fn push_face(&mut self, half: &SplitFace, k: usize, v: VertexId) {
        let mut vertices = half.vertices.map(|v| v.0);
        vertices[k] = v.0;
        self.mesh.faces.push(vertices);
        if !self.mesh.layers.is_empty() {
            let mut wedges = half.wedges.map(|w| w.0);
            wedges[k] = half.new_wedge.0;
            self.mesh.face_wedges.push(wedges);
        }
        if !self.mesh.face_materials.is_empty() {
            self.mesh.face_materials.push(self.mesh.material_of(half.face));
        }
        if !self.mesh.face_parts.is_empty() {
            self.mesh.face_parts.push(self.mesh.part_of(half.face));
        }
        self.alive.push(true);
        self.weigh(vertices, true);
        self.n_faces += 1;
        self.normals.push(area_normal(&self.mesh.positions, vertices));
        for vertex in vertices {
            self.attach(VertexId(vertex), half.new_face);
        }
    }

    /// Takes back the last edit, a split: the state is bit-equal to the one before it.
    pub fn unsplit(&mut self, record: &Split) {
        for half in record.halves.iter().rev() {
            for vertex in self.vertices_of(half.new_face) {
                self.detach(vertex, half.new_face);
            }
            self.pop_face();
            let corner = Corner::new(half.face, corner_of(half.vertices, record.b));
            self.set_vertex(corner, record.b);
            if !self.mesh.layers.is_empty() {
                self.set_wedge(corner, half.wedges[corner.k()]);
            }
            self.detach(record.vertex, half.face);
            self.attach(record.b, half.face);
        }
        self.truncate_wedges(record.first_new_wedge);
        self.pop_vertex();
        self.pop_weight();
        self.refresh_normals(record.b);
    }

    fn pop_face(&mut self) {
        if let Some(vertices) = self.mesh.faces.pop() {
            self.weigh(vertices, false);
        }
        self.mesh.face_wedges.truncate(self.mesh.faces.len());
        self.mesh.face_materials.truncate(self.mesh.faces.len());
        self.mesh.face_parts.truncate(self.mesh.faces.len());
        self.alive.pop();
        self.normals.pop();
        self.n_faces -= 1;
    }

    /// Replaces the interior edge (a, b) of triangles (a, b, c) and (b, a, d) by the edge (c, d).
    /// `None` unless the edge has exactly two triangles of opposite direction, one part and material and
    /// the same wedges on both sides, c and d are different and not yet joined, and a or b is not locked.
    pub fn swap(&mut self, a: VertexId, b: VertexId) -> Option<Swap> {
        let record = self.plan_swap(a, b)?;
        self.reswap(&record);
        Some(record)
    }

    /// What [`Self::swap`] would do, without doing it.
    pub fn plan_swap(&self, a: VertexId, b: VertexId) -> Option<Swap> {
        if self.is_locked(a) && self.is_locked(b) {
            return None;
        }
        let [left, right] = self.edge_faces(a, b).into_inner().ok()?;
        // `left` is the triangle that runs from a to b.
        let runs_ab = |f| next(self.vertices_of(f), a) == b;
        let (left, right) = match (runs_ab(left), runs_ab(right)) {
            (true, false) => (left, right),
            (false, true) => (right, left),
            _ => return None,
        };
        let c = next(self.vertices_of(left), b);
        let d = next(self.vertices_of(right), a);
        let wedge = |f, v| self.wedges_of(f)[corner_of(self.vertices_of(f), v)];
        let is_seam = [a, b].iter().any(|&v| wedge(left, v) != wedge(right, v));
        let is_border = self.mesh.material_of(left) != self.mesh.material_of(right)
            || self.mesh.part_of(left) != self.mesh.part_of(right);
        if c == d || is_seam || is_border || !self.edge_faces(c, d).is_empty() {
            return None;
        }
        let corner = |f, v| Corner::new(f, corner_of(self.vertices_of(f), v));
        Some(Swap {
            ends: [a, b],
            apexes: [c, d],
            corners: [corner(left, b), corner(right, a)],
            wedges_from: [wedge(left, b), wedge(right, a)],
            wedges_to: [wedge(right, d), wedge(left, c)],
        })
    }

    /// Applies a swap that was undone in exactly this state.
    pub fn reswap(&mut self, record: &Swap) {
        let ([a, b], [c, d]) = (record.ends, record.apexes);
        self.turn(record, [b, a], [d, c], record.wedges_to);
    }

    /// Takes back the last edit, a swap: the state is bit-equal to the one before it.
    pub fn unswap(&mut self, record: &Swap) {
        let ([a, b], [c, d]) = (record.ends, record.apexes);
        self.turn(record, [d, c], [b, a], record.wedges_from);
    }

    /// Moves the two corners of a swap from one pair of vertices to the other.
    fn turn(&mut self, record: &Swap, from: [VertexId; 2], to: [VertexId; 2], w: [WedgeId; 2]) {
        for (i, &corner) in record.corners.iter().enumerate() {
            self.set_vertex(corner, to[i]);
            if !self.mesh.layers.is_empty() {
                self.set_wedge(corner, w[i]);
            }
            self.detach(from[i], corner.face());
            self.attach(to[i], corner.face());
            let vertices = self.mesh.faces[corner.face().index()];
            self.normals[corner.face().index()] = area_normal(&self.mesh.positions, vertices);
        }
    }
}

/// The vertex after `vertex` in a triangle.
fn next(vertices: [VertexId; 3], vertex: VertexId) -> VertexId {
    vertices[(corner_of(vertices, vertex) + 1) % 3]
}
