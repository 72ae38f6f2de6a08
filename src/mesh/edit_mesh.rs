//! A mesh that can be edited in place: connectivity, area normals and the queries on them.
//!
//! Any triangle soup will do: an *edge* is a pair of vertices that share a living triangle, and
//! has as many triangles as share both (one: boundary; two: interior; more: non-manifold).
//! Duplicate triangles and opposite windings are ordinary.
//!
//! Invariants of an [`EditMesh`]:
//! 1. its mesh satisfies the invariants of [`Mesh`], dead triangles included;
//! 2. `faces_around(v)` is the ascending list of living triangles with a corner at `v`, so it
//!    depends on the state alone, never on the edits that led to it;
//! 3. `n_faces()` counts living triangles, `n_vertices()` vertices with a living triangle;
//! 4. `area_normal(f)` of a living triangle is the cross product of its current positions;
//! 5. the lists of 2 are sound (see `lists`);
//! 6. `balance[v]` is the sum, over the living triangles (v, q, r) in their direction, of
//!    mix(q) − mix(r), modulo 2⁶⁴.
//!
//! Ids are stable: dead slots stay reserved, so that an undo restores the same ids.

use glam::DVec3;
use smallvec::SmallVec;

use super::error::{MeshError, Violation};
use super::lists::Lists;
use super::model::{FaceId, Mesh, VertexId, WedgeId};

/// A mesh with connectivity for local edits.
#[derive(Clone, Debug)]
pub struct EditMesh {
    pub(super) mesh: Mesh,
    pub(super) alive: Vec<bool>,
    pub(super) around: Lists<FaceId>,
    pub(super) normals: Vec<DVec3>,
    pub(super) balance: Vec<u64>,
    pub(super) n_faces: usize,
    pub(super) n_vertices: usize,
}

impl EditMesh {
    /// Takes over a mesh. O(triangles).
    pub fn new(mesh: Mesh) -> Result<Self, MeshError> {
        mesh.check()?;
        let corners = mesh.faces.iter().enumerate().flat_map(|(f, vertices)| {
            vertices.iter().map(move |&v| (v as usize, FaceId(f as u32)))
        });
        let around = Lists::from_pairs(mesh.positions.len(), corners);
        let n_faces = mesh.faces.len();
        let n_vertices = (0..around.len()).filter(|&v| !around.get(v).is_empty()).count();
        let normals = mesh.faces.iter().map(|&face| area_normal(&mesh.positions, face)).collect();
        let balance = balances(&mesh, 0..n_faces as u32);
        let alive = vec![true; n_faces];
        Ok(Self { mesh, alive, around, normals, balance, n_faces, n_vertices })
    }

    /// The mesh underneath: dead triangles and unused vertices included, wedges of all levels.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Number of living triangles.
    pub fn n_faces(&self) -> usize {
        self.n_faces
    }

    /// Number of vertices with at least one living triangle.
    pub fn n_vertices(&self) -> usize {
        self.n_vertices
    }

    /// One more than the highest triangle id, dead ones included.
    pub fn n_face_slots(&self) -> usize {
        self.mesh.faces.len()
    }

    /// One more than the highest vertex id, unused ones included.
    pub fn n_vertex_slots(&self) -> usize {
        self.mesh.positions.len()
    }

    /// Whether a triangle is part of the mesh now.
    #[inline]
    pub fn is_alive(&self, face: FaceId) -> bool {
        self.alive[face.index()]
    }

    /// Whether a vertex has a living triangle.
    #[inline]
    pub fn is_used(&self, vertex: VertexId) -> bool {
        !self.faces_around(vertex).is_empty()
    }

    /// The living triangles at a vertex, ascending.
    #[inline]
    pub fn faces_around(&self, vertex: VertexId) -> &[FaceId] {
        self.around.get(vertex.index())
    }

    /// The living triangles, ascending.
    pub fn faces(&self) -> impl Iterator<Item = FaceId> + Clone + '_ {
        self.alive.iter().enumerate().filter(|&(_, &alive)| alive).map(|(f, _)| FaceId(f as u32))
    }

    /// The vertices of a triangle in corner order (of a dead one: as it died).
    #[inline]
    pub fn vertices_of(&self, face: FaceId) -> [VertexId; 3] {
        self.mesh.faces[face.index()].map(VertexId)
    }

    /// The wedges of a triangle's corners (all zero without attribute layers).
    pub fn wedges_of(&self, face: FaceId) -> [WedgeId; 3] {
        self.mesh.face_wedges.get(face.index()).map_or([WedgeId(0); 3], |w| w.map(WedgeId))
    }

    /// Where a vertex is, model space.
    #[inline]
    pub fn position(&self, vertex: VertexId) -> DVec3 {
        self.mesh.positions[vertex.index()]
    }

    /// Twice the area vector of a living triangle: (p1 − p0) × (p2 − p0), squared length units.
    #[inline]
    pub fn area_normal(&self, face: FaceId) -> DVec3 {
        self.normals[face.index()]
    }

    /// The living triangles that hold both vertices, ascending; empty if there is no such edge.
    pub fn edge_faces(&self, a: VertexId, b: VertexId) -> SmallVec<[FaceId; 2]> {
        let holds_b = |f: &FaceId| self.mesh.faces[f.index()].contains(&b.0);
        self.faces_around(a).iter().copied().filter(holds_b).collect()
    }

    /// The vertices that share a living triangle with `vertex`, ascending, into `out`.
    pub fn neighbours(&self, vertex: VertexId, out: &mut Vec<VertexId>) {
        out.clear();
        let is_closed = self.is_closed_fan(vertex);
        for &face in self.faces_around(vertex) {
            let [next, last] = self.turned_to(face, vertex);
            out.push(next);
            if !is_closed {
                out.push(last);
            }
        }
        out.sort_unstable();
        out.dedup();
    }

    /// Whether the edge has exactly one triangle.
    pub fn is_boundary_edge(&self, a: VertexId, b: VertexId) -> bool {
        self.edge_faces(a, b).len() == 1
    }

    /// Whether some edge at the vertex has not exactly two triangles: it lies on a boundary or
    /// on a non-manifold edge.
    pub fn is_border_vertex(&self, vertex: VertexId) -> bool {
        self.ring(vertex).iter().any(|&(_, n_faces)| n_faces != 2)
    }

    /// Whether every neighbour of the vertex follows it in as many triangles as it precedes it:
    /// true of closed, consistently oriented fans, never true at a boundary edge. O(1).
    ///
    /// (Decided by a checksum: a boundary passes for closed with a chance of 2⁻⁶⁴.)
    #[inline]
    pub fn is_closed_fan(&self, vertex: VertexId) -> bool {
        self.balance[vertex.index()] == 0
    }

    /// Neighbours of a vertex, ascending, each with the number of triangles of its edge.
    pub(super) fn ring(&self, vertex: VertexId) -> SmallVec<[(VertexId, u32); 16]> {
        let mut ring: SmallVec<[(VertexId, u32); 16]> = SmallVec::new();
        // In a closed fan every neighbour is met as often in the one direction as in the other.
        let is_closed = self.is_closed_fan(vertex);
        for &face in self.faces_around(vertex) {
            let [next, last] = self.turned_to(face, vertex);
            ring.push((next, if is_closed { 2 } else { 1 }));
            if !is_closed {
                ring.push((last, 1));
            }
        }
        ring.sort_unstable();
        ring.dedup_by(|again, first| {
            let is_same = again.0 == first.0;
            first.1 += if is_same { again.1 } else { 0 };
            is_same
        });
        ring
    }

    /// The other two vertices of a triangle in its direction, from `vertex` on.
    #[inline]
    pub fn turned_to(&self, face: FaceId, vertex: VertexId) -> [VertexId; 2] {
        let [p, q, r] = self.vertices_of(face);
        if p == vertex {
            [q, r]
        } else if q == vertex {
            [r, p]
        } else {
            [p, q]
        }
    }

    /// Moves a vertex; returns where it was, which is all an undo needs.
    pub fn move_vertex(&mut self, vertex: VertexId, to: DVec3) -> DVec3 {
        let from = std::mem::replace(&mut self.mesh.positions[vertex.index()], to);
        self.refresh_normals(vertex);
        from
    }

    /// Recomputes the area normals of the triangles at a vertex.
    pub(super) fn refresh_normals(&mut self, vertex: VertexId) {
        for face in self.around.get(vertex.index()) {
            let vertices = self.mesh.faces[face.index()];
            self.normals[face.index()] = area_normal(&self.mesh.positions, vertices);
        }
    }

    /// Counts a triangle in (or out) of the balance of its corners.
    #[inline]
    pub(super) fn weigh(&mut self, vertices: [u32; 3], is_in: bool) {
        for (v, share) in vertices.into_iter().zip(imbalance(vertices)) {
            let balance = &mut self.balance[v as usize];
            *balance = if is_in { balance.wrapping_add(share) } else { balance.wrapping_sub(share) };
        }
    }

    /// Adds a triangle to the list of a vertex.
    pub(super) fn attach(&mut self, vertex: VertexId, face: FaceId) {
        self.n_vertices += usize::from(!self.is_used(vertex));
        self.around.insert(vertex.index(), face);
    }

    /// Takes a triangle off the list of a vertex.
    pub(super) fn detach(&mut self, vertex: VertexId, face: FaceId) {
        let was_used = self.is_used(vertex);
        self.around.remove(vertex.index(), face);
        self.n_vertices -= usize::from(was_used && !self.is_used(vertex));
    }

    /// Replaces the list of a vertex.
    pub(super) fn set_faces_around(&mut self, vertex: VertexId, faces: &[FaceId]) {
        self.n_vertices += usize::from(!faces.is_empty());
        self.n_vertices -= usize::from(self.is_used(vertex));
        if faces.is_empty() {
            self.around.clear(vertex.index());
        } else {
            self.around.set(vertex.index(), faces);
        }
    }

    /// Checks invariants 1 to 6; O(triangles). For tests, after every edit.
    pub fn validate(&self) -> Result<(), Violation> {
        self.mesh.check()?;
        let corners = self.faces().flat_map(|f| self.vertices_of(f).map(|v| (v.index(), f)));
        let around = Lists::from_pairs(self.n_vertex_slots(), corners);
        if self.around.len() != self.n_vertex_slots() || !self.around.is_sound() {
            return Err(Violation::Pool);
        }
        let differs = |&v: &usize| around.get(v) != self.around.get(v);
        if let Some(vertex) = (0..around.len()).find(differs) {
            return Err(Violation::Incidence { vertex });
        }
        let n_vertices = (0..around.len()).filter(|&v| !around.get(v).is_empty()).count();
        count("living triangles", self.faces().count(), self.n_faces)?;
        count("used vertices", n_vertices, self.n_vertices)?;
        count("alive flags", self.n_face_slots(), self.alive.len())?;
        count("area normals", self.n_face_slots(), self.normals.len())?;
        let bits = |n: DVec3| n.to_array().map(f64::to_bits);
        let is_stale = |&f: &FaceId| {
            let fresh = area_normal(&self.mesh.positions, self.mesh.faces[f.index()]);
            bits(fresh) != bits(self.area_normal(f))
        };
        if let Some(face) = self.faces().find(is_stale) {
            return Err(Violation::Normal { face: face.index() });
        }
        let balance = balances(&self.mesh, self.faces().map(|f| f.0));
        match balance.iter().zip(&self.balance).position(|(fresh, kept)| fresh != kept) {
            Some(vertex) => Err(Violation::Balance { vertex }),
            None => count("balances", self.n_vertex_slots(), self.balance.len()),
        }
    }
}

fn count(what: &'static str, actual: usize, kept: usize) -> Result<(), Violation> {
    if actual == kept { Ok(()) } else { Err(Violation::Count { what, actual, kept }) }
}

/// A vertex id spread over 64 bits, such that sums over different sets of vertices differ.
#[inline]
fn mix(vertex: u32) -> u64 {
    let x = (u64::from(vertex) + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (x ^ (x >> 32)).wrapping_mul(x | 1)
}

/// What a triangle adds to the balance of each of its corners.
#[inline]
pub(super) fn imbalance(vertices: [u32; 3]) -> [u64; 3] {
    let [p, q, r] = vertices.map(mix);
    [q.wrapping_sub(r), r.wrapping_sub(p), p.wrapping_sub(q)]
}

/// The balance of every vertex over the given triangles.
fn balances(mesh: &Mesh, faces: impl Iterator<Item = u32>) -> Vec<u64> {
    let mut balance = vec![0u64; mesh.positions.len()];
    for face in faces {
        let vertices = mesh.faces[face as usize];
        for (v, share) in vertices.into_iter().zip(imbalance(vertices)) {
            balance[v as usize] = balance[v as usize].wrapping_add(share);
        }
    }
    balance
}

/// Twice the area vector of a triangle, from differences first: no cancellation far from zero.
pub(super) fn area_normal(positions: &[DVec3], face: [u32; 3]) -> DVec3 {
    let [p0, p1, p2] = face.map(|v| positions[v as usize]);
    (p1 - p0).cross(p2 - p0)
}
