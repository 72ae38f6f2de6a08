//! A compact copy of what is alive.

use super::edit_mesh::EditMesh;
use super::model::{AttributeLayer, FaceId, Mesh, VertexId};

/// A compact mesh and where its parts came from.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Living triangles in id order; used vertices and wedges in id order, renumbered.
    pub mesh: Mesh,
    /// The id that each triangle of `mesh` has in the edited mesh.
    pub face_ids: Vec<FaceId>,
    /// The id that each vertex of `mesh` has in the edited mesh.
    pub vertex_ids: Vec<VertexId>,
}

impl EditMesh {
    /// The living part as a mesh of its own.
    pub fn snapshot(&self) -> Mesh {
        self.snapshot_with_ids().mesh
    }

    /// The living part as a mesh of its own, with the ids it had here.
    pub fn snapshot_with_ids(&self) -> Snapshot {
        self.mesh.subset(self.faces().collect())
    }
}

impl Mesh {
    /// The given triangles (ascending ids) as a mesh of their own.
    pub fn subset(&self, face_ids: Vec<FaceId>) -> Snapshot {
        let (vertex_ids, faces) = compact(&face_ids, &self.faces, self.positions.len());
        let (wedge_ids, face_wedges) = compact(&face_ids, &self.face_wedges, self.n_wedges());
        let layers = self.layers.iter().map(|layer| keep_wedges(layer, &wedge_ids)).collect();
        let has_materials = !self.face_materials.is_empty();
        let materials_of = face_ids.iter().filter(|_| has_materials);
        let parts_of = face_ids.iter().filter(|_| !self.face_parts.is_empty());
        let face_parts = parts_of.map(|&f| self.part_of(f)).collect();
        let mesh = Mesh {
            positions: vertex_ids.iter().map(|&v| self.positions[v as usize]).collect(),
            faces,
            face_wedges,
            face_materials: materials_of.map(|&f| self.material_of(f)).collect(),
            layers,
            materials: self.materials.clone(),
            textures: self.textures.clone(),
            images: self.images.clone(),
            face_parts,
            tree: self.tree.clone(),
        };
        Snapshot { mesh, face_ids, vertex_ids: vertex_ids.into_iter().map(VertexId).collect() }
    }
}

/// The ids that the given triangles use, ascending, and the triangles in terms of their ranks.
/// `corners` is empty where the mesh has no such thing.
fn compact(faces: &[FaceId], corners: &[[u32; 3]], n_ids: usize) -> (Vec<u32>, Vec<[u32; 3]>) {
    if corners.is_empty() {
        return (Vec::new(), Vec::new());
    }
    let mut rank = vec![u32::MAX; n_ids];
    for face in faces {
        for id in corners[face.index()] {
            rank[id as usize] = 0;
        }
    }
    let ids: Vec<u32> = (0..n_ids as u32).filter(|&id| rank[id as usize] == 0).collect();
    for (new, &old) in ids.iter().enumerate() {
        rank[old as usize] = new as u32;
    }
    let faces = faces.iter().map(|f| corners[f.index()].map(|id| rank[id as usize])).collect();
    (ids, faces)
}

fn keep_wedges(layer: &AttributeLayer, wedges: &[u32]) -> AttributeLayer {
    let width = layer.width;
    let values = wedges.iter().flat_map(|&w| &layer.values[w as usize * width..][..width]);
    AttributeLayer { semantic: layer.semantic, width, values: values.copied().collect() }
}
