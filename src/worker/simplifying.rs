//! From the original to levels of detail: the stages before optimization.

use crate::{
    cluster,
    io::Ingest,
    jobs::spec::{Method, Spec},
    mesh::{EditMesh, Marks, Mesh, Semantic, Stage},
    metric::with_vertex_normals,
    simplify,
};

use super::{
    levels::{Levels, StoppedBy},
    params,
    pipeline::{Job, PipelineError, editable},
    recorder::Recorder,
    results::StageFigures,
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
    let mut levels = Levels::new(spec, job.original.faces.len());
    levels.announce(recorder)?;
    figures.push(memoryless_stage(spec, &mut mesh, &mut levels, recorder)?);
    if spec.method == Method::Image && !levels.is_complete() {
        figures.push(image_stage(job, &mut mesh, &mut levels, recorder)?);
    }
    levels.close(&mesh, recorder);
    levels.explain(spec, recorder)?;
    Ok(levels)
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
        None => Levels::new(job.spec, n_original),
    };
    levels.announce(recorder)?;
    if mesh.n_faces() < n_original && job.spec.simplified.is_none() {
        levels.set_stop(StoppedBy::Triangles);
    }
    levels.close(mesh, recorder);
    Ok(levels)
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
        Method::Image => levels.image_start(spec.start_factor),
        Method::Memoryless | Method::Cluster => 0,
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
            levels.blame_locks(mesh, params.topology);
        }
        if next.is_none_or(|t| t < floor) || !levels.take(mesh, recorder) {
            break;
        }
    }
    Ok(figures.end())
}

/// Image-driven simplification of what memoryless left.
fn image_stage(
    job: &mut Job<'_>,
    mesh: &mut EditMesh,
    levels: &mut Levels,
    recorder: &mut Recorder<'_>,
) -> Result<StageFigures, PipelineError> {
    let mut figures = StageFigures::prepare(Stage::Image);
    figures.start(&job.studio.evaluator(mesh, recorder)?);
    let mut objective = job.studio.show(0, mesh)?;
    recorder.enter(Stage::Image, mesh.n_faces(), levels.least());
    let params = params::image(job.spec);
    let mut simplifier = simplify::Simplifier::new(mesh, &mut objective, params);
    while let Some(target) = levels.next_target() {
        let outcome = simplifier.run_to(target, &mut |step| recorder.step(&step))?;
        figures.add(outcome.collapses, 0);
        levels.set_stop(if recorder.is_out_of_time() {
            StoppedBy::Seconds
        } else {
            recorder.check()?;
            StoppedBy::of_image(outcome.stopped_by)
        });
        levels.blame_locks(simplifier.mesh(), params::topology(job.spec));
        let (energy, d2) = (simplifier.objective().energy(), simplifier.objective().d2_percent());
        levels.set_energy(energy, d2);
        if !levels.take(simplifier.mesh(), recorder) {
            break;
        }
    }
    figures.evaluations = objective.evaluations();
    Ok(figures.end())
}
