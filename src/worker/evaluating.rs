//! The job that compares two meshes: figures and a contact sheet, and no level.
//!
//! 1. It comes to the same figures and pictures as `lookalike compare`: both ask [`params`] and `compare`.
//! 2. It asks the tape nothing and leaves no checkpoint: it takes seconds, so an attempt after a lost one starts over.

use std::{
    fs,
    ops::ControlFlow,
    panic,
    path::Path,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use serde::Serialize;

use crate::{
    compare::{self, Appearance, Comparison, Look, Part, Reference, SheetParams, Tick},
    io::{Ingest, IngestReport},
    jobs::{
        event::Report,
        spec::{Evaluate, Shading},
    },
    metric::surface::SurfaceParams,
};

use super::{params::metric, pipeline::PipelineError, progress::Progress, recorder::announcement};

/// Parts of a job's time, about.
const PARTS: [(Part, f64); 3] =
    [(Part::Pictures, 0.5), (Part::Distance, 0.35), (Part::Sheet, 0.15)];
/// Whether it is done is asked this often; progress is told less often.
const POLL: Duration = Duration::from_millis(20);

/// The same for `compare`.
pub fn params(evaluate: &Evaluate) -> compare::Params {
    let look = Look {
        shading: match evaluate.shading {
            Shading::Flat => compare::Shading::Flat,
            Shading::Smooth => compare::Shading::Smooth,
        },
        appearance: if evaluate.colours { Appearance::Coloured } else { Appearance::White },
        hides_back_faces: evaluate.hide_back_faces,
        metric: metric(evaluate.metric),
        ..Look::default()
    };
    compare::Params {
        look,
        stored_normals: evaluate.stored_normals,
        surface: evaluate.distance.then(SurfaceParams::default),
        ..compare::Params::default()
    }
}

/// What `report.json` says.
#[derive(Serialize)]
struct ReportFile<'a> {
    version: &'static str,
    device: &'static str,
    input: &'a IngestReport,
    simplified: &'a IngestReport,
    evaluate: &'a Evaluate,
    comparison: &'a Comparison,
    seconds: f64,
}

/// Compares the meshes, and writes what comes of it into `out_dir`. `Break` from `on` cancels.
pub(super) fn run(
    evaluate: &Evaluate,
    (original, simplified): (&Ingest, &Ingest),
    out_dir: &Path,
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    let begun = Instant::now();
    let mut tell = |report| match on(report) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(PipelineError::Cancelled),
    };
    let read = [("model", original), ("simplified mesh", simplified)];
    let read = read.iter().flat_map(|(what, ingest)| announcement(what, &ingest.report));
    read.into_iter().try_for_each(&mut tell)?;
    for (code, text) in compare::mismatches(&original.mesh, &simplified.mesh) {
        tell(Report::Note { code: code.into(), text })?;
    }
    let (comparison, sheet) = watched(&mut tell, |tick| {
        let params = params(evaluate);
        let reference = Reference::try_new(&original.mesh, &params, tick)?;
        let comparison = reference.try_compare(&simplified.mesh, tick)?;
        let of_sheet = SheetParams::default()
            .of_surface(&params.look)
            .with_stored_normals(params.stored_normals);
        let sheet = compare::try_sheet(&original.mesh, &simplified.mesh, &of_sheet, tick)?;
        Ok((comparison, sheet))
    })?;
    tell(Report::Note { code: "COMPARED".into(), text: compare::summary(&comparison) })?;
    let report = ReportFile {
        version: env!("CARGO_PKG_VERSION"),
        device: "native",
        input: &original.report,
        simplified: &simplified.report,
        evaluate,
        comparison: &comparison,
        seconds: begun.elapsed().as_secs_f64(),
    };
    let unwritable = |e| PipelineError::Machine(format!("cannot write the figures: {e}"));
    let [figures, report] = [compare::json(&comparison), compare::json(&report)]
        .map(|json| json.map(String::into_bytes).map_err(unwritable));
    for (name, media_type, bytes) in [
        ("comparison.json", "application/json", figures?),
        ("contact-0.png", "image/png", sheet),
        ("report.json", "application/json", report?),
    ] {
        fs::write(out_dir.join(name), &bytes)?;
        let size = bytes.len() as u64;
        tell(Report::Artifact { name: name.into(), media_type: media_type.into(), size })?;
    }
    Ok(())
}

/// The caller wants no more.
struct Stopped;

/// Works on a thread of its own, tells how far that is, and ends it between two pictures or runs of points when
/// the caller wants no more.
fn watched<T: Send>(
    tell: &mut dyn FnMut(Report) -> Result<(), PipelineError>,
    work: impl FnOnce(Tick<'_, Stopped>) -> Result<T, Stopped> + Send,
) -> Result<T, PipelineError> {
    let parts = PARTS.iter().map(|(part, share)| (part.name(), *share)).collect();
    let mut progress = Progress::of(parts);
    progress.tell(Instant::now(), 0.0).map_or(Ok(()), &mut *tell)?;
    let (is_stopped, reached) = (AtomicBool::new(false), Mutex::new((Part::Pictures, 0.0)));
    let tick = |part: Part, share: f64| {
        let mut reached = reached.lock().unwrap_or_else(PoisonError::into_inner);
        let before = if reached.0 == part { reached.1 } else { 0.0 };
        *reached = (part, before + share);
        if is_stopped.load(Ordering::Relaxed) { Err(Stopped) } else { Ok(()) }
    };
    thread::scope(|scope| {
        let working = scope.spawn(|| work(&tick));
        while !working.is_finished() {
            thread::sleep(POLL);
            let (part, done) = *reached.lock().unwrap_or_else(PoisonError::into_inner);
            progress.enter(part.name());
            let told = progress.tell(Instant::now(), done).map_or(Ok(()), &mut *tell);
            if let Err(cancelled) = told {
                is_stopped.store(true, Ordering::Relaxed);
                let _ = working.join();
                return Err(cancelled);
            }
        }
        match working.join() {
            Ok(done) => done.map_err(|Stopped| PipelineError::Cancelled),
            // As if it had happened here.
            Err(cause) => panic::resume_unwind(cause),
        }
    })
}
