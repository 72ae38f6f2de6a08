//! Levels by screen size, bytes and d2, alone and together with triangles.

use lookalike::{
    compare::{sample_mesh, textured_torus},
    io::write_glb,
    jobs::spec::{Effort, Method, Optimize, Render, Spec},
    mesh::Mesh,
    metric::{
        bounding_sphere,
        surface::{Ruler, SurfaceParams},
    },
};
use serde_json::Value;

use super::support::{Done, check_levels, job, sample, simplify_only};

fn small() -> Render {
    Render { n_views: 6, image_size: 64, ..Render::default() }
}

fn levels(done: &Done) -> Vec<Value> {
    assert!(done.result.is_ok(), "{:?}", done.result);
    done.report()["levels"].as_array().unwrap().clone()
}

fn triangles(level: &Value) -> u32 {
    level["triangles"].as_u64().unwrap() as u32
}

/// The height in pixels of the bounding sphere at which the mean distance is half a pixel.
fn screen_size(original: &Mesh, mesh: &Mesh) -> f64 {
    let ruler = Ruler::new(original, SurfaceParams { samples: 20_000, ..SurfaceParams::default() });
    bounding_sphere(original).radius / ruler.mean(mesh).unwrap()
}

#[test]
fn a_screen_size_gives_the_coarsest_mesh_that_is_good_enough() {
    let original = sample_mesh(3, 6000);
    for method in [Method::Memoryless, Method::Image] {
        let off = Optimize { max_evaluations: Some(0), ..Optimize::default() };
        let spec = Spec {
            screen_size: vec![150.0, 40.0],
            method,
            effort: Effort::Fast,
            render: small(),
            optimize: off,
            ..Spec::new(Vec::new())
        };
        let done = job(&spec, "sample.glb", &write_glb(&original).unwrap(), "cpu");
        let reader = check_levels(&done);
        let found = levels(&done);
        assert!(triangles(&found[0]) > 2 * triangles(&found[1]), "{found:?}");
        for (level, asked) in found.iter().zip([150.0, 40.0]) {
            assert_eq!(level["stopped_by"], "screen_size");
            assert!(level["screen_size_pixels"].as_f64().unwrap() >= asked, "{level}");
            // The collapse that was not made.
            let coarser = reader.extract(triangles(level) - 1).unwrap();
            assert!(screen_size(&original, &coarser) < asked, "{method:?}: {level}");
        }
    }
}

#[test]
fn a_number_of_bytes_is_made_use_of_and_not_exceeded() {
    let input = sample(6000);
    for (method, n_evaluations) in
        [(Method::Memoryless, 0), (Method::Image, 0), (Method::Image, 30_000)]
    {
        let optimize = Optimize { max_evaluations: Some(n_evaluations), ..Optimize::default() };
        let bytes = [40_000, 9_000];
        let spec = Spec {
            max_bytes: bytes.to_vec(),
            method,
            effort: Effort::Fast,
            render: small(),
            optimize,
            ..Spec::new(Vec::new())
        };
        let done = job(&spec, "sample.glb", &input, "cpu");
        let reader = check_levels(&done);
        for (level, most) in levels(&done).iter().zip(bytes) {
            assert_eq!(level["stopped_by"], "bytes");
            let n_bytes = done.files[level["file"].as_str().unwrap()].len() as u64;
            assert_eq!(level["bytes"].as_u64(), Some(n_bytes));
            assert!(n_bytes <= most, "{n_bytes} of {most}");
            // One collapse fewer would be too many.
            if n_evaluations == 0 {
                let finer = reader.extract(triangles(level) + 2).unwrap();
                assert!(write_glb(&finer).unwrap().len() as u64 > most, "{method:?}: {level}");
            }
        }
    }
}

#[test]
fn images_that_exceed_the_bytes_are_named() {
    let input = write_glb(&textured_torus()).unwrap();
    let spec =
        Spec { max_bytes: vec![3000], method: Method::Memoryless, ..simplify_only(Vec::new()) };
    let done = job(&spec, "torus.glb", &input, "cpu");
    let level = levels(&done)[0].clone();
    assert_eq!(level["stopped_by"], "images");
    assert!((4..800).contains(&triangles(&level)), "{level}");
    assert!(done.has_note("IMAGES_EXCEED_BYTES"), "{:?}", done.notes);
}

#[test]
fn every_level_has_a_limit_of_d2_of_its_own() {
    let spec = Spec {
        max_d2: vec![5.0, 2.5],
        effort: Effort::Fast,
        render: small(),
        ..simplify_only(Vec::new())
    };
    let done = job(&spec, "sample.glb", &sample(4000), "cpu");
    check_levels(&done);
    let found = levels(&done);
    for (level, most) in found.iter().zip([5.0, 2.5]) {
        assert_eq!(level["stopped_by"], "d2");
        let d2 = level["d2_percent"].as_f64().unwrap();
        assert!(d2 <= most && d2 > 0.8 * most, "{level}");
    }
    assert!(triangles(&found[0]) < triangles(&found[1]), "{found:?}");
}

#[test]
fn whichever_budget_comes_first_ends_a_level() {
    // By triangles; by screen size before the triangles; by bytes after them; by share.
    let spec = Spec {
        ratios: vec![0.1, 0.01, 0.3, 0.05],
        screen_size: vec![0.0, 200.0, 0.0, 0.0],
        max_bytes: vec![0, 0, 9_000, 0],
        effort: Effort::Fast,
        render: small(),
        ..Spec::new(Vec::new())
    };
    let done = job(&spec, "sample.glb", &sample(4000), "cpu");
    check_levels(&done);
    let found = levels(&done);
    let reasons: Vec<_> = found.iter().map(|level| level["stopped_by"].as_str().unwrap()).collect();
    assert_eq!(reasons, ["ratio", "screen_size", "bytes", "ratio"]);
    let asked = |level: &Value| level["asked"].as_u64().unwrap() as u32;
    assert!(triangles(&found[1]) > asked(&found[1]) && triangles(&found[2]) < asked(&found[2]));
    assert!(done.files["lod-2.glb"].len() <= 9_000);
    assert_eq!(done.notes.iter().filter(|note| note.0 == "TARGET_NOT_REACHED").count(), 1);
}

#[test]
fn a_view_that_counts_more_is_seen_better() {
    let with = |weights: Vec<u32>| {
        let render =
            Render { n_views: 6, image_size: 64, view_weights: weights, ..Render::default() };
        let done =
            job(&Spec { render, ..simplify_only(vec![150]) }, "sample.glb", &sample(4000), "cpu");
        levels(&done)[0]["energy"].as_u64().unwrap()
    };
    let (equal, plain) = (with(vec![1; 6]), with(Vec::new()));
    assert_eq!(equal, plain);
    // One view alone is brought closer than six are in the mean.
    let one = with(vec![0, 0, 6, 0, 0, 0]);
    assert!(one < equal, "{one} {equal}");
}
