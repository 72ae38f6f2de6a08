//! Quantized and compressed GLB files: valid, and the same mesh within a step.

use super::{
    assemblies::{json_of, ship},
    models::model,
    round_trip::rich_square,
    *,
};
use crate::{
    io::{GlbOptions, write_glb, write_glb_with},
    mesh::{AttributeLayer, FaceId, Semantic, WedgeId},
};

const PLAIN: GlbOptions = GlbOptions { quantize: false, compress: false };
const QUANTIZED: GlbOptions = GlbOptions { quantize: true, compress: false };
const COMPRESSED: GlbOptions = GlbOptions { quantize: true, compress: true };

/// The square with all layers, and one more of unknown meaning and one beyond 0..=1.
fn square() -> Mesh {
    let mut mesh = rich_square();
    let mut layer = |semantic, width, factor: f32| {
        let values = (0..6 * width).map(|i| i as f32 * factor).collect();
        mesh.layers.push(AttributeLayer { semantic, width, values });
    };
    layer(Semantic::TexCoord(2), 2, 0.3);
    layer(Semantic::Custom(0), 1, 1000.0);
    mesh
}

/// How far values of a layer may be off.
fn step_of(semantic: Semantic) -> f32 {
    match semantic {
        // Rounding and bringing back to length 1.
        Semantic::Normal | Semantic::Tangent => 1.0 / 127.0,
        Semantic::Color(_) | Semantic::TexCoord(_) => 0.5001 / 65_535.0,
        Semantic::Skin | Semantic::Custom(_) => 0.0,
    }
}

/// Whether two triangles are the same within a step, up to a turn of their corners.
fn is_same((a, f): (&Mesh, usize), (b, g): (&Mesh, usize), step: f64) -> bool {
    let corner_is_same = |i: usize, j: usize| {
        let at = |mesh: &Mesh, f: usize, k: usize| mesh.positions[mesh.faces[f][k] as usize];
        let values_are_same = a.layers.iter().all(|la| {
            let get = |l: &AttributeLayer, mesh: &Mesh, f: usize, k: usize| {
                l.get(WedgeId(mesh.face_wedges[f][k])).to_vec()
            };
            // Attributes of unknown meaning are written, and ignored by the reader.
            let Some(lb) = b.layer(la.semantic) else {
                return matches!(la.semantic, Semantic::Custom(_));
            };
            let tolerance = step_of(la.semantic);
            let mut pairs = get(la, a, f, i).into_iter().zip(get(lb, b, g, j));
            pairs.all(|(x, y)| (x - y).abs() <= tolerance)
        });
        (at(a, f, i) - at(b, g, j)).abs().max_element() <= step && values_are_same
    };
    let ids = |mesh: &Mesh, f: usize| {
        let face = FaceId(f as u32);
        (mesh.material_of(face), mesh.tree.part_name(mesh.part_of(face)))
    };
    ids(a, f) == ids(b, g) && (0..3).any(|turn| (0..3).all(|k| corner_is_same(k, (k + turn) % 3)))
}

/// Written, checked and read again: each triangle has one that is the same.
#[track_caller]
fn check_trip(mesh: &Mesh, options: GlbOptions) {
    let bytes = write_glb_with(mesh, options).unwrap();
    check_valid(&bytes, options);
    let again = load("a.glb", &bytes).unwrap().mesh;
    assert_eq!(again.faces.len(), mesh.faces.len());
    let bound = |f: fn(glam::DVec3, glam::DVec3) -> glam::DVec3| {
        mesh.positions.iter().copied().reduce(f).unwrap()
    };
    let extent = (bound(glam::DVec3::max) - bound(glam::DVec3::min)).max_element();
    let step = if options.quantize { 0.5001 / 65_535.0 } else { f64::from(f32::EPSILON) } * extent;
    let mut left: Vec<usize> = (0..again.faces.len()).collect();
    for f in 0..mesh.faces.len() {
        let found = left.iter().position(|g| is_same((mesh, f), (&again, *g), step));
        left.swap_remove(found.unwrap_or_else(|| panic!("triangle {f}, {options:?}")));
    }
    assert_eq!(write_glb_with(mesh, options).unwrap(), bytes, "the same bytes");
}

fn list<'a>(json: &'a Value, key: &str) -> &'a [Value] {
    json.get(key).map_or(&[], |list| list.as_array().unwrap())
}

fn number(value: &Value, key: &str) -> usize {
    value.get(key).map_or(0, |n| n.as_u64().unwrap() as usize)
}

/// The rules of glTF that a look at the JSON can check: lists are not empty, extensions are as
/// stated, views lie in their buffers at multiples of four with the right target and stride, and
/// accessors in their views; nodes form trees and each mesh stands in one.
#[track_caller]
fn check_valid(glb: &[u8], options: GlbOptions) {
    let json = json_of(glb);
    let lists = json.as_object().unwrap().values().filter_map(Value::as_array);
    assert!(lists.into_iter().all(|list| !list.is_empty()));
    let names = [
        ("KHR_mesh_quantization", options.quantize),
        ("EXT_meshopt_compression", options.compress),
    ];
    for (name, is_used) in names {
        for key in ["extensionsUsed", "extensionsRequired"] {
            assert_eq!(list(&json, key).contains(&name.into()), is_used, "{name}");
        }
    }
    let buffers = list(&json, "buffers");
    assert_eq!(buffers.len(), 1 + usize::from(options.compress));
    for view in list(&json, "bufferViews") {
        let packed = view.pointer("/extensions/EXT_meshopt_compression");
        assert_eq!(packed.is_some(), options.compress && view.get("target").is_some());
        for view in [view].into_iter().chain(packed) {
            let (begin, length) = (number(view, "byteOffset"), number(view, "byteLength"));
            let buffer = &buffers[number(view, "buffer")];
            assert!(begin % 4 == 0 && length > 0 && begin + length <= number(buffer, "byteLength"));
        }
        if let Some(packed) = packed {
            assert_eq!(
                number(packed, "count") * number(packed, "byteStride"),
                number(view, "byteLength")
            );
        }
    }
    for (i, primitive) in
        list(&json, "meshes").iter().flat_map(|m| list(m, "primitives")).enumerate()
    {
        assert!(number(primitive, "mode") == 4);
        check_accessor(&json, number(primitive, "indices"), 34_963);
        let attributes = primitive["attributes"].as_object().unwrap();
        assert!(attributes.contains_key("POSITION"), "primitive {i}");
        for (name, accessor) in attributes {
            let accessor = accessor.as_u64().unwrap() as usize;
            check_accessor(&json, accessor, 34_962);
            let has_bounds = list(&json, "accessors")[accessor].get("min").is_some();
            assert_eq!(has_bounds, name == "POSITION");
        }
    }
    check_nodes(&json);
}

#[track_caller]
fn check_accessor(json: &Value, index: usize, target: usize) {
    let accessor = &list(json, "accessors")[index];
    let view = &list(json, "bufferViews")[number(accessor, "bufferView")];
    let width = match accessor["type"].as_str().unwrap() {
        "SCALAR" => 1,
        kind => kind[3..].parse().unwrap(),
    };
    let size = match number(accessor, "componentType") {
        5120 => 1,
        5123 => 2,
        5125 | 5126 => 4,
        other => panic!("component {other}"),
    } * width;
    let stride = if view.get("byteStride").is_some() { number(view, "byteStride") } else { size };
    assert!(stride >= size && (target == 34_963 || stride % 4 == 0));
    let count = number(accessor, "count");
    assert!(count > 0 && (count - 1) * stride + size <= number(view, "byteLength"));
    assert_eq!(number(view, "target"), target);
}

#[track_caller]
fn check_nodes(json: &Value) {
    let nodes = list(json, "nodes");
    let mut n_parents = vec![0; nodes.len()];
    let mut n_places = vec![0; list(json, "meshes").len()];
    for child in nodes
        .iter()
        .chain(list(json, "scenes"))
        .flat_map(|n| list(n, "children").iter().chain(list(n, "nodes")))
    {
        n_parents[child.as_u64().unwrap() as usize] += 1;
    }
    for node in nodes.iter().filter(|node| node.get("mesh").is_some()) {
        n_places[number(node, "mesh")] += 1;
    }
    assert!(n_parents.iter().chain(&n_places).all(|n| *n == 1), "{n_parents:?} {n_places:?}");
}

#[test]
fn what_is_read_is_what_was_written() {
    let textured = textured_glb(&[png()], |_| {});
    for mesh in [
        square(),
        load("ship.glb", &ship()).unwrap().mesh,
        load("a.glb", &textured).unwrap().mesh,
        crate::mesh::shapes::sphere(3),
    ] {
        for options in [PLAIN, QUANTIZED, COMPRESSED] {
            check_trip(&mesh, options);
        }
    }
}

/// Bounds are of the integers that are stored, and nodes below the top do not move.
#[test]
fn the_grid_is_undone_at_the_top() {
    let mesh = load("ship.glb", &ship()).unwrap().mesh;
    let json = json_of(&write_glb_with(&mesh, QUANTIZED).unwrap());
    for (i, node) in list(&json, "nodes").iter().enumerate() {
        let is_top = list(&json["scenes"][0], "nodes").contains(&i.into());
        assert_eq!(node.get("scale").is_some(), is_top);
        assert_eq!(node.get("translation").is_some(), is_top);
    }
    let accessors = list(&json, "accessors").iter();
    let highest = accessors.filter_map(|a| a["max"][0].as_f64()).reduce(f64::max);
    // The ship spans 12 units along x.
    assert_eq!(highest, Some(65_535.0));
}

/// Real models get smaller, lose no triangle that is not thinner than a step, and keep their names.
#[test]
fn models_survive_compression() {
    for name in ["barramundi_fish.glb", "flight_helmet.glb", "two_cylinder_engine.glb"] {
        let Some(bytes) = model(name) else { continue };
        let mesh = load(name, &bytes).unwrap().mesh;
        let written = [PLAIN, QUANTIZED, COMPRESSED].map(|o| write_glb_with(&mesh, o).unwrap());
        let images: usize = mesh.images.iter().map(|image| image.bytes.len()).sum();
        let sizes = written.each_ref().map(|bytes| bytes.len() - images.min(bytes.len()));
        eprintln!("{name}: {sizes:?} bytes without images");
        assert!(sizes[1] < sizes[0] * 4 / 5 && sizes[2] < sizes[1] * 3 / 4, "{sizes:?}");
        for (bytes, options) in written.iter().zip([PLAIN, QUANTIZED, COMPRESSED]) {
            check_valid(bytes, options);
            let again = load(name, bytes).unwrap();
            assert_eq!(again.report.triangles_in_file, mesh.faces.len() as u64);
            assert_eq!(again.mesh.images, mesh.images);
            let names = |mesh: &Mesh| {
                let parts = 0..mesh.tree.parts.len() as u32;
                parts.map(|part| mesh.tree.part_name(part)).collect::<Vec<_>>()
            };
            assert_eq!(names(&again.mesh), names(&mesh));
        }
        assert_eq!(write_glb(&mesh).unwrap(), written[0]);
    }
}
