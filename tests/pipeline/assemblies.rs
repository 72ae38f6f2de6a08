//! Models of several parts with textures: what is written is what was optimized, under the names it
//! had, and what has vanished is told.

use std::sync::Arc;

use glam::DVec3;
use lookalike::{
    compare::{Appearance, Look, Params, Reference, textured_torus},
    io::{Limits, read, write_glb},
    jobs::spec::{Effort, Output, Render, Spec},
    mesh::{AttributeLayer, Material, Mesh, Node, Part, Semantic, Tree, shapes},
    metric::{Pictures, bounding_sphere, reference_pictures},
    render::{
        RenderParams, Shading, energy,
        view::{Projection, ViewParams, cameras, directions},
    },
};

use super::support::{Done, check_levels, job, real_model, simplify_only};

/// A ball with a texture, a second one on it, and inside it one that no view sees: three parts, one
/// below another, beside a node without triangles.
fn balls() -> Mesh {
    let ball = shapes::sphere(4);
    let n = ball.positions.len() as u32;
    let mut mesh = Mesh::default();
    let mut coordinates = Vec::new();
    for (i, (center, radius)) in
        [(DVec3::ZERO, 1.0), (DVec3::new(0.3, 1.2, 0.0), 0.6), (DVec3::ZERO, 0.2)]
            .into_iter()
            .enumerate()
    {
        let shift = i as u32 * n;
        mesh.positions.extend(ball.positions.iter().map(|p| center + radius * *p));
        mesh.faces.extend(ball.faces.iter().map(|f| f.map(|v| v + shift)));
        mesh.face_parts.extend(ball.faces.iter().map(|_| i as u32));
        coordinates.extend(ball.positions.iter().flat_map(|p| [p.x, p.y].map(|x| x as f32)));
    }
    mesh.face_wedges.clone_from(&mesh.faces);
    let semantic = Semantic::TexCoord(0);
    mesh.layers = vec![AttributeLayer { semantic, width: 2, values: coordinates }];
    let Mesh { materials, textures, images, .. } = textured_torus();
    (mesh.materials, mesh.textures, mesh.images) = (materials, textures, images);
    mesh.materials.push(Material { base_color: [0.8, 0.1, 0.1, 1.0], ..Material::default() });
    mesh.face_materials = mesh.face_parts.iter().map(|part| u32::from(*part == 1)).collect();
    let node = |name: &str, parent| Node { name: name.to_owned(), parent, transform: None };
    let nodes = vec![
        node("toy", None),
        node("big", Some(0)),
        node("small", Some(1)),
        node("hidden", Some(0)),
        node("lamp", Some(0)),
    ];
    let part = |node| Part { node, mesh: "ball".to_owned(), skin: None };
    mesh.tree = Arc::new(Tree { nodes, parts: [1, 2, 3].map(part).to_vec(), skins: Vec::new() });
    mesh
}

const SIZE: u32 = 96;

fn spec(triangles: Vec<u32>) -> Spec {
    let render = Render { n_views: 6, image_size: SIZE, ..Render::default() };
    Spec { effort: Effort::Fast, render, ..simplify_only(triangles) }
}

/// The run-time pictures of [`spec`].
fn pictures(original: &Mesh) -> Pictures {
    let views = ViewParams {
        directions: directions(6).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: SIZE,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    Pictures::of(original, params, cameras(&bounding_sphere(original), &views))
}

/// Every level, read back from its file, looks like the one in the progressive mesh, which is
/// the optimized one to the last bit; and that has the energy that the report states.
#[track_caller]
fn check_looks(done: &Done, original: &Mesh) {
    assert!(done.result.is_ok(), "{:?}", done.result);
    let look = Look {
        appearance: Appearance::Coloured,
        image_size: 256,
        supersampling: 2,
        ..Look::default()
    };
    let reference = Reference::new(original, &Params { look, ..Params::default() });
    let pictures = pictures(original);
    let drawn = reference_pictures(original, &pictures);
    let energy = |mesh: &Mesh| {
        energy(&pictures.views, &drawn, &reference_pictures(mesh, &pictures).pictures)
    };
    let (report, reader) = (done.report(), check_levels(done));
    for (i, level) in report["levels"].as_array().unwrap().iter().enumerate() {
        let file = &done.files[level["file"].as_str().unwrap()];
        let written = read("lod.glb", file, &Limits::default()).unwrap().mesh;
        let exact = reader.extract_level(&format!("lod-{i}")).unwrap();
        // Pixels are not stored in the progressive mesh, nor are they needed: the palette is the
        // original's.
        assert_eq!(Some(energy(&exact)), level["energy"].as_u64());
        let (a, b) = (energy(&exact) as f64, energy(&written) as f64);
        assert!((a - b).abs() <= 1e-3 * a, "level {i}: energy {a}, written {b}");
        let exact = Mesh { images: original.images.clone(), ..exact };
        let [a, b] = [&exact, &written].map(|mesh| reference.compare(mesh).d2_percent);
        assert!((a - b).abs() <= 1e-3 * a, "level {i}: d2 {a}, written {b}");
        eprintln!("level {i}: d2 {a:.6}, written {b:.6}");
    }
}

fn names_of_nodes(glb: &[u8]) -> Vec<String> {
    let mesh = read("lod.glb", glb, &Limits::default()).unwrap().mesh;
    mesh.tree.nodes.iter().map(|node| node.name.clone()).collect()
}

#[test]
fn what_is_written_is_what_was_optimized() {
    let input = write_glb(&balls()).unwrap();
    let original = read("balls.glb", &input, &Limits::default()).unwrap().mesh;
    let optimize = Spec::new(vec![1]).optimize;
    let spec = Spec { optimize, ..spec(vec![200, 900]) };
    let done = job(&spec, "balls.glb", &input, "cpu");
    check_looks(&done, &original);
    assert_eq!(names_of_nodes(&input), ["toy", "big", "small", "hidden"]);
    assert_eq!(names_of_nodes(&done.files["lod-0.glb"]), ["toy", "big", "small"]);
}

#[test]
fn real_assemblies_are_written_as_they_were_optimized() {
    let Some(input) = real_model("flight_helmet.glb") else { return };
    let original = read("helmet.glb", &input, &Limits::default()).unwrap().mesh;
    let done = job(&spec(vec![1000, 4000]), "helmet.glb", &input, "cpu");
    check_looks(&done, &original);
}

#[test]
fn what_has_vanished_is_told() {
    let done = job(&spec(vec![3000, 200]), "balls.glb", &write_glb(&balls()).unwrap(), "cpu");
    let report = done.report();
    let input = &report["input"];
    let counts = ["nodes", "parts", "instances"].map(|what| input[what].as_u64());
    assert_eq!(counts, [Some(4), Some(3), Some(3)]);
    let unseen = |of: &serde_json::Value| of["never_seen_triangles"].as_u64().unwrap();
    // The hidden ball, and what the small one covers of the big one; of each ball six views see
    // nearly all.
    assert!((2048..2600).contains(&unseen(&report)), "{}", unseen(&report));
    let [fine, coarse] = [0, 1].map(|i| &report["levels"][i]);
    assert!(unseen(coarse) < unseen(fine) && unseen(fine) < 2048, "{report:#}");
    assert_eq!(coarse["parts_vanished"], serde_json::json!({ "count": 1, "names": ["hidden"] }));
    let told: Vec<_> = done.notes.iter().filter(|n| n.0 == "PARTS_VANISHED").collect();
    let said = "lod-1: parts gone: 1 ('hidden')";
    assert!(told.iter().any(|note| note.1 == said), "{told:?}");
}

/// Quantized and compressed files hold the same levels in less room, one by one and as a chain.
#[test]
fn levels_are_quantized_and_compressed() {
    let input = write_glb(&balls()).unwrap();
    let images: usize = balls().images.iter().map(|image| image.bytes.len()).sum();
    let mut sizes = Vec::new();
    for (quantize, compress) in [(false, false), (true, false), (false, true)] {
        let output = Output { quantize, compress };
        let done = job(&Spec { output, ..spec(vec![1500, 400]) }, "balls.glb", &input, "cpu");
        let mut n_bytes = 0;
        for (file, n_faces) in [("lod-0.glb", 1500), ("lod-1.glb", 400), ("lods.glb", 1500)] {
            let bytes = &done.files[file];
            let mesh = read(file, bytes, &Limits::default()).unwrap().mesh;
            assert!(mesh.faces.len().abs_diff(n_faces) <= 1, "{file}: {}", mesh.faces.len());
            n_bytes += bytes.len() - images;
        }
        assert_eq!(done.report()["spec"].get("output").is_some(), quantize || compress);
        sizes.push(n_bytes);
    }
    assert!(sizes[1] < sizes[0] && sizes[2] < sizes[1], "{sizes:?}");
}

/// One file for all levels, finest first, whatever the order asked; none where there is one level.
#[test]
fn levels_make_a_chain() {
    let input = write_glb(&balls()).unwrap();
    let done = job(&spec(vec![300, 1500, 300, 800]), "balls.glb", &input, "cpu");
    let glb = &done.files["lods.glb"];
    let n = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + n]).unwrap();
    let nodes = json["nodes"].as_array().unwrap();
    let top = &nodes[json["scenes"][0]["nodes"][0].as_u64().unwrap() as usize];
    let ids = top["extensions"]["MSFT_lod"]["ids"].as_array().unwrap();
    let others = ids.iter().map(|id| &nodes[id.as_u64().unwrap() as usize]);
    let names: Vec<_> = [top].into_iter().chain(others).map(|node| &node["name"]).collect();
    assert_eq!(names, ["lod-1", "lod-3", "lod-0"]);
    let coverage = top["extras"]["MSFT_screencoverage"].as_array().unwrap();
    let report = done.report();
    let distance = |i: usize| report["levels"][i]["switch_distance_radii"].as_f64().unwrap();
    let wanted = [3, 0].map(|i| (3.0_f64.sqrt() / distance(i)).min(1.0));
    for (found, wanted) in coverage.iter().zip(wanted.iter().chain([&0.0])) {
        assert!((found.as_f64().unwrap() - wanted).abs() < 1e-9, "{coverage:?} {wanted:?}");
    }
    assert_eq!((coverage.len(), json["images"].as_array().unwrap().len()), (3, 1));
    let alone = job(&spec(vec![300]), "balls.glb", &input, "cpu");
    assert!(!alone.files.contains_key("lods.glb"));
}
