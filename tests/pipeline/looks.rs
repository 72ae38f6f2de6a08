//! Every way to draw the pictures, through whole jobs; what interior views are for; and what a chain
//! of levels costs.

use std::collections::BTreeMap;

use serde_json::json;

use lookalike::{
    compare::{Appearance, Look, Params, Reference, sample_mesh, textured_torus},
    io::{Limits, read, write_glb},
    jobs::spec::{Effort, Projection, Render, Shading, Spec},
    mesh::{Material, Mesh, shapes},
    render::adapters,
};

use super::support::{Done, check_levels, job, sample, simplify_only};

fn fast(triangles: Vec<u32>, render: Render) -> Spec {
    Spec { effort: Effort::Fast, start_factor: 2.0, render, ..simplify_only(triangles) }
}

/// One thing changed each, and everything at once.
fn looks() -> Vec<(&'static str, Render)> {
    let plain = Render { n_views: 6, image_size: 64, ..Render::default() };
    let views = |n_views| Render { n_views, ..plain.clone() };
    let custom_views = vec![[0.0, 0.0, 2.0], [-1.0, 0.5, 0.0], [0.0, -1.0, 1e-3]];
    vec![
        ("plain", plain.clone()),
        ("4 views", views(4)),
        ("8 views", views(8)),
        ("12 views", views(12)),
        ("20 views", views(20)),
        ("24 views", views(24)),
        ("custom views", Render { custom_views: custom_views.clone(), ..plain.clone() }),
        ("1024 pixels", Render { image_size: 1024, ..views(4) }),
        ("orthographic", Render { projection: Projection::Orthographic, ..plain.clone() }),
        ("narrow", Render { fov_degrees: 20.0, ..plain.clone() }),
        ("before black", Render { background: 0.0, ..plain.clone() }),
        ("ambient", Render { ambient: 0.6, ..plain.clone() }),
        ("lit aside", Render { light_degrees: 70.0, ..plain.clone() }),
        ("smooth", Render { shading: Shading::Smooth, ..plain.clone() }),
        ("interior", Render { interior_views: 3, ..plain.clone() }),
        (
            "all at once",
            Render {
                custom_views,
                image_size: 72,
                fov_degrees: 40.0,
                projection: Projection::Orthographic,
                background: 0.9,
                ambient: 0.3,
                light_degrees: 45.0,
                shading: Shading::Smooth,
                interior_views: 1,
                ..plain
            },
        ),
    ]
}

fn energy(done: &Done) -> u64 {
    assert!(done.result.is_ok(), "{:?}", done.result);
    done.report()["levels"][0]["energy"].as_u64().unwrap()
}

#[test]
fn every_look_makes_levels_of_its_own() {
    let input = sample(2500);
    let mut seen = BTreeMap::new();
    for (what, render) in looks() {
        let done = job(&fast(vec![800], render), "sample.glb", &input, "cpu");
        assert_eq!(done.report()["levels"][0]["stopped_by"], "triangles", "{what}");
        check_levels(&done);
        let other = seen.insert(energy(&done), what);
        assert_eq!(other, None, "{what} changes nothing");
    }
}

#[test]
fn devices_draw_every_look_alike() {
    let input = sample(2500);
    for adapter in adapters().into_iter().filter(|a| a.unfit.is_none()) {
        for (what, render) in looks() {
            if !["custom views", "orthographic", "interior", "all at once"].contains(&what) {
                continue;
            }
            let spec = fast(vec![1000], render);
            let native = job(&spec, "sample.glb", &input, "cpu");
            let device = job(&spec, "sample.glb", &input, &adapter.name);
            assert_eq!(native.timeless(), device.timeless(), "{what} on {}", adapter.name);
        }
    }
}

/// The sample has an open border, through which its inside is seen.
#[test]
fn backs_of_single_sided_materials_can_be_hidden() {
    let energy_of = |double_sided: bool, hide_back_faces: bool| {
        let mut mesh = sample_mesh(3, 2500);
        mesh.materials.iter_mut().for_each(|m| m.double_sided = double_sided);
        let render = Render { n_views: 6, image_size: 64, hide_back_faces, ..Render::default() };
        let spec = fast(vec![800], render);
        energy(&job(&spec, "sample.glb", &write_glb(&mesh).unwrap(), "cpu"))
    };
    let shown = energy_of(false, false);
    assert_eq!(energy_of(true, true), shown, "both sides are to be seen");
    assert_ne!(energy_of(false, true), shown);
}

/// A ball in a ball: no view from outside sees the inner one.
fn ball_in_ball() -> Mesh {
    let mut mesh = shapes::sphere(4);
    let n_vertices = mesh.positions.len() as u32;
    let inner = mesh.positions.iter().map(|p| {
        let dents = libm::sin(9.0 * p.x) * libm::sin(8.0 * p.y) * libm::sin(7.0 * p.z);
        *p * (0.6 + 0.1 * dents)
    });
    mesh.positions.extend(inner.collect::<Vec<_>>());
    mesh.faces.extend(mesh.faces.clone().iter().map(|f| f.map(|v| v + n_vertices)));
    mesh
}

/// Triangles of the inner ball in the coarsest level.
fn n_inner(interior_views: u32) -> usize {
    let render = Render { n_views: 6, image_size: 128, interior_views, ..Render::default() };
    let spec = Spec { start_factor: 5.0, ..fast(vec![600], render) };
    let done = job(&spec, "balls.glb", &write_glb(&ball_in_ball()).unwrap(), "cpu");
    assert!(done.result.is_ok(), "{:?}", done.result);
    let mesh = read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh;
    let is_inner = |f: &&[u32; 3]| f.iter().all(|v| mesh.positions[*v as usize].length() < 0.8);
    mesh.faces.iter().filter(is_inner).count()
}

#[test]
fn interior_views_keep_what_is_inside() {
    let (hidden, seen) = (n_inner(0), n_inner(3));
    eprintln!("triangles of the inner ball: {hidden}, with interior views {seen}");
    assert!(seen >= 100 && seen > 3 * hidden, "{hidden}, with interior views {seen}");
}

#[test]
fn levels_on_the_way_cost_nothing() {
    let input = sample(6000);
    let render = Render { n_views: 6, image_size: 64, ..Render::default() };
    let chain = fast(vec![300, 1500, 700], render.clone());
    // Alone, but from the same beginning.
    let alone = Spec { start_factor: 10.0, ..fast(vec![300], render) };
    let [chain, alone] = [chain, alone].map(|spec| job(&spec, "sample.glb", &input, "cpu"));
    let work = |done: &Done| {
        let stages = done.report()["stages"].clone();
        [0, 1].map(|i| ["evaluations", "collapses"].map(|what| stages[i][what].as_u64().unwrap()))
    };
    assert_eq!(work(&chain), work(&alone));
    assert_eq!(chain.files["lod-0.glb"], alone.files["lod-0.glb"]);
    let asked: Vec<_> = check_levels(&chain).header().levels.iter().map(|l| l.faces).collect();
    assert!(asked.is_sorted() || asked.iter().rev().is_sorted(), "{asked:?}");
    assert_eq!(asked.len(), 3);
}

/// A torus that is black, with numbers and squares that glow, if it does.
fn black_torus(glows: bool) -> Mesh {
    let mut mesh = textured_torus();
    let mut source = json!({ "pbrMetallicRoughness": { "baseColorFactor": [0, 0, 0, 1] } });
    if glows {
        source["emissiveFactor"] = json!([1, 1, 1]);
        source["emissiveTexture"] = json!({ "index": 0 });
    }
    let base_color = [0.0, 0.0, 0.0, 1.0];
    mesh.materials = vec![Material { base_color, source: Some(source), ..Material::default() }];
    mesh
}

/// What the pictures see glow stays where it was better than what they do not.
#[test]
fn what_glows_is_kept() {
    let original = black_torus(true);
    let look = Look { appearance: Appearance::Coloured, ..Look::default() };
    let reference = Reference::new(&original, &Params { look, ..Params::default() });
    let difference = |glows: bool| {
        let render = Render { n_views: 6, image_size: 128, ..Render::default() };
        let input = write_glb(&black_torus(glows)).unwrap();
        let done = job(&fast(vec![600], render), "torus.glb", &input, "cpu");
        assert!(done.result.is_ok(), "{:?}", done.result);
        let mut level = read("a.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh;
        level.materials.clone_from(&original.materials);
        level.images.clone_from(&original.images);
        reference.compare(&level).d2_255
    };
    let (seen, unseen) = (difference(true), difference(false));
    eprintln!("d2 where the glow was seen {seen:.2}, where not {unseen:.2}");
    assert!(seen < 0.9 * unseen, "{seen} against {unseen}");
}
