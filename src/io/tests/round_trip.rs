//! Written and read again: the same mesh.

use glam::DVec3;
use proptest::prelude::*;

use super::{models::model, *};
use crate::{
    io::{
        GlbLevel, GlbOptions, PlyPositions, write_glb, write_glb_with, write_lods, write_obj,
        write_ply,
    },
    mesh::{AttributeLayer, FaceId, Material, Semantic, WedgeId},
};

/// A face as its material and, per corner, the bits of position and attributes.
type FaceContent = (u32, [(Vec<u64>, Vec<u32>); 3]);

/// What a mesh shows, whatever its numbering: faces in order of material, then of the mesh.
fn content(mesh: &Mesh) -> Vec<FaceContent> {
    let mut faces: Vec<FaceContent> = (0..mesh.faces.len())
        .map(|f| {
            let corner = |k: usize| {
                let p = mesh.positions[mesh.faces[f][k] as usize].to_array();
                let wedge = mesh.face_wedges.get(f).map(|w| WedgeId(w[k]));
                let values = wedge.iter().flat_map(|w| mesh.layers.iter().flat_map(|l| l.get(*w)));
                (p.map(f64::to_bits).to_vec(), values.map(|v| v.to_bits()).collect())
            };
            (mesh.material_of(FaceId(f as u32)), [0, 1, 2].map(corner))
        })
        .collect();
    faces.sort_by_key(|f| f.0);
    faces
}

/// The square with a wedge of its own for each corner of the second face, all layers, and two
/// materials of which the later comes first.
pub(super) fn rich_square() -> Mesh {
    let layer = |semantic, width, value: fn(usize) -> f32| AttributeLayer {
        semantic,
        width,
        values: (0..6 * width).map(value).collect(),
    };
    let unit = |i: usize| [0.0, 0.6, 0.8, -1.0, 0.0, 0.0][i % 6];
    Mesh {
        positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.25)],
        faces: vec![[0, 1, 2], [2, 1, 3]],
        face_wedges: vec![[0, 1, 2], [3, 4, 5]],
        face_materials: vec![1, 0],
        layers: vec![
            layer(Semantic::Normal, 3, unit),
            layer(Semantic::Tangent, 4, |i| [1.0, 0.0, 0.0, -1.0][i % 4]),
            layer(Semantic::TexCoord(0), 2, |i| i as f32 / 16.0),
            layer(Semantic::TexCoord(1), 2, |i| i as f32 / 8.0),
            layer(Semantic::Color(0), 4, |i| (i % 5) as f32 / 4.0),
        ],
        materials: vec![
            Material { name: "a \"quoted\" name".into(), unlit: true, ..Material::default() },
            Material {
                name: String::new(),
                base_color: [0.1, 0.2, 0.3, 1.0],
                double_sided: false,
                ..Material::default()
            },
        ],
        ..Mesh::default()
    }
}

#[test]
fn glb_keeps_everything() {
    let mesh = rich_square();
    let bytes = write_glb(&mesh).unwrap();
    let again = load("x.glb", &bytes).unwrap().mesh;
    assert_eq!(content(&again), content(&mesh));
    let without_source = |m: &Material| Material { source: None, ..m.clone() };
    assert_eq!(again.materials.iter().map(without_source).collect::<Vec<_>>(), mesh.materials);
    assert_eq!(again.layers.len(), mesh.layers.len());
    // With faces in order of material, a second trip changes nothing at all.
    let bytes = write_glb(&again).unwrap();
    assert_eq!(load("x.glb", &bytes).unwrap().mesh, again);
    assert_eq!(write_glb(&again).unwrap(), bytes, "the same mesh gives the same bytes");
}

/// Singles are half a metre apart at the coordinates of a map.
#[test]
fn glb_keeps_what_is_far_from_the_origin() {
    let offset = DVec3::new(500_000.0, 4_500_000.0, 100.0);
    let mut mesh = rich_square();
    mesh.positions.iter_mut().for_each(|p| *p += offset);
    let near = write_glb(&rich_square()).unwrap();
    assert!(!String::from_utf8_lossy(&near).contains("translation"));
    for level in [write_glb(&mesh).unwrap(), {
        let level = GlbLevel { name: "a", mesh: &mesh, screen_coverage: 1.0 };
        write_lods(&[level], GlbOptions::default()).unwrap()
    }] {
        let again = load("x.glb", &level).unwrap().mesh;
        assert_eq!(again.faces.len(), mesh.faces.len());
        for p in &mesh.positions {
            let nearest = again.positions.iter().map(|q| q.distance(*p)).fold(9.0, f64::min);
            assert!(nearest < 1e-6, "{p}: {nearest}");
        }
    }
}

/// No two triangles of a file have the same three points, or Blender would drop one of them.
#[test]
fn the_sides_of_a_sheet_are_told_apart() {
    let mut mesh = rich_square();
    mesh.faces = vec![[0, 1, 2], [2, 1, 0], [1, 2, 0], [2, 1, 3]];
    mesh.face_wedges = vec![[0, 1, 2], [2, 1, 0], [1, 2, 0], [3, 4, 5]];
    mesh.face_materials = vec![0; 4];
    for (quantize, compress) in [(false, false), (true, false), (true, true)] {
        let bytes = write_glb_with(&mesh, GlbOptions { quantize, compress }).unwrap();
        let Ingest { mesh: again, report, .. } = load("x.glb", &bytes).unwrap();
        // Two of the three triangles have one more; all are joined again.
        assert_eq!((report.triangles_in_file, report.vertices_in_file), (4, 6 + 2));
        assert_eq!((again.faces.len(), again.n_wedges()), (4, 6));
        if !quantize {
            assert_eq!(content(&again), content(&mesh));
            assert_eq!(write_glb(&again).unwrap(), bytes, "the same mesh gives the same bytes");
        }
    }
}

/// What the Khronos validator looks at, as far as it can be seen from outside: the schema, four-byte
/// alignment, exact bounds of positions, unit normals and tangents, colours in 0..=1.
#[test]
fn glb_is_valid() {
    let mut mesh = rich_square();
    mesh.layers[0].values[0] = 7.0;
    mesh.layers[4].values[0] = -7.0;
    mesh.positions[3].z = 1.0 / 3.0;
    let bytes = write_glb(&mesh).unwrap();
    assert_eq!(bytes.len() % 4, 0);
    let document = gltf::Gltf::from_slice(&bytes).expect("the schema holds");
    let bin = document.blob.as_deref().unwrap();
    for view in document.views() {
        assert_eq!(view.offset() % 4, 0);
        assert!(view.target().is_some());
    }
    for primitive in document.meshes().flat_map(|m| m.primitives()) {
        let reader = primitive.reader(|_| Some(bin));
        let positions: Vec<_> = reader.read_positions().unwrap().collect();
        let bound = |f: fn(f32, f32) -> f32| {
            positions.iter().copied().reduce(|a, b| [0, 1, 2].map(|k| f(a[k], b[k]))).unwrap()
        };
        let stated = primitive.bounding_box();
        assert_eq!((stated.min, stated.max), (bound(f32::min), bound(f32::max)));
        let length = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!(reader.read_normals().unwrap().all(|n| (length(&n) - 1.0).abs() < 1e-5));
        let is_tangent = |t: [f32; 4]| (length(&t[..3]) - 1.0).abs() < 1e-5 && t[3].abs() == 1.0;
        assert!(reader.read_tangents().unwrap().all(is_tangent));
        let mut colors = reader.read_colors(0).unwrap().into_rgba_f32();
        assert!(colors.all(|c| c.iter().all(|x| (0.0..=1.0).contains(x))));
        assert!(reader.read_indices().unwrap().into_u32().all(|i| i < positions.len() as u32));
    }
}

#[test]
fn ply_keeps_what_it_has_properties_for() {
    let mut mesh = rich_square();
    mesh.positions[3].z = 1.0 / 3.0;
    mesh.layers.retain(|l| matches!(l.semantic, Semantic::Normal | Semantic::TexCoord(0)));
    let bytes = write_ply(&mesh, PlyPositions::Double).unwrap();
    let again = load("x.ply", &bytes).unwrap().mesh;
    (mesh.face_materials, mesh.materials) = (Vec::new(), Vec::new());
    assert_eq!(content(&again), content(&mesh));
    let single = write_ply(&mesh, PlyPositions::Single).unwrap();
    let single = load("x.ply", &single).unwrap().mesh;
    assert_eq!(single.positions[3].z, f64::from(1.0_f32 / 3.0));
    let colored = load("x.ply", &write_ply(&rich_square(), PlyPositions::Single).unwrap()).unwrap();
    let (found, want) = (&colored.mesh.layers[2].values, &rich_square().layers[4].values);
    assert!(found.iter().zip(want).all(|(a, b)| (a - b).abs() < 0.005), "8 bits per channel");
}

#[test]
fn obj_keeps_what_it_has_statements_for() {
    let mut mesh = rich_square();
    mesh.positions[3].z = 1.0 / 3.0;
    mesh.layers.retain(|l| matches!(l.semantic, Semantic::Normal | Semantic::TexCoord(0)));
    let again = load("x.obj", &write_obj(&mesh).unwrap()).unwrap().mesh;
    // Materials are numbered by their first use.
    assert_eq!(again.face_materials, [0, 1]);
    assert_eq!(again.materials[1].name, "a \"quoted\" name");
    let (mut again, mut mesh) = (again, mesh);
    again.face_materials.clear();
    mesh.face_materials.clear();
    assert_eq!(content(&again), content(&mesh));
}

#[test]
fn glb_mends_what_gltf_forbids() {
    let mut mesh = rich_square();
    mesh.layers[0].values[..6].copy_from_slice(&[0.0, 0.0, 0.0, 0.0, 3.0, 4.0]);
    mesh.layers[2].semantic = Semantic::TexCoord(5);
    mesh.layers[4].values[0] = 1.5;
    let again = load("x.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
    let wedges = again.face_wedges[1];
    let get = |s, k: usize| again.layer(s).unwrap().get(WedgeId(wedges[k]));
    assert_eq!(get(Semantic::Normal, 0), &[0.0, 0.0, 1.0], "computed from the face");
    assert_eq!(get(Semantic::Normal, 1), &[0.0, 0.6, 0.8]);
    assert_eq!(get(Semantic::Color(0), 0)[0], 1.0);
    assert!(again.layer(Semantic::TexCoord(1)).is_some(), "sets are numbered without gaps");
}

#[test]
fn broken_meshes_are_refused() {
    let square = rich_square();
    let change: [fn(&mut Mesh); 6] = [
        |m| m.faces.clear(),
        |m| m.faces[0][0] = 9,
        |m| m.positions[0].x = 1e300,
        |m| m.face_wedges[1][2] = 6,
        |m| m.face_materials[0] = 2,
        |m| m.layers[1].values.truncate(23),
    ];
    for change in change {
        let mut mesh = square.clone();
        change(&mut mesh);
        assert_eq!(write_glb(&mesh).unwrap_err().code(), "UNWRITABLE_MESH");
        assert!(write_ply(&mesh, PlyPositions::Single).is_err() && write_obj(&mesh).is_err());
    }
}

#[test]
fn models_survive_the_trip() {
    for name in ["house_scene.glb", "two_cylinder_engine.glb", "frog_vertex_colours.glb"] {
        let Some(bytes) = model(name) else { continue };
        // Placed instances have positions beyond single precision: written once, they stay.
        let first = load(name, &write_glb(&load(name, &bytes).unwrap().mesh).unwrap()).unwrap();
        let second = load(name, &write_glb(&first.mesh).unwrap()).unwrap();
        assert_eq!(content(&second.mesh), content(&first.mesh), "{name}");
        assert_eq!(second.mesh.materials, first.mesh.materials);
    }
}

proptest! {
    /// Random soups of single-precision points, with and without a layer.
    #[test]
    fn random_meshes_survive(
        points in prop::collection::vec(prop::array::uniform3(-100.0_f32..100.0), 3..12),
        picks in prop::collection::vec(prop::array::uniform3(0..12_usize), 1..30),
        has_layer in any::<bool>(),
    ) {
        let faces: Vec<_> = picks.iter().map(|t| t.map(|i| (i % points.len()) as u32))
            .filter(|[a, b, c]| a != b && b != c && c != a).collect();
        prop_assume!(!faces.is_empty());
        let positions = points.iter().map(|p| DVec3::from_array(p.map(f64::from))).collect();
        let mut mesh = Mesh::from_parts(positions, faces);
        if has_layer {
            // A wedge per corner; corners of even faces share values, so they join again.
            let n = mesh.faces.len() as u32;
            mesh.face_wedges = (0..n).map(|f| [3 * f, 3 * f + 1, 3 * f + 2]).collect();
            let values = (0..6 * n).map(|i| if i % 12 < 6 { 0.25 } else { i as f32 }).collect();
            mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
        }
        let first = load("x.glb", &write_glb(&mesh).unwrap()).unwrap().mesh;
        prop_assert_eq!(content(&first), content(&mesh));
        let bytes = write_glb(&first).unwrap();
        prop_assert_eq!(&load("x.glb", &bytes).unwrap().mesh, &first);
        let ply = write_ply(&first, PlyPositions::Double).unwrap();
        prop_assert_eq!(load("x.ply", &ply).unwrap().mesh.faces, first.faces);
    }
}
