//! From the original to levels of detail: the stages before optimization.

use std::ops::ControlFlow;

use crate::{
    cluster,
    io::Ingest,
    jobs::spec::{Method, Spec},
    memoryless,
    mesh::{EditMesh, Marks, Mesh, Semantic, Stage, Step},
    metric::{d2_percent, with_vertex_normals},
    simplify,
    tape::Tape,
};

use super::{
    course::{Course, Descent},
    levels::{End, Levels},
    params,
    pipeline::{Job, PipelineError, editable},
    recorder::Recorder,
    results::StageFigures,
    stopped::StoppedBy,
    studio::Studio,
    survey,
};

/// What the records begin at: the original, or the mesh that takes its place at once.
pub(super) fn base(spec: &Spec, original: &Mesh, simplified: Option<&Ingest>) -> Mesh {
    match (simplified, spec.method) {
        (Some(given), _) => {
            let lacks_normals =
                spec.optimize.normals && given.mesh.layer(Semantic::Normal).is_none();
            let mesh = given.mesh.clone();
            if lacks_normals { with_vertex_normals(mesh) } else { mesh }
        }
        (None, Method::Cluster) => {
            let target = spec.triangles.first().copied().unwrap_or(0) as usize;
            cluster::cluster(original, target)
        }
        (None, Method::Image | Method::Memoryless) => original.clone(),
    }
}

/// What is said of the vertices of the base: by its file, and by what is locked along features.
pub(super) fn marks(
    spec: &Spec,
    base: &Mesh,
    (of_original, simplified): (Marks, Option<&Ingest>),
) -> Marks {
    let mut marks = match (simplified, spec.method) {
        (Some(given), _) => given.marks.clone(),
        // Its vertices are not those of the original.
        (None, Method::Cluster) => Marks::default(),
        (None, Method::Image | Method::Memoryless) => of_original,
    };
    marks.lock_along(base, &params::features(spec), spec.hard_edge_degrees);
    marks
}

/// Makes all levels, and adds what each stage cost.
pub(super) fn run(
    job: &mut Job<'_>,
    (base, marks): (Mesh, Marks),
    recorder: &mut Recorder<'_>,
    figures: &mut Vec<StageFigures>,
) -> Result<Levels, PipelineError> {
    let spec = job.spec;
    let mut mesh = editable(&base, &marks)?;
    drop(base);
    if spec.simplified.is_some() || spec.method == Method::Cluster {
        return given(job, &mesh, recorder);
    }
    let max_energy = |d2| params::max_energy(spec, d2);
    let mut levels = Levels::new(spec, job.original.faces.len(), max_energy);
    levels.announce(recorder)?;
    let gauge = job.gauge;
    let topology = params::topology(spec);
    let measure_from = mesh.n_faces();
    let mut course = Course { levels: &mut levels, gauge, recorder, topology, measure_from };
    course.begin(&mesh)?;
    let finest = spread(job, &mesh, &mut course)?;
    let tape = job.studio.tape();
    figures.push(memoryless_stage((spec, tape), &mut mesh, &mut course, finest)?);
    if spec.method == Method::Image && !course.levels.is_complete() {
        figures.push(image_stage(job, &mut mesh, &mut course, finest)?);
    }
    levels.explain(spec, recorder)?;
    if spec.method == Method::Image {
        measure(job, &mut levels)?;
    }
    Ok(levels)
}

/// What levels look like that geometry alone has made, because they are finer than pictures show.
fn measure(job: &mut Job<'_>, levels: &mut Levels) -> Result<(), PipelineError> {
    for level in levels.simplified().filter(|level| level.energy.is_none()) {
        let energy = job.studio.energy(&editable(&level.mesh, &Marks::default())?);
        level.energy = Some(energy);
        level.d2 = Some(d2_percent(energy, params::n_counted_pixels(job.spec)));
    }
    Ok(())
}

/// Triangles of the coarsest and the finest level, about, and those at which the image-driven stage takes
/// over: a multiple of the finest.
#[derive(Clone, Copy)]
struct Spread {
    coarsest: usize,
    image_start: usize,
}

fn spread(
    job: &mut Job<'_>,
    mesh: &EditMesh,
    course: &mut Course<'_, '_>,
) -> Result<Spread, PipelineError> {
    course.recorder.enter(Stage::Memoryless, mesh.n_faces(), 0);
    let known = (&*course.levels, course.gauge);
    let estimates = survey::estimates(job, mesh, known, course.recorder)?;
    let coarsest = estimates.iter().copied().min().unwrap_or(mesh.n_faces());
    let finest = estimates.iter().max().map(|n| *n as f64 * job.spec.start_factor);
    let image_start = finest.map_or(mesh.n_faces(), |n| n.ceil() as usize);
    course.measure_from = image_start;
    Ok(Spread { coarsest, image_start })
}

/// The one level of a mesh that came with the job, or from vertex clustering.
fn given(
    job: &Job<'_>,
    mesh: &EditMesh,
    recorder: &mut Recorder<'_>,
) -> Result<Levels, PipelineError> {
    if mesh.n_faces() == 0 {
        let text = "clustering to so few triangles leaves none: ask for more".to_owned();
        return Err(PipelineError::Job { code: "NOTHING_LEFT", text });
    }
    let n_original = job.original.faces.len();
    let mut levels = match job.spec.simplified {
        Some(_) => Levels::of_simplified(mesh.n_faces(), n_original),
        None => Levels::new(job.spec, n_original, |_| u64::MAX),
    };
    levels.announce(recorder)?;
    let is_clustered = mesh.n_faces() < n_original && job.spec.simplified.is_none();
    let by_count = if job.spec.ratios.is_empty() { StoppedBy::Triangles } else { StoppedBy::Ratio };
    let stopped_by = if is_clustered { by_count } else { StoppedBy::Input };
    levels.close(mesh, End { stopped_by, energy: None }, recorder);
    Ok(levels)
}

/// Memoryless simplification: to the last level, or to where the image-driven stage takes over.
fn memoryless_stage(
    (spec, tape): (&Spec, &Tape),
    mesh: &mut EditMesh,
    course: &mut Course<'_, '_>,
    Spread { coarsest, image_start }: Spread,
) -> Result<StageFigures, PipelineError> {
    let now = course.recorder.clock().read();
    let figures = StageFigures::begin(Stage::Memoryless, "native", now);
    let floor = match spec.method {
        Method::Image => image_start,
        Method::Memoryless | Method::Cluster => 0,
    };
    course.recorder.enter(Stage::Memoryless, mesh.n_faces(), floor.max(coarsest));
    if course.levels.is_complete() || mesh.n_faces() <= floor {
        return Ok(figures.end(now));
    }
    let params = params::memoryless(spec);
    let simplifier = memoryless::Simplifier::new(mesh, &params, tape);
    let mut stage = Geometric { simplifier, figures };
    course.follow(&mut stage, floor)?;
    Ok(stage.figures.end(course.recorder.clock().read()))
}

struct Geometric<'a> {
    simplifier: memoryless::Simplifier<'a>,
    figures: StageFigures,
}

impl Descent for Geometric<'_> {
    fn mesh(&self) -> &EditMesh {
        self.simplifier.mesh()
    }

    fn run_to(
        &mut self,
        target: usize,
        _: Option<u64>,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<StoppedBy, PipelineError> {
        let outcome = self.simplifier.run_to(target as u32, on);
        self.figures.add(outcome.collapses, outcome.evaluations);
        Ok(StoppedBy::of_memoryless(outcome.stopped_by))
    }

    fn energy(&mut self, _: Option<&EditMesh>) -> Option<(u64, f64)> {
        None
    }
}

/// Image-driven simplification of what memoryless left.
fn image_stage(
    job: &mut Job<'_>,
    mesh: &mut EditMesh,
    course: &mut Course<'_, '_>,
    Spread { coarsest, .. }: Spread,
) -> Result<StageFigures, PipelineError> {
    let mut figures = StageFigures::prepare(Stage::Image, course.recorder.clock().read());
    let evaluator = job.studio.evaluator(mesh, course.recorder)?;
    figures.start(&evaluator, course.recorder.clock().read());
    let mut objective = job.studio.show(0, mesh)?;
    course.recorder.enter(Stage::Image, mesh.n_faces(), coarsest);
    let params = params::image(job.spec);
    let simplifier = simplify::Simplifier::new(mesh, &mut objective, params);
    let mut stage = ImageDriven { simplifier, figures, studio: &mut job.studio };
    course.follow(&mut stage, 0)?;
    let mut figures = stage.figures;
    figures.evaluations = objective.evaluations();
    Ok(figures.end(course.recorder.clock().read()))
}

struct ImageDriven<'a, 'm> {
    simplifier: simplify::Simplifier<'a>,
    figures: StageFigures,
    studio: &'a mut Studio<'m>,
}

impl Descent for ImageDriven<'_, '_> {
    fn mesh(&self) -> &EditMesh {
        self.simplifier.mesh()
    }

    fn run_to(
        &mut self,
        target: usize,
        max_energy: Option<u64>,
        on: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
    ) -> Result<StoppedBy, PipelineError> {
        self.simplifier.set_max_energy(max_energy);
        let outcome = self.simplifier.run_to(target, on)?;
        self.figures.add(outcome.collapses, 0);
        Ok(StoppedBy::of_image(outcome.stopped_by))
    }

    fn energy(&mut self, past: Option<&EditMesh>) -> Option<(u64, f64)> {
        let now = self.simplifier.objective();
        Some(match past {
            None => (now.energy(), now.d2_percent()),
            Some(mesh) => {
                let energy = self.studio.energy(mesh);
                (energy, d2_percent(energy, now.n_counted_pixels()))
            }
        })
    }
}
