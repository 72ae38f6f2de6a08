//! What is locked stays where it is, whatever the stages.

use std::fmt::Write as _;

use lookalike::{
    io::{Limits, PlyPositions, read, write_ply},
    jobs::spec::{Effort, Input, Lock, Method, Optimize, Render, Spec, Topology},
    mesh::{Mesh, shapes},
    worker::pipeline::{Inputs, ModelFile},
};

use super::support::{Done, check_levels, job, job_on};

/// The mesh as a PLY file with a property `lock`.
fn ply(mesh: &Mesh, is_locked: impl Fn(usize) -> bool) -> Vec<u8> {
    ply_with(mesh, "uchar lock", |v| f32::from(u8::from(is_locked(v))))
}

/// The mesh as a PLY file with a property of its vertices.
fn ply_with(mesh: &Mesh, property: &str, value: impl Fn(usize) -> f32) -> Vec<u8> {
    let (n, m) = (mesh.positions.len(), mesh.faces.len());
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n\
         property {property}\nelement face {m}\nproperty list uchar int vertex_indices\nend_header\n"
    );
    for (v, p) in mesh.positions.iter().enumerate() {
        let [x, y, z] = p.as_vec3().to_array();
        writeln!(text, "{x} {y} {z} {}", value(v)).unwrap();
    }
    for [a, b, c] in &mesh.faces {
        writeln!(text, "3 {a} {b} {c}").unwrap();
    }
    text.into_bytes()
}

/// A hilly square of 20 x 20 cells.
fn terrain() -> Mesh {
    shapes::terrain(20, 0.15)
}

/// Every eleventh vertex by the file, and those along the border by the flag.
fn is_in_mask(v: usize) -> bool {
    v.is_multiple_of(11)
}

fn is_on_border(v: usize) -> bool {
    let (x, y) = (v % 21, v / 21);
    x == 0 || x == 20 || y == 0 || y == 20
}

/// Every locked vertex is one of the level's, exactly where it was, once.
fn check(done: &Done, is_locked: impl Fn(usize) -> bool) {
    assert!(done.result.is_ok(), "{:?}", done.result);
    let places =
        |mesh: &Mesh| mesh.positions.iter().map(|p| p.as_vec3().to_array()).collect::<Vec<_>>();
    for level in done.report()["levels"].as_array().unwrap() {
        let file = level["file"].as_str().unwrap();
        let mesh = read(file, &done.files[file], &Limits::default()).unwrap().mesh;
        let there = places(&mesh);
        for (v, place) in places(&terrain()).iter().enumerate().filter(|(v, _)| is_locked(*v)) {
            let n = there.iter().filter(|p| *p == place).count();
            assert_eq!(n, 1, "{file}: vertex {v} at {place:?}");
        }
    }
}

/// Small pictures, but as many pixels a triangle as turns, descents and cycles want.
fn spec(triangles: Vec<u32>) -> Spec {
    let render = Render { n_views: 6, image_size: 200, ..Render::default() };
    Spec { render, lock: vec![Lock::Border], ..Spec::new(triangles) }
}

#[test]
fn locked_vertices_stay_through_every_stage() {
    let input = ply(&terrain(), is_in_mask);
    let is_locked = |v| is_in_mask(v) || is_on_border(v);
    let optimize = Optimize { max_evaluations: Some(400 * 180), ..Optimize::default() };
    for (method, topology) in [
        (Method::Image, Topology::Preserve),
        (Method::Image, Topology::Free),
        (Method::Memoryless, Topology::Preserve),
    ] {
        let spec = Spec { method, topology, optimize: optimize.clone(), ..spec(vec![400, 260]) };
        let done = job(&spec, "terrain.ply", &input, "cpu");
        check(&done, is_locked);
        assert!(done.has_note("VERTICES_LOCKED"), "{:?}", done.notes);
        let report = done.report();
        assert_eq!(report["levels"][1]["stopped_by"], "triangles");
        assert!(report["levels"][1]["optimization"]["edits"].as_u64() > Some(50), "{report}");
        check_levels(&done);
    }
}

#[test]
fn single_moves_leave_locked_vertices_alone() {
    // The run-time views alone, whose energy is asked for, and triangles too small for descents: searches, swaps,
    // teleports, edges.
    let render = Render { n_views: 4, image_size: 64, ..Render::default() };
    let optimize =
        Optimize { max_evaluations: Some(40_000), until: Some(0.01), ..Optimize::default() };
    let spec = Spec { render, optimize, effort: Effort::Fast, ..spec(vec![300]) };
    let done = job(&spec, "terrain.ply", &ply(&terrain(), is_in_mask), "cpu");
    check(&done, |v| is_in_mask(v) || is_on_border(v));
    let moves = done.report()["levels"][0]["optimization"]["moves"].clone();
    let tried = |name: &str| {
        let of_name = moves
            .as_array()
            .unwrap()
            .iter()
            .filter(|m| m["name"].as_str().unwrap().starts_with(name));
        of_name.map(|m| m["tried"].as_u64().unwrap()).sum::<u64>()
    };
    for name in ["vertex", "swap", "split", "collapse", "no-op"] {
        assert!(tried(name) > 0, "{name}: {moves}");
    }
}

#[test]
fn a_target_that_locks_forbid_is_not_reached() {
    let input = ply(&terrain(), |_| false);
    for method in [Method::Image, Method::Memoryless] {
        let off = Optimize { max_evaluations: Some(0), ..Optimize::default() };
        let spec = Spec { method, optimize: off, effort: Effort::Fast, ..spec(vec![10]) };
        let done = job(&spec, "terrain.ply", &input, "cpu");
        check(&done, is_on_border);
        let level = done.report()["levels"][0].clone();
        assert_eq!(level["stopped_by"], "locks", "{method:?}");
        assert!(done.has_note("TARGET_NOT_REACHED"));
    }
}

#[test]
fn a_mesh_of_another_tool_keeps_what_is_locked() {
    let original = write_ply(&shapes::terrain(40, 0.15), PlyPositions::Double).unwrap();
    let simplified = ply(&terrain(), is_in_mask);
    let input = Input { mesh: String::new(), file_name: "crude.ply".into() };
    let optimize = Optimize { max_evaluations: Some(20_000), ..Optimize::default() };
    let Spec { render, lock, .. } = spec(Vec::new());
    let spec = Spec { render, lock, optimize, ..Spec::optimizing(input) };
    let simplified = ModelFile { name: "crude.ply", bytes: &simplified };
    let inputs = Inputs { simplified: Some(simplified), ..Inputs::of("fine.ply", &original) };
    let done = job_on(&spec, &inputs, "cpu");
    check(&done, |v| is_in_mask(v) || is_on_border(v));
}

#[test]
fn pictures_order_what_matters_less_first() {
    // The left half matters a hundredth as much.
    let n_left = |property: &str| {
        let is_left = |v: usize| v % 21 < 10;
        let input = ply_with(&terrain(), property, |v| if is_left(v) { 0.01 } else { 1.0 });
        let off = Optimize { max_evaluations: Some(0), ..Optimize::default() };
        let spec = Spec { optimize: off, lock: Vec::new(), ..spec(vec![300]) };
        let done = job(&Spec { start_factor: 3.0, ..spec }, "terrain.ply", &input, "cpu");
        assert!(done.result.is_ok(), "{:?}", done.result);
        assert_eq!(done.has_note("VERTICES_WEIGHED"), property.ends_with("weight"));
        let mesh = read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh;
        let middle =
            |f: &[u32; 3]| f.map(|v| mesh.positions[v as usize].x).iter().sum::<f64>() / 3.0;
        mesh.faces.iter().filter(|f| middle(f) < 0.5).count()
    };
    let (plain, weighed) = (n_left("float of_no_meaning"), n_left("float weight"));
    assert!(2 * weighed < plain, "{weighed} of {plain}");
}
