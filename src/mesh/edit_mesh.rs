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
//! 6. beside the list of a vertex v lie a copy of its position and its balance: the sum, over the
//!    living triangles (v, q, r) in their direction, of mix(q) − mix(r), modulo 2⁶⁴.
//!
//! Ids are stable: dead slots stay reserved, so that an undo restores the same ids.

use glam::DVec3;
use smallvec::SmallVec;

use super::error::{MeshError, Violation};
use super::lists::{CacheLine, Lists};
use super::marks::Marks;
use super::model::{Corner, FaceId, Mesh, VertexId, WedgeId};
use crate::intrinsics::prefetch;

/// A mesh with connectivity for local edits.
#[derive(Clone, Debug)]
pub struct EditMesh {
    pub(super) mesh: Mesh,
    pub(super) alive: Vec<bool>,
    /// The list of triangles around each vertex, with its site beside it.
    pub(super) around: Lists<FaceId, Site, CacheLine>,
    pub(super) normals: Vec<DVec3>,
    pub(super) n_faces: usize,
    pub(super) n_vertices: usize,
    pub(super) marks: Marks,
}

/// The surroundings of a vertex.
pub(super) struct Ring {
    /// Its neighbours, ascending.
    pub(super) vertices: SmallVec<[VertexId; 24]>,
    /// Whether some edge at it has not exactly two triangles.
    pub(super) is_border: bool,
}

/// What an edit reads of a vertex besides its triangles; with them exactly one cache line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Site {
    /// A copy of the vertex's entry in `mesh.positions`.
    position: DVec3,
    /// See invariant 6.
    balance: u64,
}

impl EditMesh {
    /// Takes over a mesh. O(triangles).
    pub fn new(mesh: Mesh) -> Result<Self, MeshError> {
        mesh.check()?;
        let n_faces = mesh.faces.len();
        let sites = mesh.positions.iter().map(|&position| Site { position, balance: 0 });
        let mut this = Self {
            alive: vec![true; n_faces],
            around: Lists::new(sites),
            normals: mesh.faces.iter().map(|&face| area_normal(&mesh.positions, face)).collect(),
            mesh,
            n_faces,
            n_vertices: 0,
            marks: Marks::default(),
        };
        for f in 0..n_faces {
            let vertices = this.mesh.faces[f];
            for v in vertices {
                this.around.push(v as usize, FaceId(f as u32));
            }
            this.weigh(vertices, true);
        }
        let is_used = |&v: &usize| !this.around.get(v).is_empty();
        this.n_vertices = (0..this.around.len()).filter(is_used).count();
        Ok(this)
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

    /// Begins to load a vertex.
    #[inline]
    pub(crate) fn prefetch_vertex(&self, vertex: VertexId) {
        self.around.prefetch(vertex.index());
    }

    /// Begins to load the corners of the triangles at a vertex.
    #[inline]
    pub(crate) fn prefetch_corners(&self, vertex: VertexId) {
        self.faces_around(vertex).iter().for_each(|f| prefetch(&self.mesh.faces, f.index()));
    }

    /// Begins to load the area normals of the triangles at a vertex.
    #[inline]
    pub(crate) fn prefetch_area_normals(&self, vertex: VertexId) {
        self.faces_around(vertex).iter().for_each(|f| prefetch(&self.normals, f.index()));
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
        self.around.companion(vertex.index()).position
    }

    /// Twice the area vector of a living triangle: (p1 − p0) × (p2 − p0), squared length units.
    #[inline]
    pub fn area_normal(&self, face: FaceId) -> DVec3 {
        self.normals[face.index()]
    }

    /// The living triangles that hold both vertices, ascending; empty if there is no such edge.
    pub fn edge_faces(&self, a: VertexId, b: VertexId) -> SmallVec<[FaceId; 2]> {
        let (few, other) = self.fewer_faces(a, b);
        let holds_both = |f: &FaceId| a != b && self.mesh.faces[f.index()].contains(&other.0);
        few.iter().copied().filter(holds_both).collect()
    }

    /// Whether some living triangle holds both vertices.
    pub(super) fn has_edge(&self, a: VertexId, b: VertexId) -> bool {
        let (few, other) = self.fewer_faces(a, b);
        a != b && few.iter().any(|f| self.mesh.faces[f.index()].contains(&other.0))
    }

    /// The triangles at the end that has fewer, and the other end: one of the two may have very
    /// many.
    #[inline]
    fn fewer_faces(&self, a: VertexId, b: VertexId) -> (&[FaceId], VertexId) {
        let (at_a, at_b) = (self.faces_around(a), self.faces_around(b));
        if at_a.len() <= at_b.len() { (at_a, b) } else { (at_b, a) }
    }

    /// The vertices that share a living triangle with `vertex`, ascending, into `out`.
    pub fn neighbours(&self, vertex: VertexId, out: &mut Vec<VertexId>) {
        out.clear();
        out.extend(self.neighbours_if(vertex, |_| true));
    }

    /// The mean length of the edges at a vertex; 0 where there are none.
    pub fn mean_edge_length(&self, vertex: VertexId) -> f64 {
        let (at, ring) = (self.position(vertex), self.neighbours_if(vertex, |_| true));
        let sum: f64 = ring.iter().map(|w| at.distance(self.position(*w))).sum();
        sum / ring.len().max(1) as f64
    }

    /// Whether the edge has exactly one triangle.
    pub fn is_boundary_edge(&self, a: VertexId, b: VertexId) -> bool {
        self.edge_faces(a, b).len() == 1
    }

    /// Whether some edge at the vertex has not exactly two triangles: it lies on a boundary or
    /// on a non-manifold edge.
    pub fn is_border_vertex(&self, vertex: VertexId) -> bool {
        self.ring(vertex).is_border
    }

    /// Whether every neighbour of the vertex follows it in as many triangles as it precedes it:
    /// true of closed, consistently oriented fans, never true at a boundary edge. O(1).
    ///
    /// (Decided by a checksum: a boundary passes for closed with a chance of 2⁻⁶⁴.)
    #[inline]
    pub fn is_closed_fan(&self, vertex: VertexId) -> bool {
        self.around.companion(vertex.index()).balance == 0
    }

    /// The neighbours of a vertex that pass a test, ascending.
    pub(super) fn neighbours_if(
        &self,
        vertex: VertexId,
        test: impl Fn(VertexId) -> bool,
    ) -> SmallVec<[VertexId; 24]> {
        let mut found = self.spokes_if(vertex, test);
        found.dedup();
        found
    }

    /// The neighbours of a vertex and whether it lies on a border.
    pub(super) fn ring(&self, vertex: VertexId) -> Ring {
        let mut vertices = self.spokes_if(vertex, |_| true);
        let n_times = if self.is_closed_fan(vertex) { 1 } else { 2 };
        let is_border = vertices.chunk_by(|a, b| a == b).any(|same| same.len() != n_times);
        vertices.dedup();
        Ring { vertices, is_border }
    }

    /// The other ends of the triangles' sides at a vertex that pass a test, ascending: in a
    /// closed fan, where each comes up once in either direction, of one direction only.
    #[inline]
    fn spokes_if(
        &self,
        vertex: VertexId,
        test: impl Fn(VertexId) -> bool,
    ) -> SmallVec<[VertexId; 24]> {
        let mut found = SmallVec::new();
        let is_closed = self.is_closed_fan(vertex);
        for &face in self.faces_around(vertex) {
            let [next, last] = self.turned_to(face, vertex);
            if test(next) {
                found.push(next);
            }
            if !is_closed && test(last) {
                found.push(last);
            }
        }
        found.sort_unstable();
        found
    }

    /// The other two vertices of a triangle in its direction, from `vertex` on.
    #[inline]
    pub fn turned_to(&self, face: FaceId, vertex: VertexId) -> [VertexId; 2] {
        let [p, q, r] = self.vertices_of(face);
        // Two selections instead of one branch that nothing could predict.
        let (is_p, is_q) = (p == vertex, q == vertex);
        let next = if is_q { r } else { p };
        let last = if is_q { p } else { q };
        [if is_p { q } else { next }, if is_p { r } else { last }]
    }

    /// Moves a vertex; returns where it was, which is all an undo needs.
    pub fn move_vertex(&mut self, vertex: VertexId, to: DVec3) -> DVec3 {
        let from = self.position(vertex);
        self.put(vertex, to);
        self.refresh_normals(vertex);
        from
    }

    /// Sets a position; normals are the caller's.
    pub(super) fn put(&mut self, vertex: VertexId, to: DVec3) {
        self.mesh.positions[vertex.index()] = to;
        self.around.companion_mut(vertex.index()).position = to;
    }

    /// Appends a vertex without triangles.
    pub(super) fn push_vertex(&mut self, position: DVec3) {
        self.mesh.positions.push(position);
        self.around.push_list(Site { position, balance: 0 });
    }

    /// Removes the last vertex, which has no triangles.
    pub(super) fn pop_vertex(&mut self) {
        self.mesh.positions.pop();
        self.around.pop_list();
    }

    /// Recomputes the area normals of the triangles at a vertex.
    pub(super) fn refresh_normals(&mut self, vertex: VertexId) {
        for face in self.around.get(vertex.index()) {
            let vertices = self.mesh.faces[face.index()];
            self.normals[face.index()] = area_normal(&self.mesh.positions, vertices);
        }
    }

    /// Counts a triangle in (or out) of the balance of its corners.
    pub(super) fn weigh(&mut self, vertices: [u32; 3], is_in: bool) {
        let [p, q, r] = vertices.map(mix);
        let shares = [q.wrapping_sub(r), r.wrapping_sub(p), p.wrapping_sub(q)];
        for (v, share) in vertices.into_iter().zip(shares) {
            self.tip(v, if is_in { share } else { share.wrapping_neg() });
        }
    }

    /// Hangs a corner of a living triangle on another vertex; lists and normals are the caller's.
    pub(super) fn set_vertex(&mut self, corner: Corner, vertex: VertexId) {
        let (face, k) = (corner.face().index(), corner.k());
        let vertices = &mut self.mesh.faces[face];
        let old = std::mem::replace(&mut vertices[k], vertex.0);
        let [next, last] = [vertices[(k + 1) % 3], vertices[(k + 2) % 3]];
        let (mix_next, mix_last) = (mix(next), mix(last));
        let gain = mix(vertex.0).wrapping_sub(mix(old));
        self.tip(old, mix_last.wrapping_sub(mix_next));
        self.tip(vertex.0, mix_next.wrapping_sub(mix_last));
        self.tip(next, gain.wrapping_neg());
        self.tip(last, gain);
    }

    #[inline]
    fn tip(&mut self, vertex: u32, share: u64) {
        let site = self.around.companion_mut(vertex as usize);
        site.balance = site.balance.wrapping_add(share);
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
        let fresh = Self::of_living(self)?;
        let vertices = 0..self.n_vertex_slots();
        if self.around.len() != self.n_vertex_slots() || !self.around.is_sound() {
            return Err(Violation::Pool);
        }
        let differs = |&v: &usize| fresh.around.get(v) != self.around.get(v);
        if let Some(vertex) = vertices.clone().find(differs) {
            return Err(Violation::Incidence { vertex });
        }
        count("living triangles", self.faces().count(), self.n_faces)?;
        count("used vertices", fresh.n_vertices, self.n_vertices)?;
        count("alive flags", self.n_face_slots(), self.alive.len())?;
        count("area normals", self.n_face_slots(), self.normals.len())?;
        let bits = |n: DVec3| n.to_array().map(f64::to_bits);
        let is_stale = |&f: &FaceId| bits(fresh.area_normal(f)) != bits(self.area_normal(f));
        if let Some(face) = self.faces().find(is_stale) {
            return Err(Violation::Normal { face: face.index() });
        }
        let site = |mesh: &Self, v: usize| {
            let site = mesh.around.companion(v);
            (bits(site.position), site.balance)
        };
        match vertices.clone().find(|&v| site(&fresh, v) != site(self, v)) {
            Some(vertex) => Err(Violation::Site { vertex }),
            None => Ok(()),
        }
    }

    /// The same mesh built anew, without what is dead.
    fn of_living(mesh: &Self) -> Result<Self, Violation> {
        let mut fresh = Self::new(mesh.mesh.clone())?;
        for f in (0..mesh.n_face_slots() as u32).map(FaceId).filter(|&f| !mesh.is_alive(f)) {
            for v in fresh.vertices_of(f) {
                fresh.detach(v, f);
            }
            fresh.weigh(mesh.mesh.faces[f.index()], false);
        }
        Ok(fresh)
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

/// Twice the area vector of a triangle, from differences first: no cancellation far from zero.
pub(super) fn area_normal(positions: &[DVec3], face: [u32; 3]) -> DVec3 {
    let [p0, p1, p2] = face.map(|v| positions[v as usize]);
    (p1 - p0).cross(p2 - p0)
}
