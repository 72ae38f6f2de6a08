//! Optimization as a part of jobs, and as a job of its own.

use lookalike::{
    io::{Limits, read, write_glb},
    jobs::spec::{Effort, Input, Method, Optimize, Render, Shading, Spec},
    mesh::{EditMesh, Semantic},
    progressive::{Reader, decode_edit},
    worker::pipeline::{Inputs, ModelFile},
};
use serde_json::Value;

use super::support::{Done, job, job_on, sample};

fn small() -> Render {
    Render { n_views: 6, image_size: 128, ..Render::default() }
}

fn spec(triangles: Vec<u32>) -> Spec {
    Spec { render: small(), effort: Effort::Fast, ..Spec::new(triangles) }
}

fn optimization(done: &Done, level: usize) -> Value {
    assert!(done.result.is_ok(), "{:?}", done.result);
    done.report()["levels"][level]["optimization"].clone()
}

/// What every optimized level must keep: it looks more like the original from where no stage has looked, and the
/// file and the stream lead to it.
fn check(done: &Done, levels: usize) {
    let reader = Reader::open(&done.files["progressive.lkpm"]).unwrap();
    for level in 0..levels {
        let told = optimization(done, level);
        let unseen = [0, 1].map(|i| told["d2_unseen_percent"][i].as_f64().unwrap());
        assert!(unseen[1] < unseen[0], "{told}");
        let name = format!("lod-{level}");
        let file = &done.files[&format!("{name}.glb")];
        assert!(&write_glb(&reader.extract_level(&name).unwrap()).unwrap() == file, "{name}");

        let before = reader.extract_level_before_edits(&name).unwrap();
        let mut mesh = EditMesh::new(before).unwrap();
        let mut bytes = done.edits[&(level as u32)].as_slice();
        let mut n_edits = 0;
        while !bytes.is_empty() {
            let (record, n_bytes) = decode_edit(bytes).unwrap();
            mesh.redo(record.edit());
            bytes = &bytes[n_bytes..];
            n_edits += 1;
        }
        mesh.validate().unwrap();
        assert!(&write_glb(&mesh.snapshot()).unwrap() == file, "the stream of {name}");
        assert_eq!(told["edits"].as_u64(), Some(n_edits));
    }
}

#[test]
fn every_level_is_optimized_and_the_records_lead_to_it() {
    let done = job(&spec(vec![60, 150]), "sample.glb", &sample(4000), "cpu");
    check(&done, 2);
    let stages: Vec<_> = done.report()["stages"].as_array().unwrap().clone();
    let names: Vec<_> = stages.iter().map(|s| s["stage"].as_str().unwrap()).collect();
    assert_eq!(names, ["memoryless", "image", "optimize"]);
    assert!(stages[2]["evaluations_per_second"].as_f64().unwrap() > 0.0);
    assert!(done.files.contains_key("optimization.svg"));
    // The curve of each level falls, finest level first; evaluations run on through the stage.
    let curve: Vec<_> = done.samples.iter().filter(|s| s.stage == "optimize").collect();
    assert_eq!((curve[0].level, curve.last().unwrap().level), (Some(1), Some(0)));
    assert!(curve.is_sorted_by_key(|s| s.evaluations));
    for level in 0..2 {
        let own: Vec<_> = curve.iter().filter(|s| s.level == Some(level)).collect();
        assert!(own.is_sorted_by(|a, b| a.energy >= b.energy || a.turn < b.turn));
        assert!(own[0].d2_unseen.is_some() && own.last().unwrap().d2_unseen.is_some());
        assert_eq!(own[0].energy_ratio, Some(1.0));
    }
}

#[test]
fn a_budget_is_evaluations_an_energy_or_none_at_all() {
    let input = sample(3000);
    let run = |optimize| job(&Spec { optimize, ..spec(vec![300]) }, "sample.glb", &input, "cpu");
    let budget = |n| Optimize { max_evaluations: Some(n), ..Optimize::default() };
    let told = optimization(&run(budget(3000)), 0);
    assert_eq!(told["stopped_by"], "evaluations");
    assert!((2000..4000).contains(&told["evaluations"].as_u64().unwrap()), "{told}");
    let told = optimization(&run(Optimize { until: Some(0.95), ..Optimize::default() }), 0);
    assert_eq!(told["stopped_by"], "energy");
    assert!(told["energy_ratio"].as_f64().unwrap() <= 0.95);
    let told = optimization(&run(Optimize { max_secs: Some(0.05), ..Optimize::default() }), 0);
    assert_eq!(told["stopped_by"], "seconds");
    let off = run(budget(0));
    assert!(optimization(&off, 0).is_null());
    assert!(off.edits.is_empty() && !off.files.contains_key("optimization.svg"));
}

#[test]
fn geometry_alone_stays_geometry_unless_optimization_is_asked_for() {
    let memoryless = Spec { method: Method::Memoryless, ..spec(vec![300]) };
    let input = sample(3000);
    let plain = job(&memoryless, "sample.glb", &input, "cpu");
    assert!(optimization(&plain, 0).is_null() && plain.samples.iter().all(|s| s.d2.is_none()));
    let optimize = Optimize { max_evaluations: Some(5000), ..Optimize::default() };
    check(&job(&Spec { optimize, ..memoryless }, "sample.glb", &input, "cpu"), 1);
}

#[test]
fn clusters_are_optimized_like_any_other_mesh() {
    let input = sample(6000);
    let done =
        job(&Spec { method: Method::Cluster, ..spec(vec![500]) }, "sample.glb", &input, "cpu");
    check(&done, 1);
    let report = done.report();
    assert_eq!(report["levels"][0]["stopped_by"], "triangles");
    assert!(report["levels"][0]["triangles"].as_u64().unwrap() <= 500);
    assert_eq!(report["records"], 0);
}

#[test]
fn what_another_tool_simplified_is_optimized_against_the_original() {
    let (original, spec) = (sample(4000), spec(vec![400]));
    let off = Optimize { max_evaluations: Some(0), ..Optimize::default() };
    let crude = Spec { method: Method::Cluster, optimize: off, ..spec };
    let crude = job(&crude, "sample.glb", &original, "cpu").files["lod-0.glb"].clone();
    let input = Input { mesh: "0".repeat(64), file_name: "crude.glb".into() };
    let optimize = Optimize { max_evaluations: Some(20_000), ..Optimize::default() };
    let spec = Spec { render: small(), optimize, ..Spec::optimizing(input) };
    let inputs = Inputs {
        original: ModelFile { name: "sample.glb", bytes: &original },
        simplified: Some(ModelFile { name: "crude.glb", bytes: &crude }),
    };
    let done = job_on(&spec, &inputs, "cpu");
    check(&done, 1);
    let crude = read("crude.glb", &crude, &Limits::default()).unwrap().mesh;
    let after = read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh;
    assert!(after.faces.len().abs_diff(crude.faces.len()) <= 2);
    assert!(done.notes.iter().any(|n| n.1.starts_with("simplified mesh: read")));
    // A broken simplified mesh is the job's fault, with a reason.
    let simplified = Some(ModelFile { name: "crude.glb", bytes: b"glTF" });
    let broken = job_on(&spec, &Inputs { simplified, ..inputs }, "cpu");
    assert!(broken.result.unwrap_err().to_string().contains("crude.glb"));
}

#[test]
fn normals_are_found_and_written() {
    let render = Render { shading: Shading::Smooth, ..small() };
    let optimize = Optimize { normals: true, max_evaluations: Some(10_000), ..Optimize::default() };
    let spec = Spec { render, optimize, ..spec(vec![300]) };
    let done = job(&spec, "sample.glb", &sample(3000), "cpu");
    check(&done, 1);
    let level = read("lod-0.glb", &done.files["lod-0.glb"], &Limits::default()).unwrap().mesh;
    assert!(level.layer(Semantic::Normal).is_some());
}

/// 200 triangles in 12 views of 128²: enough pixels a triangle for view sets to take turns.
#[test]
fn view_sets_take_turns_where_pictures_are_large_enough() {
    let render = Render { n_views: 12, image_size: 128, ..Render::default() };
    let optimize = Optimize { max_evaluations: Some(20_000), ..Optimize::default() };
    let spec = Spec { render, optimize, method: Method::Memoryless, ..spec(vec![200]) };
    let done = job(&spec, "sample.glb", &sample(4000), "cpu");
    check(&done, 1);
    let curve: Vec<_> = done.samples.iter().filter(|s| s.stage == "optimize").collect();
    assert!(curve.iter().any(|s| s.turn > Some(0)) && curve.is_sorted_by_key(|s| s.turn));
    let unseen: Vec<f64> = curve.iter().filter_map(|s| s.d2_unseen).collect();
    assert!(unseen[unseen.len() - 1] < 0.95 * unseen[0], "{unseen:?}");
}
