//! glTF: nodes, primitives, accessors of every kind.

use base64::{Engine, engine::general_purpose::STANDARD};
use glam::DVec3;

use super::*;
use crate::mesh::{Semantic, WedgeId};

#[test]
fn the_square_is_read() {
    let Ingest { mesh, report, .. } = load("square.glb", &square_glb()).unwrap();
    assert_eq!(mesh.faces, vec![[0, 1, 2], [2, 1, 3]]);
    assert_eq!(mesh.positions[3], DVec3::new(1.0, 1.0, 0.0));
    assert_eq!((report.boundary_edges, report.components, report.instances), (4, 1, 1));
    assert!(mesh.layers.is_empty() && mesh.materials.is_empty() && report.notes.is_empty());
}

#[test]
fn json_with_embedded_buffers_gives_the_same() {
    let mut json = square_json();
    let text = STANDARD.encode(square_bin());
    json["buffers"][0]["uri"] = format!("data:application/octet-stream;base64,{text}").into();
    let packed = load("square.glb", &square_glb()).unwrap();
    let open = load("square.gltf", json.to_string().as_bytes()).unwrap();
    assert_eq!(packed.mesh, open.mesh);
    let unpadded = json.to_string().replace('=', "");
    assert_eq!(load("square.gltf", unpadded.as_bytes()).unwrap().mesh, open.mesh);
}

/// A parent that moves and scales, a child that turns by a quarter, and a mirrored instance.
#[test]
fn instances_are_placed_and_mirrors_turned() {
    let mut json = square_json();
    let half = 0.5_f32.sqrt();
    json["nodes"] = json!([
        { "children": [1, 2], "translation": [10, 0, 0], "scale": [2, 2, 2] },
        { "mesh": 0, "rotation": [0, 0, half, half] },
        { "mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1] },
    ]);
    let Ingest { mesh, report, .. } = load("x.glb", &glb(&json, &square_bin())).unwrap();
    assert_eq!((report.instances, report.triangles, report.components), (2, 4, 2));
    let at = |i: usize, want: [f64; 3]| {
        let want = DVec3::from_array(want);
        assert!(mesh.positions[i].distance(want) < 1e-6, "{i}: {}", mesh.positions[i]);
    };
    at(1, [10.0, 2.0, 0.0]);
    at(2, [8.0, 0.0, 0.0]);
    at(5, [8.0, 0.0, 10.0]);
    assert_eq!(mesh.faces[2], [4, 6, 5], "a mirrored triangle is turned round");
}

#[test]
fn strips_and_fans_and_unindexed_primitives() {
    let mut json = square_json();
    for (mode, faces) in [(5, vec![[0, 1, 2], [1, 3, 2]]), (6, vec![[1, 2, 0], [2, 3, 0]])] {
        json["meshes"][0]["primitives"] =
            json!([{ "attributes": { "POSITION": 0 }, "mode": mode }]);
        let mesh = load("x.glb", &glb(&json, &square_bin())).unwrap().mesh;
        assert_eq!(mesh.faces, faces, "mode {mode}");
    }
}

/// 16-bit normalized positions, strided; 8-bit colours without alpha; a sparse accessor that
/// moves vertex 3.
#[test]
fn quantized_strided_and_sparse_accessors() {
    let mut bin = Vec::new();
    for [x, y] in [[0_u16, 0], [65_535, 0], [0, 65_535], [65_535, 65_535]] {
        bin.extend([x, y, 0, 7].iter().flat_map(|v| v.to_le_bytes()));
    }
    bin.extend([255, 0, 0, 0, 255, 0, 0, 0, 255, 51, 51, 51]);
    bin.extend([3, 0, 0, 0]);
    bin.extend([65_535_u16, 65_535, 65_535, 0].iter().flat_map(|v| v.to_le_bytes()));
    let mut json = square_json();
    json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    json["meshes"][0]["primitives"] =
        json!([{ "attributes": { "POSITION": 0, "COLOR_0": 1 }, "mode": 5 }]);
    json["buffers"][0]["byteLength"] = bin.len().into();
    json["bufferViews"] = json!([
        { "buffer": 0, "byteLength": 32, "byteStride": 8 },
        { "buffer": 0, "byteOffset": 32, "byteLength": 12 },
        { "buffer": 0, "byteOffset": 44, "byteLength": 4 },
        { "buffer": 0, "byteOffset": 48, "byteLength": 8 },
    ]);
    json["accessors"] = json!([
        {
            "bufferView": 0, "componentType": 5123, "count": 4, "type": "VEC3",
            "normalized": true,
            "sparse": {
                "count": 1,
                "indices": { "bufferView": 2, "componentType": 5121 },
                "values": { "bufferView": 3 },
            },
        },
        { "bufferView": 1, "componentType": 5121, "count": 4, "type": "VEC3" },
    ]);
    let mesh = load("x.glb", &glb(&json, &bin)).unwrap().mesh;
    assert_eq!(mesh.positions[1], DVec3::X);
    assert_eq!(mesh.positions[3], DVec3::ONE);
    let colors = mesh.layer(Semantic::Color(0)).unwrap();
    assert_eq!(colors.get(WedgeId(0)), &[1.0, 0.0, 0.0, 1.0]);
    assert_eq!(colors.get(WedgeId(3)), &[0.2, 0.2, 0.2, 1.0]);
}

/// What the schema refuses though it is legal, or is never read.
#[test]
fn parts_that_nobody_reads_may_be_anything() {
    let plain = load("x.glb", &square_glb()).unwrap().mesh;
    let target = json!({ "path": "pointer",
        "extensions": { "KHR_animation_pointer": { "pointer": "/nodes/0/scale" } } });
    let animations = json!([{ "samplers": [{ "input": 0, "output": 0 }],
        "channels": [{ "sampler": 0, "target": target }] }]);
    let cameras = json!([{ "type": "perspective", "perspective": {} }]);
    let scenes = json!([{ "nodes": [0] }, { "name": "empty" }]);
    for (key, list, codes) in [
        ("animations", &animations, &["animations_ignored"][..]),
        ("cameras", &cameras, &["cameras_ignored"]),
        ("scenes", &scenes, &[]),
    ] {
        let mut json = square_json();
        json[key] = list.clone();
        json["accessors"][0]["count"] = 4.0.into();
        let Ingest { mesh, report, .. } = load("x.glb", &glb(&json, &square_bin())).unwrap();
        assert_eq!(mesh, plain, "{key}");
        assert_eq!(report.notes.iter().map(|n| n.code).collect::<Vec<_>>(), codes, "{key}");
    }
    let mut json = square_json();
    json["bufferViews"][0]["byteLength"] = "four".into();
    let error = error_of("x.glb", &glb(&json, &square_bin())).to_string();
    assert!(error.contains("JSON, line 1 column") && error.contains("string \"four\""), "{error}");
    json["animations"] = animations;
    let error = error_of("x.glb", &glb(&json, &square_bin())).to_string();
    assert!(error.contains("string \"four\""), "{error}");
}

/// An accessor that names no bytes is all zeros, of which there may be so many.
#[test]
fn accessors_without_bytes_are_zeros() {
    let mut json = square_json();
    let zeros = json!({ "componentType": 5126, "count": 4, "type": "VEC2" });
    json["accessors"].as_array_mut().unwrap().push(zeros);
    json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2.into();
    let mesh = load("x.glb", &glb(&json, &square_bin())).unwrap().mesh;
    let layer = mesh.layer(Semantic::TexCoord(0)).unwrap();
    assert_eq!(layer.values, [0.0; 8]);
    json["accessors"][1] = json!({ "componentType": 5125, "count": 3000, "type": "SCALAR" });
    let bytes = glb(&json, &square_bin());
    assert_eq!(error_of("x.glb", &bytes).code(), "NO_TRIANGLES");
    let limits = Limits { max_bytes: 11_999, ..Limits::default() };
    let error = read("x.glb", &bytes, &limits).unwrap_err().to_string();
    assert!(error.contains("indices: 12000 bytes of zeros are over the limit"), "{error}");
}

#[test]
fn materials_and_what_is_left_out() {
    let mut json = square_json();
    json["materials"] = json!([
        { "name": "skin", "doubleSided": true, "alphaMode": "MASK",
          "pbrMetallicRoughness": {
              "baseColorFactor": [0.5, 0.25, 0.125, 1], "baseColorTexture": { "index": 0 } } },
        { "extensions": { "KHR_materials_unlit": {} } },
    ]);
    json["extensionsRequired"] = json!(["KHR_materials_unlit"]);
    let primitive = |material: Value| {
        let mut p = json["meshes"][0]["primitives"][0].clone();
        p["material"] = material;
        p
    };
    let mut bare = json["meshes"][0]["primitives"][0].clone();
    bare["targets"] = json!([{ "POSITION": 0 }]);
    let points = json!({ "attributes": { "POSITION": 0 }, "mode": 0 });
    json["meshes"][0]["primitives"] =
        json!([primitive(json!(1)), primitive(json!(0)), bare, points]);
    let Ingest { mesh, report, .. } = load("x.glb", &glb(&json, &square_bin())).unwrap();
    assert_eq!(mesh.face_materials, [1, 1, 0, 0, 2, 2]);
    assert_eq!(mesh.materials[0].base_color, [0.5, 0.25, 0.125, 1.0]);
    assert!(mesh.materials[0].double_sided && !mesh.materials[1].double_sided);
    assert!(mesh.materials[1].unlit && !mesh.materials[0].unlit);
    assert_eq!(mesh.materials[0].name, "skin");
    assert_eq!(report.duplicate_faces, 4);
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    let want = ["texture_reference_broken", "morph_targets_ignored", "points_and_lines_ignored"];
    assert_eq!(codes, want);
}

/// Normals keep right angles to a sheared surface, and their length.
#[test]
fn normals_go_with_the_surface() {
    let mut bin = square_bin();
    bin.extend(bytes_of(&[0.0, 0.0, 1.0].repeat(4)));
    let mut json = square_json();
    json["buffers"][0]["byteLength"] = bin.len().into();
    json["bufferViews"]
        .as_array_mut()
        .unwrap()
        .push(json!({ "buffer": 0, "byteOffset": 60, "byteLength": 48 }));
    json["accessors"]
        .as_array_mut()
        .unwrap()
        .push(json!({ "bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC3" }));
    json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 2.into();
    // x stays, y stays, and z grows with x: the surface tilts by 45 degrees.
    json["nodes"] = json!([{ "mesh": 0,
        "matrix": [1, 0, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] }]);
    let mesh = load("x.glb", &glb(&json, &bin)).unwrap().mesh;
    let normal = mesh.layer(Semantic::Normal).unwrap().get(WedgeId(0));
    let want = [-0.5_f32.sqrt(), 0.0, 0.5_f32.sqrt()];
    assert!(normal.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-6), "{normal:?}");
}

/// KHR_mesh_quantization: integers of every kind, those that are not normalized brought back by
/// the node or by the texture's transform.
#[test]
fn quantized_attributes_of_every_kind() {
    let mut bin = Vec::new();
    for [x, y] in [[0_i16, 0], [-2000, 0], [0, 1000], [-2000, 1000]] {
        bin.extend([x, y, 0, 0].iter().flat_map(|v| v.to_le_bytes()));
    }
    bin.extend([0, 0, 129, 0].repeat(4));
    bin.extend(
        [-32_768_i16, 0, 0, 32_767]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect::<Vec<_>>()
            .repeat(4),
    );
    let uvs = [[0_u16, 0], [4095, 0], [0, 4095], [4095, 2048]];
    bin.extend(uvs.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
    bin.extend([0, 255, 0, 0, 128, 51, 0, 0].repeat(2));
    bin.extend([129, 127, 0, 0].repeat(4));
    let accessor = |view: usize, component: u32, kind: &str, normalized: bool| {
        json!({ "bufferView": view, "componentType": component, "count": 4, "type": kind,
                "normalized": normalized })
    };
    let mut json = square_json();
    json["extensionsRequired"] = json!(["KHR_mesh_quantization", "KHR_texture_transform"]);
    json["nodes"][0]["scale"] = json!([0.001, 0.001, 0.001]);
    json["nodes"][0]["translation"] = json!([2, 0, 0]);
    json["meshes"][0]["primitives"] = json!([{ "mode": 5, "material": 0, "attributes": {
        "POSITION": 0, "NORMAL": 1, "TANGENT": 2, "TEXCOORD_0": 3, "TEXCOORD_1": 4,
        "TEXCOORD_2": 5 } }]);
    json["materials"] = json!([{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0,
        "extensions": { "KHR_texture_transform": { "scale": [1.0 / 4095.0, 1.0 / 4095.0] } } } } }]);
    json["textures"] = json!([{}]);
    json["buffers"][0]["byteLength"] = bin.len().into();
    json["bufferViews"] = [(0, 32, 8), (32, 16, 4), (48, 32, 8), (80, 16, 4), (96, 16, 4), (112, 16, 4)]
        .map(|(offset, length, stride)| {
            json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "byteStride": stride })
        })
        .to_vec()
        .into();
    json["accessors"] = json!([
        accessor(0, 5122, "VEC3", false),
        accessor(1, 5120, "VEC3", true),
        accessor(2, 5122, "VEC4", true),
        accessor(3, 5123, "VEC2", false),
        accessor(4, 5121, "VEC2", true),
        accessor(5, 5120, "VEC2", true),
    ]);
    let mesh = load("x.glb", &glb(&json, &bin)).unwrap().mesh;
    let corner = mesh.positions.iter().position(|p| p.distance(DVec3::Y) < 1e-6);
    let corner = corner.unwrap() as u32;
    let at = mesh.faces.as_flattened().iter().position(|v| *v == corner).unwrap();
    let wedge = WedgeId(mesh.face_wedges.as_flattened()[at]);
    let get = |semantic| mesh.layer(semantic).unwrap().get(wedge);
    assert_eq!(get(Semantic::Normal), &[0.0, 0.0, -1.0]);
    assert_eq!(get(Semantic::Tangent), &[-1.0, 0.0, 0.0, 1.0], "no less than -1");
    assert_eq!(get(Semantic::TexCoord(0)), &[4095.0, 2048.0]);
    assert_eq!(get(Semantic::TexCoord(1)), &[128.0 / 255.0, 0.2]);
    assert_eq!(get(Semantic::TexCoord(2)), &[-1.0, 1.0]);
    let uv = get(Semantic::TexCoord(0));
    let seen = mesh.materials[0].base_texture.unwrap().transform;
    let seen = seen.map(|[a, b, c]| a * uv[0] + b * uv[1] + c);
    assert!((seen[0] - 1.0).abs() < 1e-6 && (seen[1] - 2048.0 / 4095.0).abs() < 1e-6, "{seen:?}");
}

/// The square with a lock mask in 16-bit integers and weights in normalized bytes, of which the second
/// primitive, a copy a unit above, has none.
#[test]
fn vertices_are_locked_and_weighed_by_attributes() {
    let (mut json, mut bin) = (square_json(), square_bin());
    bin.extend([0_u16, 7, 0, 1].iter().flat_map(|v| v.to_le_bytes()));
    bin.extend([255, 0, 51, 255]);
    bin.extend(bytes_of(&[0., 0., 1., 1., 0., 1., 0., 1., 1., 1., 1., 1.]));
    json["buffers"][0]["byteLength"] = bin.len().into();
    for (offset, length) in [(60, 8), (68, 4), (72, 48)] {
        let view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": length });
        json["bufferViews"].as_array_mut().unwrap().push(view);
    }
    for accessor in [
        json!({ "bufferView": 2, "componentType": 5123, "count": 4, "type": "SCALAR" }),
        json!({ "bufferView": 3, "componentType": 5121, "count": 4, "type": "SCALAR", "normalized": true }),
        json!({ "bufferView": 4, "componentType": 5126, "count": 4, "type": "VEC3" }),
    ] {
        json["accessors"].as_array_mut().unwrap().push(accessor);
    }
    json["meshes"][0]["primitives"] = json!([
        { "attributes": { "POSITION": 0, "_LOCK": 2, "_WEIGHT": 3 }, "indices": 1 },
        { "attributes": { "POSITION": 4 }, "indices": 1 },
    ]);
    let ingest = load("x.glb", &glb(&json, &bin)).unwrap();
    let marks = ingest.marks;
    let (f, t) = (false, true);
    assert_eq!(marks.locked, [f, t, f, t, f, f, f, f]);
    assert_eq!(marks.weights, [1.0, 0.0, 0.2, 1.0, 1.0, 1.0, 1.0, 1.0]);
    assert!(ingest.report.notes.is_empty(), "{:?}", ingest.report.notes);
    json["accessors"][2]["count"] = 3.into();
    let error = error_of("x.glb", &glb(&json, &bin)).to_string();
    assert!(error.contains("_LOCK") && error.contains("3 values for 4 positions"), "{error}");
}

/// Each of these says something that does not reach the mesh, but for the extension of a material.
#[test]
fn what_extensions_and_scenes_say_is_named() {
    let bytes = textured_glb(&[png(), png()], |json| {
        json["extensionsUsed"] =
            json!(["KHR_lights_punctual", "ACME_material", "KHR_mesh_quantization", "MSFT_lod"]);
        json["materials"][0]["extensions"] = json!({ "ACME_material": { "k": 1 } });
        json["scenes"] = json!([{ "nodes": [0] }, { "nodes": [1] }]);
        json["nodes"].as_array_mut().unwrap().push(json!({}));
        json["textures"] = json!([
            { "extensions": { "EXT_texture_avif": { "source": 0 } } },
            { "source": 1, "extensions": { "MSFT_texture_dds": { "source": 0 } } },
        ]);
    });
    let Ingest { mesh, report, .. } = load("x.glb", &bytes).unwrap();
    let text: Vec<_> = report.notes.iter().map(|n| (n.code, n.text.as_str())).collect();
    let codes: Vec<_> = text.iter().map(|(code, _)| *code).collect();
    let expected =
        ["texture_format_ignored", "scenes_ignored", "extension_ignored", "levels_ignored"];
    assert_eq!(codes, expected);
    assert!(text[0].1.starts_with("texture 0 has its image by EXT_texture_avif alone"), "{text:?}");
    assert!(text[2].1.starts_with("extension KHR_lights_punctual is not read"), "{text:?}");
    assert_eq!((mesh.textures[0].image, mesh.textures[1].image), (None, Some(1)));
}
