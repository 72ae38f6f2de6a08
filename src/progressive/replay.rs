//! A mesh to which records are applied and from which they are undone, on plain arrays.
//!
//! Invariants:
//! 1. the corners of alive faces are those in `rings`, each at its vertex;
//! 2. vertices of alive faces are alive, the three of a face are distinct;
//! 3. a record is checked against the mesh as a whole before anything is changed: after an error
//!    the mesh is as before;
//! 4. values of wedges are appended and never overwritten by other values.
//!
//! Collapses are here, other edits in `replay_edits`.

use std::sync::Arc;

use glam::DVec3;

use super::{
    error::{Damage, ProgressiveError},
    record::{GENERAL_ORDER, order_of, same_bits},
    rings::Rings,
};
use crate::mesh::{
    AttributeLayer, Collapse, Image, Material, Mesh, RemovedFace, Rewedged, Semantic, Texture,
    Tree, VertexId, WedgeId,
};

/// A mesh at some level between the original and the coarsest.
#[derive(Clone, Debug)]
pub struct Replay {
    pub(super) positions: Vec<[f64; 3]>,
    pub(super) is_vertex_alive: Vec<bool>,
    /// Last known vertices of every face, alive or not.
    pub(super) faces: Vec<[u32; 3]>,
    /// Empty without layers.
    pub(super) face_wedges: Vec<[u32; 3]>,
    pub(super) is_face_alive: Vec<bool>,
    /// Empty when all faces use material 0.
    pub(super) face_materials: Vec<u32>,
    pub(super) rings: Rings,
    /// All layers of a wedge, then those of the next.
    pub(super) wedge_values: Vec<f32>,
    /// Wedges at this level: the original ones and those that records have appended so far.
    pub(super) n_wedges: u32,
    pub(super) n_original_wedges: u32,
    pub(super) layers: Vec<(Semantic, usize)>,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    pub(super) images: Vec<Image>,
    /// Empty when all faces are of part 0.
    pub(super) face_parts: Vec<u32>,
    pub(super) tree: Arc<Tree>,
    pub(super) n_alive_faces: u32,
    pub(super) n_alive_vertices: u32,
    /// Edits other than collapses that are applied.
    pub(super) n_edits: u64,
}

/// What an edit does to wedges.
#[derive(Clone, Copy)]
pub(super) struct WedgeChange<'a> {
    pub(super) rewedged: &'a [Rewedged],
    pub(super) first_new: WedgeId,
    pub(super) new_values: &'a [f32],
}

impl<'a> WedgeChange<'a> {
    fn of(c: &'a Collapse) -> Self {
        Self { rewedged: &c.rewedged, first_new: c.first_new_wedge, new_values: &c.new_wedges }
    }
}

impl Replay {
    /// Starts at the original mesh.
    ///
    /// # Errors
    /// [`ProgressiveError::Mesh`] for a mesh that breaks its invariants.
    pub fn from_mesh(mesh: &Mesh) -> Result<Self, ProgressiveError> {
        check_mesh(mesh).map_err(|problem| ProgressiveError::Mesh { problem })?;
        let (n_vertices, n_faces) = (mesh.positions.len(), mesh.faces.len());
        let mut rings = Rings::new(n_vertices, n_faces);
        for (corner, vertex) in mesh.faces.iter().flatten().enumerate() {
            rings.insert(*vertex, corner as u32);
        }
        let n_wedges = mesh.n_wedges();
        let mut wedge_values = Vec::new();
        for wedge in 0..n_wedges as u32 {
            wedge_values.extend(mesh.layers.iter().flat_map(|l| l.get(WedgeId(wedge))));
        }
        Ok(Self {
            positions: mesh.positions.iter().map(DVec3::to_array).collect(),
            is_vertex_alive: vec![true; n_vertices],
            faces: mesh.faces.clone(),
            face_wedges: mesh.face_wedges.clone(),
            is_face_alive: vec![true; n_faces],
            face_materials: mesh.face_materials.clone(),
            rings,
            wedge_values,
            n_wedges: n_wedges as u32,
            n_original_wedges: n_wedges as u32,
            layers: mesh.layers.iter().map(|l| (l.semantic, l.width)).collect(),
            materials: mesh.materials.clone(),
            textures: mesh.textures.clone(),
            images: mesh.images.clone(),
            face_parts: mesh.face_parts.clone(),
            tree: mesh.tree.clone(),
            n_alive_faces: n_faces as u32,
            n_alive_vertices: n_vertices as u32,
            n_edits: 0,
        })
    }

    /// Triangles at this level.
    pub fn n_faces(&self) -> u32 {
        self.n_alive_faces
    }

    /// Vertices that triangles of this level use.
    pub fn n_vertices(&self) -> u32 {
        (0..self.positions.len() as u32).filter(|v| !self.rings.is_empty(*v)).count() as u32
    }

    /// Collapses: one step coarser.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when the record does not describe this very mesh.
    pub fn apply(&mut self, c: &Collapse) -> Result<(), ProgressiveError> {
        self.check_apply(c).map_err(|Damage(problem)| ProgressiveError::Misfit { problem })?;
        for face in &c.removed {
            self.set_alive(face, false);
        }
        for corner in &c.moved {
            self.move_corner(corner.0, c.drop, c.keep);
        }
        self.apply_wedges(WedgeChange::of(c));
        self.positions[c.keep.index()] = c.to.to_array();
        self.is_vertex_alive[c.drop.index()] = false;
        self.n_alive_vertices -= 1;
        Ok(())
    }

    /// Splits: one step finer.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when the record is not the one that made this very mesh.
    pub fn undo(&mut self, c: &Collapse) -> Result<(), ProgressiveError> {
        self.check_undo(c).map_err(|Damage(problem)| ProgressiveError::Misfit { problem })?;
        self.is_vertex_alive[c.drop.index()] = true;
        self.n_alive_vertices += 1;
        self.positions[c.keep.index()] = c.keep_from.to_array();
        self.positions[c.drop.index()] = c.drop_from.to_array();
        self.undo_wedges(WedgeChange::of(c));
        for corner in &c.moved {
            self.move_corner(corner.0, c.keep, c.drop);
        }
        for face in &c.removed {
            self.faces[face.face.index()] = face.vertices.map(|v| v.0);
            if let Some(wedges) = self.face_wedges.get_mut(face.face.index()) {
                *wedges = face.wedges.map(|w| w.0);
            }
            self.set_alive(face, true);
        }
        Ok(())
    }

    /// The mesh of this level: its faces in the order of their ids, and the vertices and wedges
    /// that they use, in the order of theirs. With no record or edit applied it is the original,
    /// verbatim.
    pub fn to_mesh(&self) -> Mesh {
        if self.is_original() {
            return self.mesh_of(
                &self.positions,
                self.faces.clone(),
                self.face_wedges.clone(),
                None,
            );
        }
        let alive = || (0..self.faces.len()).filter(|f| self.is_face_alive[*f]);
        let mut faces: Vec<[u32; 3]> = alive().map(|f| self.faces[f]).collect();
        let vertices = compact(&mut faces, self.positions.len());
        let positions: Vec<_> = vertices.iter().map(|v| self.positions[*v as usize]).collect();
        let mut face_wedges: Vec<[u32; 3]> =
            alive().filter_map(|f| self.face_wedges.get(f).copied()).collect();
        let wedges = compact(&mut face_wedges, self.wedge_values.len() / self.width().max(1));
        let mut mesh = self.mesh_of(&positions, faces, face_wedges, Some(&wedges));
        let of_alive = |list: &[u32]| alive().filter_map(|f| list.get(f).copied()).collect();
        mesh.face_materials = of_alive(&self.face_materials);
        mesh.face_parts = of_alive(&self.face_parts);
        mesh
    }

    /// Whether no record and no edit is applied.
    pub(super) fn is_original(&self) -> bool {
        self.n_alive_faces as usize == self.faces.len()
            && self.n_alive_vertices as usize == self.positions.len()
            && self.n_wedges == self.n_original_wedges
            && self.n_edits == 0
    }

    /// Values per wedge, all layers together.
    pub(super) fn width(&self) -> usize {
        self.layers.iter().map(|l| l.1).sum()
    }

    /// Wedges that have so many values together.
    pub(super) fn n_wedges_of(&self, values: &[f32]) -> u32 {
        (values.len() / self.width().max(1)) as u32
    }

    /// All layers of a wedge; nothing for one that is not there.
    pub(super) fn wedge(&self, wedge: u32) -> &[f32] {
        let at = wedge as usize * self.width();
        self.wedge_values.get(at..at + self.width()).unwrap_or_default()
    }

    /// `wedges` are the wedges to take, `None` for the original ones.
    fn mesh_of(
        &self,
        positions: &[[f64; 3]],
        faces: Vec<[u32; 3]>,
        face_wedges: Vec<[u32; 3]>,
        wedges: Option<&[u32]>,
    ) -> Mesh {
        let mut begin = 0;
        let mut layers = Vec::with_capacity(self.layers.len());
        for &(semantic, width) in &self.layers {
            let of_wedge = |w: u32| self.wedge(w).iter().skip(begin).take(width).copied();
            let values = match wedges {
                Some(list) => list.iter().flat_map(|w| of_wedge(*w)).collect(),
                None => (0..self.n_original_wedges).flat_map(of_wedge).collect(),
            };
            layers.push(AttributeLayer { semantic, width, values });
            begin += width;
        }
        Mesh {
            positions: positions.iter().map(|p| DVec3::from_array(*p)).collect(),
            faces,
            face_wedges,
            face_materials: self.face_materials.clone(),
            layers,
            materials: self.materials.clone(),
            textures: self.textures.clone(),
            images: self.images.clone(),
            face_parts: self.face_parts.clone(),
            tree: self.tree.clone(),
        }
    }

    /// Links or unlinks the corners of a face.
    pub(super) fn set_alive(&mut self, face: &RemovedFace, alive: bool) {
        self.is_face_alive[face.face.index()] = alive;
        for (k, vertex) in face.vertices.iter().enumerate() {
            let corner = 3 * face.face.0 + k as u32;
            if alive {
                self.rings.insert(vertex.0, corner);
            } else {
                self.rings.remove(vertex.0, corner);
            }
        }
        if alive {
            self.n_alive_faces += 1;
        } else {
            self.n_alive_faces -= 1;
        }
    }

    /// Appends wedges and gives corners their new ones.
    pub(super) fn apply_wedges(&mut self, change: WedgeChange<'_>) {
        for r in change.rewedged {
            self.face_wedges[r.corner.face().index()][r.corner.k()] = r.to.0;
        }
        let begin = change.first_new.index() * self.width();
        let end = begin + change.new_values.len();
        if self.wedge_values.len() < end {
            self.wedge_values.resize(end, 0.0);
        }
        self.wedge_values[begin..end].copy_from_slice(change.new_values);
        self.n_wedges += self.n_wedges_of(change.new_values);
    }

    /// Takes back wedges, but keeps their values: the same ones come again.
    pub(super) fn undo_wedges(&mut self, change: WedgeChange<'_>) {
        self.n_wedges -= self.n_wedges_of(change.new_values);
        for r in change.rewedged {
            self.face_wedges[r.corner.face().index()][r.corner.k()] = r.from.0;
        }
    }

    pub(super) fn move_corner(&mut self, corner: u32, from: VertexId, to: VertexId) {
        self.rings.remove(from.0, corner);
        self.rings.insert(to.0, corner);
        self.faces[corner as usize / 3][corner as usize % 3] = to.0;
    }

    pub(super) fn check_apply(&self, c: &Collapse) -> Result<(), Damage> {
        ensure(c.keep != c.drop, "keep and drop are the same vertex")?;
        ensure(self.is_alive(c.keep) && self.is_alive(c.drop), "keep or drop is not there")?;
        let is_at = |v: VertexId, p| same_bits(DVec3::from_array(self.positions[v.index()]), p);
        ensure(is_at(c.keep, c.keep_from), "keep is somewhere else")?;
        ensure(is_at(c.drop, c.drop_from), "drop is somewhere else")?;
        ensure(is_ascending(c.removed.iter().map(|f| f.face.0)), "removed faces do not ascend")?;
        for face in &c.removed {
            let id = face.face.index();
            ensure(self.is_face_alive.get(id) == Some(&true), "a removed face is not there")?;
            let is_same = self.faces[id] == face.vertices.map(|v| v.0)
                && self.face_wedges.get(id).copied().unwrap_or_default()
                    == face.wedges.map(|w| w.0);
            ensure(is_same, "a removed face has other corners")?;
            let order = order_of(face.vertices, c.keep, c.drop);
            ensure(order != GENERAL_ORDER, "a removed face lacks keep or drop")?;
        }
        self.check_corners(c, c.drop)?;
        // No moved corner is of a removed face, so equal numbers mean that none is missing.
        let n_corners = self.rings.of(c.drop.0).count();
        ensure(n_corners == c.moved.len() + c.removed.len(), "not all corners of drop are named")?;
        self.check_wedges(WedgeChange::of(c), self.n_wedges, |r| (r.from, r.to))?;
        for r in &c.rewedged {
            let face = self.faces[r.corner.face().index()];
            let is_removed = face.contains(&c.keep.0) && face.contains(&c.drop.0);
            ensure(!is_removed, "a corner of a removed face gets a new wedge")?;
        }
        Ok(())
    }

    pub(super) fn check_undo(&self, c: &Collapse) -> Result<(), Damage> {
        ensure(self.is_alive(c.keep), "keep is not there")?;
        ensure(self.is_vertex_alive.get(c.drop.index()) == Some(&false), "drop was not dropped")?;
        let is_at = same_bits(DVec3::from_array(self.positions[c.keep.index()]), c.to);
        ensure(is_at, "keep is somewhere else")?;
        ensure(is_ascending(c.removed.iter().map(|f| f.face.0)), "removed faces do not ascend")?;
        let first_new = c.first_new_wedge;
        for face in &c.removed {
            let id = face.face.index();
            ensure(self.is_face_alive.get(id) == Some(&false), "a face was not removed")?;
            let order = order_of(face.vertices, c.keep, c.drop);
            ensure(order != GENERAL_ORDER, "a removed face lacks keep or drop")?;
            let is_third = |v: &VertexId| *v != c.keep && *v != c.drop && self.is_alive(*v);
            let n_third = face.vertices.iter().filter(|v| is_third(v)).count();
            ensure(n_third == 1, "the third vertex of a removed face is not there")?;
            let are_known = if self.layers.is_empty() {
                face.wedges == [WedgeId(0); 3]
            } else {
                face.wedges.iter().all(|w| *w < first_new)
            };
            ensure(are_known, "a removed face has an unknown wedge")?;
        }
        self.check_corners(c, c.keep)?;
        self.check_undo_wedges(WedgeChange::of(c))
    }

    /// The moved corners are corners of alive faces, all at `vertex`, of faces without the other
    /// end of the edge.
    fn check_corners(&self, c: &Collapse, vertex: VertexId) -> Result<(), Damage> {
        ensure(is_ascending(c.moved.iter().map(|x| x.0)), "moved corners do not ascend")?;
        let other = if vertex == c.keep { c.drop } else { c.keep };
        for corner in &c.moved {
            let id = corner.face().index();
            ensure(self.is_face_alive.get(id) == Some(&true), "a moved corner is not there")?;
            let face = self.faces[id];
            ensure(face[corner.k()] == vertex.0, "a moved corner is at another vertex")?;
            ensure(!face.contains(&other.0), "a face with both ends is not removed")?;
        }
        Ok(())
    }

    /// The change is the last one that was made.
    pub(super) fn check_undo_wedges(&self, change: WedgeChange<'_>) -> Result<(), Damage> {
        let n_before = self.n_wedges.checked_sub(self.n_wedges_of(change.new_values));
        let n_before = n_before.filter(|n| *n >= self.n_original_wedges);
        let n_before = n_before.ok_or(Damage("more new wedges than there are"))?;
        self.check_wedges(change, n_before, |r| (r.to, r.from))?;
        let are_old = change.rewedged.iter().all(|r| r.from < change.first_new);
        ensure(are_old, "an old wedge is not old")?;
        let begin = change.first_new.index() * self.width();
        let values = self.wedge_values.get(begin..begin + change.new_values.len());
        let values = values.unwrap_or_default().iter().map(|v| v.to_bits());
        let is_same = values.eq(change.new_values.iter().map(|v| v.to_bits()));
        ensure(is_same, "the new wedges have other values")
    }

    /// `n_before` wedges were there before the change; `sides` gives (now, then) of a corner.
    pub(super) fn check_wedges(
        &self,
        change: WedgeChange<'_>,
        n_before: u32,
        sides: fn(&Rewedged) -> (WedgeId, WedgeId),
    ) -> Result<(), Damage> {
        let WedgeChange { rewedged, first_new, new_values } = change;
        if self.layers.is_empty() {
            let none = rewedged.is_empty() && new_values.is_empty() && first_new.0 == 0;
            return ensure(none, "wedges in a mesh without attributes");
        }
        ensure(first_new.0 == n_before, "new wedges do not follow the last one")?;
        let is_whole = new_values.len().is_multiple_of(self.width());
        ensure(is_whole, "the values of new wedges are not complete")?;
        let n_after = n_before.checked_add(self.n_wedges_of(new_values));
        let n_after = n_after.ok_or(Damage("more wedges than 32 bits can number"))?;
        let ascend = is_ascending(rewedged.iter().map(|r| r.corner.0));
        ensure(ascend, "changed wedges do not ascend")?;
        for r in rewedged {
            let id = r.corner.face().index();
            ensure(self.is_face_alive.get(id) == Some(&true), "a changed corner is not there")?;
            let (now, then) = sides(r);
            ensure(self.face_wedges[id][r.corner.k()] == now.0, "a corner has another wedge")?;
            ensure(then.0 < n_after, "a corner gets an unknown wedge")?;
        }
        Ok(())
    }

    pub(super) fn is_alive(&self, v: VertexId) -> bool {
        self.is_vertex_alive.get(v.index()) == Some(&true)
    }
}

pub(super) fn ensure(condition: bool, problem: &'static str) -> Result<(), Damage> {
    if condition { Ok(()) } else { Err(Damage(problem)) }
}

pub(super) fn is_ascending(ids: impl Iterator<Item = u32>) -> bool {
    ids.is_sorted_by(|a, b| a < b)
}

/// Renumbers the indices in `list` so that those in use follow each other; returns the old ids.
fn compact(list: &mut [[u32; 3]], n: usize) -> Vec<u32> {
    let mut new_ids = vec![u32::MAX; n];
    list.iter().flatten().for_each(|i| new_ids[*i as usize] = 0);
    let used: Vec<u32> = (0..n as u32).filter(|i| new_ids[*i as usize] == 0).collect();
    for (new, old) in used.iter().enumerate() {
        new_ids[*old as usize] = new as u32;
    }
    list.iter_mut().flatten().for_each(|i| *i = new_ids[*i as usize]);
    used
}

fn check_mesh(mesh: &Mesh) -> Result<(), &'static str> {
    let (n_vertices, n_wedges) = (mesh.positions.len(), mesh.n_wedges());
    let in_range = |list: &[[u32; 3]], n: usize| list.iter().flatten().all(|i| (*i as usize) < n);
    let n_face_wedges = if mesh.layers.is_empty() { 0 } else { mesh.faces.len() };
    let is_distinct = |f: &[u32; 3]| f[0] != f[1] && f[1] != f[2] && f[2] != f[0];
    let largest = (mesh.faces.len() * 3).max(n_vertices).max(n_wedges);
    let rules = [
        (u32::try_from(largest).is_ok_and(|n| n < u32::MAX), "too large for 32-bit ids"),
        (in_range(&mesh.faces, n_vertices), "a face names a vertex that is not there"),
        (mesh.faces.iter().all(is_distinct), "a face has a repeated vertex"),
        (mesh.face_wedges.len() == n_face_wedges, "not every corner has a wedge"),
        (in_range(&mesh.face_wedges, n_wedges), "a corner names a wedge that is not there"),
        (
            mesh.layers.iter().all(|l| l.width > 0 && l.values.len() == n_wedges * l.width),
            "an attribute layer has the wrong length",
        ),
        (
            mesh.face_materials.is_empty() || mesh.face_materials.len() == mesh.faces.len(),
            "not every face has a material",
        ),
        (
            mesh.face_parts.is_empty() || mesh.face_parts.len() == mesh.faces.len(),
            "not every face has a part",
        ),
        (
            mesh.face_parts.iter().all(|part| (*part as usize) < mesh.n_parts()),
            "a face names a part that is not there",
        ),
    ];
    rules.iter().find(|(holds, _)| !holds).map_or(Ok(()), |(_, problem)| Err(problem))
}
