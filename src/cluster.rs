//! Vertex clustering: the crude and fast simplifier that image-driven optimization is compared by
//! (Lindstrom & Turk 2000, section 7.3). A thin layer over meshoptimizer's "sloppy" simplification.
//!
//! Invariants:
//! 1. the result has no degenerate triangle, no triangle twice, and at most the triangles asked for;
//! 2. vertices are some of the original's, at their places in single precision's nearest cell.
//!
//! Topology is not kept: parts join, holes open. A vertex takes the attributes, and a triangle part
//! and material, of the first triangle of the original at the vertex (at its first vertex).

use std::collections::BTreeSet;

use crate::mesh::{FaceId, Mesh};

/// Simplifies `original` to at most `target` triangles; one that has no more stays as it is.
pub fn cluster(original: &Mesh, target: usize) -> Mesh {
    // The library asserts that there is something to do, and an assertion ends the process.
    if original.faces.len() <= target {
        return original.clone();
    }
    let indices: Vec<u32> = original.faces.as_flattened().to_vec();
    let low = original.positions.iter().copied().reduce(glam::DVec3::min).unwrap_or_default();
    // From a corner of the model, so that single precision is enough wherever it stands.
    let places: Vec<[f32; 3]> =
        original.positions.iter().map(|p| (*p - low).as_vec3().to_array()).collect();
    let kept = meshopt::simplify_sloppy_decoder(&indices, &places, 3 * target, f32::MAX, None);
    let corners = first_corners(original);
    let mut seen = BTreeSet::new();
    let is_new = |face: &[u32; 3]| {
        let mut key = *face;
        key.sort_unstable();
        key[0] != key[1] && key[1] != key[2] && seen.insert(key)
    };
    let faces: Vec<[u32; 3]> = kept.as_chunks::<3>().0.iter().copied().filter(is_new).collect();
    let corner = |v: &u32| corners[*v as usize];
    let of_corners = |face: &[u32; 3]| face.map(|v| wedge(original, corner(&v)));
    let material = |face: &[u32; 3]| original.material_of(FaceId(corner(&face[0]).0));
    let part = |face: &[u32; 3]| original.part_of(FaceId(corner(&face[0]).0));
    let has_wedges = !original.layers.is_empty();
    let has_materials = !original.face_materials.is_empty();
    let has_parts = !original.face_parts.is_empty();
    let mesh = Mesh {
        face_wedges: faces.iter().filter(|_| has_wedges).map(of_corners).collect(),
        face_materials: faces.iter().filter(|_| has_materials).map(material).collect(),
        face_parts: faces.iter().filter(|_| has_parts).map(part).collect(),
        tree: original.tree.clone(),
        faces,
        positions: original.positions.clone(),
        layers: original.layers.clone(),
        materials: original.materials.clone(),
        textures: original.textures.clone(),
        images: original.images.clone(),
    };
    let all = (0..mesh.faces.len() as u32).map(FaceId).collect();
    mesh.subset(all).mesh
}

/// The first triangle at each vertex, and the vertex's corner in it.
fn first_corners(mesh: &Mesh) -> Vec<(u32, usize)> {
    let mut corners = vec![(0, 0); mesh.positions.len()];
    for (f, face) in mesh.faces.iter().enumerate().rev() {
        for (k, v) in face.iter().enumerate() {
            corners[*v as usize] = (f as u32, k);
        }
    }
    corners
}

fn wedge(mesh: &Mesh, (face, k): (u32, usize)) -> u32 {
    mesh.face_wedges[face as usize][k]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{AttributeLayer, EditMesh, Semantic, shapes};

    #[test]
    fn a_torus_gets_coarse_and_stays_a_mesh() {
        let original = shapes::torus(64, 32, 0.2);
        for target in [2000, 300] {
            let crude = cluster(&original, target);
            assert!(crude.faces.len() <= target && crude.faces.len() > target / 4, "{target}");
            assert!(crude.positions.iter().all(|p| original.positions.contains(p)));
            EditMesh::new(crude).unwrap().validate().unwrap();
        }
    }

    #[test]
    fn attributes_and_materials_come_along() {
        let mut original = shapes::torus(24, 16, 0.2);
        original.face_materials = vec![0; original.faces.len()];
        original.face_wedges.clone_from(&original.faces);
        // Every vertex has a value that no other has.
        let values = (0..3 * original.positions.len()).map(|i| i as f32).collect();
        original.layers = vec![AttributeLayer { semantic: Semantic::Normal, width: 3, values }];
        let crude = cluster(&original, 100);
        assert_eq!(crude.face_wedges.len(), crude.faces.len());
        assert_eq!(crude.face_materials.len(), crude.faces.len());
        let near = |v: usize| {
            let k = original.positions.iter().position(|p| *p == crude.positions[v]).unwrap();
            original.layers[0].values[3 * k..3 * k + 3].to_vec()
        };
        for (face, wedges) in crude.faces.iter().zip(&crude.face_wedges) {
            for (v, w) in face.iter().zip(wedges) {
                assert_eq!(crude.layers[0].values[3 * *w as usize..][..3], near(*v as usize));
            }
        }
    }

    #[test]
    fn what_is_small_enough_stays_as_it_is() {
        assert_eq!(cluster(&Mesh::default(), 10), Mesh::default());
        let torus = shapes::torus(8, 6, 0.2);
        assert_eq!(cluster(&torus, torus.faces.len()), torus);
        // All corners in one cell: nothing is left, and nothing fails.
        assert!(cluster(&torus, 1).faces.len() <= 1);
    }
}
