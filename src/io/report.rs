//! What a file held and what became of it: counts for the user, taken on the joined mesh.

use glam::DVec3;
use serde::Serialize;

use super::weld::{Welded, name_of};
use crate::mesh::Mesh;

/// A remark about something that was left out, filled in or read in an unusual way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Note {
    /// Stable lower-snake-case code.
    pub code: &'static str,
    /// For people.
    pub text: String,
    /// How often.
    pub count: u64,
}

/// Axis-aligned bounds, model units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoundingBox {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

/// Counts taken while reading a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct IngestReport {
    /// Name of the format.
    pub format: &'static str,
    /// Triangles after instances were placed and polygons split.
    pub triangles_in_file: u64,
    /// Vertices as stored, instances placed.
    pub vertices_in_file: u64,
    /// Triangles of the mesh.
    pub triangles: u64,
    /// Triangles dropped because two of their corners are at the same point.
    pub degenerate_dropped: u64,
    /// Distinct positions.
    pub vertices: u64,
    /// Distinct attribute vectors at vertices (0 without attributes).
    pub wedges: u64,
    /// Edges with one triangle.
    pub boundary_edges: u64,
    /// Edges with more than two triangles.
    pub non_manifold_edges: u64,
    /// Triangles that repeat the three vertices of an earlier one, in any order.
    pub duplicate_faces: u64,
    /// Pieces that share no vertex.
    pub components: u64,
    /// Bounds of the vertices.
    pub bounding_box: BoundingBox,
    /// Attribute layers.
    pub layers: Vec<String>,
    /// Materials.
    pub materials: u64,
    /// Meshes placed by nodes; 1 for formats without nodes.
    pub instances: u64,
    /// Nodes of the tree; 0 where there is none, or a single one without a name.
    pub nodes: u64,
    /// Parts, of which levels say where they have vanished: the instances that have triangles.
    pub parts: u64,
    /// What was left out, filled in or read in an unusual way.
    pub notes: Vec<Note>,
}

/// Counts everything; takes the notes.
pub(super) fn survey(format: &'static str, welded: &mut Welded) -> IngestReport {
    let mesh = &welded.mesh;
    let edges = EdgeCounts::of(mesh);
    IngestReport {
        format,
        triangles_in_file: welded.n_triangles_in_file,
        vertices_in_file: welded.n_points_in_file,
        triangles: mesh.faces.len() as u64,
        degenerate_dropped: welded.n_degenerate,
        vertices: mesh.positions.len() as u64,
        wedges: mesh.n_wedges() as u64,
        boundary_edges: edges.n_boundary,
        non_manifold_edges: edges.n_non_manifold,
        duplicate_faces: count_duplicates(mesh),
        components: count_components(mesh),
        bounding_box: bounds_of(mesh),
        layers: mesh.layers.iter().map(|l| name_of(l.semantic)).collect(),
        materials: mesh.materials.len() as u64,
        instances: welded.n_instances,
        nodes: mesh.tree.nodes.len() as u64,
        parts: mesh.part_sizes().iter().filter(|n| **n > 0).count() as u64,
        notes: std::mem::take(&mut welded.notes).into_vec(),
    }
}

#[derive(Default)]
struct EdgeCounts {
    n_boundary: u64,
    n_non_manifold: u64,
}

impl EdgeCounts {
    fn of(mesh: &Mesh) -> Self {
        let mut sides: Vec<u64> = Vec::with_capacity(mesh.faces.len() * 3);
        for &[a, b, c] in &mesh.faces {
            let key = |v: u32, w: u32| u64::from(v.min(w)) << 32 | u64::from(v.max(w));
            sides.extend([key(a, b), key(b, c), key(c, a)]);
        }
        sides.sort_unstable();
        let mut counts = Self::default();
        for edge in sides.chunk_by(|x, y| x == y) {
            counts.n_boundary += u64::from(edge.len() == 1);
            counts.n_non_manifold += u64::from(edge.len() > 2);
        }
        counts
    }
}

fn count_components(mesh: &Mesh) -> u64 {
    let mut pieces = Pieces::new(mesh.positions.len());
    for [a, b, c] in &mesh.faces {
        pieces.join(*a, *b);
        pieces.join(*a, *c);
    }
    pieces.count()
}

/// Disjoint sets of vertices (union by the smaller index, with path halving).
struct Pieces(Vec<u32>);

impl Pieces {
    fn new(n: usize) -> Self {
        Self((0..n as u32).collect())
    }

    fn root(&mut self, mut x: u32) -> u32 {
        while self.0[x as usize] != x {
            let up = self.0[self.0[x as usize] as usize];
            self.0[x as usize] = up;
            x = up;
        }
        x
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }

    fn count(&self) -> u64 {
        self.0.iter().enumerate().filter(|(i, up)| *i as u32 == **up).count() as u64
    }
}

fn count_duplicates(mesh: &Mesh) -> u64 {
    let mut keys: Vec<[u32; 3]> = mesh.faces.clone();
    for key in &mut keys {
        key.sort_unstable();
    }
    keys.sort_unstable();
    keys.chunk_by(|a, b| a == b).map(|same| same.len() as u64 - 1).sum()
}

fn bounds_of(mesh: &Mesh) -> BoundingBox {
    let mut points = mesh.positions.iter();
    let first = points.next().copied().unwrap_or(DVec3::ZERO);
    let (min, max) = points.fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    BoundingBox { min: min.to_array(), max: max.to_array() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles on an edge, a third on the same edge, a copy of it turned over, one
    /// more that shares only a vertex, and one apart.
    #[test]
    fn counts_edges_pieces_and_copies() {
        let faces = vec![[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 0, 4], [4, 5, 6], [7, 8, 9]];
        let mesh = Mesh::from_parts(vec![DVec3::ONE; 10], faces);
        let edges = EdgeCounts::of(&mesh);
        assert_eq!((edges.n_boundary, edges.n_non_manifold), (4 + 3 + 3, 1));
        assert_eq!(count_components(&mesh), 2);
        assert_eq!(count_duplicates(&mesh), 1);
    }
}
