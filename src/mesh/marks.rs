//! What someone says of single vertices: that they stay where they are, and how much their
//! surroundings matter.
//!
//! Invariants:
//! 1. a locked vertex is neither moved nor removed by an edit that was planned on an
//!    [`EditMesh`]: [`EditMesh::may_collapse`] and the plans of splits and swaps see to that, who
//!    moves vertices asks [`EditMesh::is_locked`], and who collapses asks
//!    [`EditMesh::survivor_first`] and [`EditMesh::fixed_place`];
//! 2. an edge between two locked vertices is neither split nor swapped, and a collapse that ends at a locked vertex
//!    leaves its attributes as they are;
//! 3. marks are no part of a mesh: edits do not record them, and an undo does not restore weights.

use std::collections::BTreeMap;

use glam::DVec3;

use super::edit_mesh::EditMesh;
use super::legality::Topology;
use super::model::{FaceId, Mesh, Semantic, VertexId};

/// What lies along edges whose vertices stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Feature {
    /// Edges that have not exactly two triangles.
    Border,
    /// Edges across which the material, a texture coordinate or a colour changes abruptly.
    Seam,
    /// Edges at which the surface turns by an angle or more.
    HardEdge,
}

/// Greatest weight of a vertex.
pub const MAX_WEIGHT: f32 = 16.0;
/// What a weight of 0 counts as, so that places that do not matter still go in the order of cost.
const LEAST_WEIGHT: f64 = 1.0 / 65_536.0;

/// What is said of the vertices of a mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Marks {
    /// Whether each vertex stays where it is; vertices beyond the end do not have to.
    pub locked: Vec<bool>,
    /// How much the surroundings of each vertex matter, 0 to [`MAX_WEIGHT`]; empty: 1 everywhere.
    pub weights: Vec<f32>,
}

impl Marks {
    /// Number of locked vertices.
    pub fn n_locked(&self) -> usize {
        self.locked.iter().filter(|&&locked| locked).count()
    }

    /// Locks the vertices along some features; `hard_edge_degrees` is the angle of hard edges.
    pub fn lock_along(&mut self, mesh: &Mesh, features: &[Feature], hard_edge_degrees: f64) {
        if features.is_empty() {
            return;
        }
        self.locked.resize(mesh.positions.len(), false);
        let max_cos = libm::cos(hard_edge_degrees.to_radians());
        for (ends, faces) in edges_of(mesh) {
            let is_there = |feature: &Feature| match feature {
                Feature::Border => faces.len() != 2,
                Feature::Seam => is_seam(mesh, ends, &faces),
                Feature::HardEdge => is_hard(mesh, ends, &faces, max_cos),
            };
            if features.iter().any(is_there) {
                ends.iter().for_each(|v| self.locked[*v as usize] = true);
            }
        }
    }

    /// The marks of some vertices, in this order.
    #[must_use]
    pub fn of(&self, vertices: &[VertexId]) -> Self {
        let pick = |v: &VertexId| self.locked.get(v.index()).copied().unwrap_or(false);
        let weigh = |v: &VertexId| self.weights.get(v.index()).copied().unwrap_or(1.0);
        let locked = vertices.iter().filter(|_| !self.locked.is_empty()).map(pick).collect();
        let weights = vertices.iter().filter(|_| !self.weights.is_empty()).map(weigh).collect();
        Self { locked, weights }
    }
}

/// Every edge, by its ends ascending, and the triangles that have it.
fn edges_of(mesh: &Mesh) -> BTreeMap<[u32; 2], Vec<FaceId>> {
    let mut edges: BTreeMap<[u32; 2], Vec<FaceId>> = BTreeMap::new();
    for (f, [a, b, c]) in mesh.faces.iter().enumerate() {
        for (a, b) in [(a, b), (b, c), (c, a)] {
            edges.entry([*a.min(b), *a.max(b)]).or_default().push(FaceId(f as u32));
        }
    }
    edges
}

/// Whether something other than normals, tangents and skins changes across an edge of two triangles.
fn is_seam(mesh: &Mesh, ends: [u32; 2], faces: &[FaceId]) -> bool {
    let &[one, other] = faces else { return false };
    let wedge = |f: FaceId, v: u32| {
        let at = mesh.faces[f.index()].iter().position(|w| *w == v)?;
        mesh.face_wedges.get(f.index()).map(|wedges| wedges[at] as usize)
    };
    let differs = |v: &u32| match (wedge(one, *v), wedge(other, *v)) {
        (Some(a), Some(b)) if a != b => mesh.layers.iter().any(|layer| {
            let values = |w: usize| &layer.values[w * layer.width..][..layer.width];
            !matches!(layer.semantic, Semantic::Normal | Semantic::Tangent | Semantic::Skin)
                && values(a) != values(b)
        }),
        _ => false,
    };
    mesh.material_of(one) != mesh.material_of(other) || ends.iter().any(differs)
}

/// Whether the two triangles at an edge are turned against each other by so much or more. Those that
/// run along it in the same direction show opposite sides: one of them counts as turned over.
fn is_hard(mesh: &Mesh, [a, b]: [u32; 2], faces: &[FaceId], max_cos: f64) -> bool {
    let &[one, other] = faces else { return false };
    let normal = |f: FaceId| {
        let face = mesh.faces[f.index()];
        let [p, q, r] = face.map(|v| mesh.positions[v as usize]);
        let runs = (0..3).any(|k| face[k] == a && face[(k + 1) % 3] == b);
        (q - p).cross(r - p).normalize_or_zero() * if runs { 1.0 } else { -1.0 }
    };
    let (n, m) = (normal(one), normal(other));
    // Triangles without area have no direction.
    n != DVec3::ZERO && m != DVec3::ZERO && -n.dot(m) <= max_cos
}

impl EditMesh {
    /// The same mesh with marks, whose vertices are its own.
    #[must_use]
    pub fn with_marks(mut self, marks: Marks) -> Self {
        self.mark(marks);
        self
    }

    /// Says something else of its vertices.
    pub fn mark(&mut self, marks: Marks) {
        self.marks = marks;
        if self.marks.n_locked() == 0 {
            self.marks.locked.clear();
        }
    }

    /// What is said of its vertices.
    pub fn marks(&self) -> &Marks {
        &self.marks
    }

    /// Whether a vertex stays where it is.
    #[inline]
    pub fn is_locked(&self, vertex: VertexId) -> bool {
        self.marks.locked.get(vertex.index()).copied().unwrap_or(false)
    }

    /// Whether some vertex is locked.
    #[inline]
    pub fn has_locks(&self) -> bool {
        !self.marks.locked.is_empty()
    }

    /// The ends of an edge that may collapse, the one that survives first.
    #[inline]
    pub fn survivor_first(&self, [a, b]: [VertexId; 2]) -> [VertexId; 2] {
        if self.is_locked(b) { [b, a] } else { [a, b] }
    }

    /// Where a collapse of an edge must put its vertex, if that is not free.
    #[inline]
    pub fn fixed_place(&self, ends: [VertexId; 2]) -> Option<DVec3> {
        ends.into_iter().find(|&end| self.is_locked(end)).map(|end| self.position(end))
    }

    /// Whether collapsing (a, b) leaves every locked vertex where it is, with a triangle.
    #[inline]
    pub(super) fn respects_locks(&self, a: VertexId, b: VertexId) -> bool {
        !self.has_locks() || self.leaves_locked(a, b)
    }

    #[cold]
    fn leaves_locked(&self, a: VertexId, b: VertexId) -> bool {
        let going = self.edge_faces(a, b);
        let stays = |v: VertexId| self.faces_around(v).iter().any(|f| !going.contains(f));
        let is_locked = [a, b].map(|end| self.is_locked(end));
        let apexes =
            going.iter().flat_map(|f| self.vertices_of(*f)).filter(|v| ![a, b].contains(v));
        is_locked != [true; 2]
            && (is_locked == [false; 2] || stays(a) || stays(b))
            && apexes.into_iter().all(|v| !self.is_locked(v) || stays(v))
    }

    /// Whether some edge could be collapsed if nothing were locked. O(triangles).
    pub fn is_held_by_locks(&self, topology: Topology) -> bool {
        let sides = |f| {
            let [a, b, c] = self.vertices_of(f);
            [[a, b], [b, c], [c, a]]
        };
        let is_held = |[a, b]: [VertexId; 2]| {
            !self.respects_locks(a, b) && topology.permits(self.legality(a, b))
        };
        self.has_locks() && self.faces().flat_map(sides).any(is_held)
    }

    /// How much the triangles at the ends of an edge matter: the mean weight of their vertices.
    #[inline]
    pub fn weight_around(&self, ends: [VertexId; 2]) -> f64 {
        if self.marks.weights.is_empty() { 1.0 } else { self.mean_weight(ends) }
    }

    #[cold]
    fn mean_weight(&self, ends: [VertexId; 2]) -> f64 {
        let faces = ends.into_iter().flat_map(|end| self.faces_around(end));
        let mut vertices: Vec<VertexId> = faces.flat_map(|f| self.vertices_of(*f)).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let sum: f64 = vertices.iter().map(|v| self.weight(*v)).sum();
        (sum / vertices.len().max(1) as f64).max(LEAST_WEIGHT)
    }

    fn weight(&self, vertex: VertexId) -> f64 {
        self.marks.weights.get(vertex.index()).copied().map_or(1.0, f64::from)
    }

    /// A vertex that stands for two matters as much as the one that matters more.
    pub(super) fn join_weights(&mut self, keep: VertexId, drop: VertexId) {
        let greater = self.weight(keep).max(self.weight(drop)) as f32;
        if let Some(weight) = self.marks.weights.get_mut(keep.index()) {
            *weight = greater;
        }
    }

    /// The last vertex is new, and stands between two.
    pub(super) fn push_weight(&mut self, [a, b]: [VertexId; 2]) {
        if !self.marks.weights.is_empty() {
            let between = f64::midpoint(self.weight(a), self.weight(b)) as f32;
            self.marks.weights.resize(self.n_vertex_slots(), between);
        }
    }

    /// The last vertex is gone.
    pub(super) fn pop_weight(&mut self) {
        self.marks.weights.truncate(self.n_vertex_slots());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{AttributeLayer, shapes};

    /// A roof of two squares, folded by 90 degrees along the edge 1-4; its corners 0 to 5 in two rows.
    fn roof() -> Mesh {
        let row = |y: f64| [(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)].map(|(x, z)| DVec3::new(x, y, z));
        let positions = [row(0.0), row(1.0)].concat();
        Mesh::from_parts(positions, vec![[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    }

    fn locked(mesh: &Mesh, features: &[Feature], degrees: f64) -> Vec<usize> {
        let mut marks = Marks::default();
        marks.lock_along(mesh, features, degrees);
        (0..marks.locked.len()).filter(|v| marks.locked[*v]).collect()
    }

    #[test]
    fn features_are_found() {
        let mut mesh = roof();
        assert_eq!(locked(&mesh, &[Feature::HardEdge], 60.0), [1, 4]);
        assert_eq!(locked(&mesh, &[Feature::HardEdge], 90.5), Vec::<usize>::new());
        assert_eq!(locked(&mesh, &[Feature::Border], 60.0).len(), 6);
        assert_eq!(locked(&mesh, &[Feature::Seam], 60.0), Vec::<usize>::new());
        // One of the slopes turned over: the angle stays.
        mesh.faces[2..].iter_mut().for_each(|f| f.swap(1, 2));
        assert_eq!(locked(&mesh, &[Feature::HardEdge], 60.0), [1, 4]);
        mesh.face_materials = vec![0, 0, 1, 1];
        assert_eq!(locked(&mesh, &[Feature::Seam], 60.0), [1, 4]);
        mesh.face_materials.clear();
        // Wedges 6 and 7 are the corners 1 and 4 as the right slope has them.
        mesh.face_wedges = vec![[0, 1, 4], [0, 4, 3], [6, 2, 5], [6, 5, 7]];
        let mut layer =
            AttributeLayer { semantic: Semantic::Normal, width: 1, values: vec![0.0; 8] };
        layer.values[6] = 1.0;
        mesh.layers = vec![layer];
        assert_eq!(
            locked(&mesh, &[Feature::Seam], 60.0),
            Vec::<usize>::new(),
            "normals make no seam"
        );
        mesh.layers[0].semantic = Semantic::TexCoord(0);
        assert_eq!(locked(&mesh, &[Feature::Seam], 60.0), [1, 4]);
    }

    #[test]
    fn locked_ends_survive_in_place_or_forbid_the_collapse() {
        let locked = vec![false, true, false, false, true, false, false];
        let mesh = EditMesh::new(shapes::octahedron()).unwrap();
        let mesh = mesh.with_marks(Marks { locked, ..Marks::default() });
        let [a, b, c, d] = [0, 1, 2, 4].map(VertexId);
        assert_eq!(
            (mesh.survivor_first([a, b]), mesh.fixed_place([a, b])),
            ([b, a], Some(DVec3::X))
        );
        assert_eq!((mesh.survivor_first([a, c]), mesh.fixed_place([a, c])), ([a, c], None));
        assert!(mesh.may_collapse(a, b, Topology::Preserve));
        assert!(!mesh.may_collapse(b, d, Topology::Free), "both are locked");
        assert!(mesh.plan_swap(b, d).is_none() && mesh.plan_split(b, d, DVec3::X).is_none());
        assert!(mesh.plan_split(a, b, DVec3::X).is_some());
    }

    #[test]
    fn no_collapse_takes_the_last_triangle_of_a_locked_vertex() {
        // Vertex 2 has one triangle, which both collapses of its other side would take away.
        let positions = (0..5).map(|i| DVec3::splat(f64::from(i))).collect();
        let mesh = Mesh::from_parts(positions, vec![[0, 1, 2], [1, 0, 3], [3, 0, 4]]);
        let mut marks = Marks { locked: vec![false; 5], ..Marks::default() };
        let may = |marks: &Marks, a: u32, b: u32| {
            let mesh = EditMesh::new(mesh.clone()).unwrap().with_marks(marks.clone());
            mesh.may_collapse(VertexId(a), VertexId(b), Topology::Free)
        };
        assert!(may(&marks, 0, 1));
        marks.locked[2] = true;
        assert!(!may(&marks, 0, 1) && may(&marks, 0, 3));
    }

    #[test]
    fn weights_are_means_and_go_with_the_survivor() {
        let mesh = EditMesh::new(shapes::octahedron()).unwrap();
        assert_eq!(mesh.weight_around([VertexId(0), VertexId(1)]), 1.0);
        let weights = vec![0.0, 6.0, 0.0, 0.0, 0.0, 0.0];
        let mut mesh = mesh.with_marks(Marks { weights, ..Marks::default() });
        // Around 0-1 are all six vertices; around 3 alone are all but 1.
        assert_eq!(mesh.weight_around([VertexId(0), VertexId(1)]), 1.0);
        assert_eq!(mesh.weight_around([VertexId(3), VertexId(3)]), LEAST_WEIGHT);
        mesh.collapse(VertexId(0), VertexId(1), DVec3::Z);
        assert_eq!(mesh.weight(VertexId(0)), 6.0);
        let split = mesh.split(VertexId(0), VertexId(2), DVec3::Y).unwrap();
        assert_eq!(mesh.weight(split.vertex), 3.0);
        mesh.undo(&split);
        assert_eq!(mesh.marks().weights.len(), 6);
    }
}
