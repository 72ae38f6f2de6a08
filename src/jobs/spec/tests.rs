use super::*;

fn fields(spec: &Spec) -> Vec<String> {
    spec.validate().into_iter().map(|fault| fault.field).collect()
}

#[test]
fn the_default_job_is_sound() {
    assert_eq!(Spec::new(vec![500, 100]).validate(), []);
    let read: Spec = serde_json::from_str(r#"{"triangles": [500, 100]}"#).unwrap();
    assert_eq!(read, Spec::new(vec![500, 100]));
}

#[test]
fn every_fault_is_listed_at_once() {
    let mut spec = Spec::new(vec![10, 0]);
    spec.start_factor = 0.5;
    spec.lambda = f64::NAN;
    spec.max_secs = f64::INFINITY;
    spec.render.n_views = 7;
    spec.render.image_size = 100;
    spec.render.interior_views = 8;
    spec.render.background = -0.1;
    let wanted = [
        "triangles[1]",
        "start_factor",
        "lambda",
        "max_secs",
        "render.n_views",
        "render.image_size",
        "render.interior_views",
        "render.background",
    ];
    assert_eq!(fields(&spec), wanted);
}

#[test]
fn levels_are_numbers_or_shares_of_triangles() {
    let mut spec = Spec { ratios: vec![0.25, 1e-9], ..Spec::new(Vec::new()) };
    assert_eq!((spec.validate(), spec.n_levels()), (vec![], 2));
    let read: Spec = serde_json::from_str(r#"{"ratios": [0.25, 1e-9]}"#).unwrap();
    assert_eq!(read, spec);
    let resolved = read.resolved(1002);
    assert_eq!((resolved.triangles, resolved.ratios), (vec![251, 1], spec.ratios.clone()));
    spec.triangles = vec![7];
    spec.ratios.extend([0.0, 1.0, f64::NAN]);
    assert_eq!(fields(&spec), ["ratios", "ratios[2]", "ratios[3]", "ratios[4]"]);
    assert_eq!(fields(&Spec::new(Vec::new())), ["triangles"]);
}

#[test]
fn d2_is_for_those_who_look_at_pictures() {
    let mut spec = Spec { max_d2: vec![2.5], ..Spec::new(vec![10]) };
    assert_eq!(spec.validate(), []);
    for method in [Method::Memoryless, Method::Cluster] {
        spec.method = method;
        assert_eq!(fields(&spec), ["max_d2"]);
    }
    spec = Spec { max_d2: vec![f64::NAN], ..Spec::new(vec![10]) };
    assert_eq!(fields(&spec), ["max_d2"]);
}

#[test]
fn levels_have_budgets_of_many_kinds() {
    // Level 0 by triangles, 1 by screen size, 2 by bytes; d2 for all.
    let mut spec = Spec {
        max_d2: vec![3.0],
        screen_size: vec![0.0, 200.0, 0.0],
        max_bytes: vec![0, 0, 50_000],
        ..Spec::new(vec![500, 0, 0])
    };
    assert_eq!(spec.validate(), []);
    let d2 = LevelBudget { max_d2: Some(3.0), ..LevelBudget::default() };
    let wanted = [
        LevelBudget { triangles: Some(500), ..d2 },
        LevelBudget { screen_size: Some(200.0), ..d2 },
        LevelBudget { max_bytes: Some(50_000), ..d2 },
    ];
    assert_eq!(spec.level_budgets(), wanted);
    // Level 1 is left without any, lists are of different lengths, values out of range.
    spec.max_d2 = Vec::new();
    spec.screen_size = vec![0.0, 0.0, 1e9];
    spec.max_bytes = vec![12, 0];
    let wanted = ["max_bytes", "triangles[1]", "screen_size[1]", "screen_size[2]", "max_bytes[0]"];
    assert_eq!(fields(&spec), [&wanted[..], &["max_bytes[1]"]].concat());
    let alone = Spec { screen_size: vec![300.0], ..Spec::new(Vec::new()) };
    assert_eq!((alone.validate(), alone.n_levels()), (vec![], 1));
    let crude = Spec { method: Method::Cluster, lock: vec![Lock::Border], ..alone };
    assert_eq!(fields(&crude), ["screen_size", "lock"]);
}

#[test]
fn views_are_weighed_one_by_one() {
    let mut spec = Spec::new(vec![10]);
    spec.render.n_views = 4;
    spec.render.view_weights = vec![0, 1, 16, 2];
    spec.hard_edge_degrees = 0.0;
    assert_eq!(fields(&spec), ["hard_edge_degrees"]);
    spec.hard_edge_degrees = 30.0;
    for (weights, wanted) in [
        (vec![1, 17, 1, 1], "render.view_weights[1]"),
        (vec![1, 1], "render.view_weights"),
        (vec![0; 4], "render.view_weights"),
    ] {
        spec.render.view_weights = weights;
        assert_eq!(fields(&spec), [wanted]);
    }
}

#[test]
fn custom_views_replace_the_count() {
    let mut spec = Spec::new(vec![10]);
    spec.render.n_views = 7;
    spec.render.custom_views = vec![[0.0, 0.0, 2.0]];
    assert_eq!(spec.validate(), []);
    spec.render.custom_views.push([0.0; 3]);
    spec.render.custom_views.push([f64::INFINITY, 0.0, 0.0]);
    assert_eq!(fields(&spec), ["render.custom_views[1]", "render.custom_views[2]"]);
}

/// A request may hold millions of them.
#[test]
fn however_many_are_wrong_few_faults_are_found() {
    let mut spec = Spec::new(vec![0; 100_000]);
    spec.render.custom_views = vec![[0.0; 3]; 100_000];
    let found = fields(&spec);
    assert_eq!(found[..3], ["triangles", "render.custom_views", "render.custom_views[0]"]);
    assert!(found.len() < 100, "{}", found.len());
}

#[test]
fn optimization_has_faults_of_its_own() {
    let mut spec = Spec::new(vec![10, 20]);
    spec.method = Method::Cluster;
    spec.optimize.until = Some(1.5);
    spec.optimize.max_secs = Some(f64::NAN);
    spec.optimize.delta = 0.0;
    spec.optimize.normals = true;
    let wanted = ["triangles", "optimize.max_secs", "optimize.until", "optimize.delta"];
    assert_eq!(fields(&spec), [&wanted[..], &["optimize.normals"]].concat());
    let input = || Input { mesh: "a".repeat(64), file_name: "crude.ply".into() };
    let mut spec = Spec::optimizing(input());
    assert_eq!((spec.validate(), spec.n_levels()), (vec![], 1));
    spec.triangles = vec![9];
    spec.ratios = vec![0.5];
    spec.max_d2 = vec![1.0];
    spec.optimize.max_evaluations = Some(0);
    assert_eq!(fields(&spec), ["triangles", "ratios", "max_d2", "optimize"]);
}

#[test]
fn an_evaluation_takes_meshes_as_they_are() {
    let input = Input { mesh: "a".repeat(64), file_name: "crude.ply".into() };
    let looks = Evaluate {
        shading: Shading::Smooth,
        colours: true,
        distance: false,
        ..Evaluate::default()
    };
    let sound = Spec::evaluating(input, looks);
    assert_eq!((sound.validate(), sound.n_levels(), sound.kind()), (vec![], 0, Kind::Evaluate));
    let text = serde_json::to_string(&sound).unwrap();
    assert_eq!(serde_json::from_str::<Spec>(&text).unwrap(), sound);
    type Change = fn(&mut Spec);
    let check = |change: Change, wanted: &str| {
        let mut spec = sound.clone();
        change(&mut spec);
        assert_eq!(fields(&spec), [wanted]);
    };
    let cases: [(Change, &str); 20] = [
        (|s| s.simplified = None, "simplified"),
        (|s| s.triangles = vec![9], "triangles"),
        (|s| s.ratios = vec![0.5], "ratios"),
        (|s| s.max_d2 = vec![1.0], "max_d2"),
        (|s| s.screen_size = vec![300.0], "screen_size"),
        (|s| s.max_bytes = vec![9000], "max_bytes"),
        (|s| s.method = Method::Memoryless, "method"),
        (|s| s.effort = Effort::Best, "effort"),
        (|s| s.topology = Topology::Free, "topology"),
        (|s| s.start_factor = 4.0, "start_factor"),
        (|s| s.lambda = 0.1, "lambda"),
        (|s| s.lock = vec![Lock::Seam], "lock"),
        (|s| s.hard_edge_degrees = 30.0, "hard_edge_degrees"),
        (|s| s.render.shading = Shading::Smooth, "render.shading"),
        (|s| s.render.view_weights = vec![1], "render.view_weights"),
        (|s| s.optimize.max_evaluations = Some(0), "optimize.max_evaluations"),
        (|s| s.output.compress = true, "output"),
        (|s| s.max_evaluations = 9, "max_evaluations"),
        (|s| s.max_secs = f64::NAN, "max_secs"),
        (|s| s.seed = 1, "seed"),
    ];
    cases.into_iter().for_each(|(change, wanted)| check(change, wanted));
    // All at once.
    let mut spec = sound;
    (spec.seed, spec.render.n_views, spec.triangles) = (1, 7, vec![0]);
    assert_eq!(fields(&spec), ["render.n_views", "seed", "triangles"]);
}

#[test]
fn numbers_survive_storage() {
    let mut spec = Spec::new(vec![10]);
    spec.seed = u64::MAX;
    spec.render.custom_views = vec![[1.0 / 3.0, std::f64::consts::PI, -1e-300]];
    let text = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<Spec>(&text).unwrap(), spec);
}
