//! The specification of a job, to and from the wire.

use super::{mesh_hash, mesh_name, v1};
use crate::jobs::spec::{
    Effort, Evaluate, Fault, Input, Lock, Method, Metric, Optimize, Output, Projection, Render,
    Shading, Solver, Spec, Topology,
};

const METHODS: [(v1::Method, Method); 3] = [
    (v1::Method::Image, Method::Image),
    (v1::Method::Memoryless, Method::Memoryless),
    (v1::Method::Cluster, Method::Cluster),
];

const SOLVERS: [(v1::Solver, Solver); 2] =
    [(v1::Solver::Quadratic, Solver::Quadratic), (v1::Solver::Simplex, Solver::Simplex)];

const EFFORTS: [(v1::Effort, Effort); 3] = [
    (v1::Effort::Fast, Effort::Fast),
    (v1::Effort::Balanced, Effort::Balanced),
    (v1::Effort::Best, Effort::Best),
];

const TOPOLOGIES: [(v1::Topology, Topology); 3] = [
    (v1::Topology::Auto, Topology::Auto),
    (v1::Topology::Preserve, Topology::Preserve),
    (v1::Topology::Free, Topology::Free),
];

const LOCKS: [(v1::Lock, Lock); 3] = [
    (v1::Lock::Border, Lock::Border),
    (v1::Lock::Seam, Lock::Seam),
    (v1::Lock::HardEdge, Lock::HardEdge),
];

const SHADINGS: [(v1::Shading, Shading); 2] =
    [(v1::Shading::Flat, Shading::Flat), (v1::Shading::Smooth, Shading::Smooth)];

const PROJECTIONS: [(v1::Projection, Projection); 2] = [
    (v1::Projection::Perspective, Projection::Perspective),
    (v1::Projection::Orthographic, Projection::Orthographic),
];

const METRICS: [(v1::Metric, Metric); 3] = [
    (v1::Metric::Luminance, Metric::Luminance),
    (v1::Metric::Rgb, Metric::Rgb),
    (v1::Metric::Perceptual, Metric::Perceptual),
];

/// Names on the wire of fields that have another one in [`crate::jobs`], or stand elsewhere.
const WIRE_NAMES: [(&str, &str); 5] = [
    // `max_d2` itself is one for all levels.
    ("max_d2", "level_max_d2"),
    // A reserved word in a client's language.
    ("lambda", "surface_weight"),
    ("optimize", "optimization"),
    ("simplified.mesh", "simplified_mesh"),
    ("simplified.file_name", "simplified_file_name"),
];

/// Where a field of a create request with this specification is found on the wire.
pub fn field_on_wire(spec: &Spec, field: &str) -> String {
    let Some(inner) = field.strip_prefix("spec.") else { return field.into() };
    let kind = spec.kind().name();
    let renamed = |(ours, theirs): &(&str, &str)| {
        let rest =
            inner.strip_prefix(ours).filter(|r| r.is_empty() || r.starts_with(['.', '[']))?;
        Some(format!("spec.{kind}.{theirs}{rest}"))
    };
    WIRE_NAMES.iter().find_map(renamed).unwrap_or_else(|| format!("spec.{kind}.{inner}"))
}

/// A specification on the wire, with every default written out.
pub fn spec_to_wire(spec: &Spec) -> v1::JobSpec {
    let kind = match (&spec.evaluate, &spec.simplified) {
        (Some(evaluate), input) => {
            v1::job_spec::Kind::Evaluate(evaluate_to_wire(evaluate, input.as_ref()))
        }
        (None, Some(input)) => v1::job_spec::Kind::Optimize(optimize_to_wire(spec, input)),
        (None, None) => v1::job_spec::Kind::Simplify(simplify_to_wire(spec)),
    };
    v1::JobSpec { kind: Some(kind) }
}

fn simplify_to_wire(spec: &Spec) -> v1::SimplifySpec {
    v1::SimplifySpec {
        triangles: spec.triangles.clone(),
        ratios: spec.ratios.clone(),
        method: to_wire(&METHODS, spec.method),
        effort: to_wire(&EFFORTS, spec.effort),
        topology: to_wire(&TOPOLOGIES, spec.topology),
        start_factor: (spec.start_factor != 0.0).then_some(spec.start_factor),
        surface_weight: Some(spec.lambda),
        max_d2: 0.0,
        level_max_d2: spec.max_d2.clone(),
        screen_size: spec.screen_size.clone(),
        max_bytes: spec.max_bytes.clone(),
        lock: locks_to_wire(spec),
        hard_edge_degrees: Some(spec.hard_edge_degrees),
        render: Some(render_to_wire(&spec.render)),
        optimization: Some(optimization_to_wire(&spec.optimize)),
        max_evaluations: spec.max_evaluations,
        max_secs: spec.max_secs,
        seed: spec.seed,
        output: Some(output_to_wire(spec.output)),
    }
}

fn optimize_to_wire(spec: &Spec, input: &Input) -> v1::OptimizeSpec {
    v1::OptimizeSpec {
        simplified_mesh: mesh_name(&input.mesh),
        simplified_file_name: input.file_name.clone(),
        optimization: Some(optimization_to_wire(&spec.optimize)),
        render: Some(render_to_wire(&spec.render)),
        max_evaluations: spec.max_evaluations,
        max_secs: spec.max_secs,
        seed: spec.seed,
        topology: to_wire(&TOPOLOGIES, spec.topology),
        lock: locks_to_wire(spec),
        hard_edge_degrees: Some(spec.hard_edge_degrees),
        output: Some(output_to_wire(spec.output)),
    }
}

fn evaluate_to_wire(evaluate: &Evaluate, input: Option<&Input>) -> v1::EvaluateSpec {
    v1::EvaluateSpec {
        simplified_mesh: input.map_or_else(String::new, |input| mesh_name(&input.mesh)),
        simplified_file_name: input.map_or_else(String::new, |input| input.file_name.clone()),
        shading: to_wire(&SHADINGS, evaluate.shading),
        colours: evaluate.colours,
        hide_back_faces: evaluate.hide_back_faces,
        stored_normals: evaluate.stored_normals,
        distance: Some(evaluate.distance),
        metric: to_wire(&METRICS, evaluate.metric),
    }
}

fn output_to_wire(output: Output) -> v1::Output {
    v1::Output { quantize: output.quantize, compress: output.compress }
}

fn locks_to_wire(spec: &Spec) -> Vec<i32> {
    spec.lock.iter().map(|lock| to_wire(&LOCKS, *lock)).collect()
}

fn optimization_to_wire(optimize: &Optimize) -> v1::Optimization {
    v1::Optimization {
        max_evaluations: optimize.max_evaluations,
        max_secs: optimize.max_secs,
        until: optimize.until,
        delta: Some(optimize.delta),
        solver: to_wire(&SOLVERS, optimize.solver),
        normals: optimize.normals,
        keep_attributes: optimize.keep_attributes,
    }
}

fn render_to_wire(render: &Render) -> v1::RenderSpec {
    let direction = |&[x, y, z]: &[f64; 3]| v1::Direction { x, y, z };
    v1::RenderSpec {
        n_views: Some(render.n_views),
        custom_views: render.custom_views.iter().map(direction).collect(),
        image_size: (render.image_size > 0).then_some(render.image_size),
        fov_degrees: Some(render.fov_degrees),
        projection: to_wire(&PROJECTIONS, render.projection),
        background: Some(render.background),
        ambient: Some(render.ambient),
        light_degrees: Some(render.light_degrees),
        shading: to_wire(&SHADINGS, render.shading),
        interior_views: render.interior_views,
        hide_back_faces: render.hide_back_faces,
        view_weights: render.view_weights.clone(),
        metric: to_wire(&METRICS, render.metric),
    }
}

/// A specification from the wire, and what could not be read (the values are not judged here).
pub fn spec_from_wire(wire: Option<v1::JobSpec>) -> (Spec, Vec<Fault>) {
    let mut faults = Vec::new();
    let spec = match wire.and_then(|spec| spec.kind) {
        Some(v1::job_spec::Kind::Simplify(wire)) => simplify_from_wire(wire, &mut faults),
        Some(v1::job_spec::Kind::Optimize(wire)) => optimize_from_wire(wire, &mut faults),
        Some(v1::job_spec::Kind::Evaluate(wire)) => evaluate_from_wire(wire, &mut faults),
        None => {
            let text =
                "missing, or of a kind this server does not know: use `simplify`, `optimize` or \
                        `evaluate`"
                    .into();
            faults.push(Fault { field: "spec".into(), text });
            Spec::new(vec![1])
        }
    };
    (spec, faults)
}

fn simplify_from_wire(wire: v1::SimplifySpec, faults: &mut Vec<Fault>) -> Spec {
    let default = Spec::new(wire.triangles);
    Spec {
        ratios: wire.ratios,
        method: from_wire(&METHODS, wire.method, "method", faults),
        effort: from_wire(&EFFORTS, wire.effort, "effort", faults),
        topology: from_wire(&TOPOLOGIES, wire.topology, "topology", faults),
        start_factor: wire.start_factor.unwrap_or(default.start_factor),
        lambda: wire.surface_weight.unwrap_or(default.lambda),
        max_d2: max_d2_from_wire(wire.max_d2, wire.level_max_d2, faults),
        screen_size: wire.screen_size,
        max_bytes: wire.max_bytes,
        lock: locks_from_wire(&wire.lock, faults),
        hard_edge_degrees: wire.hard_edge_degrees.unwrap_or(default.hard_edge_degrees),
        render: render_from_wire(&wire.render.unwrap_or_default(), faults),
        optimize: optimization_from_wire(&wire.optimization.unwrap_or_default(), faults),
        max_evaluations: wire.max_evaluations,
        max_secs: wire.max_secs,
        seed: wire.seed,
        output: output_from_wire(wire.output),
        ..default
    }
}

fn max_d2_from_wire(for_all: f64, of_levels: Vec<f64>, faults: &mut Vec<Fault>) -> Vec<f64> {
    if for_all == 0.0 {
        return of_levels;
    }
    if !of_levels.is_empty() {
        let text = "max_d2 is given too: leave one of the two out".into();
        faults.push(Fault { field: "spec.max_d2".into(), text });
    }
    vec![for_all]
}

fn locks_from_wire(wire: &[i32], faults: &mut Vec<Fault>) -> Vec<Lock> {
    let mut locks = Vec::new();
    for (i, word) in wire.iter().enumerate() {
        match LOCKS.iter().find(|(known, _)| i32::from(*known) == *word) {
            // However often it is named.
            Some((_, lock)) if locks.contains(lock) => {}
            Some((_, lock)) => locks.push(*lock),
            None => {
                let text = format!("{word} is no value this server knows");
                faults.push(Fault { field: format!("spec.lock[{i}]"), text });
                break;
            }
        }
    }
    locks
}

fn optimize_from_wire(wire: v1::OptimizeSpec, faults: &mut Vec<Fault>) -> Spec {
    let mesh = mesh_hash(&wire.simplified_mesh);
    let default = Spec::optimizing(Input { mesh, file_name: wire.simplified_file_name });
    Spec {
        topology: from_wire(&TOPOLOGIES, wire.topology, "topology", faults),
        render: render_from_wire(&wire.render.unwrap_or_default(), faults),
        optimize: optimization_from_wire(&wire.optimization.unwrap_or_default(), faults),
        max_evaluations: wire.max_evaluations,
        max_secs: wire.max_secs,
        seed: wire.seed,
        lock: locks_from_wire(&wire.lock, faults),
        hard_edge_degrees: wire.hard_edge_degrees.unwrap_or(default.hard_edge_degrees),
        output: output_from_wire(wire.output),
        ..default
    }
}

fn evaluate_from_wire(wire: v1::EvaluateSpec, faults: &mut Vec<Fault>) -> Spec {
    let mesh = mesh_hash(&wire.simplified_mesh);
    let input = Input { mesh, file_name: wire.simplified_file_name };
    let evaluate = Evaluate {
        shading: from_wire(&SHADINGS, wire.shading, "shading", faults),
        colours: wire.colours,
        hide_back_faces: wire.hide_back_faces,
        stored_normals: wire.stored_normals,
        distance: wire.distance.unwrap_or(Evaluate::default().distance),
        metric: from_wire(&METRICS, wire.metric, "metric", faults),
    };
    Spec::evaluating(input, evaluate)
}

fn output_from_wire(wire: Option<v1::Output>) -> Output {
    let wire = wire.unwrap_or_default();
    Output { quantize: wire.quantize, compress: wire.compress }
}

fn optimization_from_wire(wire: &v1::Optimization, faults: &mut Vec<Fault>) -> Optimize {
    Optimize {
        max_evaluations: wire.max_evaluations,
        max_secs: wire.max_secs,
        until: wire.until,
        delta: wire.delta.unwrap_or(Optimize::default().delta),
        solver: from_wire(&SOLVERS, wire.solver, "optimize.solver", faults),
        normals: wire.normals,
        keep_attributes: wire.keep_attributes,
    }
}

fn render_from_wire(wire: &v1::RenderSpec, faults: &mut Vec<Fault>) -> Render {
    let default = Render::default();
    Render {
        n_views: wire.n_views.unwrap_or(default.n_views),
        custom_views: wire.custom_views.iter().map(|d| [d.x, d.y, d.z]).collect(),
        image_size: wire.image_size.unwrap_or(default.image_size),
        fov_degrees: wire.fov_degrees.unwrap_or(default.fov_degrees),
        projection: from_wire(&PROJECTIONS, wire.projection, "render.projection", faults),
        background: wire.background.unwrap_or(default.background),
        ambient: wire.ambient.unwrap_or(default.ambient),
        light_degrees: wire.light_degrees.unwrap_or(default.light_degrees),
        shading: from_wire(&SHADINGS, wire.shading, "render.shading", faults),
        interior_views: wire.interior_views,
        hide_back_faces: wire.hide_back_faces,
        view_weights: wire.view_weights.clone(),
        metric: from_wire(&METRICS, wire.metric, "render.metric", faults),
    }
}

fn to_wire<W: Copy + Into<i32>, D: Copy + PartialEq>(table: &[(W, D)], ours: D) -> i32 {
    table.iter().find(|(_, d)| *d == ours).map_or(0, |(wire, _)| (*wire).into())
}

/// UNSPECIFIED, which is 0 everywhere, is the default.
fn from_wire<W: Copy + Into<i32>, D: Copy + Default>(
    table: &[(W, D)],
    wire: i32,
    field: &str,
    faults: &mut Vec<Fault>,
) -> D {
    let row = table.iter().find(|(w, _)| (*w).into() == wire);
    if row.is_none() && wire != 0 {
        let text = format!("{wire} is no value this server knows");
        faults.push(Fault { field: format!("spec.{field}"), text });
    }
    row.map(|(_, ours)| *ours).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pick<T: Copy + std::fmt::Debug, W: Copy + std::fmt::Debug>(
        table: &'static [(W, T)],
    ) -> impl Strategy<Value = T> {
        (0..table.len()).prop_map(move |i| table[i].1)
    }

    fn spec() -> impl Strategy<Value = Spec> {
        let numbers = prop::array::uniform6(0.0..1e3f64);
        let looks = (pick(&SHADINGS), pick(&PROJECTIONS), pick(&METRICS));
        let words = (pick(&METHODS), pick(&EFFORTS), pick(&TOPOLOGIES), looks, pick(&SOLVERS));
        let views = prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 0..3);
        let ratios = prop::collection::vec(0.0..1.0f64, 0..3);
        let budgets = (ratios.clone(), ratios.clone(), prop::collection::vec(any::<u64>(), 0..3));
        let all_locks: Vec<_> = LOCKS.iter().map(|(_, lock)| *lock).collect();
        let locks = prop::sample::subsequence(all_locks, 0..=LOCKS.len());
        let levels = (prop::collection::vec(any::<u32>(), 0..4), ratios, budgets, locks);
        let counts = (levels, prop::array::uniform3(0..99u32));
        (numbers, words, views, counts, any::<u64>(), any::<u64>()).prop_map(
            |(x, words, custom_views, (levels, n), seed, max_evaluations)| Spec {
                triangles: levels.0.clone(),
                ratios: levels.1,
                max_d2: levels.2.0,
                screen_size: levels.2.1,
                max_bytes: levels.2.2,
                lock: levels.3,
                hard_edge_degrees: x[5] / 3.0,
                simplified: None,
                evaluate: None,
                method: words.0,
                effort: words.1,
                topology: words.2,
                start_factor: x[0],
                lambda: x[1],
                render: Render {
                    n_views: n[0],
                    custom_views,
                    image_size: n[1],
                    fov_degrees: x[2],
                    projection: words.3.1,
                    background: x[3],
                    ambient: x[4],
                    light_degrees: x[5],
                    shading: words.3.0,
                    interior_views: n[2],
                    hide_back_faces: n[0] % 2 == 0,
                    view_weights: levels.0,
                    metric: words.3.2,
                },
                optimize: Optimize {
                    max_evaluations: (n[0] > 50).then_some(seed / 3),
                    max_secs: (n[1] > 50).then_some(x[1]),
                    until: (n[2] > 50).then_some(x[2]),
                    delta: x[3],
                    solver: words.4,
                    normals: n[0] % 2 == 0,
                    keep_attributes: n[1] % 2 == 0,
                },
                output: Output { quantize: n[1] % 2 == 0, compress: n[2] % 2 == 0 },
                max_evaluations,
                max_secs: x[0] / 3.0,
                seed,
            },
        )
    }

    /// The same for a mesh that is simplified already.
    fn optimizing(spec: Spec) -> Spec {
        let input = Input { mesh: "0".repeat(64), file_name: "crude.ply".into() };
        let (topology, render) = (spec.topology, spec.render);
        let (lock, hard_edge_degrees) = (spec.lock, spec.hard_edge_degrees);
        let (optimize, max_evaluations, max_secs) =
            (spec.optimize, spec.max_evaluations, spec.max_secs);
        let (seed, output) = (spec.seed, spec.output);
        let base = Spec::optimizing(input);
        let base = Spec { lock, hard_edge_degrees, ..base };
        Spec { topology, render, optimize, output, max_evaluations, max_secs, seed, ..base }
    }

    /// The comparison of the two.
    fn evaluating(spec: &Spec) -> Spec {
        let input = Input { mesh: "0".repeat(64), file_name: "crude.ply".into() };
        let evaluate = Evaluate {
            shading: spec.render.shading,
            colours: spec.output.quantize,
            hide_back_faces: spec.render.hide_back_faces,
            stored_normals: spec.output.compress,
            distance: spec.seed.is_multiple_of(2),
            metric: spec.render.metric,
        };
        Spec::evaluating(input, evaluate)
    }

    proptest! {
        #[test]
        fn specifications_survive_the_wire(spec in spec()) {
            prop_assert_eq!(spec_from_wire(Some(spec_to_wire(&spec))), (spec.clone(), vec![]));
            let other = evaluating(&spec);
            prop_assert_eq!(spec_from_wire(Some(spec_to_wire(&other))), (other, vec![]));
            let spec = optimizing(spec);
            prop_assert_eq!(spec_from_wire(Some(spec_to_wire(&spec))), (spec, vec![]));
        }
    }

    #[test]
    fn what_is_left_out_takes_the_default() {
        let simplify = v1::SimplifySpec { triangles: vec![7], ..Default::default() };
        let wire = v1::JobSpec { kind: Some(v1::job_spec::Kind::Simplify(simplify)) };
        assert_eq!(spec_from_wire(Some(wire)), (Spec::new(vec![7]), vec![]));
    }

    #[test]
    fn fields_are_found_by_their_wire_names() {
        let names = [
            ("spec.lambda", "spec.simplify.surface_weight"),
            ("spec.triangles[1]", "spec.simplify.triangles[1]"),
            ("spec.render.image_size", "spec.simplify.render.image_size"),
            ("spec.optimize.until", "spec.simplify.optimization.until"),
            ("request_id", "request_id"),
        ];
        for (ours, wire) in names {
            assert_eq!(field_on_wire(&Spec::new(vec![7]), ours), wire);
        }
        let input = Input { mesh: String::new(), file_name: String::new() };
        let spec = Spec::optimizing(input);
        for (ours, wire) in [
            ("spec.optimize", "spec.optimize.optimization"),
            ("spec.simplified.mesh", "spec.optimize.simplified_mesh"),
        ] {
            assert_eq!(field_on_wire(&spec, ours), wire);
        }
        let spec = Spec { evaluate: Some(Evaluate::default()), ..spec };
        for (ours, wire) in [
            ("spec.shading", "spec.evaluate.shading"),
            ("spec.simplified.file_name", "spec.evaluate.simplified_file_name"),
        ] {
            assert_eq!(field_on_wire(&spec, ours), wire);
        }
    }

    #[test]
    fn unknown_words_are_faults() {
        let mut wire = spec_to_wire(&Spec::new(vec![7]));
        if let Some(v1::job_spec::Kind::Simplify(simplify)) = &mut wire.kind {
            simplify.method = 99;
            simplify.effort = -1;
            simplify.topology = 4;
            simplify.lock = vec![1, 0, 0];
            (simplify.max_d2, simplify.level_max_d2) = (1.0, vec![2.0]);
        }
        let fields: Vec<_> = spec_from_wire(Some(wire)).1.into_iter().map(|f| f.field).collect();
        assert_eq!(
            fields,
            ["spec.method", "spec.effort", "spec.topology", "spec.max_d2", "spec.lock[1]"]
        );
        assert_eq!(spec_from_wire(None).1.len(), 1);
    }
}
