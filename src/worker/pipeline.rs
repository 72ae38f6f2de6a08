//! One attempt of a job, from the bytes of a model to the files of the result.
//!
//! Invariants:
//! 1. artifacts other than `report.json` and the seconds column of `energy.csv` depend on the
//!    input, the specification and the build alone, not on the device, threads or time;
//! 2. every accepted collapse is recorded once, in order, in the stream and in `progressive.lkpm`.

use std::{ops::ControlFlow, path::Path, time::Instant};

use crate::{
    io,
    jobs::{
        event::Report,
        spec::{Method, Spec},
    },
    mesh::{EditMesh, Mesh, Stage},
    progressive::ProgressiveError,
    render::RenderError,
    simplify::SimplifyError,
};

use super::{
    levels::{Levels, StoppedBy},
    params,
    recorder::Recorder,
    results::{self, StageFigures},
};

/// Which evaluator to use: `auto` measures and takes the fastest, `cpu` is the native twin,
/// anything else names an adapter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceChoice(pub String);

/// Why an attempt ended without a result.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The model or the specification is at fault; trying again cannot help.
    #[error("{code}: {text}")]
    Job {
        /// Stable upper-snake-case code.
        code: &'static str,
        /// What, where, and what to do.
        text: String,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// The machine is at fault (disk, device); another worker may succeed.
    #[error("{0}")]
    Machine(String),
}

impl From<std::io::Error> for PipelineError {
    fn from(e: std::io::Error) -> Self {
        Self::Machine(format!("cannot write the result: {e}"))
    }
}
impl From<RenderError> for PipelineError {
    fn from(e: RenderError) -> Self {
        Self::Machine(e.to_string())
    }
}
impl From<SimplifyError> for PipelineError {
    fn from(e: SimplifyError) -> Self {
        Self::Machine(e.to_string())
    }
}
impl From<io::IoError> for PipelineError {
    fn from(e: io::IoError) -> Self {
        Self::Job { code: e.code(), text: e.to_string() }
    }
}
impl From<ProgressiveError> for PipelineError {
    fn from(e: ProgressiveError) -> Self {
        Self::Machine(format!("cannot write the progressive mesh: {e}"))
    }
}

/// What a worker runs: [`run`], or in its place what a test wants to happen.
pub type Pipeline = fn(
    &Spec,
    &str,
    &[u8],
    &Path,
    &DeviceChoice,
    &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError>;

/// Runs the whole job: reads `input` (the bytes of a model file; `name` gives the format by its
/// extension), writes every artifact into `out_dir`, and tells `on` of each step. `Break` from `on`
/// cancels.
pub fn run(
    spec: &Spec,
    name: &str,
    input: &[u8],
    out_dir: &Path,
    device: &DeviceChoice,
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    let start = Instant::now();
    let ingest = io::read(name, input, &io::Limits::default())?;
    let original = ingest.mesh;
    let mut recorder = Recorder::new(spec, &original, start, on)?;
    recorder.announce(&ingest.report)?;
    let mut levels = Levels::new(spec, original.faces.len());
    levels.announce(&mut recorder)?;

    let mut mesh = editable(&original)?;
    let mut figures = vec![memoryless_stage(spec, &mut mesh, &mut levels, &mut recorder)?];
    if spec.method == Method::Image && !levels.is_complete() {
        figures.push(image_stage(spec, &original, &mut mesh, &mut levels, device, &mut recorder)?);
    }
    levels.close(&mesh, &mut recorder);

    let attempt = results::Attempt { spec, ingest: &ingest.report, figures: &figures, start };
    results::write_all(out_dir, &original, &levels, &mut recorder, &attempt)
}

fn editable(original: &Mesh) -> Result<EditMesh, PipelineError> {
    EditMesh::new(original.clone())
        .map_err(|e| PipelineError::Job { code: "INVALID_MESH", text: e.to_string() })
}

/// Memoryless simplification: to the last level, or to where the image-driven stage takes over.
fn memoryless_stage(
    spec: &Spec,
    mesh: &mut EditMesh,
    levels: &mut Levels,
    recorder: &mut Recorder<'_>,
) -> Result<StageFigures, PipelineError> {
    let mut figures = StageFigures::begin(Stage::Memoryless, "native");
    let params = params::memoryless(spec);
    let floor = match spec.method {
        Method::Memoryless => 0,
        Method::Image => levels.image_start(spec.start_factor),
    };
    recorder.enter(Stage::Memoryless, mesh.n_faces(), floor.max(levels.least()));
    loop {
        let next = levels.next_target();
        let target = next.map_or(floor, |t| t.max(floor));
        if target < mesh.n_faces() {
            let outcome = crate::memoryless::simplify(mesh, target as u32, &params, &mut |step| {
                recorder.step(&step)
            });
            figures.add(outcome.collapses, outcome.evaluations);
            recorder.check()?;
            levels.set_stop(StoppedBy::of_memoryless(outcome.stopped_by));
        }
        if next.is_none_or(|t| t < floor) || !levels.take(mesh, recorder) {
            break;
        }
    }
    Ok(figures.end())
}

/// Image-driven simplification of what memoryless left.
fn image_stage(
    spec: &Spec,
    original: &Mesh,
    mesh: &mut EditMesh,
    levels: &mut Levels,
    device: &DeviceChoice,
    recorder: &mut Recorder<'_>,
) -> Result<StageFigures, PipelineError> {
    let setup_start = Instant::now();
    let mut objective = params::objective(spec, original, mesh, device, recorder)?;
    let mut figures = StageFigures::begin(Stage::Image, &objective.evaluator_name());
    figures.setup_secs = setup_start.elapsed().as_secs_f64();
    recorder.enter(Stage::Image, mesh.n_faces(), levels.least());
    let mut simplifier =
        crate::simplify::Simplifier::new(mesh, &mut objective, params::image(spec));
    while let Some(target) = levels.next_target() {
        let outcome = simplifier.run_to(target, &mut |step| recorder.step(&step))?;
        figures.add(outcome.collapses, 0);
        levels.set_stop(if recorder.is_out_of_time() {
            StoppedBy::Seconds
        } else {
            recorder.check()?;
            StoppedBy::of_image(outcome.stopped_by)
        });
        let (energy, d2) = (simplifier.objective().energy(), simplifier.objective().d2_percent());
        levels.set_energy(energy, d2);
        if !levels.take(simplifier.mesh(), recorder) {
            break;
        }
    }
    figures.evaluations = objective.evaluations();
    Ok(figures.end())
}
