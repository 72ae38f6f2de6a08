//! Evaluations per second of the native twin and of every Vulkan adapter, beside the limit that
//! memory bandwidth would set.
//!
//! One evaluation is one edge collapse judged in 20 pictures of 256². Prints processor time per
//! evaluation, which other programs on the machine disturb less than the wall clock, then lets
//! criterion time batches.
//!
//! On a quiet machine with two cores of an AMD EPYC (16.6 GB/s), evaluations per second at batches of
//! 512 and of 32; for 512 also processor time each, and the share of the limit:
//!
//! | model, triangles | native, 512 | native, 32 | lavapipe, 512 | lavapipe, 32 |
//! |---|---:|---:|---:|---:|
//! | bunny, 6.4k | 71.0 k (27.9 µs, 1/5) | 48.3 k | 35.6 k (44.6 µs, 1/11) | 20.0 k |
//! | bunny, 1.3k | 44.1 k (45.0 µs, 1/2) | 37.5 k | 9.0 k (178.7 µs, 1/10) | 6.3 k |
//! | generated jellyfish, 6.4k | 58.0 k (32.5 µs, 1/5) | 49.6 k | 23.9 k (66.1 µs, 1/11) | 15.5 k |
//! | generated jellyfish, 1.3k | 22.3 k (87.3 µs, 1/3) | 16.2 k | 4.0 k (367.1 µs, 1/16) | 4.2 k |
//!
//! Moves of the jellyfish touch more pixels. A commit takes 0.36 to 0.40 ms (native) and 1.8 to 5.5 ms
//! (lavapipe) with the bunny, 0.36 to 0.98 ms and 4.6 to 12 ms with the jellyfish.

#![allow(clippy::expect_used, reason = "a benchmark fails by panicking")]

mod support;

use std::{fs, hint::black_box, ops::ControlFlow, time::Instant};

use criterion::Criterion;
use lookalike::{
    compare::sample_mesh,
    io, memoryless,
    mesh::{EdgeTable, EditMesh, Mesh, Topology},
    metric::{Objective, Pictures, bounding_sphere, reference_pictures, scene_of_edit_mesh},
    render::{
        Evaluator, Move, Reference, RenderParams, Scene, Shading, adapters, make_evaluator,
        view::{Projection, ViewParams, cameras, directions},
    },
};

use support::cpu_seconds;

/// Triangles to measure at.
const SIZES: [(&str, u32); 2] = [("6.4k", 6444), ("1.3k", 1336)];
/// Moves of a batch: the lazy queue's, and a large one.
const BATCHES: [usize; 2] = [32, 512];

fn main() {
    let bandwidth = memory_bandwidth();
    println!("memory bandwidth of one thread (copy, read and write): {:.1} GB/s", bandwidth / 1e9);
    let mut criterion = Criterion::default().sample_size(10).configure_from_args();
    for (name, original) in models() {
        for (size, n_triangles) in SIZES {
            let label = format!("{name} {size}");
            let (scene, reference, moves) = prepare(&original, n_triangles);
            let bytes = bytes_touched(&scene, &moves);
            println!(
                "{label}: {bytes:.0} B touched an evaluation, so at most {:.0} evaluations/s",
                bandwidth / bytes
            );
            for device in devices() {
                let made = make_evaluator(&device, &scene, reference.clone());
                let Ok(mut evaluator) = made else {
                    println!("{device}: does not open");
                    continue;
                };
                for batch in BATCHES {
                    report(&label, evaluator.as_mut(), &scene, &moves, batch, bandwidth / bytes);
                }
                commit_times(&label, evaluator.as_mut(), &scene, &moves);
                criterion.bench_function(&format!("{label}/{}/32", evaluator.name()), |b| {
                    b.iter(|| black_box(evaluator.evaluate(&scene, &moves[..32])));
                });
            }
        }
    }
}

/// The twin, and every adapter that can be used.
fn devices() -> Vec<String> {
    let usable = adapters().into_iter().filter(|a| a.unfit.is_none()).map(|a| a.name);
    std::iter::once("cpu".to_owned()).chain(usable).collect()
}

/// Processor and wall time of 2048 evaluations, the least of twelve runs.
fn report(
    label: &str,
    evaluator: &mut dyn Evaluator,
    scene: &Scene,
    moves: &[Move],
    batch: usize,
    limit: f64,
) {
    let mut run = |n_batches: usize| {
        for k in 0..n_batches {
            let at = k * batch % moves.len();
            black_box(evaluator.evaluate(scene, &moves[at..at + batch])).expect("the device works");
        }
    };
    run(moves.len() / batch);
    let n_batches = 2048 / batch;
    let (mut wall, mut cpu) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..12 {
        let (wall_start, cpu_start) = (Instant::now(), cpu_seconds());
        run(n_batches);
        wall = wall.min(wall_start.elapsed().as_secs_f64());
        cpu = cpu.min(cpu_seconds() - cpu_start);
    }
    let n = (n_batches * batch) as f64;
    println!(
        "{label:>14} {:<38} batch {batch:>4}: {:6.1} µs of processor, {:6.1} µs of wall an \
         evaluation; {:7.0}/s, 1/{:.0} of the limit",
        evaluator.name(),
        cpu / n * 1e6,
        wall / n * 1e6,
        n / wall,
        limit / (n / wall)
    );
}

/// Time of making moves.
fn commit_times(label: &str, evaluator: &mut dyn Evaluator, scene: &Scene, moves: &[Move]) {
    let mut scene = scene.clone();
    let (wall, cpu) = (Instant::now(), cpu_seconds());
    let mut made: Vec<&Move> = Vec::new();
    for mv in moves {
        let fresh = |f: &u32| made.iter().all(|m| !m.removed.contains(f));
        if mv.removed.iter().all(fresh) && made.len() < 40 {
            evaluator.commit(&mut scene, mv).expect("the device works");
            made.push(mv);
        }
    }
    let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
    let n = made.len() as f64;
    println!(
        "{label:>14} {:<38} {} commits: {:.0} µs of processor, {:.0} µs of wall each",
        evaluator.name(),
        made.len(),
        cpu / n * 1e6,
        wall / n * 1e6
    );
}

/// Bytes per second of a large copy, counting reads and writes.
fn memory_bandwidth() -> f64 {
    let from = vec![1_u8; 64 << 20];
    let mut to = vec![0_u8; 64 << 20];
    let best = (0..5).map(|_| {
        let start = Instant::now();
        to.copy_from_slice(black_box(&from));
        black_box(&to);
        start.elapsed().as_secs_f64()
    });
    2.0 * from.len() as f64 / best.fold(f64::INFINITY, f64::min)
}

/// What an evaluation must read at least: 12 bytes for each pixel of the move's rectangles, and
/// 48 for each triangle that comes.
fn bytes_touched(scene: &Scene, moves: &[Move]) -> f64 {
    let mut bytes = 0.0;
    for mv in moves {
        let corners: Vec<u32> = mv
            .removed
            .iter()
            .filter_map(|f| scene.faces[*f as usize])
            .flat_map(|f| f.vertices)
            .collect();
        let moved: Vec<_> =
            mv.moved.iter().map(|m| scene.project(m.1).collect::<Vec<_>>()).collect();
        for view in 0..scene.n_views() {
            let old = corners.iter().map(|v| scene.screen_points(*v)[view]);
            let points: Vec<_> = old.chain(moved.iter().map(|m| m[view])).collect();
            let span = |of: &dyn Fn(usize) -> i32| {
                let all = (0..points.len()).map(of);
                (all.clone().min().unwrap_or(0), all.max().unwrap_or(0))
            };
            let rect = scene
                .lattice
                .pixels_within(span(&|k| points[k].x.into()), span(&|k| points[k].y.into()));
            if !rect.is_empty() {
                bytes += 12.0 * f64::from((rect.x1 - rect.x0 + 1) * (rect.y1 - rect.y0 + 1));
            }
        }
        bytes += 48.0 * (mv.added.len() * scene.n_views()) as f64;
    }
    bytes / moves.len() as f64
}

/// The models to measure with: the one that the project generates, and the Stanford bunny where
/// it is present.
fn models() -> Vec<(&'static str, Mesh)> {
    let mut models = vec![("jellyfish", sample_mesh(1, 70_000))];
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/models/stanford_bunny.glb");
    if let Ok(bytes) = fs::read(path) {
        let bunny = io::read("bunny.glb", &bytes, &io::Limits::default()).expect("a model");
        models.push(("bunny", bunny.mesh));
    }
    models
}

/// The model at `n_triangles`, its reference pictures, and collapses of edges drawn at random, each
/// placed where memoryless simplification would.
fn prepare(original: &Mesh, n_triangles: u32) -> (Scene, Reference, Vec<Move>) {
    let params = memoryless::Params::default();
    let mut mesh = EditMesh::new(original.clone()).expect("a mesh");
    memoryless::simplify(&mut mesh, n_triangles, &params, &mut |_| ControlFlow::Continue(()));
    let pictures = pictures(original);
    let reference = reference_pictures(original, &pictures);
    let scene = scene_of_edit_mesh(&mesh, &pictures);
    let twin = make_evaluator("cpu", &scene, reference.clone()).expect("the twin is always there");
    let objective = Objective::new(&mesh, &pictures.palette, scene.clone(), twin);
    let table = EdgeTable::new(&mesh);
    let mut edges: Vec<_> = table.edges().collect();
    shuffle(&mut edges);
    let mut scratch = memoryless::Scratch::default();
    let moves = edges.into_iter().filter_map(|edge| {
        let [a, b] = table.ends(edge);
        if !mesh.may_collapse(a, b, Topology::Preserve) {
            return None;
        }
        let place = memoryless::placement(&mesh, a, b, &params, &mut scratch)?;
        objective.collapse_move(&mesh, &mesh.plan_collapse(a, b, place.to))
    });
    let moves = moves.take(BATCHES[1]).collect();
    (scene, reference, moves)
}

/// 20 views of 256², flat.
fn pictures(original: &Mesh) -> Pictures {
    let view_params = ViewParams {
        directions: directions(20).expect("20 is a view set"),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 256,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    Pictures::of(original, params, cameras(&bounding_sphere(original), &view_params))
}

/// The same order every time.
fn shuffle<T>(items: &mut [T]) {
    let mut state = 1_u64;
    for i in (1..items.len()).rev() {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        items.swap(i, (state >> 33) as usize % (i + 1));
    }
}
