//! From a job's specification to each stage's parameters. Tables, no logic.

use glam::DVec3;

use crate::{
    jobs::spec::{self, Effort, Projection, Shading, Spec},
    memoryless,
    mesh::{Mesh, Topology},
    metric::{Pictures, bounding_sphere},
    optimize,
    render::{
        self, RenderParams,
        view::{self, ViewParams, cameras, directions},
    },
    simplify::{self, Policy, Rules},
};

use super::budget::Budget;

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
    let (policy, ahead, search_rounds) = match spec.effort {
        Effort::Fast => (Policy::Lazy, 1, 3),
        Effort::Balanced => (Policy::Eager, 1, 5),
        Effort::Best => (Policy::Eager, 128, 8),
    };
    simplify::Params {
        policy,
        rules: Rules { topology: topology(spec), memoryless: memoryless(spec) },
        batch: BATCH,
        ahead,
        search_rounds,
        max_evaluations: spec.max_evaluations,
    }
}

/// Parameters of the optimization of a level.
pub fn optimization(spec: &Spec, budget: &Budget) -> optimize::Params {
    optimize::Params {
        seed: spec.seed,
        max_evaluations: budget.evaluations.unwrap_or(0),
        until: budget.until.unwrap_or(0.0),
        delta: spec.optimize.delta,
        solver: match spec.optimize.solver {
            spec::Solver::Quadratic => optimize::Solver::Quadratic,
            spec::Solver::Simplex => optimize::Solver::Simplex,
        },
        closes_holes: topology(spec) == Topology::Free,
        optimizes_normals: spec.optimize.normals,
        ..optimize::Params::default()
    }
}

/// Evaluations for each triangle from which on turns pay.
///
/// Bunny, 1,336 triangles, unseen d2 as a share of the start: with turns .876 at 40 evaluations a
/// triangle and .834 at 150; without .857 at 62 and .842 at 150. The threshold lies between by guess.
const TURNS_FROM: u64 = 100;
/// Pixels of all views for each triangle below which a turn would fit noise.
const TURNS_FROM_PIXELS: u64 = 64;

/// How view sets take turns in the optimization of so many triangles with so many evaluations; `None`
/// where turns would not pay.
pub fn turns(spec: &Spec, n_faces: usize, max_evaluations: u64) -> Option<optimize::Turns> {
    let n = n_faces as u64;
    let n_pixels = spec.render.view_count() as u64 * u64::from(spec.render.image_size).pow(2);
    let pays = max_evaluations >= TURNS_FROM * n && n_pixels >= TURNS_FROM_PIXELS * n;
    pays.then_some(optimize::Turns { evaluations: 20 * n, n_others: 3, last_evaluations: 20 * n })
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
