//! Every kind of edit on a [`Replay`]: splits, swaps, displacements and new values beside the
//! collapses of `replay`.
//!
//! Invariants beside those of `replay`:
//! 1. an edit is checked as a whole before anything is changed, in both directions;
//! 2. splits append slots in the order of their ids and their undo removes the last ones, so the
//!    arrays grow by what the record holds and never by a number in it;
//! 3. undoing the last edit gives the mesh before it, bit by bit.

use glam::DVec3;

use super::{
    error::{Damage, ProgressiveError},
    record::{GENERAL_ORDER, order_of, same_bits},
    replay::{Replay, WedgeChange, ensure, is_ascending},
};
use crate::mesh::{
    Displacement, Edit, FaceId, RemovedFace, Revalue, Split, SplitFace, Swap, VertexId, WedgeId,
};

impl Replay {
    /// Applies an edit of any kind.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when the record does not describe this very mesh.
    pub fn apply_edit<'a>(&mut self, edit: impl Into<Edit<'a>>) -> Result<(), ProgressiveError> {
        let edit = edit.into();
        if let Edit::Collapse(c) = edit {
            return self.apply(c);
        }
        self.check_edit(edit).map_err(misfit)?;
        match edit {
            Edit::Collapse(_) => {}
            Edit::Split(s) => self.apply_split(s),
            Edit::Swap(s) => self.turn(s, flipped(s.ends), flipped(s.apexes), s.wedges_to),
            Edit::Displacement(d) => self.positions[d.vertex.index()] = d.to.to_array(),
            Edit::Revalue(r) => self.apply_wedges(change_of(r)),
        }
        self.n_edits += 1;
        Ok(())
    }

    /// Takes back the last edit.
    ///
    /// # Errors
    /// [`ProgressiveError::Misfit`] when the record is not the one that made this very mesh.
    pub fn undo_edit<'a>(&mut self, edit: impl Into<Edit<'a>>) -> Result<(), ProgressiveError> {
        let edit = edit.into();
        if let Edit::Collapse(c) = edit {
            return self.undo(c);
        }
        self.check_undo_edit(edit).map_err(misfit)?;
        match edit {
            Edit::Collapse(_) => {}
            Edit::Split(s) => self.undo_split(s),
            Edit::Swap(s) => self.turn(s, flipped(s.apexes), flipped(s.ends), s.wedges_from),
            Edit::Displacement(d) => self.positions[d.vertex.index()] = d.from.to_array(),
            Edit::Revalue(r) => self.undo_wedges(change_of(r)),
        }
        self.n_edits -= 1;
        Ok(())
    }

    /// Whether an edit describes this very mesh.
    pub(super) fn check_edit(&self, edit: Edit<'_>) -> Result<(), Damage> {
        match edit {
            Edit::Collapse(c) => self.check_apply(c),
            Edit::Split(s) => self.check_split(s),
            Edit::Swap(s) => self.check_swap(s, flipped(s.ends), s.wedges_from, s.wedges_to),
            Edit::Displacement(d) => self.check_place(d, d.from),
            Edit::Revalue(r) => self.check_wedges(change_of(r), self.n_wedges, |r| (r.from, r.to)),
        }
    }

    fn check_undo_edit(&self, edit: Edit<'_>) -> Result<(), Damage> {
        ensure(self.n_edits > 0, "there is no edit to take back")?;
        match edit {
            Edit::Collapse(c) => self.check_undo(c),
            Edit::Split(s) => self.check_undo_split(s),
            Edit::Swap(s) => self.check_swap(s, flipped(s.apexes), s.wedges_to, s.wedges_from),
            Edit::Displacement(d) => self.check_place(d, d.to),
            Edit::Revalue(r) => self.check_undo_wedges(change_of(r)),
        }
    }

    fn check_place(&self, d: &Displacement, place: DVec3) -> Result<(), Damage> {
        ensure(self.is_alive(d.vertex), "the vertex is not there")?;
        ensure(self.is_at(d.vertex, place), "the vertex is somewhere else")
    }

    /// The two faces are (a, b, c) and (b, a, d), but with `turned` at the corners that the swap
    /// turns; these have the wedges `now`.
    fn check_swap(
        &self,
        s: &Swap,
        turned: [VertexId; 2],
        now: [WedgeId; 2],
        then: [WedgeId; 2],
    ) -> Result<(), Damage> {
        let ([a, b], [c, d]) = (s.ends, s.apexes);
        let are_distinct = a != b && c != d && ![a, b].contains(&c) && ![a, b].contains(&d);
        ensure(are_distinct, "the vertices of a swap are not four")?;
        ensure(s.corners[0].face() != s.corners[1].face(), "the faces of a swap are the same")?;
        for (i, corner) in s.corners.into_iter().enumerate() {
            let (id, k) = (corner.face().index(), corner.k());
            ensure(self.is_face_alive.get(id) == Some(&true), "a turned corner is not there")?;
            let [next, last] = [[c, a], [d, b]][i];
            let found = [0, 1, 2].map(|step| VertexId(self.faces[id][(k + step) % 3]));
            ensure(found == [turned[i], next, last], "a turned corner has other vertices")?;
            let wedge = self.face_wedges.get(id).map_or(0, |w| w[k]);
            ensure(wedge == now[i].0, "a turned corner has another wedge")?;
            let is_known = then[i].0 < self.n_wedges.max(1);
            ensure(is_known, "a turned corner gets an unknown wedge")?;
        }
        Ok(())
    }

    fn turn(&mut self, s: &Swap, from: [VertexId; 2], to: [VertexId; 2], wedges: [WedgeId; 2]) {
        for (i, corner) in s.corners.into_iter().enumerate() {
            self.move_corner(corner.0, from[i], to[i]);
            if let Some(face_wedges) = self.face_wedges.get_mut(corner.face().index()) {
                face_wedges[corner.k()] = wedges[i].0;
            }
        }
    }

    fn check_split(&self, s: &Split) -> Result<(), Damage> {
        ensure(s.a != s.b, "the ends of a split edge are the same vertex")?;
        ensure(self.is_alive(s.a) && self.is_alive(s.b), "an end of a split edge is not there")?;
        ensure(s.vertex.index() == self.positions.len(), "the new vertex is not the next one")?;
        let n_corners = 3 * (self.faces.len() + s.halves.len());
        let largest = n_corners.max(self.positions.len() + 1);
        ensure(largest < u32::MAX as usize, "too large for 32-bit ids")?;
        ensure(is_ascending(s.halves.iter().map(|h| h.face.0)), "cut faces do not ascend")?;
        self.check_wedges(wedges_of(s), self.n_wedges, |r| (r.from, r.to))?;
        let n_wedges = self.n_wedges + self.n_wedges_of(&s.new_wedges);
        for (i, half) in s.halves.iter().enumerate() {
            let id = half.face.index();
            ensure(self.is_face_alive.get(id) == Some(&true), "a cut face is not there")?;
            let is_same = self.has_corners(half.face, half.vertices, half.wedges);
            ensure(is_same, "a cut face has other corners")?;
            corners_at(half, s)?;
            let is_next = half.new_face.index() == self.faces.len() + i;
            ensure(is_next, "a new face is not the next one")?;
            ensure(half.new_wedge.0 < n_wedges.max(1), "the new vertex gets an unknown wedge")?;
        }
        let n_at_edge =
            self.rings.of(s.a.0).filter(|c| self.faces[*c as usize / 3].contains(&s.b.0));
        let is_whole = !s.halves.is_empty() && n_at_edge.count() == s.halves.len();
        ensure(is_whole, "not all faces of a split edge are cut")
    }

    fn apply_split(&mut self, s: &Split) {
        self.apply_wedges(wedges_of(s));
        self.positions.push(s.at.to_array());
        self.is_vertex_alive.push(true);
        self.rings.push_vertex();
        self.n_alive_vertices += 1;
        for half in &s.halves {
            let Ok([at_a, at_b]) = corners_at(half, s) else { continue };
            let new = new_half(half, s.vertex, at_a);
            self.faces.push(new.vertices.map(|v| v.0));
            self.is_face_alive.push(false);
            self.rings.push_face();
            for list in [&mut self.face_materials, &mut self.face_parts] {
                list.extend(list.get(half.face.index()).copied());
            }
            self.set_alive(&new, true);
            self.move_corner(3 * half.face.0 + at_b as u32, s.b, s.vertex);
            if !self.face_wedges.is_empty() {
                self.face_wedges.push(new.wedges.map(|w| w.0));
                self.face_wedges[half.face.index()][at_b] = half.new_wedge.0;
            }
        }
    }

    fn check_undo_split(&self, s: &Split) -> Result<(), Damage> {
        let n_halves = s.halves.len();
        ensure(s.a != s.b, "the ends of a split edge are the same vertex")?;
        ensure(self.is_alive(s.a) && self.is_alive(s.b), "an end of a split edge is not there")?;
        ensure(s.vertex.index() + 1 == self.positions.len(), "the new vertex is not the last one")?;
        ensure(s.vertex != s.a && s.vertex != s.b, "the new vertex is an end of its edge")?;
        ensure(self.is_alive(s.vertex), "the new vertex is not there")?;
        ensure(self.is_at(s.vertex, s.at), "the new vertex is somewhere else")?;
        ensure(is_ascending(s.halves.iter().map(|h| h.face.0)), "cut faces do not ascend")?;
        let n_before = self.faces.len().checked_sub(n_halves);
        let n_before = n_before.ok_or(Damage("more new faces than there are"))?;
        self.check_undo_wedges(wedges_of(s))?;
        let n_wedges = if self.layers.is_empty() { 1 } else { s.first_new_wedge.0 };
        for (i, half) in s.halves.iter().enumerate() {
            let [at_a, at_b] = corners_at(half, s)?;
            let (mut vertices, mut wedges) = (half.vertices, half.wedges);
            (vertices[at_b], wedges[at_b]) = (s.vertex, half.new_wedge);
            let is_old = half.face.index() < n_before && half.new_face.index() == n_before + i;
            ensure(is_old, "a new face is not one of the last")?;
            let new = new_half(half, s.vertex, at_a);
            let are_same = self.has_corners(half.face, vertices, wedges)
                && self.has_corners(new.face, new.vertices, new.wedges);
            ensure(are_same, "a cut face has other corners")?;
            let is_known = half.wedges.iter().all(|w| w.0 < n_wedges);
            ensure(is_known, "a cut face has an unknown wedge")?;
        }
        // The corners of the halves at the new vertex are different ones: none may be left.
        let n_corners = self.rings.of(s.vertex.0).take(2 * n_halves + 1).count();
        ensure(n_halves > 0 && n_corners == 2 * n_halves, "the new vertex has other corners")
    }

    fn undo_split(&mut self, s: &Split) {
        for half in s.halves.iter().rev() {
            let Ok([at_a, at_b]) = corners_at(half, s) else { continue };
            self.set_alive(&new_half(half, s.vertex, at_a), false);
            self.move_corner(3 * half.face.0 + at_b as u32, s.vertex, s.b);
            self.faces.pop();
            self.is_face_alive.pop();
            self.rings.pop_face();
            self.face_materials.truncate(self.faces.len());
            self.face_parts.truncate(self.faces.len());
            if let Some(wedges) = self.face_wedges.get_mut(half.face.index()) {
                wedges[at_b] = half.wedges[at_b].0;
            }
            self.face_wedges.truncate(self.faces.len());
        }
        self.rings.pop_vertex();
        self.positions.pop();
        self.is_vertex_alive.pop();
        self.n_alive_vertices -= 1;
        self.undo_wedges(wedges_of(s));
    }

    /// Whether a living face has these vertices and wedges.
    fn has_corners(&self, face: FaceId, vertices: [VertexId; 3], wedges: [WedgeId; 3]) -> bool {
        let id = face.index();
        self.is_face_alive.get(id) == Some(&true)
            && self.faces[id] == vertices.map(|v| v.0)
            && self.face_wedges.get(id).copied().unwrap_or_default() == wedges.map(|w| w.0)
    }

    fn is_at(&self, vertex: VertexId, place: DVec3) -> bool {
        same_bits(DVec3::from_array(self.positions[vertex.index()]), place)
    }
}

fn misfit(Damage(problem): Damage) -> ProgressiveError {
    ProgressiveError::Misfit { problem }
}

fn flipped([a, b]: [VertexId; 2]) -> [VertexId; 2] {
    [b, a]
}

fn change_of(r: &Revalue) -> WedgeChange<'_> {
    WedgeChange { rewedged: &r.rewedged, first_new: r.first_new_wedge, new_values: &r.new_wedges }
}

/// The wedges that a split appends; its corners are looked after by themselves.
fn wedges_of(s: &Split) -> WedgeChange<'_> {
    WedgeChange { rewedged: &[], first_new: s.first_new_wedge, new_values: &s.new_wedges }
}

/// Where the ends of the edge are in a face that is cut.
fn corners_at(half: &SplitFace, s: &Split) -> Result<[usize; 2], Damage> {
    let has_both = order_of(half.vertices, s.a, s.b) != GENERAL_ORDER;
    ensure(has_both, "a cut face lacks an end of the edge")?;
    Ok([s.a, s.b].map(|end| half.vertices.iter().position(|v| *v == end).unwrap_or(0)))
}

/// The new face on the side of b.
fn new_half(half: &SplitFace, vertex: VertexId, at_a: usize) -> RemovedFace {
    let (mut vertices, mut wedges) = (half.vertices, half.wedges);
    (vertices[at_a], wedges[at_a]) = (vertex, half.new_wedge);
    RemovedFace { face: half.new_face, vertices, wedges }
}
