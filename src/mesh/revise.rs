//! Edits that leave the connectivity alone, and the redo and undo of any edit.
//!
//! Invariant: undoing the last edit restores the state before it bit for bit, whatever its kind.
//! Redo and undo of splits append and remove slots, so edits are undone in the reverse order.

use glam::DVec3;
use smallvec::SmallVec;

use super::edit::{Displacement, Edit, Revalue, Rewedged};
use super::edit_mesh::EditMesh;
use super::model::{Corner, Semantic, VertexId, WedgeId};

impl EditMesh {
    /// Applies an edit that was planned, or undone, in exactly this state.
    pub fn redo<'a>(&mut self, edit: impl Into<Edit<'a>>) {
        match edit.into() {
            Edit::Collapse(record) => self.recollapse(record),
            Edit::Split(record) => self.resplit(record),
            Edit::Swap(record) => self.reswap(record),
            Edit::Displacement(record) => {
                self.move_vertex(record.vertex, record.to);
            }
            Edit::Revalue(record) => self.rewedge(record, true),
        }
    }

    /// Takes back the last edit: the state is bit-equal to the one before it.
    pub fn undo<'a>(&mut self, edit: impl Into<Edit<'a>>) {
        match edit.into() {
            Edit::Collapse(record) => self.uncollapse(record),
            Edit::Split(record) => self.unsplit(record),
            Edit::Swap(record) => self.unswap(record),
            Edit::Displacement(record) => {
                self.move_vertex(record.vertex, record.from);
            }
            Edit::Revalue(record) => self.rewedge(record, false),
        }
    }

    /// Moves a vertex.
    pub fn displace(&mut self, vertex: VertexId, to: DVec3) -> Displacement {
        let from = self.move_vertex(vertex, to);
        Displacement { vertex, from, to }
    }

    /// Gives every wedge at the vertices new values of one layer, `values[i]` at the i-th vertex;
    /// other layers keep theirs. `None` if the mesh has no such layer of that width.
    pub fn revalue<const N: usize>(
        &mut self,
        semantic: Semantic,
        values: &[(VertexId, [f32; N])],
    ) -> Option<Revalue> {
        let layer = self.mesh.layers.iter().position(|l| l.semantic == semantic && l.width == N)?;
        let values = values.iter().map(|(vertex, value)| (*vertex, None, &value[..]));
        Some(self.revalue_layer(layer, values))
    }

    /// Gives corners new values of one layer: `values[i]` takes the place of the first numbers of what the i-th
    /// corner has, at every corner of its vertex that has the same, whatever its wedge. So what is the same stays
    /// the same. Other layers keep theirs. `None` if the mesh has no such layer, or a narrower one.
    pub fn revalue_shared<const N: usize>(
        &mut self,
        semantic: Semantic,
        values: &[(Corner, [f32; N])],
    ) -> Option<Revalue> {
        let layer = self.mesh.layers.iter().position(|l| l.semantic == semantic && l.width >= N)?;
        let vertex = |corner: Corner| self.vertices_of(corner.face())[corner.k()];
        let wedge = |corner: Corner| self.wedges_of(corner.face())[corner.k()];
        let planned: Vec<_> = (values.iter())
            .map(|(corner, value)| (vertex(*corner), Some(wedge(*corner)), &value[..]))
            .collect();
        Some(self.revalue_layer(layer, planned.into_iter()))
    }

    /// At each vertex, every wedge gets the value; where a wedge is given, only those that have its value.
    fn revalue_layer<'v>(
        &mut self,
        layer: usize,
        values: impl Iterator<Item = (VertexId, Option<WedgeId>, &'v [f32])>,
    ) -> Revalue {
        let mut record = Revalue {
            rewedged: SmallVec::new(),
            first_new_wedge: self.next_wedge(),
            new_wedges: Vec::new(),
        };
        for (vertex, like, value) in values {
            self.plan_revalue((vertex, like), layer, value, &mut record);
        }
        record.rewedged.sort_unstable_by_key(|r| r.corner);
        self.rewedge(&record, true);
        record
    }

    /// Adds corners of one vertex to a record: a new wedge for each old one.
    fn plan_revalue(
        &self,
        (v, like): (VertexId, Option<WedgeId>),
        layer: usize,
        value: &[f32],
        record: &mut Revalue,
    ) {
        let has_value = |wedge: WedgeId| {
            let layer = &self.mesh.layers[layer];
            let bits = |w| layer.get(w).iter().map(|x| x.to_bits());
            like.is_none_or(|like| bits(like).eq(bits(wedge)))
        };
        let mut renewed: SmallVec<[(WedgeId, WedgeId); 4]> = SmallVec::new();
        for &face in self.faces_around(v) {
            for k in (0..3).filter(|&k| self.vertices_of(face)[k] == v) {
                let from = self.wedges_of(face)[k];
                if !has_value(from) {
                    continue;
                }
                let to = match renewed.iter().find(|(old, _)| *old == from) {
                    Some((_, new)) => *new,
                    None => self.append_copy(from, layer, value, record),
                };
                renewed.push((from, to));
                record.rewedged.push(Rewedged { corner: Corner::new(face, k), from, to });
            }
        }
    }

    /// Adds a copy of a wedge with other values of one layer, or other first ones, to a record; returns its id.
    fn append_copy(
        &self,
        wedge: WedgeId,
        layer: usize,
        v: &[f32],
        record: &mut Revalue,
    ) -> WedgeId {
        let stride: usize = self.mesh.layers.iter().map(|l| l.width).sum();
        let id = record.first_new_wedge.index() + record.new_wedges.len() / stride.max(1);
        for (i, l) in self.mesh.layers.iter().enumerate() {
            let (old, n_new) = (l.get(wedge), if i == layer { v.len() } else { 0 });
            record.new_wedges.extend(v[..n_new].iter().chain(&old[n_new..]));
        }
        WedgeId(id as u32)
    }

    fn rewedge(&mut self, record: &Revalue, is_forward: bool) {
        if is_forward {
            self.append_wedges(&record.new_wedges);
        }
        for r in &record.rewedged {
            self.set_wedge(r.corner, if is_forward { r.to } else { r.from });
        }
        if !is_forward {
            self.truncate_wedges(record.first_new_wedge);
        }
    }
}
