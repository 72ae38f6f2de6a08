//! From a job's specification to each stage's parameters. Tables, no logic.

use glam::DVec3;

use crate::{
    jobs::spec::{self, Effort, Projection, Shading, Spec},
    memoryless,
    mesh::{EditMesh, Mesh, Topology},
    metric::{Objective, Pictures, bounding_sphere, reference_pictures, scene_of_edit_mesh},
    render::{
        self, RenderParams, choose,
        view::{self, ViewParams, cameras, directions},
    },
    simplify::{self, Placements, Policy, Rules},
};

use super::{
    pipeline::{DeviceChoice, PipelineError},
    recorder::Recorder,
};

/// Memoryless parameters.
pub fn memoryless(spec: &Spec) -> memoryless::Params {
    memoryless::Params {
        lambda: spec.lambda,
        topology: topology(spec),
        seed: spec.seed,
        ..memoryless::Params::default()
    }
}

fn topology(spec: &Spec) -> Topology {
    match spec.topology {
        spec::Topology::Preserve => Topology::Preserve,
        spec::Topology::Free => Topology::Free,
    }
}

/// Edges judged at once when the queue needs fresh keys (spec: evaluator.md, speculation table).
const BATCH: usize = 32;

/// Image-driven parameters: what each effort means.
pub fn image(spec: &Spec) -> simplify::Params {
    let (policy, placements, search_rounds) = match spec.effort {
        Effort::Fast => (Policy::Lazy, Placements::Optimum, 3),
        Effort::Balanced => (Policy::Eager, Placements::Optimum, 5),
        Effort::Best => (Policy::Eager, Placements::OptimumMidpointEnds, 8),
    };
    simplify::Params {
        policy,
        rules: Rules { placements, topology: topology(spec), memoryless: memoryless(spec) },
        batch: BATCH,
        search_rounds,
        max_evaluations: spec.max_evaluations,
    }
}

/// Cameras and drawing.
pub fn pictures(spec: &Spec, original: &Mesh) -> Pictures {
    let r = &spec.render;
    let custom = || r.custom_views.iter().map(|d| DVec3::from_array(*d)).collect();
    let directions = if r.custom_views.is_empty() {
        directions(r.n_views).unwrap_or_default()
    } else {
        custom()
    };
    let view_params = ViewParams {
        directions,
        fov_degrees: r.fov_degrees,
        projection: match r.projection {
            Projection::Perspective => view::Projection::Perspective,
            Projection::Orthographic => view::Projection::Orthographic,
        },
        light_degrees: r.light_degrees,
    };
    Pictures {
        views: cameras(&bounding_sphere(original), &view_params),
        params: RenderParams {
            image_size: r.image_size,
            shading: match r.shading {
                Shading::Flat => render::Shading::Flat,
                Shading::Smooth => render::Shading::Smooth,
            },
            ambient: r.ambient,
            background: (r.background * 255.0 + 0.5) as u8,
            interior_views: r.interior_views as usize,
        },
    }
}

/// Draws the original and the current mesh, on the chosen device.
pub fn objective(
    spec: &Spec,
    original: &Mesh,
    mesh: &EditMesh,
    device: &DeviceChoice,
    recorder: &mut Recorder<'_>,
) -> Result<Objective, PipelineError> {
    let pictures = pictures(spec, original);
    let reference = reference_pictures(original, &pictures);
    let scene = scene_of_edit_mesh(mesh, &pictures);
    let choice = choose(&device.0, &scene, reference)?;
    for (name, evaluations_per_sec) in &choice.figures {
        let text = format!("{name}: {evaluations_per_sec:.0} evaluations/s");
        recorder.note("DEVICE_MEASURED", &text)?;
    }
    for note in &choice.notes {
        recorder.note("DEVICE_NOTE", note)?;
    }
    recorder.note("DEVICE_CHOSEN", &choice.evaluator.name())?;
    Ok(Objective::new(mesh, scene, choice.evaluator))
}
