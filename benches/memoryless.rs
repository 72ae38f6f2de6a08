//! Speed of memoryless simplification, one thread: triangles removed per second on the generated
//! sample at three sizes, and the cost of one placement.
//!
//! For comparison, CGAL 5.5.1's `edge_collapse` with its Lindstrom–Turk policies, CPU clocks, best of
//! six (bunny) and three (dragon) runs in alternation with ours, on 2 shared cores of an AMD EPYC under
//! other load, so that only the ratios mean anything, and those to about a tenth:
//!
//! | model | CGAL | this | ratio |
//! |---|---:|---:|---:|
//! | Stanford bunny 69,451 → 1,336 | 1.29 s | 0.167 s | 7.7 (of the medians: 6.7) |
//! | Stanford dragon 871,414 → 8,192 | 20.7 s | 3.23 s | 6.4 |
//! | the same, `GLIBC_TUNABLES=glibc.malloc.hugetlb=1` | 20.7 s | 2.99 s | 6.9 |
//!
//! The generated sample, best of three: 70,000 triangles 447 k/s, 250,000 336 k/s, a million 278 k/s.
//! The number of steps is linear (6.5 evaluations a collapse, at any size); a step waits longer for
//! memory where the mesh, 180 bytes a triangle with edges and queue, no longer fits the cache: the queue jumps to
//! another place of the mesh each time. Loading ahead what the queue hands out next
//! (`memoryless/ahead.rs`) took a sixth off the bunny, three tenths off the dragon. No order of
//! vertices and triangles helped: meshes sorted along a space-filling curve took as long.

#![allow(clippy::expect_used, reason = "a benchmark fails by panicking")]

use std::hint::black_box;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use lookalike::compare::sample_mesh;
use lookalike::memoryless::{Params, Scratch, Simplifier, placement, simplify};
use lookalike::mesh::{EdgeTable, EditMesh};
use lookalike::tape::{Tape, pack};

/// Triangles of the sample.
const SIZES: [usize; 3] = [70_000, 250_000, 1_000_000];
/// Bytes of a piece of tape.
const PIECE: usize = 1 << 20;

fn sample(n_faces: usize) -> EditMesh {
    EditMesh::new(sample_mesh(3, n_faces)).expect("the sample is sound")
}

/// Bytes for each triangle of the largest sample: the mesh, its edges and the queue, at their most.
fn memory(_: &mut Criterion) {
    let resident = |field: &str| {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find(|line| line.starts_with(field))?;
        line.split_whitespace().nth(1)?.parse::<u64>().ok()
    };
    let before = resident("VmRSS:");
    let mut mesh = sample(SIZES[2]);
    let n_faces = mesh.n_faces() as u64;
    // The peak from here on.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    simplify(&mut mesh, SIZES[2] as u32 / 52, &Params::default(), &mut |_| {
        ControlFlow::Continue(())
    });
    if let (Some(before), Some(peak)) = (before, resident("VmHWM:")) {
        println!("memory: {} bytes a triangle of {n_faces}", (peak - before) * 1024 / n_faces);
    }
}

fn simplification(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("memoryless");
    group.sample_size(10).measurement_time(Duration::from_secs(5));
    for n in SIZES {
        let mesh = sample(n);
        let (n_faces, target) = (mesh.n_faces() as u64, mesh.n_faces() as u32 / 52);
        group.throughput(Throughput::Elements(n_faces - u64::from(target)));
        group.bench_function(BenchmarkId::new("triangles_removed", n_faces), |bencher| {
            bencher.iter_batched_ref(
                || mesh.clone(),
                |mesh| {
                    let params = Params::default();
                    simplify(mesh, target, &params, &mut |_| ControlFlow::Continue(()))
                },
                BatchSize::PerIteration,
            );
        });
    }
    group.finish();
}

/// The same when all keys are on a tape: what an attempt does again that goes on from a checkpoint.
fn resumption(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("memoryless");
    group.sample_size(10).measurement_time(Duration::from_secs(5));
    for n in SIZES {
        let mesh = sample(n);
        let (n_faces, target) = (mesh.n_faces() as u64, mesh.n_faces() as u32 / 52);
        let params = Params::default();
        let run = |mesh: &mut EditMesh, tape: &Tape| {
            Simplifier::new(mesh, &params, tape).run_to(target, &mut |_| ControlFlow::Continue(()))
        };
        let pieces = Arc::new(Mutex::new(Vec::new()));
        let keep = Arc::clone(&pieces);
        let keeper = move |recorded: &mut Vec<u8>| {
            if recorded.len() > PIECE {
                keep.lock().expect("one thread").extend(pack(&std::mem::take(recorded)));
            }
        };
        run(&mut mesh.clone(), &Tape::new(Vec::new(), Box::new(keeper)));
        let pieces = pieces.lock().expect("one thread").clone();
        group.throughput(Throughput::Elements(n_faces - u64::from(target)));
        group.bench_function(BenchmarkId::new("triangles_removed_again", n_faces), |bencher| {
            bencher.iter_batched_ref(
                || (mesh.clone(), Tape::new(pieces.clone(), Box::new(|_| ()))),
                |(mesh, tape)| run(mesh, tape),
                BatchSize::PerIteration,
            );
        });
    }
    group.finish();
}

fn evaluation(criterion: &mut Criterion) {
    let mesh = sample(SIZES[0]);
    let edges = EdgeTable::new(&mesh);
    let ends: Vec<_> = edges.edges().map(|e| edges.ends(e)).collect();
    let (params, mut scratch) = (Params::default(), Scratch::default());
    let mut group = criterion.benchmark_group("placement");
    group.throughput(Throughput::Elements(ends.len() as u64));
    group.bench_function("all_edges", |bencher| {
        bencher.iter(|| {
            for &[a, b] in &ends {
                black_box(placement(&mesh, a, b, &params, &mut scratch));
            }
        });
    });
    group.finish();
}

criterion_group!(benches, memory, simplification, resumption, evaluation);
criterion_main!(benches);
