//! One attempt of a job, from the bytes of a model to the files of the result.
//!
//! Invariants:
//! 1. artifacts other than `report.json` and the seconds column of `energy.csv` depend on the
//!    input, the specification and the build alone, not on the device, threads or time;
//! 2. every accepted edit is recorded once, in order, in the stream and in `progressive.lkpm`.

use std::{
    iter,
    ops::ControlFlow,
    path::Path,
    sync::{Arc, OnceLock},
    thread,
};

use crate::{
    compare::mismatches,
    io::{self, Ingest},
    jobs::{
        event::Report,
        spec::{Metric, Spec, Topology},
    },
    mesh::{EditMesh, Marks, Mesh, Semantic},
    metric::{Palette, is_grey, with_vertex_normals},
    optimize::OptimizeError,
    progressive::ProgressiveError,
    render::RenderError,
    simplify::SimplifyError,
    tape::Tape,
};

use super::{
    automatic::Model,
    budget::n_optimized,
    chosen::Facts,
    critic::Critic,
    evaluating,
    gauge::Gauge,
    illustrator::{Plan, draw_ahead},
    optimizing, params,
    recorder::Recorder,
    results, simplifying,
    studio::Studio,
};

/// Which evaluator to use: `auto` takes the fastest of the native twin and all GPUs, `cpu` is the twin,
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
impl From<OptimizeError> for PipelineError {
    fn from(e: OptimizeError) -> Self {
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

/// The bytes of a model file; the extension of the name gives the format.
#[derive(Clone, Copy, Debug)]
pub struct ModelFile<'a> {
    /// File name.
    pub name: &'a str,
    /// Contents.
    pub bytes: &'a [u8],
}

/// What a job works on.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// The original.
    pub original: ModelFile<'a>,
    /// What some tool has simplified it to, where the job is to optimize that or to compare the two.
    pub simplified: Option<ModelFile<'a>>,
}

impl<'a> Inputs<'a> {
    /// The original alone.
    pub fn of(name: &'a str, bytes: &'a [u8]) -> Self {
        Self { original: ModelFile { name, bytes }, simplified: None }
    }
}

/// What a worker runs: [`run`], or in its place what a test wants to happen.
pub type Pipeline = fn(
    &Spec,
    &Inputs<'_>,
    &Path,
    (&DeviceChoice, &Tape),
    &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError>;

/// What the stages share.
pub(super) struct Job<'j> {
    /// What was asked.
    pub spec: &'j Spec,
    /// The original, with vertex normals where they are to be optimized.
    pub original: &'j Mesh,
    /// The pictures of the original, and who judges by them.
    pub studio: Studio<'j>,
    /// Measures levels.
    pub gauge: &'j Gauge<'j>,
    /// The unseen pictures, once they are drawn.
    pub critic: &'j OnceLock<Critic<'j>>,
}

/// Runs the whole job: reads its inputs, writes every artifact into `out_dir`, and tells `on` of
/// each step that is not on the tape. `Break` from `on` cancels.
pub fn run(
    asked: &Spec,
    inputs: &Inputs<'_>,
    out_dir: &Path,
    (device, tape): (&DeviceChoice, &Tape),
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    match (&asked.evaluate, read(inputs)?) {
        (Some(evaluate), (original, Some(simplified))) => {
            evaluating::run(evaluate, (&original, &simplified), out_dir, on)
        }
        (_, inputs) => make_levels(asked, inputs, out_dir, (device, tape), on),
    }
}

/// Reads the models. Where there are two, the reason why one cannot be read says which.
fn read(inputs: &Inputs<'_>) -> Result<(Ingest, Option<Ingest>), PipelineError> {
    let read = |file: &ModelFile<'_>| io::read(file.name, file.bytes, &io::Limits::default());
    let Some(simplified) = &inputs.simplified else { return Ok((read(&inputs.original)?, None)) };
    let named = |what: &str, file: &ModelFile<'_>| {
        let text = |e: io::IoError| format!("the {what}, {e}");
        read(file).map_err(|e| PipelineError::Job { code: e.code(), text: text(e) })
    };
    let original = named("original", &inputs.original)?;
    Ok((original, Some(named("simplified mesh", simplified)?)))
}

/// Simplifies the original, or takes what is simplified already, and optimizes that.
fn make_levels(
    asked: &Spec,
    (original, simplified): (Ingest, Option<Ingest>),
    out_dir: &Path,
    (device, tape): (&DeviceChoice, &Tape),
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    let n_simplified = simplified.as_ref().map(|s| s.mesh.faces.len());
    let mut meshes = iter::once(&original).chain(&simplified);
    let shows_colours =
        asked.render.metric == Metric::Rgb && !meshes.all(|read| is_grey(&read.mesh));
    let ingest = original.report;
    let n_triangles = original.mesh.faces.len();
    let model = Model { report: &ingest, n_triangles, n_simplified, shows_colours };
    let spec = &model.settle(asked);
    let asked_marks = original.marks;
    let original = prepared(spec, original.mesh);
    let (critic, gauge) = (OnceLock::new(), Gauge::new(&original, params::glb_options(spec)));
    let base = simplifying::base(spec, &original, simplified.as_ref());
    let marks = simplifying::marks(spec, &base, (asked_marks, simplified.as_ref()));
    let mut recorder = Recorder::new(spec, &base, tape, on)?;
    recorder.announce("model", &ingest)?;
    if asked.topology != spec.topology {
        recorder.note("TOPOLOGY_CHOSEN", chosen_topology(spec.topology))?;
    }
    if let Some(simplified) = &simplified {
        recorder.announce("simplified mesh", &simplified.report)?;
        for (code, text) in mismatches(&original, &simplified.mesh) {
            recorder.note(code, &text)?;
        }
    }
    let mut facts = Facts { asked, n_locked: marks.n_locked(), n_optimized: 0, model: &model };
    tell_of_marks(&marks, &mut recorder)?;
    let mut figures = Vec::new();
    let pictures = params::pictures(spec, &original);
    let palette = match simplified {
        Some(_) => {
            Arc::new(Palette::of(&base, spec.render.image_size, params::metric(spec.render.metric)))
        }
        None => pictures.palette.clone(),
    };
    let targets = spec.triangles.iter().filter(|n| **n > 0);
    let n_coarsest = targets.min().map_or(base.faces.len(), |n| *n as usize);
    let (levels, n_unseen) = thread::scope(|scope| {
        let plan = Plan::new(spec, n_coarsest);
        let drawn = draw_ahead(scope, plan, (spec, &original), pictures.clone(), &critic);
        let studio = Studio::new(&original, (pictures, palette), drawn, (device, tape));
        let mut job = Job { spec, original: &original, studio, gauge: &gauge, critic: &critic };
        let mut levels = simplifying::run(&mut job, (base, marks), &mut recorder, &mut figures)?;
        let triangles: Vec<usize> = levels.simplified().map(|l| l.mesh.faces.len()).collect();
        facts.n_optimized = n_optimized(spec, &triangles);
        if spec.optimizes() {
            figures.extend(optimizing::run(&mut job, &mut levels, &mut recorder, &figures)?);
        }
        levels.look(|mesh| job.studio.n_unseen_of(mesh));
        Ok::<_, PipelineError>((levels, job.studio.n_unseen()))
    })?;

    let attempt = results::Attempt {
        spec,
        ingest: &ingest,
        facts,
        gauge: &gauge,
        figures: &figures,
        n_unseen,
    };
    results::write_all(out_dir, &original, &levels, &mut recorder, &attempt)
}

fn tell_of_marks(marks: &Marks, recorder: &mut Recorder<'_>) -> Result<(), PipelineError> {
    let n_locked = marks.n_locked();
    if n_locked > 0 {
        let text = format!("{n_locked} vertices stay where they are");
        recorder.note("VERTICES_LOCKED", &text)?;
    }
    if !marks.weights.is_empty() {
        let text =
            "collapses are ordered by what they cost times how much their surroundings matter";
        recorder.note("VERTICES_WEIGHED", text)?;
    }
    Ok(())
}

fn chosen_topology(topology: Topology) -> &'static str {
    match topology {
        Topology::Free => {
            "the model has several parts or edges of more than two triangles: topology is free, parts may \
             vanish where pictures do not miss them; `preserve` keeps them"
        }
        _ => "the model is one piece: its topology is kept; `free` lets handles and holes close",
    }
}

/// The original, with vertex normals where they are to be optimized and it has none: collapses
/// carry them from level to level.
fn prepared(spec: &Spec, original: Mesh) -> Mesh {
    if spec.optimize.normals && spec.optimizes() && original.layer(Semantic::Normal).is_none() {
        with_vertex_normals(original)
    } else {
        original
    }
}

/// A mesh that can be edited as far as its marks allow.
pub(super) fn editable(mesh: &Mesh, marks: &Marks) -> Result<EditMesh, PipelineError> {
    EditMesh::new(mesh.clone())
        .map(|mesh| mesh.with_marks(marks.clone()))
        .map_err(|e| PipelineError::Job { code: "INVALID_MESH", text: e.to_string() })
}
