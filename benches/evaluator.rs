//! Evaluations per second of the native twin and of every Vulkan adapter, beside the limit that
//! memory bandwidth would set.
//!
//! One evaluation is one edge collapse judged in 20 pictures of 256². Prints processor time per
//! evaluation, which other programs on the machine disturb less than the wall clock, then lets
//! criterion time batches.

#![allow(clippy::expect_used, reason = "a benchmark fails by panicking")]

use std::{fs, hint::black_box, time::Instant};

use criterion::Criterion;
use glam::DVec3;
use lookalike::render::{
    AddedFace, Evaluator, Move, RenderParams, Scene, SceneFace, Shading, adapters, make_evaluator,
    reference,
    view::{BoundingSphere, Projection, ViewParams, cameras, directions},
};

/// Quads from pole to pole: 4 n² triangles.
const SIZES: [(&str, usize); 2] = [("6.4k", 40), ("1.3k", 18)];
/// Moves of a batch: the lazy queue's, and a large one.
const BATCHES: [usize; 2] = [32, 512];

fn main() {
    let bandwidth = memory_bandwidth();
    println!("memory bandwidth of one thread (copy, read and write): {:.1} GB/s", bandwidth / 1e9);
    let mut criterion = Criterion::default().sample_size(10).configure_from_args();
    for (label, n) in SIZES {
        let scene = bumpy_scene(n);
        let moves = collapses(&scene, BATCHES[1]);
        let bytes = bytes_touched(&scene, &moves);
        println!(
            "{label} triangles: {bytes:.0} B touched an evaluation, so at most {:.0} evaluations/s",
            bandwidth / bytes
        );
        for device in devices() {
            let made = make_evaluator(&device, &scene, reference(&scene));
            let Ok(mut evaluator) = made else {
                println!("{device}: does not open");
                continue;
            };
            for batch in BATCHES {
                report(label, evaluator.as_mut(), &scene, &moves, batch, bandwidth / bytes);
            }
            commit_times(label, evaluator.as_mut(), &scene, &moves);
            criterion.bench_function(&format!("{label}/{}/32", evaluator.name()), |b| {
                b.iter(|| black_box(evaluator.evaluate(&scene, &moves[..32])));
            });
        }
    }
}

/// The twin, and every adapter that can be used.
fn devices() -> Vec<String> {
    let usable = adapters().into_iter().filter(|a| a.unfit.is_none()).map(|a| a.name);
    std::iter::once("cpu".to_owned()).chain(usable).collect()
}

/// Processor and wall time of about half a second of evaluations.
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
    let n_batches = 16_384 / batch;
    let (wall, cpu) = (Instant::now(), cpu_seconds());
    run(n_batches);
    let (wall, cpu) = (wall.elapsed().as_secs_f64(), cpu_seconds() - cpu);
    let n = (n_batches * batch) as f64;
    println!(
        "{label:>5} {:<40} batch {batch:>4}: {:6.1} µs of processor, {:6.1} µs of wall an \
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
        "{label:>5} {:<40} {} commits: {:.0} µs of processor, {:.0} µs of wall each",
        evaluator.name(),
        made.len(),
        cpu / n * 1e6,
        wall / n * 1e6
    );
}

/// Processor time of all threads of this process so far.
fn cpu_seconds() -> f64 {
    let Ok(tasks) = fs::read_dir("/proc/self/task") else { return 0.0 };
    tasks
        .filter_map(|task| fs::read_to_string(task.ok()?.path().join("schedstat")).ok())
        .filter_map(|stat| stat.split(' ').next()?.parse::<f64>().ok())
        .sum::<f64>()
        / 1e9
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
        let place = |v: u32| mv.moved.iter().find(|m| m.0 == v).map(|m| m.1);
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
        black_box(place(0));
    }
    bytes / moves.len() as f64
}

/// A bumpy sphere of 4 n² triangles in 20 pictures of 256².
fn bumpy_scene(n: usize) -> Scene {
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for i in 0..=n {
        for j in 0..2 * n {
            let (theta, phi) = (i as f64 / n as f64, j as f64 / n as f64);
            let (theta, phi) = (theta * std::f64::consts::PI, phi * std::f64::consts::PI);
            let r = 1.0 + 0.2 * libm::sin(5.0 * phi) * libm::sin(4.0 * theta);
            let (st, ct) = libm::sincos(theta);
            let (sp, cp) = libm::sincos(phi);
            positions.push(DVec3::new(st * cp, ct, st * sp) * r);
        }
    }
    let at = |i: usize, j: usize| (i * 2 * n + j % (2 * n)) as u32;
    for i in 0..n {
        for j in 0..2 * n {
            for vertices in [
                [at(i, j), at(i, j + 1), at(i + 1, j)],
                [at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)],
            ] {
                faces.push(Some(SceneFace { vertices, albedo: [255; 3] }));
            }
        }
    }
    let view_params = ViewParams {
        directions: directions(20).expect("20 is a view set"),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let views = cameras(&BoundingSphere::of(positions.iter().copied()), &view_params);
    let params = RenderParams {
        image_size: 256,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
    };
    Scene::new(params, views, positions, faces)
}

/// Edge collapses spread over the model, each to the middle of its edge; the poles, where many
/// triangles meet, are left out.
fn collapses(scene: &Scene, n_moves: usize) -> Vec<Move> {
    let n_vertices = scene.faces.iter().flatten().flat_map(|f| f.vertices).max().unwrap_or(0) + 1;
    let mut around = vec![Vec::new(); n_vertices as usize];
    for (id, f) in scene.faces.iter().enumerate() {
        for v in f.iter().flat_map(|f| f.vertices) {
            around[v as usize].push(id as u32);
        }
    }
    let mut moves = Vec::new();
    for k in 0..scene.faces.len() {
        let Some(face) = scene.faces[k * 7919 % scene.faces.len()] else { continue };
        let (keep, drop) = (face.vertices[k % 3], face.vertices[(k + 1) % 3]);
        if around[keep as usize].len() > 8 || around[drop as usize].len() > 8 {
            continue;
        }
        moves.push(collapse(scene, &around, keep, drop));
        if moves.len() == n_moves {
            break;
        }
    }
    let n = moves.len();
    moves.into_iter().cycle().take(n_moves.max(n)).collect()
}

fn collapse(scene: &Scene, around: &[Vec<u32>], keep: u32, drop: u32) -> Move {
    let to = (scene.position(keep) + scene.position(drop)) * 0.5;
    let mut mv = Move { moved: [(keep, to)].into_iter().collect(), ..Move::default() };
    let mut ids = [around[keep as usize].as_slice(), &around[drop as usize]].concat();
    ids.sort_unstable();
    ids.dedup();
    for face in ids {
        let Some(f) = scene.faces[face as usize] else { continue };
        mv.removed.push(face);
        if !(f.vertices.contains(&keep) && f.vertices.contains(&drop)) {
            let vertices = f.vertices.map(|v| if v == drop { keep } else { v });
            mv.added.push(AddedFace { face, vertices, albedo: f.albedo });
        }
    }
    mv
}
