//! Edits and their undo on small meshes and on random soup.

use glam::DVec3;
use proptest::prelude::*;

use super::*;

/// What must be equal after an undo: everything observable, bit for bit.
fn state(mesh: &EditMesh) -> String {
    use std::fmt::Write;
    let mut text = format!("{:?} {} {}", mesh.mesh(), mesh.n_faces(), mesh.n_vertices());
    for v in (0..mesh.n_vertex_slots() as u32).map(VertexId) {
        let bits = mesh.position(v).to_array().map(f64::to_bits);
        write!(text, "\n{v:?} {bits:?} {:?}", mesh.faces_around(v)).unwrap();
    }
    for f in mesh.faces() {
        write!(text, "\n{f:?} {:?}", mesh.area_normal(f)).unwrap();
    }
    text
}

/// A mesh with normals and texture coordinates; every third triangle has wedges of its own, so
/// there are seams everywhere.
fn with_wedges(mut mesh: Mesh) -> Mesh {
    let n = mesh.positions.len() as u32;
    let seam = |(f, face): (usize, &[u32; 3])| face.map(|v| if f % 3 == 0 { v + n } else { v });
    mesh.face_wedges = mesh.faces.iter().enumerate().map(seam).collect();
    let wedges = || (0..2 * n).map(|w| w as f32);
    mesh.layers = vec![
        AttributeLayer {
            semantic: Semantic::Normal,
            width: 3,
            values: wedges().flat_map(|w| [w.sin(), w.cos(), 0.0]).collect(),
        },
        AttributeLayer {
            semantic: Semantic::TexCoord(0),
            width: 2,
            values: wedges().flat_map(|w| [w, -w]).collect(),
        },
    ];
    mesh.face_materials = (0..mesh.faces.len() as u32).map(|f| f % 2).collect();
    mesh.face_parts = (0..mesh.faces.len() as u32).map(|f| f % 3).collect();
    mesh.tree = Tree { parts: vec![Part::default(); 3], ..Tree::default() }.into();
    mesh
}

#[test]
fn a_collapse_keeps_corner_order_and_lists_what_it_did() {
    let mut mesh = EditMesh::new(shapes::octahedron()).unwrap();
    let before = state(&mesh);
    let [keep, drop] = [VertexId(0), VertexId(1)];
    let record = mesh.collapse(keep, drop, DVec3::ONE);
    mesh.validate().unwrap();
    assert_eq!((mesh.n_faces(), mesh.n_vertices()), (6, 5));
    assert_eq!(record.removed.len(), 2);
    // The lower triangles (5, 2, 1) and (5, 1, 4) survive with 1 replaced in place.
    let moved: Vec<_> = record.moved.iter().map(|c| mesh.vertices_of(c.face())).collect();
    assert!(record.moved.iter().zip(moved).all(|(c, vertices)| vertices[c.k()] == keep));
    mesh.undo(&record);
    mesh.validate().unwrap();
    assert_eq!(state(&mesh), before);
    mesh.redo(&record);
    assert_eq!((mesh.n_faces(), mesh.position(keep)), (6, DVec3::ONE));
}

#[test]
fn wedges_of_a_collapsed_edge_merge_where_the_vertex_lands() {
    // A square of two triangles around the diagonal 0-2, one wedge per vertex.
    let positions = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
    let mut mesh = Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]]);
    mesh.face_wedges = mesh.faces.clone();
    let values = vec![0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0];
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    let mut mesh = EditMesh::new(mesh).unwrap();
    let record = mesh.collapse(VertexId(0), VertexId(1), DVec3::X * 0.25);
    mesh.validate().unwrap();
    assert_eq!(record.new_wedges, [0.25, 0.0]);
    assert_eq!(mesh.wedges_of(FaceId(1)), [4, 2, 3].map(WedgeId));
    let snapshot = mesh.snapshot();
    assert_eq!(snapshot.faces, [[0, 1, 2]]);
    assert_eq!(snapshot.layers[0].values, [1.0, 1.0, 0.0, 1.0, 0.25, 0.0]);
}

/// A flat grid of 6 × 6 quads with two charts that meet at x = 3: (x, y) on the left and (20 − x, y + 7)
/// on the right.
fn two_charts() -> Mesh {
    let at = |i: u32, j: u32| 7 * j + i;
    let mut mesh = Mesh::default();
    for j in 0..7 {
        mesh.positions.extend((0..7).map(|i| DVec3::new(f64::from(i), f64::from(j), 0.0)));
    }
    for (i, j) in (0..6).flat_map(|j| (0..6).map(move |i| (i, j))) {
        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
        mesh.faces.extend([[a, b, c], [a, c, d]]);
        let right = if i >= 3 { 49 } else { 0 };
        mesh.face_wedges.extend([[a, b, c], [a, c, d]].map(|f| f.map(|v| v + right)));
    }
    let uv = |p: &DVec3| [p.x as f32, p.y as f32];
    let left = mesh.positions.iter().flat_map(uv);
    let right = mesh.positions.iter().map(uv).flat_map(|[x, y]| [20.0 - x, y + 7.0]);
    let values = left.chain(right).collect();
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    mesh
}

/// Attributes that are affine on a plane stay so on both sides of a seam, wherever the vertex goes.
#[test]
fn collapses_keep_affine_attributes() {
    let original = two_charts();
    let at = |i: u32, j: u32| VertexId(7 * j + i);
    let rows = [
        // On the left, off the line between the ends.
        (at(1, 2), at(2, 2), DVec3::new(1.6, 2.3, 0.0)),
        // The seam gives way along itself.
        (at(3, 2), at(3, 3), DVec3::new(3.0, 2.7, 0.0)),
        // A vertex of the seam swallows one beside it, and slides along the seam.
        (at(3, 4), at(2, 4), DVec3::new(3.0, 4.4, 0.0)),
        (at(4, 3), at(3, 3), DVec3::new(3.0, 3.2, 0.0)),
    ];
    for (keep, drop, to) in rows {
        let mut mesh = EditMesh::new(original.clone()).unwrap();
        mesh.collapse(keep, drop, to);
        mesh.validate().unwrap();
        for face in mesh.faces() {
            let right =
                mesh.mesh().faces[face.index()].iter().map(|v| mesh.position(VertexId(*v)).x);
            let right = right.sum::<f64>() / 3.0 > 3.0;
            for (v, w) in mesh.vertices_of(face).into_iter().zip(mesh.wedges_of(face)) {
                let p = mesh.position(v);
                let expected =
                    if right { [20.0 - p.x, p.y + 7.0] } else { [p.x, p.y] }.map(|x| x as f32);
                let found = mesh.mesh().layers[0].get(w);
                let is_near = (0..2).all(|k| (found[k] - expected[k]).abs() < 1e-5);
                assert!(is_near, "{keep:?} {drop:?}: {found:?}, not {expected:?} at {p}");
            }
        }
    }
}

#[test]
fn a_swap_turns_the_diagonal_and_a_seam_forbids_it() {
    let positions = vec![DVec3::ZERO, DVec3::X, DVec3::ONE, DVec3::Y];
    let square = Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]]);
    let mut mesh = EditMesh::new(square.clone()).unwrap();
    let record = mesh.swap(VertexId(0), VertexId(2)).unwrap();
    mesh.validate().unwrap();
    assert_eq!(record.apexes.map(|v| v.0).iter().sum::<u32>(), 4);
    assert_eq!(mesh.edge_faces(VertexId(1), VertexId(3)).len(), 2);
    assert!(mesh.swap(VertexId(0), VertexId(1)).is_none(), "a boundary edge has no other side");
    mesh.unswap(&record);
    assert_eq!(mesh.snapshot(), square);
    let mut seamed = EditMesh::new(with_wedges(square.clone())).unwrap();
    assert!(seamed.swap(VertexId(0), VertexId(2)).is_none());
    let tree = Tree { parts: vec![Part::default(); 2], ..Tree::default() }.into();
    let parted = Mesh { face_parts: vec![0, 1], tree, ..square };
    let mut parted = EditMesh::new(parted).unwrap();
    assert!(parted.swap(VertexId(0), VertexId(2)).is_none(), "the triangles are of two parts");
}

#[test]
fn a_collapse_onto_a_locked_vertex_leaves_its_values() {
    let [keep, drop] = [VertexId(20), VertexId(21)];
    for is_locked in [true, false] {
        let locked = (0..96).map(|v| is_locked && v == keep.index()).collect();
        let mesh = EditMesh::new(with_wedges(shapes::torus(12, 8, 0.1))).unwrap();
        let mut mesh = mesh.with_marks(Marks { locked, ..Marks::default() });
        let values = |mesh: &EditMesh, face: FaceId| {
            let k = mesh.vertices_of(face).iter().position(|v| *v == keep)?;
            let wedge = mesh.wedges_of(face)[k];
            Some(mesh.mesh().layers.iter().map(|l| l.get(wedge).to_vec()).collect::<Vec<_>>())
        };
        let before: Vec<_> =
            mesh.faces_around(keep).iter().map(|f| (*f, values(&mesh, *f))).collect();
        mesh.collapse(keep, drop, mesh.position(keep));
        mesh.validate().unwrap();
        let stays = |(f, old): &(FaceId, _)| !mesh.is_alive(*f) || values(&mesh, *f) == *old;
        assert_eq!(before.iter().all(stays), is_locked, "{is_locked}");
    }
}

#[test]
fn new_values_make_new_wedges_and_leave_the_old_ones() {
    let positions = vec![DVec3::ZERO, DVec3::X, DVec3::ONE, DVec3::Y];
    let square = Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]]);
    let mut mesh = EditMesh::new(with_wedges(square)).unwrap();
    let before = mesh.mesh().layers.clone();
    let record = mesh.revalue(Semantic::TexCoord(0), &[(VertexId(2), [0.5, 0.25])]).unwrap();
    mesh.validate().unwrap();
    // The two triangles have wedges of their own at vertex 2, so there are two new ones.
    assert_eq!(record.rewedged.len(), 2);
    for (layer, old) in mesh.mesh().layers.iter().zip(&before) {
        assert!(layer.values.starts_with(&old.values));
        assert_eq!(layer.values.len(), old.values.len() + 2 * old.width);
    }
    for r in &record.rewedged {
        assert_eq!(mesh.mesh().layers[1].get(r.to), [0.5, 0.25]);
        assert_eq!(mesh.mesh().layers[0].get(r.to), before[0].get(r.from));
    }
    assert!(mesh.revalue(Semantic::Color(0), &[(VertexId(2), [0.0; 4])]).is_none());
}

#[test]
fn corners_that_share_a_value_get_the_new_one_together() {
    // Vertex 2 has two wedges: they differ in the first layer, and in the second by what is given here.
    for (other, n_changed) in [([0.5, 0.5], 2), ([0.5, -0.5], 1)] {
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::ONE, DVec3::Y];
        let mut mesh = Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]]);
        mesh.face_wedges = vec![[0, 1, 2], [0, 4, 3]];
        let normals = (0..15).map(|k| k as f32).collect();
        let mut uvs = vec![0.5; 10];
        uvs[8..].copy_from_slice(&other);
        mesh.layers = vec![
            AttributeLayer { semantic: Semantic::Normal, width: 3, values: normals },
            AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values: uvs },
        ];
        let mut mesh = EditMesh::new(mesh).unwrap();
        let before = mesh.snapshot();
        let corner = Corner::new(FaceId(0), 2);
        let record = mesh.revalue_shared(Semantic::TexCoord(0), &[(corner, [0.25])]).unwrap();
        mesh.validate().unwrap();
        let corners: Vec<Corner> = record.rewedged.iter().map(|r| r.corner).collect();
        assert_eq!(corners, [corner, Corner::new(FaceId(1), 1)][..n_changed]);
        for r in &record.rewedged {
            // The second number, which was not given, stays; so does the other layer.
            assert_eq!(mesh.mesh().layers[1].get(r.to), [0.25, 0.5]);
            assert_eq!(mesh.mesh().layers[0].get(r.to), mesh.mesh().layers[0].get(r.from));
        }
        assert!(mesh.revalue_shared(Semantic::TexCoord(0), &[(corner, [0.0; 3])]).is_none());
        mesh.undo(&record);
        assert_eq!(mesh.snapshot(), before);
    }
}

#[test]
fn faulty_meshes_are_refused_with_the_place() {
    let bad = |positions, faces| EditMesh::new(Mesh::from_parts(positions, faces)).err();
    assert_eq!(
        bad(vec![DVec3::ZERO; 3], vec![[0, 1, 3]]),
        Some(MeshError::VertexOutOfRange { face: 0, vertex: 3, n_vertices: 3 })
    );
    assert_eq!(
        bad(vec![DVec3::ZERO; 3], vec![[0, 1, 2], [2, 1, 2]]),
        Some(MeshError::RepeatedVertex { face: 1, vertex: 2 })
    );
    assert_eq!(bad(vec![DVec3::NAN], vec![]), Some(MeshError::NotFinite { vertex: 0 }));
    let mut mesh = with_wedges(shapes::octahedron());
    mesh.face_wedges[2][1] = 12;
    let fault = MeshError::WedgeOutOfRange { face: 2, wedge: 12, n_wedges: 12 };
    assert_eq!(EditMesh::new(mesh).err(), Some(fault));
}

#[test]
fn generated_shapes_have_the_topology_they_promise() {
    let n_boundary = |mesh: &EditMesh| {
        let edges = EdgeTable::new(mesh);
        edges.edges().filter(|&e| mesh.is_boundary_edge(edges.ends(e)[0], edges.ends(e)[1])).count()
    };
    for (mesh, n_faces, boundary) in [
        (shapes::octahedron(), 8, 0),
        (shapes::sphere(2), 128, 0),
        (shapes::torus(12, 7, 0.1), 168, 0),
        (shapes::terrain(6, 0.1), 72, 24),
        (shapes::spherical_segment(), 16_384, 512),
    ] {
        let mesh = EditMesh::new(mesh).unwrap();
        mesh.validate().unwrap();
        assert_eq!((mesh.n_faces(), n_boundary(&mesh)), (n_faces, boundary));
    }
}

/// An applied edit, to be taken back later.
enum Done {
    Collapse(Collapse),
    Split(Split),
    Swap(Swap),
    Displacement(Displacement),
    Revalue(Revalue),
}

impl Done {
    fn edit(&self) -> Edit<'_> {
        match self {
            Self::Collapse(record) => record.into(),
            Self::Split(record) => record.into(),
            Self::Swap(record) => record.into(),
            Self::Displacement(record) => record.into(),
            Self::Revalue(record) => record.into(),
        }
    }
}

/// Does the edit that three random numbers choose, on any existing edge; none if it is refused.
fn edit(mesh: &mut EditMesh, [what, which, place]: [u32; 3]) -> Option<Done> {
    let edges = EdgeTable::new(mesh);
    let edge = EdgeId(which % (edges.n_slots() as u32).max(1));
    let [a, b] = (edges.n_slots() > 0).then(|| edges.ends(edge))?;
    let at = mesh.position(a).lerp(mesh.position(b), f64::from(place % 8) / 7.0) + DVec3::Z;
    let normal = [(a, at.as_vec3().to_array()), (b, [0.0, 2.0, 0.0])];
    match what % 7 {
        0 => mesh.split(a, b, at).map(Done::Split),
        1 => mesh.swap(a, b).map(Done::Swap),
        3 => Some(Done::Displacement(mesh.displace(a, at))),
        4 => mesh.revalue(Semantic::Normal, &normal).map(Done::Revalue),
        6 => {
            let face = *mesh.faces_around(a).first()?;
            let k = mesh.vertices_of(face).iter().position(|v| *v == a)?;
            let values = [(Corner::new(face, k), [at.x as f32])];
            mesh.revalue_shared(Semantic::TexCoord(0), &values).map(Done::Revalue)
        }
        _ => Some(Done::Collapse(mesh.collapse(a, b, at))),
    }
}

/// Random triangles over few vertices: non-manifold, duplicated, both windings.
fn soup() -> impl Strategy<Value = Mesh> {
    let face = [0..9u32, 0..9u32, 0..9u32];
    let faces = prop::collection::vec(face, 1..25);
    faces.prop_map(|faces| {
        let is_proper = |f: &[u32; 3]| f[0] != f[1] && f[1] != f[2] && f[0] != f[2];
        let positions = (0..9u32).map(|i| DVec3::new(f64::from(i).sin(), f64::from(i), 0.0));
        Mesh::from_parts(positions.collect(), faces.into_iter().filter(is_proper).collect())
    })
}

fn any_mesh() -> impl Strategy<Value = Mesh> {
    let shape = prop_oneof![
        soup(),
        Just(shapes::torus(6, 5, 0.1)),
        Just(shapes::terrain(4, 0.2)),
        Just(shapes::octahedron()),
    ];
    (shape, any::<bool>()).prop_map(|(mesh, wedges)| if wedges { with_wedges(mesh) } else { mesh })
}

proptest! {
    #[test]
    fn undoing_any_edits_restores_the_state_bit_for_bit(
        mesh in any_mesh(),
        choices in prop::collection::vec(any::<[u32; 3]>(), 1..30),
    ) {
        let mut mesh = EditMesh::new(mesh).unwrap();
        let mut states = vec![state(&mesh)];
        let mut done = Vec::new();
        for choice in choices {
            if let Some(edit) = edit(&mut mesh, choice) {
                mesh.validate().unwrap();
                states.push(state(&mesh));
                done.push(edit);
            }
        }
        prop_assert!(mesh.snapshot().check().is_ok());
        while let Some(last) = done.pop() {
            prop_assert_eq!(&state(&mesh), &states.pop().unwrap());
            mesh.undo(last.edit());
            mesh.validate().unwrap();
        }
        prop_assert_eq!(&state(&mesh), &states[0]);
    }

    #[test]
    fn redo_repeats_an_edit_exactly(mesh in any_mesh(), choice in any::<[u32; 3]>()) {
        let mut mesh = EditMesh::new(mesh).unwrap();
        if let Some(done) = edit(&mut mesh, choice) {
            let after = state(&mesh);
            mesh.undo(done.edit());
            mesh.redo(done.edit());
            prop_assert_eq!(state(&mesh), after);
        }
    }

    #[test]
    fn the_edge_table_follows_collapses(
        mesh in any_mesh(),
        choices in prop::collection::vec(any::<u32>(), 1..40),
    ) {
        let mut mesh = EditMesh::new(mesh).unwrap();
        let mut edges = EdgeTable::new(&mesh);
        edges.validate(&mesh).unwrap();
        for choice in choices {
            let alive: Vec<EdgeId> = edges.edges().collect();
            if alive.is_empty() {
                break;
            }
            let [a, b] = edges.ends(alive[choice as usize % alive.len()]);
            let record = mesh.collapse(a, b, mesh.position(b));
            let change = edges.apply(&mesh, &record);
            edges.validate(&mesh).unwrap();
            prop_assert_eq!(edges.edges().count() + change.died.len(), alive.len());
        }
    }

    #[test]
    fn legal_collapses_keep_a_closed_surface_closed(
        choices in prop::collection::vec(any::<u32>(), 1..60),
    ) {
        let mut mesh = EditMesh::new(shapes::torus(6, 5, 0.1)).unwrap();
        let mut edges = EdgeTable::new(&mesh);
        for choice in choices {
            let alive: Vec<EdgeId> = edges.edges().collect();
            let [a, b] = edges.ends(alive[choice as usize % alive.len()]);
            if mesh.legality(a, b) == Legality::Legal {
                let record = mesh.collapse(a, b, mesh.position(a));
                edges.apply(&mesh, &record);
            }
        }
        let n_edges = edges.edges().count();
        // Every edge has two triangles, and the Euler characteristic of a torus is 0.
        prop_assert_eq!(2 * n_edges, 3 * mesh.n_faces());
        prop_assert_eq!(mesh.n_vertices() + mesh.n_faces(), n_edges);
        let n_faces_at = |e| mesh.edge_faces(edges.ends(e)[0], edges.ends(e)[1]).len();
        prop_assert!(edges.edges().all(|e| n_faces_at(e) == 2));
    }
}
