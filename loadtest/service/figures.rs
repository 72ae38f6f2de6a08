//! Latency from submission to claim, submissions, batches of events, replay; and pgbench beside them.

use std::{
    process::Command,
    time::{Duration, Instant},
};

use futures::{StreamExt, stream};
use lookalike::{
    jobs::event::{EnergySample, Report},
    service::{
        auth::Secret,
        client::{Access, Connection, connection},
        convert::report_to_wire,
        proto::{
            v1,
            worker::v1::{self as wire, worker_service_client::WorkerServiceClient},
        },
    },
};
use tokio::task::JoinSet;

use crate::{
    Figures, Size,
    page::Row,
    quantile,
    stores::Stores,
    support::{Client, Server, create, create_request, small_torus, upload},
};

type Worker = WorkerServiceClient<Connection>;

/// A worker that says who it is, or nothing.
pub(crate) fn worker_as(server: &Server, token: Option<&str>) -> Worker {
    let access = Access { token: token.map(Secret::new), ..Access::default() };
    WorkerServiceClient::new(connection(&server.url, &access).unwrap())
}

/// Clients that submit at once, and workers that report at once.
const N_CLIENTS: usize = 16;
const N_WORKERS: usize = 8;
/// A connection has room for 256 calls.
const WATCHERS_OF_ONE: usize = 200;
/// What is measured is what the server can do, not what it lets one principal do.
const UNLIMITED: &str = "--max-requests-per-sec=1000000";
/// As the pipeline makes them: records of a chunk, and bytes of a record.
const RECORDS: u32 = 512;
const RECORD_BYTES: usize = 12;

/// All figures of a pair of stores.
pub(crate) async fn take(stores: &mut Stores, size: Size) -> Figures {
    let mut rows = Vec::new();
    let mut add = |what, value: f64, asked| {
        eprintln!("{what}: {value:.1}");
        rows.push(Row { what, value, asked });
    };
    let server = stores.server(&[UNLIMITED]);
    let waits = latency(&server, size.n_single).await;
    add("submission to claim, idle, p50 (ms)", quantile(waits.clone(), 0.5), "");
    add("submission to claim, idle, p99 (ms)", quantile(waits, 0.99), "< 50");
    let asked = "500 and 300";
    let server = stores.server(&[UNLIMITED]);
    let rate = submissions(&server, size.n_jobs).await;
    add("submissions a second, 16 clients", rate, asked);
    add("the same, processor time of the server each (ms)", busy(&server) / size.n_jobs as f64, "");
    let server = stores.server(&[UNLIMITED]);
    let asked = "1,000 and 300";
    let rate = batches(&server, size.n_batches, &progress()).await;
    add("batches of 10 events a second, 8 workers", rate, asked);
    let n_batches = (N_WORKERS as u64 * size.n_batches) as f64;
    add("the same, processor time of the server each (ms)", busy(&server) / n_batches, "");
    let rate = batches(&server, size.n_batches, &records()).await;
    add("batches of 10 events with 512 records a second", rate, "");
    let (rate, mib) = replay(&server, size.n_chunks).await;
    add("replayed records a second, one client", rate, "500,000");
    add("the same in MiB a second", mib, "");
    let server = stores.server(&[UNLIMITED, "--max-streams=10000"]);
    let (n_watchers, waits, kib) = watch(&server, size.n_watchers).await;
    add("streams that watch one job", n_watchers, "thousands");
    add("until the half of them has an entry of the log (ms)", quantile(waits.clone(), 0.5), "");
    add("until the last one has it (ms)", quantile(waits, 1.0), "");
    add("memory of the server for each (KiB)", kib, "");
    if let Stores::Shared { cluster, .. } = stores {
        add(
            "pgbench, 8 clients: transactions a second",
            bench(&cluster.create(), size.bench_secs),
            "",
        );
    }
    (stores.name(), rows)
}

/// Milliseconds of processor time that a server has taken so far: other builds on the machine do not change it
/// much.
fn busy(server: &Server) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", server.pid())).unwrap();
    let fields = stat.rsplit_once(')').unwrap().1.split_whitespace();
    // utime and stime, in hundredths of a second.
    fields.skip(11).take(2).map(|ticks| ticks.parse::<f64>().unwrap() * 10.0).sum()
}

/// Milliseconds from the beginning of each submission until a waiting worker has the job.
async fn latency(server: &Server, n: usize) -> Vec<f64> {
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    let mut waits = Vec::with_capacity(n);
    for _ in 0..n {
        let mut worker = worker_as(server, None);
        let mut claimant = JoinSet::new();
        claimant.spawn(async move {
            let assignment = worker.claim(claim("w")).await.unwrap().into_inner().assignment;
            let claimed = Instant::now();
            worker.complete(failed(assignment.unwrap().lease)).await.unwrap();
            claimed
        });
        // The worker is waiting by then.
        tokio::time::sleep(Duration::from_millis(50)).await;
        let submitted = Instant::now();
        client.create_job(create_request(&mesh, "")).await.unwrap();
        let claimed = claimant.join_next().await.unwrap().unwrap();
        waits.push((claimed - submitted).as_secs_f64() * 1e3);
    }
    waits
}

fn claim(worker: &str) -> wire::ClaimRequest {
    let version = env!("CARGO_PKG_VERSION").into();
    wire::ClaimRequest { worker: worker.into(), version, wait_secs: 20.0, ..Default::default() }
}

fn failed(lease: Option<wire::Lease>) -> wire::CompleteRequest {
    let failed = wire::Failed { reason: "LOAD".into(), text: "a test of load".into() };
    wire::CompleteRequest { lease, outcome: Some(wire::complete_request::Outcome::Failed(failed)) }
}

/// Jobs a second, submitted by many clients, each on its own connection.
async fn submissions(server: &Server, n: usize) -> f64 {
    let mesh = upload(&mut server.client(), small_torus()).await;
    let clients: Vec<Client> = (0..N_CLIENTS).map(|_| server.client()).collect();
    let start = Instant::now();
    let submissions = (0..n).map(|i| {
        let mut client = clients[i % N_CLIENTS].clone();
        let request = create_request(&mesh, &format!("load-{i}"));
        async move { client.create_job(request).await.unwrap() }
    });
    let done = stream::iter(submissions).buffer_unordered(N_CLIENTS).count().await;
    let rate = done as f64 / start.elapsed().as_secs_f64();
    let counted = server.client().list_jobs(v1::ListJobsRequest::default()).await.unwrap();
    assert!(!counted.into_inner().jobs.is_empty() && done == n);
    rate
}

/// Ten points of the energy curve.
fn progress() -> Vec<Report> {
    let sample = |i| EnergySample {
        stage: "image".into(),
        evaluations: i,
        seconds: 0.1,
        triangles: 1000,
        energy: Some(123_456_789),
        d2: Some(1.25),
        level: None,
        energy_ratio: None,
        d2_unseen: None,
        turn: None,
    };
    (0..10).map(|i| Report::Sample(sample(i))).collect()
}

/// The same with a chunk of records in place of one.
fn records() -> Vec<Report> {
    let mut reports = progress();
    reports[0] = chunk(0);
    reports
}

fn chunk(first: u64) -> Report {
    let mut bytes = vec![0; RECORDS as usize * RECORD_BYTES];
    blake3::Hasher::new().update(&first.to_le_bytes()).finalize_xof().fill(&mut bytes);
    Report::Records { level: None, first, count: RECORDS, bytes }
}

/// Batches a second of workers that each have a job and wait for each answer.
async fn batches(server: &Server, n_batches: u64, reports: &[Report]) -> f64 {
    let mut leases = Vec::new();
    for i in 0..N_WORKERS {
        leases.push(lease(server.client(), worker_as(server, None), i).await);
    }
    let start = Instant::now();
    let mut workers = JoinSet::new();
    for lease in leases {
        let mut worker = worker_as(server, None);
        let reports = reports.to_vec();
        workers.spawn(async move {
            for i in 0..n_batches {
                let held = append(&mut worker, &lease, i * reports.len() as u64, &reports).await;
                assert_eq!(held, (i + 1) * reports.len() as u64);
            }
            worker.complete(failed(Some(lease))).await.unwrap();
        });
    }
    workers.join_all().await;
    (N_WORKERS as u64 * n_batches) as f64 / start.elapsed().as_secs_f64()
}

async fn lease(mut client: Client, mut worker: Worker, i: usize) -> wire::Lease {
    let mesh = upload(&mut client, small_torus()).await;
    client.create_job(create_request(&mesh, "")).await.unwrap();
    let claimed = worker.claim(claim(&format!("w{i}"))).await.unwrap().into_inner();
    claimed.assignment.unwrap().lease.unwrap()
}

async fn append(
    worker: &mut Worker,
    lease: &wire::Lease,
    first_index: u64,
    reports: &[Report],
) -> u64 {
    let events = reports.iter().cloned().map(report_to_wire);
    let events = events.map(|body| wire::WorkerEvent { body: Some(body) }).collect();
    let request = wire::AppendEventsRequest { lease: Some(lease.clone()), first_index, events };
    worker.append_events(request).await.unwrap().into_inner().appended
}

/// Claims the job that waits, fills its log with chunks of records, and ends it; its name.
pub(crate) async fn write_long_log(mut worker: Worker, n_chunks: u64) -> String {
    let claimed = worker.claim(claim("w0")).await.unwrap().into_inner();
    let lease = claimed.assignment.unwrap().lease.unwrap();
    for batch in 0..n_chunks / 50 {
        let chunks = (0..50).map(|i| chunk((batch * 50 + i) * u64::from(RECORDS)));
        append(&mut worker, &lease, batch * 50, &chunks.collect::<Vec<_>>()).await;
    }
    let name = lease.job.clone();
    worker.complete(failed(Some(lease))).await.unwrap();
    name
}

/// Records and mebibytes a second that one client receives of a log that has ended.
async fn replay(server: &Server, n_chunks: u64) -> (f64, f64) {
    create(&mut server.client()).await;
    let name = write_long_log(worker_as(server, None), n_chunks).await;
    let mut client = server.client();
    let start = Instant::now();
    let watch = v1::WatchJobRequest { name, after_seq: 0 };
    let mut events = client.watch_job(watch).await.unwrap().into_inner();
    let (mut n_records, mut n_bytes) = (0, 0);
    while let Some(answer) = events.message().await.unwrap() {
        if let Some(v1::job_event::Body::RecordChunk(chunk)) = answer.event.unwrap().body {
            n_records += u64::from(chunk.count);
            n_bytes += chunk.data.len();
        }
    }
    assert_eq!(n_records, n_chunks / 50 * 50 * u64::from(RECORDS));
    let secs = start.elapsed().as_secs_f64();
    (n_records as f64 / secs, n_bytes as f64 / secs / f64::from(1 << 20))
}

/// Streams that watch a job at which something happens once: how many, milliseconds until each has heard of it, and
/// what one costs the server.
async fn watch(server: &Server, n: usize) -> (f64, Vec<f64>, f64) {
    let mut worker = worker_as(server, None);
    let lease = lease(server.client(), worker_as(server, None), 0).await;
    let before = resident_kib(server);
    let mut streams = Vec::with_capacity(n);
    while streams.len() < n {
        let mut client = server.client();
        for _ in 0..WATCHERS_OF_ONE.min(n - streams.len()) {
            let watch = v1::WatchJobRequest { name: lease.job.clone(), after_seq: 1 };
            let mut stream = client.watch_job(watch).await.unwrap().into_inner();
            // Its start, which has happened before.
            stream.message().await.unwrap().unwrap();
            streams.push(stream);
        }
    }
    let kib = (resident_kib(server) - before) / n as f64;
    let start = Instant::now();
    let mut watchers = JoinSet::new();
    for mut stream in streams {
        watchers.spawn(async move {
            stream.message().await.unwrap().unwrap();
            start.elapsed().as_secs_f64() * 1e3
        });
    }
    append(&mut worker, &lease, 0, &progress()[..1]).await;
    let waits = watchers.join_all().await;
    worker.complete(failed(Some(lease))).await.unwrap();
    (n as f64, waits, kib)
}

fn resident_kib(server: &Server) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.pid())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

/// PostgreSQL's own benchmark (TPC-B-like), for scale: transactions a second. NaN where it is missing.
fn bench(url: &str, secs: u32) -> f64 {
    let run = |args: &[&str]| {
        let output = Command::new("pgbench").args(args).arg(url).output().ok()?;
        Some(String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let secs = secs.to_string();
    let _ = run(&["-i", "-q", "-s", "10"]);
    let told = run(&["-c", "8", "-j", "2", "-T", &secs]).unwrap_or_default();
    let tps = told.lines().find_map(|line| line.strip_prefix("tps = ")?.split(' ').next());
    tps.and_then(|tps| tps.parse().ok()).unwrap_or(f64::NAN)
}
