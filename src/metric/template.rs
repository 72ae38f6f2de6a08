//! One local edit with free vertices: the move that every choice of their places makes.
//!
//! An optimizer tries many places for the same vertices under the same change of connectivity.
//! What that removes and adds is worked out once; each candidate then fills in places, so a
//! compound edit (say a split and the displacement of four vertices) costs one evaluation.
//!
//! Invariants:
//! 1. a template holds the triangles of every free vertex, so a move of it may change no triangle
//!    that the template does not name;
//! 2. with derived normals (smooth shading) it also holds the triangles of every vertex whose
//!    normal may change (Lindstrom & Turk 2000, section 5);
//! 3. a template is good as long as none of its triangles changes.

use glam::DVec3;
use smallvec::SmallVec;

use crate::{
    mesh::{Collapse, EditMesh, FaceId, Split, SplitFace, Swap, VertexId},
    render::{AddedFace, MAX_MOVE_VERTICES, Move, Shading},
};

use super::objective::Objective;

/// A change of connectivity that was planned and not yet made.
#[derive(Clone, Copy, Debug)]
pub enum Change<'a> {
    /// None: vertices move, nothing else.
    Nothing,
    /// An edge becomes a vertex.
    Collapse(&'a Collapse),
    /// An edge gets a vertex.
    Split(&'a Split),
    /// An edge turns.
    Swap(&'a Swap),
}

/// A vertex whose place is to be found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Free {
    /// The vertex; a split's new one by the id that it will get.
    pub vertex: VertexId,
    /// Where it starts.
    pub at: DVec3,
    /// The normal it starts with; of use where the model has normals of its own.
    pub normal: DVec3,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Template {
    /// The move with every free vertex where it starts.
    start: Move,
    /// For each corner of each added triangle: how to find its place and whose normal it shares
    /// (derived normals only).
    corners: Vec<[DerivedCorner; 3]>,
}

/// A corner whose triangle contributes to derived normals.
#[derive(Clone, Copy, Debug)]
struct DerivedCorner {
    /// Where it is, if it is not free.
    at_rest: DVec3,
    /// Index among the free vertices.
    free: Option<u8>,
    /// Index among the vertices whose normals change.
    normal: Option<u8>,
}

impl Template {
    /// Triangles that the move removes (all it touches), ascending.
    pub fn touched(&self) -> &[u32] {
        &self.start.removed
    }

    /// The move with every free vertex where it started.
    pub fn start(&self) -> &Move {
        &self.start
    }

    /// The move that puts the i-th free vertex at `places[i]` with normal `normals[i]` (which may
    /// be empty where the model has no normals of its own).
    pub fn at(&self, places: &[DVec3], normals: &[DVec3]) -> Move {
        let mut mv = self.start.clone();
        for (slot, place) in mv.moved.iter_mut().zip(places) {
            slot.1 = *place;
        }
        if self.corners.is_empty() {
            for (slot, normal) in mv.normals.iter_mut().zip(normals) {
                slot.1 = as_stored(*normal);
            }
        } else {
            self.derive_normals(&mut mv);
        }
        mv
    }

    /// Area-weighted unit normals (Lindstrom & Turk 2000, section 4).
    fn derive_normals(&self, mv: &mut Move) {
        for (_, normal) in &mut mv.normals {
            *normal = DVec3::ZERO;
        }
        for corners in &self.corners {
            let place = |c: &DerivedCorner| {
                let free = c.free.and_then(|i| mv.moved.get(usize::from(i)));
                free.map_or(c.at_rest, |m| m.1)
            };
            let [p0, p1, p2] = [&corners[0], &corners[1], &corners[2]].map(place);
            let area = (p1 - p0).cross(p2 - p0);
            for c in corners {
                if let Some(sum) = c.normal.and_then(|i| mv.normals.get_mut(usize::from(i))) {
                    sum.1 += area;
                }
            }
        }
        for (_, normal) in &mut mv.normals {
            *normal = normal.normalize_or_zero();
        }
    }
}

impl Objective {
    /// The template of a planned change in which `free` may move. A collapse's surviving vertex
    /// and a split's new one must be among them. `None` when one move cannot hold it.
    pub fn template(&self, mesh: &EditMesh, change: Change<'_>, free: &[Free]) -> Option<Template> {
        let mut patch = Patch::of_change(self, mesh, change);
        for f in free.iter().filter(|f| f.vertex.index() < mesh.n_vertex_slots()) {
            patch.touch_around(self, mesh, f.vertex);
        }
        let is_derived = self.shading() == Shading::Smooth && !self.has_own_normals();
        let affected = if is_derived { patch.affected(mesh) } else { Vec::new() };
        for v in affected.iter().filter(|v| v.index() < mesh.n_vertex_slots()) {
            patch.touch_around(self, mesh, *v);
        }
        if patch.added.len() * 3 > MAX_MOVE_VERTICES {
            return None;
        }
        let mut start = patch.into_move();
        start.moved = free.iter().map(|f| (f.vertex.0, f.at)).collect();
        start.normals = if is_derived {
            affected.iter().map(|v| (v.0, DVec3::ZERO)).collect()
        } else if self.has_own_normals() {
            free.iter().map(|f| (f.vertex.0, as_stored(f.normal))).collect()
        } else {
            SmallVec::new()
        };
        let mut template = Template { start, corners: Vec::new() };
        if is_derived {
            template.corners = derived_corners(mesh, &template.start);
            let mut start = std::mem::take(&mut template.start);
            template.derive_normals(&mut start);
            template.start = start;
        }
        Some(template)
    }
}

/// A normal as an attribute layer holds it, in single precision.
fn as_stored(normal: DVec3) -> DVec3 {
    normal.as_vec3().as_dvec3()
}

fn derived_corners(mesh: &EditMesh, mv: &Move) -> Vec<[DerivedCorner; 3]> {
    let index = |at: Option<usize>| at.and_then(|i| u8::try_from(i).ok());
    let corner = |v: u32| {
        let free = index(mv.moved.iter().position(|m| m.0 == v));
        let normal = index(mv.normals.iter().position(|n| n.0 == v));
        let at_rest = if free.is_some() { DVec3::ZERO } else { mesh.position(VertexId(v)) };
        DerivedCorner { at_rest, free, normal }
    };
    mv.added.iter().map(|a| a.vertices.map(corner)).collect()
}

/// The triangles of a move while they are gathered.
struct Patch {
    removed: SmallVec<[u32; 16]>,
    added: SmallVec<[AddedFace; 16]>,
    /// The vertex that a collapse takes away.
    dropped: Option<VertexId>,
}

impl Patch {
    fn of_change(objective: &Objective, mesh: &EditMesh, change: Change<'_>) -> Self {
        let mut patch = Self { removed: SmallVec::new(), added: SmallVec::new(), dropped: None };
        match change {
            Change::Nothing => {}
            Change::Collapse(plan) => patch.collapse(objective, mesh, plan),
            Change::Split(plan) => {
                for half in &plan.halves {
                    patch.split(objective, mesh, plan, half);
                }
            }
            Change::Swap(plan) => patch.swap(objective, mesh, plan),
        }
        patch
    }

    fn collapse(&mut self, objective: &Objective, mesh: &EditMesh, plan: &Collapse) {
        self.dropped = Some(plan.drop);
        for end in [plan.keep, plan.drop] {
            for &face in mesh.faces_around(end) {
                if !self.removed.contains(&face.0) {
                    self.removed.push(face.0);
                    self.added.extend(objective.after_collapse(mesh, plan, face));
                }
            }
        }
    }

    fn split(&mut self, objective: &Objective, mesh: &EditMesh, plan: &Split, half: &SplitFace) {
        self.removed.push(half.face.0);
        let appearance = objective.appearance();
        let old = appearance.of_face(mesh.mesh(), half.face);
        let nth = half.new_wedge.0.saturating_sub(plan.first_new_wedge.0) as usize;
        let cut = |face: FaceId, replaced: VertexId| {
            let (mut vertices, mut surface) = (half.vertices.map(|v| v.0), old);
            for k in (0..3).filter(|&k| half.vertices[k] == replaced) {
                vertices[k] = plan.vertex.0;
                let new = (&plan.new_wedges[..], nth);
                appearance.set_corner(&mut surface, k, (mesh, half.face), new);
            }
            AddedFace { face: face.0, vertices, surface }
        };
        self.added.push(cut(half.face, plan.b));
        self.added.push(cut(half.new_face, plan.a));
    }

    fn swap(&mut self, objective: &Objective, mesh: &EditMesh, plan: &Swap) {
        // The corner of b in the first triangle becomes d's, that of a in the second c's; a
        // corner brings its own colour along (a swap never crosses an attribute border).
        let olds = plan.corners.map(|c| objective.appearance().of_face(mesh.mesh(), c.face()));
        for (i, corner) in plan.corners.iter().enumerate() {
            let face = corner.face();
            let to = plan.apexes[1 - i];
            let other = plan.corners[1 - i].face();
            let mut vertices = mesh.vertices_of(face).map(|v| v.0);
            let mut surface = olds[i];
            vertices[corner.k()] = to.0;
            if let Some(k) = mesh.vertices_of(other).iter().position(|v| *v == to) {
                surface.set_corner(corner.k(), &olds[1 - i], k);
            }
            self.removed.push(face.0);
            self.added.push(AddedFace { face: face.0, vertices, surface });
        }
    }

    /// Adds the triangles at a vertex that are not in it yet, unchanged.
    fn touch_around(&mut self, objective: &Objective, mesh: &EditMesh, vertex: VertexId) {
        for &face in mesh.faces_around(vertex) {
            if !self.removed.contains(&face.0) {
                let vertices = mesh.vertices_of(face).map(|v| v.0);
                let surface = objective.appearance().of_face(mesh.mesh(), face);
                self.removed.push(face.0);
                self.added.push(AddedFace { face: face.0, vertices, surface });
            }
        }
    }

    /// The vertices of all its triangles, before and after, ascending: their normals may change.
    fn affected(&self, mesh: &EditMesh) -> Vec<VertexId> {
        let before = self.removed.iter().flat_map(|f| mesh.vertices_of(FaceId(*f)));
        let after = self.added.iter().flat_map(|a| a.vertices.map(VertexId));
        let mut all: Vec<VertexId> =
            before.chain(after).filter(|v| Some(*v) != self.dropped).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    fn into_move(mut self) -> Move {
        self.removed.sort_unstable();
        self.added.sort_unstable_by_key(|a| a.face);
        Move { removed: self.removed, added: self.added, ..Move::default() }
    }
}
