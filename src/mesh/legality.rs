//! Which edges may be collapsed (Hoppe et al. 1993, section 4.1, as a table).
//!
//! Border here means: some edge at the vertex has not exactly two triangles. Non-manifold edges
//! therefore act as borders of the sheets that meet there, and are never collapsed themselves.
//!
//! Knows nothing of geometry: flips are the caller's to judge.

use super::edit_mesh::{EditMesh, Ring};
use super::model::VertexId;

/// What stands against collapsing an edge, or that nothing does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Legality {
    /// Collapsing it keeps the topology.
    Legal,
    /// The two vertices share no triangle.
    NoEdge,
    /// More than two triangles share the edge.
    NonManifoldEdge,
    /// Its two triangles have the same third vertex: a degenerate volume.
    FoldedPair,
    /// A vertex adjacent to both ends forms no triangle with the edge.
    LinkVertex,
    /// Both ends lie on a border but the edge is interior: two borders would touch.
    BorderBridge,
    /// The part is as small as it may get: a tetrahedron, or a lone triangle.
    TooSmall,
    /// An edge opposite to both ends: two triangles would fall onto each other.
    LinkEdge,
    /// The edge is a side of a triangular hole, and nothing else is amiss: it closes.
    ClosesHole,
}

/// Whether an edit must keep the topology.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Topology {
    /// Only collapses whose [`Legality`] is `Legal`.
    #[default]
    Preserve,
    /// These, and those that close a triangular hole.
    CloseHoles,
    /// Any edge that exists.
    Free,
}

impl Topology {
    /// Whether a collapse with this finding may go ahead.
    pub fn permits(self, legality: Legality) -> bool {
        match self {
            Self::Preserve => legality == Legality::Legal,
            Self::CloseHoles => matches!(legality, Legality::Legal | Legality::ClosesHole),
            Self::Free => legality != Legality::NoEdge,
        }
    }
}

/// What the rules look at.
struct Facts {
    /// Triangles that hold both ends.
    n_faces: usize,
    /// Different third vertices of those triangles.
    n_apexes: usize,
    /// Vertices adjacent to both ends.
    n_common: usize,
    /// Ends that lie on a border.
    n_border_ends: usize,
    /// Vertices adjacent to an end, the ends included.
    n_vertices: usize,
    /// Vertices that form a hole of three edges with the edge.
    n_holes: usize,
    /// Whether each end has a triangle with both apexes of an interior edge.
    apexes_joined_twice: bool,
}

/// Whether an obstacle is present.
type Test = fn(&Facts) -> bool;

/// The obstacles; the first that is present decides.
const OBSTACLES: [(Legality, Test); 8] = [
    (Legality::NoEdge, |f| f.n_faces == 0),
    (Legality::NonManifoldEdge, |f| f.n_faces > 2),
    (Legality::FoldedPair, |f| f.n_apexes < f.n_faces),
    (Legality::LinkVertex, |f| f.n_common > f.n_apexes + f.n_holes.min(1)),
    (Legality::BorderBridge, |f| f.n_border_ends == 2 && f.n_faces == 2),
    (Legality::TooSmall, |f| f.n_vertices <= if f.n_border_ends == 0 { 4 } else { 3 }),
    (Legality::LinkEdge, |f| f.apexes_joined_twice),
    (Legality::ClosesHole, |f| f.n_holes > 0),
];

impl EditMesh {
    /// Whether the edge (a, b) may be collapsed without changing the topology, and if not, why.
    pub fn legality(&self, a: VertexId, b: VertexId) -> Legality {
        if self.is_plainly_legal(a, b) {
            return Legality::Legal;
        }
        let facts = self.facts(a, b);
        let found = OBSTACLES.iter().find(|(_, is_present)| is_present(&facts));
        found.map_or(Legality::Legal, |&(obstacle, _)| obstacle)
    }

    /// Whether collapsing the edge (a, b) is allowed under the given switch, and by what is locked.
    pub fn may_collapse(&self, a: VertexId, b: VertexId, topology: Topology) -> bool {
        let is_permitted = match topology {
            Topology::Preserve | Topology::CloseHoles => topology.permits(self.legality(a, b)),
            Topology::Free => !self.edge_faces(a, b).is_empty(),
        };
        is_permitted && self.respects_locks(a, b)
    }

    /// Whether the edge lies in the inside of an ordinary surface and no rule can object: both
    /// ends have few triangles, closed and without repetition, and share two neighbours. Says no
    /// when in doubt; spares most edges the table.
    fn is_plainly_legal(&self, a: VertexId, b: VertexId) -> bool {
        let (Some(of_a), Some(of_b)) = (self.small_fan(a), self.small_fan(b)) else { return false };
        let n_common = of_a.next.iter().filter(|&&v| v != NO_VERTEX && of_b.has(v)).count();
        let is_edge = of_a.has(b.0) && of_b.has(a.0);
        // Two common neighbours, and they are the apexes: distinct, so not a folded pair. More
        // than four vertices, and no apex so poor that the other is opposite to both ends.
        let apexes = [of_a.before(b.0), of_b.before(a.0)];
        let are_common = apexes.iter().all(|&v| v != NO_VERTEX && of_a.has(v) && of_b.has(v));
        is_edge
            && n_common == 2
            && are_common
            && apexes[0] != apexes[1]
            && of_a.n + of_b.n > 6
            && !(self.has_face(a, VertexId(apexes[0]), VertexId(apexes[1])))
    }

    /// The neighbours of a vertex that has a few triangles, closed and without repetition.
    fn small_fan(&self, vertex: VertexId) -> Option<SmallFan> {
        let faces = self.faces_around(vertex);
        if faces.len() > MAX_SMALL || !self.is_closed_fan(vertex) {
            return None;
        }
        let mut fan = SmallFan { next: [NO_VERTEX; MAX_SMALL], last: [NO_VERTEX; MAX_SMALL], n: 0 };
        for (i, &face) in faces.iter().enumerate() {
            let [next, last] = self.turned_to(face, vertex);
            if fan.has(next.0) {
                return None;
            }
            (fan.next[i], fan.last[i], fan.n) = (next.0, last.0, i + 1);
        }
        Some(fan)
    }

    fn facts(&self, a: VertexId, b: VertexId) -> Facts {
        let faces = self.edge_faces(a, b);
        let apex = |&f: &_| self.vertices_of(f).into_iter().find(|&v| v != a && v != b);
        let mut apexes: smallvec::SmallVec<[VertexId; 2]> = faces.iter().filter_map(apex).collect();
        apexes.sort_unstable();
        apexes.dedup();
        let rings = [self.ring(a), self.ring(b)];
        let n_common = n_common(&rings[0].vertices, &rings[1].vertices);
        Facts {
            n_faces: faces.len(),
            n_apexes: apexes.len(),
            n_common,
            n_holes: if faces.len() == 1 { self.n_holes_at([a, b], &rings, &apexes) } else { 0 },
            n_border_ends: rings.iter().filter(|ring| ring.is_border).count(),
            n_vertices: rings[0].vertices.len() + rings[1].vertices.len() - n_common,
            apexes_joined_twice: match apexes[..] {
                [c, d] => [a, b].iter().all(|&end| self.has_face(end, c, d)),
                _ => false,
            },
        }
    }

    /// Common neighbours, no apexes, whose edges to both ends are boundaries as well.
    fn n_holes_at(&self, ends: [VertexId; 2], rings: &[Ring; 2], apexes: &[VertexId]) -> usize {
        let [of_a, of_b] = rings;
        let is_hole = |v: &&VertexId| {
            of_b.vertices.binary_search(v).is_ok()
                && !apexes.contains(v)
                && ends.iter().all(|&end| self.is_boundary_edge(end, **v))
        };
        of_a.vertices.iter().filter(is_hole).count()
    }

    /// Whether some living triangle has these three vertices.
    fn has_face(&self, a: VertexId, b: VertexId, c: VertexId) -> bool {
        self.faces_around(a).iter().any(|&f| {
            let vertices = self.vertices_of(f);
            vertices.contains(&b) && vertices.contains(&c)
        })
    }
}

/// Most triangles at an end that the short way looks at.
const MAX_SMALL: usize = 16;
/// In place of a vertex.
const NO_VERTEX: u32 = u32::MAX;

/// The other corners of the triangles at a vertex.
struct SmallFan {
    next: [u32; MAX_SMALL],
    last: [u32; MAX_SMALL],
    n: usize,
}

impl SmallFan {
    /// Whether a vertex is a neighbour. All places are compared, without branches.
    #[inline]
    fn has(&self, vertex: u32) -> bool {
        self.next.iter().filter(|&&v| v == vertex).count() > 0
    }

    /// The vertex that `vertex` precedes in its triangle.
    fn before(&self, vertex: u32) -> u32 {
        let at = self.next.iter().position(|&v| v == vertex);
        at.map_or(NO_VERTEX, |at| self.last[at])
    }
}

/// Vertices that two ascending rings share.
fn n_common(a: &[VertexId], b: &[VertexId]) -> usize {
    let (mut i, mut j, mut n) = (0, 0, 0);
    while let (Some(x), Some(y)) = (a.get(i), b.get(j)) {
        n += usize::from(x == y);
        i += usize::from(x <= y);
        j += usize::from(y <= x);
    }
    n
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::mesh::Mesh;

    /// Legality of (a, b) in a mesh given by its triangles alone.
    fn legality(faces: &[[u32; 3]], a: u32, b: u32) -> Legality {
        let n = faces.iter().flatten().max().map_or(0, |&v| v + 1);
        let positions = (0..n).map(|i| DVec3::splat(f64::from(i))).collect();
        let mesh = EditMesh::new(Mesh::from_parts(positions, faces.to_vec())).unwrap();
        mesh.legality(VertexId(a), VertexId(b))
    }

    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]];
    /// Two fans of four around 0 and 5: an octahedron.
    const OCTAHEDRON: [[u32; 3]; 8] =
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]];

    #[test]
    fn closed_parts_stop_at_the_tetrahedron() {
        assert_eq!(legality(&OCTAHEDRON, 0, 1), Legality::Legal);
        assert_eq!(legality(&TETRAHEDRON, 0, 1), Legality::TooSmall);
    }

    #[test]
    fn open_parts_stop_at_the_triangle() {
        assert_eq!(legality(&[[0, 1, 2]], 0, 1), Legality::TooSmall);
        // Two triangles: an outer edge may go, the diagonal would join two borders.
        let pair = [[0, 1, 2], [0, 2, 3]];
        assert_eq!(legality(&pair, 0, 1), Legality::Legal);
        assert_eq!(legality(&pair, 0, 2), Legality::BorderBridge);
        assert_eq!(legality(&pair, 1, 3), Legality::NoEdge);
    }

    #[test]
    fn soup_is_refused_by_name() {
        let fin = [[0, 1, 2], [1, 0, 3], [0, 1, 4]];
        assert_eq!(legality(&fin, 0, 1), Legality::NonManifoldEdge);
        // The same three vertices twice, once each way round: a volume of nothing.
        assert_eq!(legality(&[[0, 1, 2], [0, 2, 1]], 0, 1), Legality::FoldedPair);
        // A ring of three quads, a tube: edge 0-1 belongs to a hole with third vertex 2. Across a
        // wall, 0-4, two borders would touch.
        let tube = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]];
        assert_eq!(legality(&tube, 0, 1), Legality::ClosesHole);
        assert_eq!(legality(&tube, 0, 4), Legality::BorderBridge);
        // The waist of a longer tube: 0-1-2 is no triangle, and no hole either.
        let mut longer = tube.to_vec();
        longer.extend([[6, 7, 1], [6, 1, 0], [7, 8, 2], [7, 2, 1], [8, 6, 0], [8, 0, 2]]);
        assert_eq!(legality(&longer, 0, 1), Legality::LinkVertex);
        // A tetrahedron whose edge 0-1 ends in a second sheet at vertex 0: more than four
        // vertices, but 2-3 is opposite to both ends.
        let mut pinched = TETRAHEDRON.to_vec();
        pinched.extend([[0, 4, 5], [0, 5, 6], [0, 6, 4], [4, 6, 5]]);
        assert_eq!(legality(&pinched, 0, 1), Legality::LinkEdge);
    }

    #[test]
    fn a_collapse_closes_a_triangular_hole() {
        let mesh = Mesh::from_parts(
            (0..6).map(|i| DVec3::splat(f64::from(i))).collect(),
            OCTAHEDRON[1..].to_vec(),
        );
        let mut mesh = EditMesh::new(mesh).unwrap();
        let [a, b] = [VertexId(0), VertexId(1)];
        assert!(!mesh.may_collapse(a, b, Topology::Preserve));
        assert!(mesh.may_collapse(a, b, Topology::CloseHoles));
        mesh.collapse(a, b, DVec3::ONE);
        mesh.validate().unwrap();
        assert_eq!(mesh.n_faces(), 6);
        assert!((0..6).map(VertexId).all(|v| !mesh.is_used(v) || !mesh.is_border_vertex(v)));
    }

    #[test]
    fn free_topology_takes_every_edge_that_exists() {
        assert!(Topology::Free.permits(Legality::NonManifoldEdge));
        assert!(!Topology::Free.permits(Legality::NoEdge));
        assert!(!Topology::Preserve.permits(Legality::TooSmall));
    }
}
