//! A mesh at one level, moved up and down by collapse records on plain arrays.
//!
//! Invariants: slots are those of the original (ids never change); a triangle's vertices, wedges and
//! a vertex's position are bit-equal to those of the simplification at the same record.

use super::bytes::CodecError;
use crate::mesh::{Collapse, Corner, FaceId, Mesh, WedgeId};

/// A level of detail that can be refined or coarsened record by record.
#[derive(Clone, Debug)]
pub struct Level {
    /// All slots, dead ones included.
    pub(super) mesh: Mesh,
    pub(super) alive: Vec<bool>,
    n_faces: usize,
}

impl Level {
    /// The finest level: the original.
    pub fn finest(original: &Mesh) -> Self {
        let n_faces = original.faces.len();
        Self { mesh: original.clone(), alive: vec![true; n_faces], n_faces }
    }

    /// A level whose living triangles are marked.
    pub(super) fn new(mesh: Mesh, alive: Vec<bool>) -> Self {
        let n_faces = alive.iter().filter(|a| **a).count();
        Self { mesh, alive, n_faces }
    }

    /// Triangles now.
    pub fn n_faces(&self) -> usize {
        self.n_faces
    }

    /// The level as a mesh of its own.
    pub fn to_mesh(&self) -> Mesh {
        let living = (0..self.alive.len() as u32).filter(|f| self.alive[*f as usize]);
        self.mesh.subset(living.map(FaceId).collect()).mesh
    }

    /// One step coarser.
    pub fn collapse(&mut self, r: &Collapse) -> Result<(), CodecError> {
        self.check(r)?;
        self.append_wedges(r)?;
        for f in &r.removed {
            self.n_faces -= usize::from(std::mem::take(&mut self.alive[f.face.index()]));
        }
        for c in &r.moved {
            self.mesh.faces[c.face().index()][c.k()] = r.keep.0;
        }
        for w in &r.rewedged {
            self.set_wedge(w.corner, w.to)?;
        }
        self.mesh.positions[r.keep.index()] = r.to;
        Ok(())
    }

    /// One step finer: the reverse.
    pub fn split(&mut self, r: &Collapse) -> Result<(), CodecError> {
        self.check(r)?;
        for w in &r.rewedged {
            self.set_wedge(w.corner, w.from)?;
        }
        for c in &r.moved {
            self.mesh.faces[c.face().index()][c.k()] = r.drop.0;
        }
        for f in &r.removed {
            let slot = f.face.index();
            self.mesh.faces[slot] = f.vertices.map(|v| v.0);
            if !self.mesh.layers.is_empty() {
                for k in 0..3 {
                    self.set_wedge(Corner::new(f.face, k), f.wedges[k])?;
                }
            }
            self.n_faces += usize::from(!std::mem::replace(&mut self.alive[slot], true));
        }
        self.mesh.positions[r.keep.index()] = r.keep_from;
        self.mesh.positions[r.drop.index()] = r.drop_from;
        Ok(())
    }

    /// Enters the values of wedges that the record appended.
    fn append_wedges(&mut self, r: &Collapse) -> Result<(), CodecError> {
        let stride: usize = self.mesh.layers.iter().map(|l| l.width).sum();
        if r.new_wedges.is_empty() {
            return Ok(());
        }
        if stride == 0 || !r.new_wedges.len().is_multiple_of(stride) {
            return Err(malformed("wedge values do not match the attribute layers"));
        }
        if r.first_new_wedge.index() != self.mesh.n_wedges() {
            return Ok(()); // Replayed before: the values are there already.
        }
        for values in r.new_wedges.chunks_exact(stride) {
            let mut at = 0;
            for layer in &mut self.mesh.layers {
                layer.values.extend_from_slice(&values[at..at + layer.width]);
                at += layer.width;
            }
        }
        Ok(())
    }

    fn set_wedge(&mut self, corner: Corner, wedge: WedgeId) -> Result<(), CodecError> {
        if wedge.index() >= self.mesh.n_wedges() {
            return Err(malformed("wedge id out of range"));
        }
        match self.mesh.face_wedges.get_mut(corner.face().index()) {
            Some(w) => w[corner.k()] = wedge.0,
            None => return Err(malformed("wedges in a mesh without attributes")),
        }
        Ok(())
    }

    /// Whether every id of a record exists.
    fn check(&self, r: &Collapse) -> Result<(), CodecError> {
        let n_vertices = self.mesh.positions.len();
        let n_slots = self.alive.len();
        let vertices = r.removed.iter().flat_map(|f| f.vertices).chain([r.keep, r.drop]);
        let faces = r.removed.iter().map(|f| f.face);
        let corners = r.moved.iter().copied().chain(r.rewedged.iter().map(|w| w.corner));
        let is_sound = vertices.into_iter().all(|v| v.index() < n_vertices)
            && faces.chain(corners.map(Corner::face)).all(|f| f.index() < n_slots);
        if is_sound { Ok(()) } else { Err(malformed("a record names what the mesh does not have")) }
    }
}

fn malformed(problem: &str) -> CodecError {
    CodecError::Malformed { what: "collapse record", problem: problem.into() }
}
