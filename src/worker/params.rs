//! From a job's specification to each stage's parameters. Tables, no logic.

use glam::DVec3;

use crate::{
    io::GlbOptions,
    jobs::spec::{self, Effort, Lock, Projection, Shading, Spec},
    memoryless,
    mesh::{Feature, Mesh, Topology},
    metric::{Metric, Pictures, bounding_sphere, energy_of_d2},
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

/// The edges whose vertices stay.
pub fn features(spec: &Spec) -> Vec<Feature> {
    let feature = |lock: &Lock| match lock {
        Lock::Border => Feature::Border,
        Lock::Seam => Feature::Seam,
        Lock::HardEdge => Feature::HardEdge,
    };
    spec.lock.iter().map(feature).collect()
}

/// What collapses must keep.
pub fn topology(spec: &Spec) -> Topology {
    match spec.topology {
        // The pipeline has settled it by now.
        spec::Topology::Auto | spec::Topology::Preserve => Topology::Preserve,
        spec::Topology::Free => Topology::Free,
    }
}

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
        batch: simplify::BATCH,
        ahead,
        search_rounds,
        max_evaluations: spec.max_evaluations,
        max_energy: None,
    }
}

/// By what pictures are compared.
pub fn metric(metric: spec::Metric) -> Metric {
    match metric {
        spec::Metric::Luminance => Metric::Luminance,
        spec::Metric::Rgb => Metric::Rgb,
        spec::Metric::Perceptual => Metric::Perceptual,
    }
}

/// The highest energy at which d2 on the run-time views is no more than so many percent.
pub fn max_energy(spec: &Spec, d2_percent: f64) -> u64 {
    energy_of_d2(d2_percent, n_counted_pixels(spec))
}

/// How levels are written.
pub fn glb_options(spec: &Spec) -> GlbOptions {
    GlbOptions { quantize: spec.output.quantize, compress: spec.output.compress }
}

/// Evaluations for each triangle after which a run ends that was given another limit.
const MOST_PER_TRIANGLE: u64 = 10_000;

/// Parameters of the optimization of a level of so many triangles.
pub fn optimization(spec: &Spec, budget: &Budget, n_faces: usize) -> optimize::Params {
    optimize::Params {
        seed: spec.seed,
        max_evaluations: budget.evaluations.unwrap_or(MOST_PER_TRIANGLE * n_faces as u64),
        until: budget.until.unwrap_or(0.0),
        delta: spec.optimize.delta,
        solver: match spec.optimize.solver {
            spec::Solver::Quadratic => optimize::Solver::Quadratic,
            spec::Solver::Simplex => optimize::Solver::Simplex,
        },
        closes_holes: topology(spec) == Topology::Free,
        optimizes_normals: spec.optimize.normals,
        optimizes_attributes: !spec.optimize.keep_attributes,
        ..optimize::Params::default()
    }
}

/// Pixels of all run-time views for each triangle below which turns do not pay: slopes of triangles of a
/// few pixels are noise.
///
/// Bunny from image-driven simplification, 20 views of 256², 40 evaluations a triangle, unseen d2 as a
/// share of the start: 2,000 triangles .935 with turns and .968 without; 4,000 .991 and .962; 8,000 .995
/// and .968 (200 evaluations a triangle: .997 and .957).
const TURNS_FROM_PIXELS: u64 = 512;
/// How view sets take turns at an effort.
struct Rota {
    n_sets: usize,
    /// Steps of descents: the first, those between, the last.
    steps: [usize; 3],
    /// Evaluations of a turn's moves, for each triangle.
    turn: u64,
}

/// By effort.
///
/// Bunny from memoryless simplification to 1,336 triangles, unseen d2 as a share of the start: at 40
/// evaluations a triangle .832 with 6 sets and .839 with 16 and longer descents, at 200 .802 with 8 and
/// .798 with 16. Drawing 16 sets of a model of 70,000 triangles takes two seconds. Fast, from image-driven
/// simplification to 1,333 triangles (bunny, armadillo): .922 and .935 with 6 sets, whether the steps are
/// these or 24 each, .925 and .946 with 4 sets. At 200, turns of 50 reach .797.
fn rota(effort: Effort) -> Rota {
    match effort {
        Effort::Fast => Rota { n_sets: 6, steps: [16, 12, 24], turn: 20 },
        Effort::Balanced | Effort::Best => Rota { n_sets: 16, steps: [48, 24, 48], turn: 50 },
    }
}

/// The run-time views alone, where their energy is what was asked for, or they count for more or less. It falls to 63.1% after 200 evaluations a
/// triangle with turns of 20 (see [`rota`]), to 60.6% after 740 with cycles and turns of 50, to 60.3% with turns of
/// 100, and to 59.5% with searches for single vertices among a turn's moves.
const RUN_TIME_VIEWS: Rota = Rota { n_sets: 1, steps: [48, 24, 48], turn: 100 };

/// Evaluations for each triangle of a cycle of more and fewer triangles (optimize/cycle.rs): at 200 .793
/// with cycles of 100, .796 of 80 and of 140.
const CYCLE: u64 = 100;

fn rota_of(spec: &Spec, budget: &Budget) -> Rota {
    let is_alone = budget.until.is_some() || !spec.render.view_weights.is_empty();
    if is_alone { RUN_TIME_VIEWS } else { rota(spec.effort) }
}

/// Most bytes of the original's pictures in all view sets.
const VIEW_SET_BYTES: usize = 128 << 20;

/// Evaluations for each triangle between two judgements of a search in the run-time views.
const SEARCH: u64 = 10;
/// View sets that judge it.
const N_JUDGES: usize = 2;

/// How view sets take turns in the optimization of so many triangles.
pub fn turns(spec: &Spec, budget: &Budget, n_faces: usize) -> optimize::Turns {
    let n = n_faces as u64;
    let Rota { steps, turn, .. } = rota_of(spec, budget);
    let n_sets = n_view_sets(spec, budget, n_faces);
    if descents_pay(spec, n_faces) {
        let (evaluations, cycle) = (turn * n, CYCLE * n);
        optimize::Turns { evaluations, n_others: 3, n_looked_at: n_sets, steps, cycle }
    } else {
        // Where nobody judges, it goes on to the end.
        let evaluations = if n_sets == 1 { u64::MAX } else { SEARCH * n };
        optimize::Turns { evaluations, n_others: 0, n_looked_at: 1, steps: [0; 3], cycle: 0 }
    }
}

/// Whether so many triangles have pixels enough for descents.
pub fn descents_pay(spec: &Spec, n_faces: usize) -> bool {
    n_pixels(spec) as u64 >= TURNS_FROM_PIXELS * n_faces as u64
}

/// Number of view sets, the run-time views among them.
pub fn n_view_sets(spec: &Spec, budget: &Budget, n_faces: usize) -> usize {
    let n_sets = rota_of(spec, budget).n_sets;
    let n_sets = if descents_pay(spec, n_faces) { n_sets } else { n_sets.min(1 + N_JUDGES) };
    let n_bytes = n_pixels(spec) * metric(spec.render.metric).n_bytes();
    (VIEW_SET_BYTES / n_bytes.max(1)).clamp(1, n_sets)
}

/// Pixels of all run-time views.
pub fn n_pixels(spec: &Spec) -> usize {
    spec.render.view_count() * (spec.render.image_size as usize).pow(2)
}

/// The same as often as they count at most, in all channels.
pub fn n_counted_pixels(spec: &Spec) -> u64 {
    let weights = &spec.render.view_weights;
    let n_equal = spec.render.view_count() as u64;
    let n_views =
        if weights.is_empty() { n_equal } else { weights.iter().copied().map(u64::from).sum() };
    n_views * metric(spec.render.metric).full_weight() * u64::from(spec.render.image_size).pow(2)
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
    let params = RenderParams {
        image_size: r.image_size,
        shading: match r.shading {
            Shading::Flat => render::Shading::Flat,
            Shading::Smooth => render::Shading::Smooth,
        },
        ambient: r.ambient,
        background: (r.background * 255.0 + 0.5) as u8,
        interior_views: r.interior_views as usize,
        hides_back_faces: r.hide_back_faces,
    };
    let mut views = cameras(&bounding_sphere(original), &view_params);
    views.iter_mut().zip(&r.view_weights).for_each(|(view, weight)| view.weight = *weight);
    Pictures::by_metric(original, params, views, metric(spec.render.metric))
}
