//! Vertex clustering: the crude and fast simplifier that image-driven optimization is compared by
//! (Lindstrom & Turk 2000, section 7.3). A thin layer over meshoptimizer's "sloppy" simplification.
//!
//! Invariants:
//! 1. the result has no degenerate triangle, none twice from the same side, and at most the triangles
//!    asked for;
//! 2. vertices are some of the original's, at their places in single precision's nearest cell; where
//!    sheets meet, each has its own;
//! 3. no edge has more than two triangles, and what became flat has two sides; what was closed is, but for
//!    some edges (`mesh/sheets.rs`, and triangles that fall onto each other from the same side leave one).
//!
//! Of a mesh that is small enough nothing is said. Topology is not kept: parts join and come apart. A
//! vertex takes the attributes, and a triangle part and material, of the first triangle of the original at
//! the vertex (at its first vertex).
//!
//! Measured, energy in percent of the start after 1,500,000 evaluations of optimization, the bunny in
//! clusters, 1,433 to 1,471 triangles, topology free: one side of what is flat, sheets joined 26.4 (one
//! run); of three seeds two sides 26.2 (26.16 to 26.27); two sides and sheets cut apart 25.7 (25.50 to
//! 25.89). Where outside between two triangles makes them one sheet, what is flat stays one piece: 25.9
//! (25.82 to 25.90).

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
    let faces = kept.as_chunks::<3>().0.to_vec();
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
    mesh.subset(all).mesh.cut_into_sheets()
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
    use std::collections::BTreeMap;

    use glam::DVec3;

    use super::*;
    use crate::mesh::{AttributeLayer, EditMesh, Semantic, shapes};

    /// How many triangles have each edge in either direction.
    fn of_each_edge(mesh: &Mesh) -> BTreeMap<[u32; 2], [u32; 2]> {
        let mut edges = BTreeMap::new();
        for [a, b, c] in mesh.faces.iter().copied() {
            for [from, to] in [[a, b], [b, c], [c, a]] {
                let sides: &mut [u32; 2] = edges.entry([from.min(to), from.max(to)]).or_default();
                sides[usize::from(from > to)] += 1;
            }
        }
        edges
    }

    /// A box with the connectivity of a sphere, fine, between two corners.
    fn fine_box([low, high]: [DVec3; 2]) -> Mesh {
        let mut mesh = shapes::sphere(4);
        for p in &mut mesh.positions {
            let share = (*p / p.abs().max_element() + 1.0) * 0.5;
            *p = low + share * (high - low);
        }
        mesh
    }

    #[test]
    fn what_gets_flat_keeps_two_sides_and_what_touches_stays_apart() {
        let at = DVec3::new;
        // Two that have less than a cell between them, and one that is thinner than a cell.
        let boxes = [
            [DVec3::ZERO, DVec3::ONE],
            [at(1.02, 0.0, 0.0), at(2.0, 1.0, 1.0)],
            [at(0.3, 0.3, 1.0), at(0.7, 0.305, 1.6)],
        ];
        let mut original = Mesh::default();
        for part in boxes.map(fine_box) {
            let first = original.positions.len() as u32;
            original.positions.extend(part.positions);
            original.faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
        }
        let crude = cluster(&original, 600);
        assert!(of_each_edge(&crude).values().all(|sides| *sides == [1, 1]));
        let place = |v: u32| crude.positions[v as usize].to_array().map(f64::to_bits);
        let mut sides: Vec<_> = crude.faces.iter().map(|f| f.map(place)).collect();
        sides.iter_mut().for_each(|side| side.sort_unstable());
        sides.sort_unstable();
        assert!(sides.windows(2).any(|two| two[0] == two[1]), "both sides of the thin one");
        let pair = sides.iter().flatten();
        let n_places = pair.collect::<std::collections::BTreeSet<_>>().len();
        assert!(crude.positions.len() > n_places, "some have one place and are two");
    }

    #[test]
    fn a_torus_gets_coarse_and_stays_a_mesh() {
        let original = shapes::torus(64, 32, 0.2);
        for target in [2000, 300] {
            let crude = cluster(&original, target);
            assert!(crude.faces.len() <= target && crude.faces.len() > target / 4, "{target}");
            assert!(crude.positions.iter().all(|p| original.positions.contains(p)));
            let edges = of_each_edge(&crude);
            assert!(edges.values().all(|[one, other]| one.max(other) == &1), "{target}");
            let n_open = edges.values().filter(|sides| **sides != [1, 1]).count();
            assert!(50 * n_open < edges.len(), "{target}: {n_open} of {}", edges.len());
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
