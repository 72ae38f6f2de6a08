//! What a claim costs, by how many jobs one owner has queued: it should not matter.
//!
//! A claim by a worker of a job that is handed back at once, SQLite, while another owner has ten jobs queued. With
//! `QUEUE_DATABASE=postgres://…` (an empty database) the same on PostgreSQL.

#![allow(clippy::expect_used, reason = "a benchmark fails by panicking")]

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use lookalike::jobs::{
    Limits,
    lease::{Lease, Terms},
    spec::Spec,
    store::{Address, NewJob, Outcome, Store},
};
use tokio::runtime::Runtime;

/// Jobs that one owner has queued.
const SIZES: [usize; 4] = [10, 100, 1_000, 10_000];

async fn fill(store: &Store, owner: &str, from: usize, to: usize) {
    let mesh = blake3::hash(b"mesh").to_hex().to_string();
    store.lock_mesh(&mesh).await.expect("a lock").add(4).await.expect("a mesh");
    for i in from..to {
        let new = NewJob {
            owner: owner.into(),
            request_id: String::new(),
            mesh: mesh.clone(),
            file_name: "a.ply".into(),
            spec: Spec::new(vec![5]),
            priority: 0,
            labels: std::collections::BTreeMap::default(),
            webhook: String::new(),
            trace: String::new(),
        };
        let id = format!("{owner}{i}");
        store.create(&id, &new, &Limits::default()).await.expect("a job");
    }
}

async fn claim_and_hand_back(store: &Store) {
    let job = store.claim("w", &Terms::default()).await.expect("a claim").job;
    let job = job.expect("no refusal").expect("a job");
    let lease = Lease { job: job.id, epoch: job.epoch, worker: "w".into() };
    store.complete(&lease, &Outcome::Released(String::new()), 3).await.expect("an end");
}

fn claims(criterion: &mut Criterion) {
    let runtime = Runtime::new().expect("a runtime");
    let folder = tempfile::tempdir().expect("a folder");
    let address = std::env::var("QUEUE_DATABASE").map_or_else(
        |_| Address::file(&folder.path().join("jobs.sqlite3")).expect("a path"),
        |url| Address::parse(&url).expect("an address"),
    );
    let store = runtime.block_on(Store::open(&address)).expect("a database");
    runtime.block_on(fill(&store, "bob", 0, 10));
    let mut group = criterion.benchmark_group("claim");
    group.sample_size(50);
    let mut n_queued = 0;
    for n in SIZES {
        runtime.block_on(fill(&store, "ann", n_queued, n));
        n_queued = n;
        group.bench_function(BenchmarkId::new("queued", n), |bencher| {
            bencher.iter(|| runtime.block_on(claim_and_hand_back(&store)));
        });
    }
    group.finish();
}

criterion_group!(benches, claims);
criterion_main!(benches);
