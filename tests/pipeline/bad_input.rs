//! Malformed, degenerate and impossible: a clear error or a sensible result with a stated reason.

use lookalike::{
    io::{Limits, read},
    jobs::spec::{Method, Optimize, Render, Spec},
    worker::pipeline::{Inputs, PipelineError},
};

use super::support::{job, real_model, sample};

/// An OBJ of the given faces over four corners of a square and an apex.
fn obj(faces: &str) -> Vec<u8> {
    format!("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 1\n{faces}").into_bytes()
}

#[test]
fn files_that_cannot_be_read_are_refused_with_the_reason() {
    let glb = sample(2000);
    let cases: [(&str, &str, Vec<u8>); 7] = [
        ("an empty file", "a.glb", Vec::new()),
        ("a truncated GLB", "a.glb", glb[..glb.len() / 2].to_vec()),
        (
            "a position that is not a number",
            "a.obj",
            b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".into(),
        ),
        ("an index out of range", "a.obj", obj("f 1 2 9\n")),
        ("degenerate triangles alone", "a.obj", obj("f 1 1 2\nf 3 3 3\n")),
        ("triangles on a line", "a.obj", b"v 0 0 0\nv 1 1 1\nv 3 3 3\nf 1 2 3\n".to_vec()),
        ("no format at all", "a.xyz", b"hello".into()),
    ];
    for (what, name, bytes) in cases {
        let done = job(&Spec::new(vec![10]), name, &bytes, "cpu");
        let Err(PipelineError::Job { code, text }) = &done.result else {
            panic!("{what}: {:?}", done.result);
        };
        assert!(!code.is_empty() && text.contains(name), "{what}: {code}: {text}");
        assert!(done.files.is_empty(), "{what} left files");
    }
}

#[test]
fn a_target_above_the_input_gives_the_original_and_says_so() {
    // A pyramid of six triangles asked for twenty.
    let pyramid = obj("f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 1 3 2\nf 1 4 3\n");
    for method in [Method::Image, Method::Memoryless] {
        let spec = Spec { method, ..Spec::new(vec![20]) };
        let done = job(&spec, "pyramid.obj", &pyramid, "cpu");
        assert!(done.result.is_ok(), "{:?}", done.result);
        assert!(done.has_note("TARGET_NOT_BELOW_INPUT"), "{:?}", done.notes);
        let level = &done.report()["levels"][0];
        assert_eq!(
            (level["triangles"].as_u64(), level["stopped_by"].as_str()),
            (Some(6), Some("input"))
        );
    }
}

#[test]
fn a_target_out_of_reach_stops_with_the_reason() {
    // A closed surface cannot have two triangles and keep its topology.
    let pyramid = obj("f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 1 3 2\nf 1 4 3\n");
    let done = job(&Spec::new(vec![2]), "pyramid.obj", &pyramid, "cpu");
    let level = done.report()["levels"][0].clone();
    assert_eq!(level["stopped_by"], "no_legal_collapse");
    assert_eq!(level["triangles"], 4);
    assert!(done.has_note("TARGET_NOT_REACHED"), "{:?}", done.notes);
}

#[test]
fn clustering_that_leaves_nothing_says_so() {
    let tetrahedron = obj("f 1 2 5\nf 2 4 5\nf 4 1 5\nf 1 4 2\n");
    let spec = Spec { method: Method::Cluster, ..Spec::new(vec![1]) };
    let done = job(&spec, "tetrahedron.obj", &tetrahedron, "cpu");
    let Err(PipelineError::Job { code, .. }) = &done.result else { panic!("{:?}", done.result) };
    assert_eq!(*code, "NOTHING_LEFT");
}

#[test]
fn a_spent_budget_stops_with_the_reason_and_keeps_what_there_is() {
    let spec = Spec { max_evaluations: 500, ..Spec::new(vec![1500, 100]) };
    let done = job(&spec, "sample.glb", &sample(6000), "cpu");
    assert!(done.result.is_ok(), "{:?}", done.result);
    let report = done.report();
    assert_eq!(report["levels"][1]["stopped_by"], "evaluations");
    assert!(done.has_note("TARGET_NOT_REACHED"), "{:?}", done.notes);
    for level in ["lod-0.glb", "lod-1.glb"] {
        assert!(read(level, &done.files[level], &Limits::default()).is_ok());
    }
}

#[test]
fn a_limit_of_d2_ends_the_chain_with_the_reason() {
    let optimize = Optimize { max_evaluations: Some(0), ..Optimize::default() };
    let render = Render { n_views: 4, image_size: 64, ..Render::default() };
    let shares = Spec { ratios: vec![0.005, 0.1, 0.001], ..Spec::new(Vec::new()) };
    let spec = Spec { max_d2: vec![4.0], optimize, render, ..shares };
    let done = job(&spec, "sample.glb", &sample(6000), "cpu");
    assert!(done.result.is_ok(), "{:?}", done.result);
    let report = done.report();
    let [coarse, fine, coarsest] = [0, 1, 2].map(|i| report["levels"][i].clone());
    assert_eq!(fine["stopped_by"], "ratio");
    for level in [&coarse, &coarsest] {
        assert_eq!(level["stopped_by"], "d2");
        assert!(level["triangles"].as_u64() > level["asked"].as_u64(), "{level}");
        assert!(level["d2_percent"].as_f64().unwrap() <= 4.0, "{level}");
    }
    assert_eq!(coarse["triangles"], coarsest["triangles"]);
    let radii = |level: &serde_json::Value| level["switch_distance_radii"].as_f64().unwrap();
    assert!(radii(&fine) > 0.0 && radii(&coarse) > radii(&fine), "{report}");
    assert!(done.has_note("TARGET_NOT_REACHED"), "{:?}", done.notes);
}

#[test]
fn cancelling_stops_the_job_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let device = lookalike::worker::pipeline::DeviceChoice("cpu".into());
    let spec = Spec::new(vec![300]);
    let mut reports = 0;
    let result = lookalike::worker::pipeline::run(
        &spec,
        &Inputs::of("sample.glb", &sample(6000)),
        dir.path(),
        (&device, &lookalike::tape::Tape::off()),
        &mut |_| {
            reports += 1;
            if reports == 5 {
                std::ops::ControlFlow::Break(())
            } else {
                std::ops::ControlFlow::Continue(())
            }
        },
    );
    assert!(matches!(result, Err(PipelineError::Cancelled)), "{result:?}");
    assert_eq!(reports, 5);
}

#[test]
fn a_non_manifold_soup_is_simplified_as_far_as_its_topology_allows() {
    let Some(house) = real_model("house_scene.glb") else { return };
    // What optimization makes of such a soup is worth a look, but not a minute.
    let optimize = Optimize { max_evaluations: Some(2000), ..Optimize::default() };
    let spec = Spec { optimize, ..Spec::new(vec![5000, 1000]) };
    let done = job(&spec, "house_scene.glb", &house, "cpu");
    assert!(done.result.is_ok(), "{:?}", done.result);
    for level in done.report()["levels"].as_array().unwrap() {
        let (asked, got) = (level["asked"].as_u64().unwrap(), level["triangles"].as_u64().unwrap());
        let reason = level["stopped_by"].as_str().unwrap();
        assert!(got <= asked || reason == "no_legal_collapse", "{got} of {asked}: {reason}");
    }
    assert_eq!(done.records, done.report()["records"].as_u64().unwrap());
}
