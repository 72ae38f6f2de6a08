//! Explicit edges: an id for every pair of vertices that share a living triangle.
//!
//! Invariants:
//! 1. the living edges are exactly the edges of the mesh that the table was last told of, one id
//!    each, `ends` ascending;
//! 2. `edges_around(v)` is the ascending list of living edges at `v`;
//! 3. new tables number edges by (lower end, upper end); ids are never reused.
//!
//! Follows collapses only, forward only.

use smallvec::SmallVec;

use super::edit::Collapse;
use super::edit_mesh::EditMesh;
use super::error::Violation;
use super::lists::Lists;
use super::model::{EdgeId, VertexId};
use crate::intrinsics::prefetch;

/// Edges of a mesh, by id and by vertex.
#[derive(Clone, Debug)]
pub struct EdgeTable {
    ends: Vec<[VertexId; 2]>,
    alive: Vec<bool>,
    around: Lists<EdgeId>,
}

/// What a collapse did to the edges.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EdgeChange {
    /// Edges that are gone: the collapsed one, the higher of each two that became one, and those
    /// left without a triangle.
    pub died: SmallVec<[EdgeId; 4]>,
}

/// Edges at a vertex, each with its far end.
type Spokes = SmallVec<[(EdgeId, VertexId); 16]>;

impl EdgeTable {
    /// The edges of a mesh. O(triangles).
    pub fn new(mesh: &EditMesh) -> Self {
        let mut ends = Vec::with_capacity(mesh.n_faces() * 3 / 2);
        for v in (0..mesh.n_vertex_slots() as u32).map(VertexId) {
            let upper = mesh.neighbours_if(v, |w| w > v);
            ends.extend(upper.into_iter().map(|w| [v, w]));
        }
        ends.shrink_to_fit();
        let mut around = Lists::new(std::iter::repeat_n((), mesh.n_vertex_slots()));
        for (edge, pair) in ends.iter().enumerate() {
            for v in pair {
                around.push(v.index(), EdgeId(edge as u32));
            }
        }
        Self { alive: vec![true; ends.len()], ends, around }
    }

    /// One more than the highest edge id, dead ones included.
    pub fn n_slots(&self) -> usize {
        self.ends.len()
    }

    /// Whether an edge exists now.
    #[inline]
    pub fn is_alive(&self, edge: EdgeId) -> bool {
        self.alive[edge.index()]
    }

    /// Begins to load the ends of an edge.
    #[inline]
    pub(crate) fn prefetch(&self, edge: EdgeId) {
        prefetch(&self.ends, edge.index());
    }

    /// Begins to load the edges at a vertex.
    #[inline]
    pub(crate) fn prefetch_around(&self, vertex: VertexId) {
        self.around.prefetch(vertex.index());
    }

    /// The ends of an edge, ascending (of a dead one: as it died).
    #[inline]
    pub fn ends(&self, edge: EdgeId) -> [VertexId; 2] {
        self.ends[edge.index()]
    }

    /// The living edges at a vertex, ascending.
    #[inline]
    pub fn edges_around(&self, vertex: VertexId) -> &[EdgeId] {
        self.around.get(vertex.index())
    }

    /// The living edges, ascending.
    pub fn edges(&self) -> impl Iterator<Item = EdgeId> + '_ {
        (0..self.n_slots() as u32).map(EdgeId).filter(|&e| self.is_alive(e))
    }

    /// The edge between two vertices.
    pub fn find(&self, a: VertexId, b: VertexId) -> Option<EdgeId> {
        let (at_a, at_b) = (self.edges_around(a), self.edges_around(b));
        let few = if at_a.len() <= at_b.len() { at_a } else { at_b };
        few.iter().copied().find(|&e| self.ends(e) == if a < b { [a, b] } else { [b, a] })
    }

    /// The end of an edge that is not `vertex`.
    #[inline]
    pub fn other_end(&self, edge: EdgeId, vertex: VertexId) -> VertexId {
        let [a, b] = self.ends(edge);
        if a == vertex { b } else { a }
    }

    /// Follows a collapse; `mesh` is the mesh after it. Edges of `drop` move to `keep`; where
    /// that makes two of one, the lower id stays.
    pub fn apply(&mut self, mesh: &EditMesh, collapse: &Collapse) -> EdgeChange {
        let (keep, drop) = (collapse.keep, collapse.drop);
        let mut change = EdgeChange::default();
        let at_drop = self.spokes(drop, keep);
        let mut at_keep = self.spokes(keep, drop);
        if let Some(edge) = self.find(keep, drop) {
            self.bury(edge, &mut change);
        }
        for (edge, far) in at_drop {
            self.ends[edge.index()] = if far < keep { [far, keep] } else { [keep, far] };
            match at_keep.iter_mut().find(|spoke| spoke.1 == far) {
                Some(spoke) => {
                    let loser = spoke.0.max(edge);
                    spoke.0 = spoke.0.min(edge);
                    self.around.remove(far.index(), loser);
                    self.bury(loser, &mut change);
                }
                None => at_keep.push((edge, far)),
            }
        }
        self.drop_bare_edges(mesh, collapse, &mut at_keep, &mut change);
        at_keep.sort_unstable();
        let mut joined: SmallVec<[EdgeId; 24]> = SmallVec::new();
        for &(edge, _) in &at_keep {
            joined.push(edge);
        }
        self.around.set(keep.index(), &joined);
        self.around.clear(drop.index());
        change
    }

    /// The edges at `vertex`, but not the one to `other`.
    fn spokes(&self, vertex: VertexId, other: VertexId) -> Spokes {
        let mut spokes = Spokes::new();
        for &edge in self.edges_around(vertex) {
            let far = self.other_end(edge, vertex);
            if far != other {
                spokes.push((edge, far));
            }
        }
        spokes
    }

    /// Edges between `keep` and the third vertex of a removed triangle may have lost their last.
    fn drop_bare_edges(
        &mut self,
        mesh: &EditMesh,
        collapse: &Collapse,
        at_keep: &mut Spokes,
        change: &mut EdgeChange,
    ) {
        let ends = [collapse.keep, collapse.drop];
        for removed in &collapse.removed {
            let Some(apex) = removed.vertices.into_iter().find(|v| !ends.contains(v)) else {
                continue;
            };
            if mesh.has_edge(collapse.keep, apex) {
                continue;
            }
            if let Some(at) = at_keep.iter().position(|spoke| spoke.1 == apex) {
                let (bare, _) = at_keep.remove(at);
                self.around.remove(apex.index(), bare);
                self.bury(bare, change);
            }
        }
    }

    fn bury(&mut self, edge: EdgeId, change: &mut EdgeChange) {
        self.alive[edge.index()] = false;
        change.died.push(edge);
    }

    /// Checks invariants 1 and 2 against the mesh; O(triangles). For tests.
    pub fn validate(&self, mesh: &EditMesh) -> Result<(), Violation> {
        let fault = |edge: EdgeId, what| Err(Violation::Edge { edge: edge.index(), what });
        for edge in self.edges() {
            let [a, b] = self.ends(edge);
            if a >= b {
                return fault(edge, "ends are not ascending");
            }
            if mesh.edge_faces(a, b).is_empty() {
                return fault(edge, "alive without a triangle");
            }
            if [a, b].iter().any(|&v| !self.edges_around(v).contains(&edge)) {
                return fault(edge, "missing from the list of an end");
            }
        }
        let n_listed = (0..self.around.len()).map(|v| self.around.get(v).len()).sum::<usize>();
        let actual = Self::new(mesh).n_slots();
        let kept = self.edges().count();
        if actual != kept || n_listed != 2 * kept {
            return Err(Violation::Count { what: "living edges", actual, kept });
        }
        if self.around.is_sound() { Ok(()) } else { Err(Violation::Pool) }
    }
}
