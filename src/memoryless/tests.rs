//! The paper's figures and guarantees, and inputs that no paper expects.

use std::{io::Write as _, ops::ControlFlow};

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::mesh::{
    Collapse, EdgeTable, Edit, EditMesh, Marks, Mesh, Stage, Step, Topology, VertexId, shapes,
};

/// Simplifies a mesh and hands back what is left of it.
fn run(mesh: &Mesh, target: u32, params: &Params) -> (EditMesh, Outcome) {
    let mut mesh = EditMesh::new(mesh.clone()).unwrap();
    let outcome = simplify(&mut mesh, target, params, &mut |_| ControlFlow::Continue(()));
    mesh.validate().unwrap();
    assert_eq!(outcome.faces as usize, mesh.n_faces());
    (mesh, outcome)
}

fn with_lambda(lambda: f64) -> Params {
    Params { lambda, ..Params::default() }
}

fn with_scheme(scheme: Scheme) -> Params {
    Params { scheme, ..Params::default() }
}

fn n_boundary_edges(mesh: &EditMesh) -> usize {
    let edges = EdgeTable::new(mesh);
    let is_boundary = |&e: &_| {
        let [a, b] = edges.ends(e);
        mesh.is_boundary_edge(a, b)
    };
    edges.edges().filter(is_boundary).count()
}

fn corners(mesh: &Mesh) -> impl Iterator<Item = [DVec3; 3]> + '_ {
    mesh.faces.iter().map(|face| face.map(|v| mesh.positions[v as usize]))
}

fn volume(mesh: &Mesh) -> f64 {
    corners(mesh).map(|[p, q, r]| p.dot(q.cross(r)) / 6.0).sum()
}

fn area(mesh: &Mesh) -> f64 {
    corners(mesh).map(|[p, q, r]| (q - p).cross(r - p).length() / 2.0).sum()
}

/// The bunny of the papers, from `../shared/models`, or nothing and a line that says so.
fn bunny() -> Option<Mesh> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/models/stanford_bunny.ply");
    let Ok(text) = std::fs::read_to_string(path) else {
        let _ = writeln!(std::io::stderr(), "skipped: {path} is not there");
        return None;
    };
    let (header, body) = text.split_once("end_header\n").unwrap();
    let count = |of| {
        let line = header.lines().find_map(|l| l.strip_prefix(of)).unwrap();
        line.trim().parse::<usize>().unwrap()
    };
    let (n_vertices, n_faces) = (count("element vertex"), count("element face"));
    let numbers = |line: &str| line.split(' ').filter_map(|x| x.parse().ok()).collect::<Vec<f64>>();
    let positions = body.lines().take(n_vertices).map(|l| DVec3::from_slice(&numbers(l)));
    let faces = body.lines().skip(n_vertices).take(n_faces).map(|line| {
        let n = numbers(line);
        [n[1], n[2], n[3]].map(|v| v as u32)
    });
    Some(Mesh::from_parts(positions.collect(), faces.collect()))
}

/// Distance from a point to a triangle: to its plane if the foot lies inside, else to a side.
fn distance(p: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
    let normal = (b - a).cross(c - a);
    let inside =
        [(a, b), (b, c), (c, a)].iter().all(|&(s, t)| (t - s).cross(p - s).dot(normal) >= 0.0);
    if inside && normal.length() > 0.0 {
        return (p - a).dot(normal).abs() / normal.length();
    }
    let to_side = |(s, t): (DVec3, DVec3)| {
        let along = ((p - s).dot(t - s) / s.distance_squared(t)).clamp(0.0, 1.0);
        p.distance(s.lerp(t, along))
    };
    [(a, b), (b, c), (c, a)].map(to_side).into_iter().fold(f64::INFINITY, f64::min)
}

/// Mean distance from some of the original's vertices to the simplified surface.
fn mean_distance(original: &Mesh, simplified: &Mesh) -> f64 {
    let step = original.positions.len().div_ceil(600);
    let nearest =
        |&p: &DVec3| corners(simplified).map(|t| distance(p, t)).fold(f64::INFINITY, f64::min);
    let distances: Vec<f64> = original.positions.iter().step_by(step).map(nearest).collect();
    distances.iter().sum::<f64>() / distances.len() as f64
}

#[test]
fn a_closed_mesh_keeps_its_volume() {
    for mesh in [shapes::torus(90, 40, 0.08), shapes::sphere(5)] {
        for target in [2000, 400, 100] {
            let (simplified, _) = run(&mesh, target, &Params::default());
            let (before, after) = (volume(&mesh), volume(&simplified.snapshot()));
            assert!((after / before - 1.0).abs() < 1e-12, "{before} became {after}");
        }
    }
}

#[test]
fn lambda_decides_how_much_goes_to_the_boundary() {
    // The paper's 33, 27 and 25 of its spherical segment; by symmetry every cost there ties with
    // 255 others, and which of them goes first moves the counts by one or two.
    for (lambda, expected) in [(1.0 / 32.0, 33), (0.5, 27), (31.0 / 32.0, 25)] {
        let (mesh, outcome) = run(&shapes::spherical_segment(), 49, &with_lambda(lambda));
        assert!(n_boundary_edges(&mesh).abs_diff(expected) <= 2, "at {lambda}");
        assert_eq!((outcome.reached, outcome.faces), (true, 49));
    }
}

#[test]
fn the_bunny_keeps_the_boundary_of_the_paper() {
    let Some(bunny) = bunny() else { return };
    assert_eq!(bunny.faces.len(), 69_451);
    for (lambda, target, expected) in
        [(1.0 / 32.0, 1326, 76), (0.5, 1336, 42), (31.0 / 32.0, 1342, 28)]
    {
        let (mesh, outcome) = run(&bunny, target, &with_lambda(lambda));
        assert!(n_boundary_edges(&mesh).abs_diff(expected) <= 2, "at {lambda}");
        assert!(outcome.faces.abs_diff(target) <= 1);
        assert!(outcome.evaluations < 10 * outcome.collapses, "{outcome:?}");
    }
}

#[test]
fn the_eight_schemes_rank_as_in_the_paper() {
    let original = shapes::torus(100, 50, 0.08);
    let error = |scheme: &Scheme| {
        mean_distance(&original, &run(&original, 300, &with_scheme(*scheme)).0.snapshot())
    };
    let errors: Vec<f64> = Scheme::ALL.iter().map(error).collect();
    let of = |number: usize| errors[number - 1];
    for number in 1..8 {
        assert!(of(8) < of(number), "8 is best: {errors:?}");
    }
    for number in 1..=4 {
        assert!(of(number + 4) < of(number), "keeping the volume helps: {errors:?}");
    }
    assert!(of(3) > of(1) && of(3) > of(2) && of(7) > of(6), "midpoints are worst: {errors:?}");
    assert!(of(2) <= of(1) && of(6) <= of(5), "the better end is better: {errors:?}");
}

#[test]
fn each_scheme_places_as_its_name_says() {
    let mesh = EditMesh::new(shapes::torus(12, 8, 0.1)).unwrap();
    let edges = EdgeTable::new(&mesh);
    for edge in edges.edges() {
        let [a, b] = edges.ends(edge);
        let (p, q) = (mesh.position(a), mesh.position(b));
        let mut scratch = Scratch::default();
        let found = Scheme::ALL
            .map(|scheme| placement(&mesh, a, b, &with_scheme(scheme), &mut scratch).unwrap());
        let is_end = |x: DVec3| x.distance(p).min(x.distance(q)) < 1e-12;
        assert!(is_end(found[0].to) && is_end(found[1].to));
        assert!(found[2].to.distance(p.lerp(q, 0.5)) < 1e-12);
        assert!(found[1].cost <= found[0].cost && found[3].cost <= found[1].cost);
        assert!(found[3].cost <= found[7].cost + 1e-18, "8 has a constraint more than 4");
        for kept in &found[4..] {
            let mut edited = mesh.clone();
            edited.collapse(a, b, kept.to);
            let change = volume(&edited.snapshot()) - volume(mesh.mesh());
            assert!(change.abs() < 1e-13, "{change}");
        }
        assert!(placement(&mesh, a, a, &Params::default(), &mut scratch).is_none());
    }
}

#[test]
fn a_flat_square_keeps_its_outline() {
    let (mesh, outcome) = run(&shapes::terrain(40, 0.0), 2, &Params::default());
    assert_eq!((outcome.reached, mesh.n_faces()), (true, 2));
    let square = mesh.snapshot();
    assert!((area(&square) - 1.0).abs() < 1e-9, "no folds, no losses: {square:?}");
    assert!(
        square.positions.iter().all(|p| p.min_element() > -1e-9 && p.max_element() < 1.0 + 1e-9)
    );
}

#[test]
fn nothing_flies_away_over_nearly_flat_ground() {
    // Bumps a billionth high: normals almost cancel everywhere.
    let mesh = shapes::terrain(60, 1e-9);
    for scheme in Scheme::ALL {
        let (simplified, _) = run(&mesh, 40, &with_scheme(scheme));
        let far = simplified
            .snapshot()
            .positions
            .iter()
            .map(|p| p.abs().max_element())
            .fold(0.0, f64::max);
        assert!(far < 1.5, "{far} under {scheme:?}");
    }
}

#[test]
fn it_stops_and_says_so_when_nothing_is_left_to_collapse() {
    let (sphere, outcome) = run(&shapes::sphere(3), 0, &Params::default());
    assert_eq!((sphere.n_faces(), outcome.reached), (4, false));
    assert_eq!(outcome.stopped_by, StoppedBy::NoLegalCollapse);
    let free = Params { topology: Topology::Free, max_turn_degrees: 180.0, ..Params::default() };
    let (pair, outcome) = run(&shapes::sphere(3), 0, &free);
    assert_eq!((pair.n_faces(), outcome.stopped_by), (2, StoppedBy::NoLegalCollapse));
    let (same, outcome) = run(&shapes::sphere(1), 1000, &Params::default());
    assert_eq!((same.snapshot(), outcome.collapses), (shapes::sphere(1), 0));
}

/// Two cones on one rim: two vertices of `n` triangles each.
fn double_cone(n: u32) -> Mesh {
    let mut positions = vec![DVec3::Z, -DVec3::Z];
    let turns = (0..n).map(|k| std::f64::consts::TAU * f64::from(k) / f64::from(n));
    positions.extend(turns.map(|t| DVec3::new(t.cos(), t.sin(), 0.1 * (11.0 * t).sin())));
    let faces = (0..n).flat_map(|k| {
        let (a, b) = (2 + k, 2 + (k + 1) % n);
        [[0, a, b], [1, b, a]]
    });
    Mesh::from_parts(positions, faces.collect())
}

#[test]
fn hubs_cost_little_and_keep_their_place() {
    // Evaluating a spoke takes as many steps as its hub has triangles: at first no spoke is.
    let n = 20_000;
    let (mesh, outcome) = run(&double_cone(n), 2000, &Params::default());
    assert!(outcome.reached && outcome.evaluations < 6 * u64::from(n), "{outcome:?}");
    assert_eq!([0, 1].map(|v| mesh.position(VertexId(v))), [DVec3::Z, -DVec3::Z]);
    let (small, outcome) = run(&double_cone(n), 60, &Params::default());
    assert!(outcome.reached);
    assert!((volume(&small.snapshot()) / volume(&double_cone(n)) - 1.0).abs() < 1e-9);
}

#[test]
fn hubs_give_way_where_nothing_else_does() {
    // Triangles that share one vertex and no edge: only spokes may go.
    let positions = (0..2001).map(|k| DVec3::new(f64::from(k).sin(), f64::from(k), 1.0)).collect();
    let faces = (0..1000).map(|k| [0, 2 * k + 1, 2 * k + 2]).collect();
    let free = Params { max_turn_degrees: 180.0, ..Params::default() };
    let (_, outcome) = run(&Mesh::from_parts(positions, faces), 10, &free);
    assert_eq!((outcome.reached, outcome.faces), (true, 10));
}

#[test]
fn edits_progress_and_samples_reach_the_caller_who_may_stop() {
    let original = shapes::torus(40, 20, 0.05);
    let mut mesh = EditMesh::new(original.clone()).unwrap();
    let mut edits: Vec<Collapse> = Vec::new();
    let (mut done_so_far, mut n_samples) = (0, 0);
    let outcome = simplify(&mut mesh, 100, &Params::default(), &mut |step| {
        match step {
            Step::Edit(Edit::Collapse(collapse)) => edits.push(collapse.clone()),
            other @ (Step::Edit(_) | Step::Moves(_)) => panic!("{other:?}"),
            Step::Progress { done, total } => {
                assert!(done > done_so_far && done <= total && total == 1500);
                done_so_far = done;
            }
            Step::Sample(sample) => {
                assert_eq!((sample.stage, sample.energy), (Stage::Memoryless, None));
                assert_eq!(sample.triangles as usize + 2 * edits.len(), 1600);
                n_samples += 1;
            }
        }
        if edits.len() == 500 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!((outcome.stopped_by, outcome.collapses), (StoppedBy::Caller, 500));
    assert!(n_samples > 100);
    while let Some(collapse) = edits.pop() {
        mesh.undo(&collapse);
    }
    mesh.validate().unwrap();
    assert_eq!(mesh.snapshot(), original);
}

#[test]
fn size_does_not_matter() {
    let mesh = shapes::terrain(20, 0.2);
    let scaled = |factor: f64| {
        let positions = mesh.positions.iter().map(|&p| p * factor).collect();
        run(&Mesh::from_parts(positions, mesh.faces.clone()), 100, &Params::default()).0.snapshot()
    };
    let expected = scaled(1.0);
    for exponent in [-60, 40] {
        let factor = 2.0f64.powi(exponent);
        let found = scaled(factor);
        assert_eq!(found.faces, expected.faces);
        let back: Vec<DVec3> = found.positions.iter().map(|&p| p / factor).collect();
        assert_eq!(back, expected.positions, "powers of two scale exactly");
    }
}

/// Positions of nine vertices as bad as files have them.
fn bad_positions() -> impl Strategy<Value = Vec<DVec3>> {
    let coordinate = prop_oneof![
        Just(0.0),
        Just(1.0),
        -1.0..1.0,
        Just(1e30),
        Just(-1e30),
        Just(1e-30),
        Just(1e150),
        Just(1e-200),
    ];
    let position = [coordinate.clone(), coordinate.clone(), coordinate].prop_map(DVec3::from_array);
    prop::collection::vec(position, 9)
}

proptest! {
    #[test]
    fn soup_of_any_kind_is_simplified_without_panic(
        positions in bad_positions(),
        faces in prop::collection::vec([0..9u32, 0..9u32, 0..9u32], 0..30),
        (target, number, is_free) in (0..20u32, 0..8usize, any::<bool>()),
        lambda in prop_oneof![Just(0.0), Just(0.5), Just(1.0)],
    ) {
        let is_proper = |f: &[u32; 3]| f[0] != f[1] && f[1] != f[2] && f[0] != f[2];
        let faces: Vec<_> = faces.into_iter().filter(is_proper).collect();
        let mesh = Mesh::from_parts(positions, faces);
        let topology = if is_free { Topology::Free } else { Topology::Preserve };
        let params = Params { lambda, topology, ..with_scheme(Scheme::ALL[number]) };
        let (simplified, outcome) = run(&mesh, target, &params);
        prop_assert!(outcome.reached == (outcome.stopped_by == StoppedBy::Target));
        prop_assert!(simplified.snapshot().check().is_ok(), "finite positions");
        let again = run(&mesh, target, &params);
        prop_assert_eq!((again.0.snapshot(), again.1), (simplified.snapshot(), outcome));
    }

    #[test]
    fn turns_are_measured_on_surviving_triangles(angle in 5.0..175.0f64) {
        // Two triangles hinged on 0-1, folded by `angle` when vertex 3 collapses onto 2.
        let up = DVec3::new(0.5, angle.to_radians().cos(), angle.to_radians().sin());
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::new(0.5, 1.0, 0.0), DVec3::new(0.5, 2.0, 0.0)];
        let mesh = EditMesh::new(Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]])).unwrap();
        let ends = [VertexId(2), VertexId(3)];
        for limit in [30.0f64, 75.0, 120.0] {
            let turns = turns_too_far(&mesh, ends, up, limit.to_radians().cos());
            prop_assert!(turns == (angle > limit) || (angle - limit).abs() < 1e-6);
        }
    }
}

/// Where the locked vertices of a mesh are.
fn places_of_locked(mesh: &EditMesh) -> Vec<Option<DVec3>> {
    let ids = (0..mesh.n_vertex_slots() as u32).map(VertexId).filter(|v| mesh.is_locked(*v));
    ids.map(|v| mesh.is_used(v).then(|| mesh.position(v))).collect()
}

proptest! {
    #[test]
    fn locked_vertices_stay(
        mask in prop::collection::vec(prop::bool::weighted(0.15), 169),
        is_free in any::<bool>(),
        is_open in any::<bool>(),
    ) {
        let mesh = if is_open { shapes::terrain(12, 0.3) } else { shapes::torus(13, 13, 0.1) };
        let marks = Marks { locked: mask, ..Marks::default() };
        let mut mesh = EditMesh::new(mesh).unwrap().with_marks(marks);
        let before = places_of_locked(&mesh);
        let topology = if is_free { Topology::Free } else { Topology::Preserve };
        let params = Params { topology, ..Params::default() };
        let outcome = simplify(&mut mesh, 2, &params, &mut |_| ControlFlow::Continue(()));
        mesh.validate().unwrap();
        prop_assert_eq!(places_of_locked(&mesh), before.clone());
        prop_assert!(outcome.collapses > 0);
        prop_assert!(before.len() < 4 || mesh.is_held_by_locks(topology));
    }
}

#[test]
fn what_matters_less_goes_first() {
    // A terrain like waves, of which the left half matters a hundredth as much.
    let mesh = shapes::terrain(20, 0.2);
    let n_left = |weights: Vec<f32>| {
        let marks = Marks { weights, ..Marks::default() };
        let mut mesh = EditMesh::new(mesh.clone()).unwrap().with_marks(marks);
        simplify(&mut mesh, 300, &Params::default(), &mut |_| ControlFlow::Continue(()));
        let middle = |f| mesh.vertices_of(f).map(|v| mesh.position(v).x).iter().sum::<f64>() / 3.0;
        mesh.faces().filter(|f| middle(*f) < 0.5).count()
    };
    let as_they_are = n_left(Vec::new());
    assert_eq!(n_left(vec![1.0; 441]), as_they_are);
    let weights = mesh.positions.iter().map(|p| if p.x < 0.5 { 0.01 } else { 1.0 }).collect();
    let weighed = n_left(weights);
    assert!(2 * weighed < as_they_are, "{weighed} of {as_they_are}");
}

/// A run whose keys are known up to any place ends as one that has to find them all, and judges fewer edges.
#[test]
fn a_run_goes_on_where_it_was_broken_off() {
    use std::sync::{Arc, Mutex};

    use crate::tape::{Tape, pack};

    let original = shapes::terrain(40, 0.3);
    let params = Params::default();
    // Two targets, one after the other.
    let play = |tape: &Tape| {
        let (mut mesh, mut story) = (EditMesh::new(original.clone()).unwrap(), Vec::new());
        let mut simplifier = Simplifier::new(&mut mesh, &params, tape);
        for target in [1500, 90] {
            let outcome = simplifier.run_to(target, &mut |step| {
                story.push(format!("{step:?}"));
                ControlFlow::Continue(())
            });
            story.push(format!("{outcome:?}"));
        }
        (mesh.snapshot().positions, story)
    };
    let kept: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
    let (keep, mut n_asked) = (Arc::clone(&kept), 0);
    let every_so_often = move |recorded: &mut Vec<u8>| {
        n_asked += 1;
        if n_asked % 2000 == 0 {
            keep.lock().unwrap().push(pack(&std::mem::take(recorded)).unwrap());
        }
    };
    let wanted = play(&Tape::new(Vec::new(), Box::new(every_so_often)));
    assert!(wanted == play(&Tape::off()));
    let pieces = kept.lock().unwrap().clone();
    assert!(pieces.len() > 5, "{} pieces", pieces.len());
    let mut n_found = Vec::new();
    for n in 1..=pieces.len() {
        let asked = Arc::new(Mutex::new(0));
        let count = Arc::clone(&asked);
        let tape = Tape::new(pieces[..n].to_vec(), Box::new(move |_| *count.lock().unwrap() += 1));
        assert!(play(&tape) == wanted, "other edits after {n} pieces");
        assert_eq!(tape.fault(), None);
        n_found.push(*asked.lock().unwrap());
    }
    assert!(n_found.windows(2).all(|n| n[0] == n[1] + 2000), "{n_found:?}");
}
