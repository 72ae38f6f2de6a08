//! Speed of memoryless simplification, one thread: triangles removed per second on generated
//! meshes of two sizes (the rate should hardly depend on the size), and the cost of one placement.
//!
//! For comparison, CGAL 5.5.1's `edge_collapse` with its Lindstrom–Turk policies, CPU clocks, on
//! the same machine (2 shared cores of an AMD EPYC, 2026-11-23) under heavy other load, so that
//! only the ratios mean anything, and those to about a tenth:
//!
//! | model | CGAL | this | ratio | how |
//! |---|---:|---:|---:|---|
//! | Stanford bunny 69,451 → 1,336 | 1.47 s | 0.200 s | 7.3 | best of 4, in alternation |
//! | the same, after the last change of layout | 2.04 s | 0.297 s | 6.9 | best of 4, in alternation |
//! | Stanford dragon 871,414 → 8,192 | 34.3 s | 4.87 s | 7.0 | one run of CGAL, best of 6, apart |
//!
//! The dragon cost 1.8 times as much per triangle as the bunny here (CGAL: 1.4 to 1.8 times).
//!
//! Memory latency bounds it: an edge that comes up after its surroundings changed touches about
//! twenty cache lines anywhere in the mesh. Huge pages (`GLIBC_TUNABLES=glibc.malloc.hugetlb=1`)
//! make large meshes about 20 % faster.

#![allow(clippy::expect_used, reason = "a benchmark fails by panicking")]

use std::hint::black_box;
use std::ops::ControlFlow;
use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use lookalike::memoryless::{Params, Scratch, placement, simplify};
use lookalike::mesh::{EdgeTable, EditMesh, shapes};

/// Grids of n × n/2 quads around a torus: 70 thousand and a million triangles.
const SIZES: [u32; 2] = [264, 1000];

fn simplification(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("memoryless");
    group.sample_size(10).measurement_time(Duration::from_secs(5));
    for n in SIZES {
        let mesh = EditMesh::new(shapes::torus(n, n / 2, 0.05)).expect("a torus is sound");
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

fn evaluation(criterion: &mut Criterion) {
    let mesh = EditMesh::new(shapes::torus(SIZES[0], SIZES[0] / 2, 0.05)).expect("sound");
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

criterion_group!(benches, simplification, evaluation);
criterion_main!(benches);
