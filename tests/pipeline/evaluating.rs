//! The job that compares two meshes: what `compare` says of them, as files.

use std::{
    ops::ControlFlow,
    time::{Duration, Instant},
};

use lookalike::{
    compare::{self, Appearance, Look, SheetParams, sample_mesh, textured_torus},
    io::{Limits, read, write_glb},
    jobs::{
        event::Report,
        spec::{Evaluate, Input, Metric, Shading, Spec},
    },
    metric::surface::SurfaceParams,
    tape::Tape,
    worker::pipeline::{DeviceChoice, Inputs, ModelFile, PipelineError, run},
};

use super::support::{job_on, job_with, sample};

fn spec(evaluate: Evaluate) -> Spec {
    Spec::evaluating(Input { mesh: "0".repeat(64), file_name: "crude.glb".into() }, evaluate)
}

fn inputs<'a>(original: &'a [u8], simplified: &'a [u8]) -> Inputs<'a> {
    let simplified = Some(ModelFile { name: "crude.glb", bytes: simplified });
    Inputs { simplified, ..Inputs::of("model.glb", original) }
}

/// The files are those that `compare` makes; progress goes up through its parts.
fn check(evaluate: Evaluate, params: &compare::Params, [original, simplified]: [&[u8]; 2]) {
    let has_distance = evaluate.distance;
    let mut told: Vec<(String, f64)> = Vec::new();
    let hear = |report: &Report| {
        if let Report::Progress { stage, fraction, .. } = report {
            told.push((stage.clone(), *fraction));
        }
    };
    let spec = spec(evaluate);
    let tape = Tape::off();
    let done = job_with(&spec, &inputs(original, simplified), ("cpu", &tape, false), hear);
    assert!(done.result.is_ok(), "{:?}", done.result);
    assert!(done.files.keys().eq(["comparison.json", "contact-0.png", "report.json"]));

    let [a, b] = [original, simplified].map(|m| read("m.glb", m, &Limits::default()).unwrap().mesh);
    let wanted = compare::compare(&a, &b, params);
    let json = String::from_utf8(done.files["comparison.json"].clone()).unwrap();
    assert_eq!(json, compare::json(&wanted).unwrap());
    let of_sheet =
        SheetParams::default().of_surface(&params.look).with_stored_normals(params.stored_normals);
    assert!(done.files["contact-0.png"] == compare::sheet(&a, &b, &of_sheet));
    assert_eq!(wanted.metro.is_some(), has_distance);
    assert!(wanted.d2_percent > 0.1 && wanted.per_view.len() == 24);

    let report = done.report();
    assert_eq!(report["comparison"], serde_json::to_value(&wanted).unwrap());
    assert_eq!(report["input"]["triangles"], a.faces.len());
    assert_eq!(report["simplified"]["triangles"], b.faces.len());
    assert_eq!(report["device"], "native");
    assert!(report["seconds"].as_f64().unwrap() > 0.0);
    let note = done.notes.iter().find(|n| n.0 == "COMPARED").unwrap();
    assert!(note.1.contains(&format!("{:.4} %", wanted.d2_percent)), "{note:?}");
    assert_eq!(note.1.contains("on average"), has_distance, "{note:?}");
    assert_eq!(told.first(), Some(&("pictures".into(), 0.02)), "{told:?}");
    assert!(told.is_sorted_by_key(|t| t.1) && told.iter().all(|t| t.1 < 1.0), "{told:?}");
}

#[test]
fn the_figures_are_those_of_compare() {
    let plain =
        compare::Params { surface: Some(SurfaceParams::default()), ..compare::Params::default() };
    check(Evaluate::default(), &plain, [&sample(6000), &sample(3000)]);

    // Textures, vertex normals of the file, and one side of the surface.
    let fine = textured_torus();
    let mut crude = fine.clone();
    crude.positions.iter_mut().for_each(|p| *p *= 0.97);
    let evaluate = Evaluate {
        shading: Shading::Smooth,
        colours: true,
        hide_back_faces: true,
        stored_normals: true,
        distance: false,
        metric: Metric::Rgb,
    };
    let look = Look {
        shading: compare::Shading::Smooth,
        appearance: Appearance::Coloured,
        hides_back_faces: true,
        metric: lookalike::metric::Metric::Rgb,
        ..Look::default()
    };
    let params = compare::Params { look, stored_normals: true, ..compare::Params::default() };
    check(
        evaluate,
        &params,
        [&fine, &crude].map(|mesh| write_glb(mesh).unwrap()).each_ref().map(Vec::as_slice),
    );
}

#[test]
fn of_two_models_the_bad_one_is_named() {
    let good = sample(2000);
    for (original, simplified, wanted) in [
        (&b"glTF"[..], &good[..], "the original, model.glb: "),
        (&good, b"glTF", "the simplified mesh, crude.glb: "),
        (&good, b"", "the simplified mesh, crude.glb: the file is empty"),
    ] {
        let done = job_on(&spec(Evaluate::default()), &inputs(original, simplified), "cpu");
        let Err(PipelineError::Job { code, text }) = &done.result else {
            panic!("{wanted}: {:?}", done.result);
        };
        assert!(!code.is_empty() && text.starts_with(wanted), "{code}: {text}");
        assert!(done.files.is_empty());
    }
}

#[test]
fn it_ends_while_it_computes_when_it_is_told_to() {
    let dir = tempfile::tempdir().unwrap();
    let [fine, crude] = [200_000, 100_000].map(|n| write_glb(&sample_mesh(3, n)).unwrap());
    for stage in ["pictures", "distance"] {
        let mut told = None;
        let mut hear = |report: Report| match report {
            // The first report comes before anything is computed.
            Report::Progress { stage: now, fraction, .. } if now == stage && fraction > 0.03 => {
                told = Some(Instant::now());
                ControlFlow::Break(())
            }
            _ => ControlFlow::Continue(()),
        };
        let (device, tape) = (DeviceChoice("cpu".into()), Tape::off());
        let spec = spec(Evaluate::default());
        let result = run(&spec, &inputs(&fine, &crude), dir.path(), (&device, &tape), &mut hear);
        assert!(matches!(result, Err(PipelineError::Cancelled)), "{stage}: {result:?}");
        let elapsed = told.unwrap().elapsed();
        assert!(elapsed < Duration::from_secs(2), "{stage}: {elapsed:?}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
