//! A run that is broken off and goes on from its checkpoint: the same files, and the same story told once.

use std::sync::{Arc, Mutex};

use lookalike::{
    compare::textured_torus,
    io::write_glb,
    jobs::{
        event::Report,
        spec::{Effort, Optimize, Render, Shading, Spec},
    },
    tape::{Tape, pack},
    worker::pipeline::Inputs,
};

use super::support::{Done, job_with, sample};

/// What a run said, and the pieces of its checkpoint, each with how much had been said before it.
#[derive(Default)]
struct Story {
    reports: Vec<Report>,
    pieces: Vec<(usize, Vec<u8>)>,
    n_questions: usize,
}

/// A run that goes on from `pieces`, and leaves a piece at each `every`-th question.
fn tell(spec: &Spec, inputs: &Inputs<'_>, pieces: Vec<Vec<u8>>, every: usize) -> (Story, Done) {
    let story = Arc::new(Mutex::new(Story::default()));
    let (keep, heard) = (Arc::clone(&story), Arc::clone(&story));
    let goes_on = !pieces.is_empty();
    let keeper = move |recorded: &mut Vec<u8>| {
        let mut story = keep.lock().unwrap();
        story.n_questions += 1;
        if story.n_questions.is_multiple_of(every) {
            let n_before = story.reports.len();
            story.pieces.push((n_before, pack(&std::mem::take(recorded)).unwrap()));
        }
    };
    let tape = Tape::new(pieces, Box::new(keeper));
    let done = job_with(spec, inputs, ("cpu", &tape, goes_on), |report| {
        heard.lock().unwrap().reports.extend(timeless(report));
    });
    assert_eq!(tape.fault(), None);
    assert!(done.result.is_ok(), "{:?}", done.result);
    drop(tape);
    let story = std::mem::take(&mut *story.lock().unwrap());
    (story, done)
}

/// A report without what depends on the clock.
fn timeless(report: &Report) -> Option<Report> {
    match report.clone() {
        Report::Progress { .. } => None,
        Report::Sample(mut sample) => {
            sample.seconds = 0.0;
            Some(Report::Sample(sample))
        }
        // Two files tell of seconds, which may have more or fewer digits.
        Report::Artifact { name, media_type, .. } => {
            Some(Report::Artifact { name, media_type, size: 0 })
        }
        other => Some(other),
    }
}

/// Broken off at `n_cuts` places and gone on with, the run ends as if it had not been.
fn check(spec: &Spec, inputs: &Inputs<'_>, n_cuts: usize) {
    let (undisturbed, wanted) = tell(spec, inputs, Vec::new(), usize::MAX);
    let every = undisturbed.n_questions / n_cuts;
    let (cut, done) = tell(spec, inputs, Vec::new(), every);
    assert!(done.timeless() == wanted.timeless());
    assert!(cut.reports == undisturbed.reports);
    assert!(cut.pieces.len() >= n_cuts);
    let pieces: Vec<_> = cut.pieces.iter().map(|(_, piece)| piece.clone()).collect();
    for (n, (n_before, _)) in cut.pieces.iter().enumerate() {
        let (resumed, done) = tell(spec, inputs, pieces[..=n].to_vec(), usize::MAX);
        assert!(done.timeless() == wanted.timeless(), "other files from piece {n}");
        let left = undisturbed.n_questions - resumed.n_questions;
        assert_eq!(left + 1, (n + 1) * every, "questions that were not asked again");
        let told = [&cut.reports[..*n_before], &resumed.reports].concat();
        if let Some(at) = (0..told.len()).find(|&i| undisturbed.reports.get(i) != Some(&told[i])) {
            let all = &undisturbed.reports;
            panic!("from piece {n}, report {at}: {:?}, not {:?}", told[at], all.get(at));
        }
        assert_eq!(told.len(), undisturbed.reports.len());
    }
}

fn small() -> Render {
    Render { n_views: 6, image_size: 64, ..Render::default() }
}

fn budget(n: u64) -> Optimize {
    Optimize { max_evaluations: Some(n), ..Optimize::default() }
}

#[test]
fn both_stages_with_turns_and_cycles() {
    let spec = Spec {
        effort: Effort::Balanced,
        render: Render { image_size: 128, ..small() },
        optimize: budget(24_000),
        ..Spec::new(vec![150])
    };
    check(&spec, &Inputs::of("sample.glb", &sample(1500)), 6);
}

#[test]
fn smooth_shading_with_normals_of_its_own() {
    let optimize = Optimize { normals: true, ..budget(8_000) };
    let render = Render { shading: Shading::Smooth, ..small() };
    let spec = Spec { effort: Effort::Fast, render, optimize, ..Spec::new(vec![120]) };
    check(&spec, &Inputs::of("sample.glb", &sample(1500)), 5);
}

#[test]
fn texture_coordinates_of_a_torus() {
    let optimize = budget(6_000);
    let render = Render { image_size: 128, ..small() };
    let spec =
        Spec { effort: Effort::Fast, start_factor: 2.0, render, optimize, ..Spec::new(vec![150]) };
    let input = write_glb(&textured_torus()).unwrap();
    check(&spec, &Inputs::of("torus.glb", &input), 3);
}

#[test]
fn levels_that_are_measured() {
    let spec = Spec {
        max_d2: vec![2.0, 0.0],
        max_bytes: vec![0, 8_000],
        render: small(),
        optimize: budget(4_000),
        ..Spec::new(Vec::new())
    };
    check(&spec, &Inputs::of("sample.glb", &sample(2000)), 5);
}

#[test]
fn time_goes_on_where_it_was() {
    // Enough for a part of the work: where it ends is on the tape.
    let optimize = Optimize { max_secs: Some(0.7), max_evaluations: None, ..Optimize::default() };
    let render = Render { image_size: 128, ..small() };
    let spec = Spec { effort: Effort::Best, render, optimize, ..Spec::new(vec![300]) };
    let input = sample(1500);
    let inputs = Inputs::of("sample.glb", &input);
    let (cut, done) = tell(&spec, &inputs, Vec::new(), 40);
    let pieces: Vec<_> = cut.pieces.iter().map(|(_, piece)| piece.clone()).collect();
    // What was decided by the clock is decided as before, up to the end.
    let (_, resumed) = tell(&spec, &inputs, pieces, usize::MAX);
    let last = |done: &Done| done.samples.last().map(|s| s.evaluations);
    assert!(last(&done).is_some());
    assert_eq!(resumed.files["lod-0.glb"], done.files["lod-0.glb"]);
}
