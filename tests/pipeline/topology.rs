//! Jobs that may change the topology, and jobs that may not.

use lookalike::{
    io::{Limits, read},
    jobs::spec::{Effort, Method, Render, Spec, Topology},
};

use super::support::{Done, check_levels, job, real_model, simplify_only};

/// Octahedra beside one another: twenty parts of eight triangles, each of which can shrink to four
/// and no further.
fn octahedra() -> Vec<u8> {
    let mut obj = Vec::new();
    for part in 0..20 {
        let (x, y) = (f64::from(part % 5) * 3.0, f64::from(part / 5) * 3.0);
        for [dx, dy, dz] in [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]] {
            let size = 1.0 - 0.03 * f64::from(part);
            let (dx, dy, dz) = (size * f64::from(dx), size * f64::from(dy), size * f64::from(dz));
            obj.push(format!("v {} {} {dz}", x + dx, y + dy));
        }
        for k in 0..4 {
            let (a, b, first) = (k + 1, (k + 1) % 4 + 1, 6 * part);
            obj.push(format!("f {} {} {}", first + a, first + b, first + 5));
            obj.push(format!("f {} {} {}", first + b, first + a, first + 6));
        }
    }
    obj.join("\n").into_bytes()
}

fn with(topology: Topology, method: Method, triangles: Vec<u32>) -> Spec {
    let render = Render { n_views: 6, image_size: 64, ..Render::default() };
    Spec { topology, method, render, effort: Effort::Fast, ..simplify_only(triangles) }
}

fn level(done: &Done, i: usize) -> (u64, String) {
    assert!(done.result.is_ok(), "{:?}", done.result);
    let level = &done.report()["levels"][i];
    let reason = level["stopped_by"].as_str().unwrap_or_default().to_owned();
    (level["triangles"].as_u64().unwrap_or_default(), reason)
}

#[test]
fn free_topology_reaches_targets_that_parts_forbid() {
    let input = octahedra();
    for method in [Method::Image, Method::Memoryless] {
        let kept = job(&with(Topology::Preserve, method, vec![30]), "parts.obj", &input, "cpu");
        assert_eq!(level(&kept, 0), (80, "no_legal_collapse".into()), "{method:?}");
        let free = job(&with(Topology::Free, method, vec![30, 1]), "parts.obj", &input, "cpu");
        let (triangles, reason) = level(&free, 0);
        assert!((28..=30).contains(&triangles), "{method:?}: {triangles}");
        assert_eq!(reason, "triangles", "{method:?}");
        // Whatever is asked, something is left.
        assert!((1..=2).contains(&level(&free, 1).0), "{method:?}: {:?}", level(&free, 1));
        check_levels(&free);
    }
}

#[test]
fn free_topology_takes_a_house_of_many_parts_to_its_target() {
    let name = "house_scene.glb";
    let Some(house) = real_model(name) else { return };
    let original = read(name, &house, &Limits::default()).unwrap().mesh;
    let target = original.faces.len() as u32 / 50;
    let kept =
        job(&with(Topology::Preserve, Method::Memoryless, vec![target]), name, &house, "cpu");
    let (triangles, reason) = level(&kept, 0);
    assert!(triangles > u64::from(target) && reason == "no_legal_collapse", "{triangles}");
    let free = job(&with(Topology::Free, Method::Image, vec![target]), name, &house, "cpu");
    let (triangles, reason) = level(&free, 0);
    assert!(triangles <= u64::from(target), "{triangles} of {target}: {reason}");
    check_levels(&free);
}
