//! A crash at each point between two durable steps, on both pairs of stores.
//!
//! One story goes through uploading, creating, claiming, appending, storing, completing, deleting and sweeping.
//! A process that lives it ends, as a kill would end it, at one of the points it passes; another one opens what
//! is left, finds what was acknowledged, and lives the story again: clients and workers repeat their calls.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{Write, stdout},
    process::{Command, Output},
    sync::atomic::{AtomicUsize, Ordering},
};

use super::{s3::S3, *};
use crate::jobs::{
    blobs::{Blob, BucketName},
    points::Point,
};

const DIR: &str = "LOOKALIKE_CRASH_DIR";
const DATABASE: &str = "LOOKALIKE_CRASH_DATABASE";
const BUCKET: &str = "LOOKALIKE_CRASH_BUCKET";
/// The number of the point, in the order in which they are passed, at which the process ends.
const AT: &str = "LOOKALIKE_CRASH_AT";
/// What the process before had acknowledged.
const ACKNOWLEDGED: &str = "LOOKALIKE_CRASH_ACKNOWLEDGED";

/// All points; the story passes each.
const POINTS: [Point; 28] = [
    Point::UploadStaged,
    Point::UploadNamed,
    Point::UploadListed,
    Point::UploadOwned,
    Point::CreateWritten,
    Point::CreateCommitted,
    Point::ClaimWritten,
    Point::ClaimCommitted,
    Point::SegmentStored,
    Point::AppendWritten,
    Point::AppendCommitted,
    Point::ArtifactStaged,
    Point::ArtifactNamed,
    Point::ArtifactWritten,
    Point::ArtifactCommitted,
    Point::PieceStaged,
    Point::PieceNamed,
    Point::PieceWritten,
    Point::PieceCommitted,
    Point::ResumeWritten,
    Point::ResumeCommitted,
    Point::CompleteWritten,
    Point::CompleteCommitted,
    Point::DeleteWritten,
    Point::DeleteCommitted,
    Point::ResultsForgotten,
    Point::ResultsRemoved,
    Point::MeshesForgotten,
];

/// Ends the process if it is meant to end here. Other tests pass on.
pub(in crate::jobs) fn pass(point: Point) {
    static PASSED: AtomicUsize = AtomicUsize::new(0);
    if std::env::var_os(DIR).is_none() {
        return;
    }
    say("passed", &format!("{point:?}"));
    if std::env::var(AT).is_ok_and(|at| at == PASSED.fetch_add(1, Ordering::Relaxed).to_string()) {
        std::process::abort();
    }
}

fn say(what: &str, text: &str) {
    // The runner of tests writes to the same line.
    println!("\n{what} {text}");
    stdout().flush().unwrap();
}

/// Where a story happens.
struct Stage {
    dir: TempDir,
    environment: Vec<(String, String)>,
}

impl Stage {
    fn on_sqlite() -> Self {
        Self { dir: tempfile::tempdir().unwrap(), environment: Vec::new() }
    }

    fn on_postgres(bucket: &S3, number: usize) -> Option<Self> {
        let mut environment = bucket.environment();
        environment.push((DATABASE.into(), database()?));
        environment.push((BUCKET.into(), format!("{}/{number}", S3::url())));
        Some(Self { dir: tempfile::tempdir().unwrap(), environment })
    }

    /// Lives the story in a process of its own.
    fn live(&self, crash_at: Option<usize>, acknowledged: &str) -> Output {
        let mut child = Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", "jobs::tests::crashes::story", "--ignored", "--nocapture"]);
        child.env(DIR, self.dir.path()).env(ACKNOWLEDGED, acknowledged);
        child.envs(self.environment.iter().cloned());
        crash_at.map(|at| child.env(AT, at.to_string()));
        child.output().unwrap()
    }
}

/// What a process has said of one kind.
fn said(output: &Output, what: &str) -> Vec<String> {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let lines = text.lines().filter_map(|line| line.strip_prefix(what)?.strip_prefix(' '));
    lines.map(str::to_owned).collect()
}

#[test]
fn a_crash_between_any_two_commit_points_on_sqlite() {
    rehearse(|_| Some(Stage::on_sqlite()));
}

#[test]
fn a_crash_between_any_two_commit_points_on_postgresql() {
    let bucket = S3::start();
    rehearse(|number| Stage::on_postgres(&bucket, number));
}

fn rehearse(stage: impl Fn(usize) -> Option<Stage>) {
    let Some(undisturbed) = stage(0) else { return };
    let output = undisturbed.live(None, "");
    assert!(output.status.success(), "{output:?}");
    let passed = said(&output, "passed");
    let distinct: BTreeSet<_> = passed.iter().cloned().collect();
    assert_eq!(distinct, POINTS.map(|point| format!("{point:?}")).into(), "points of the story");
    for (at, point) in passed.iter().enumerate() {
        let stage = stage(at + 1).unwrap();
        let crashed = stage.live(Some(at), "");
        assert!(!crashed.status.success(), "{point} ({at}): no crash");
        assert_eq!(said(&crashed, "passed"), passed[..=at], "{point} ({at})");
        let acknowledged = said(&crashed, "acknowledged").join("\n");
        let again = stage.live(None, &acknowledged);
        let told = || String::from_utf8_lossy(&again.stdout).into_owned();
        assert!(again.status.success(), "{point} ({at}), after {acknowledged}: {}", told());
    }
}

/// Who lives the story: clients and a worker, with what they were told before.
struct Actors {
    jobs: Jobs,
    /// By step.
    known: BTreeMap<String, String>,
}

#[tokio::test]
#[ignore = "a process that the rehearsals start"]
async fn story() {
    let known = std::env::var(ACKNOWLEDGED).unwrap_or_default();
    let pairs = known.lines().filter_map(|line| line.split_once(' '));
    let known = pairs.map(|(step, value)| (step.into(), value.into())).collect();
    let mut actors = Actors { jobs: open(Duration::from_hours(1)).await, known };
    actors.check_acknowledged().await;
    let id = actors.work().await;
    actors.delete_another().await;
    actors.sweep(&id).await;
    actors.forget_meshes(&id).await;
}

async fn open(keep_meshes: Duration) -> Jobs {
    let variable = |name| std::env::var(name).ok();
    let places = Places {
        data_dir: variable(DIR).unwrap().into(),
        database: variable(DATABASE).map(|url| Address::parse(&url).unwrap()),
        bucket: variable(BUCKET).map(|url| BucketName::parse(&url).unwrap()),
    };
    let keep_results = Some(Duration::ZERO);
    let limits = Limits { keep_meshes, keep_results, ..Limits::default() };
    let jobs = Jobs::open(places, Terms::default(), limits).await.unwrap();
    jobs.sweep_orphans().await.unwrap();
    jobs
}

/// What the first attempt leaves to the second.
const PIECE: &[u8] = b"what was found out so far";

fn chunk() -> Vec<u8> {
    (0..300_000_u32).flat_map(u32::to_le_bytes).collect()
}

fn reports() -> Vec<Report> {
    let records = |first| Report::Records { level: None, first, count: 5, bytes: chunk() };
    vec![Report::Note { code: "A".into(), text: "b".into() }, records(0), records(5)]
}

impl Actors {
    fn acknowledge(&mut self, step: &str, value: &str) {
        say("acknowledged", &format!("{step} {value}"));
        self.known.insert(step.into(), value.into());
    }

    /// What was acknowledged is there, before anybody repeats a call.
    async fn check_acknowledged(&self) {
        let jobs = &self.jobs;
        for (step, value) in &self.known {
            match step.as_str() {
                "mesh" => {
                    assert!(jobs.find_mesh(LOCAL, value).await.unwrap().is_some());
                    assert!(jobs.0.blobs.has_mesh(value).await.unwrap());
                }
                "job" => drop(jobs.job(value).await.unwrap()),
                "claim-1" | "claim-2" => {
                    let epoch = jobs.job(&self.known["job"]).await.unwrap().epoch;
                    assert!(epoch >= value.parse().unwrap());
                }
                "events" => {
                    let stored = jobs.0.store.events(&self.known["job"], 0, 100).await.unwrap();
                    assert_eq!(stored.iter().filter(|event| event.bytes.is_some()).count(), 2);
                }
                "completed" => {
                    assert_eq!(jobs.job(value).await.unwrap().state, State::Succeeded);
                }
                "deleted" => {
                    assert!(matches!(jobs.job(value).await, Err(Error::NotFound(_))));
                }
                "swept" => assert!(jobs.job(value).await.unwrap().results_removed),
                _ => {}
            }
        }
    }

    /// A job from its mesh to its end, in two attempts; its id.
    async fn work(&mut self) -> String {
        let id = self.create("a job", "mesh", "job").await;
        if self.jobs.job(&id).await.unwrap().attempt < 2 {
            let first = self.claim(&id, "claim-1").await;
            self.store(&first, b"of the first attempt").await;
            let next = self.jobs.resume(&first, "b").await.unwrap().len() as u32;
            let piece = bytes_of(&[PIECE]);
            self.jobs.put_piece(&first, (next, "b"), &Announced::default(), piece).await.unwrap();
            self.acknowledge("piece", &id);
            let released = Outcome::Released("told to".into());
            drop(self.jobs.complete(&first, &released).await.unwrap());
        }
        let job = self.jobs.job(&id).await.unwrap();
        if job.state != State::Succeeded {
            let second = self.claim(&id, "claim-2").await;
            let n_pieces = self.jobs.resume(&second, "b").await.unwrap().len();
            assert!(n_pieces > 0 || !self.known.contains_key("piece"), "the checkpoint is lost");
            for blob in self.jobs.checkpoint(&second).await.unwrap() {
                let chunks = blob.read(0, u64::MAX).await.unwrap();
                assert_eq!(chunks.try_collect::<Vec<_>>().await.unwrap().concat(), PIECE);
            }
            let appended = self.jobs.append(&second, 0, reports()).await.unwrap();
            assert_eq!(appended.held, 3);
            self.acknowledge("events", "3");
            self.store(&second, b"of the second attempt").await;
            let done = Outcome::Succeeded(vec!["lod-0.glb".into()]);
            let (ended, _) = self.jobs.complete(&second, &done).await.unwrap();
            self.acknowledge("completed", &id);
            // Its answer is lost, and the worker asks again.
            let (again, is_new) = self.jobs.complete(&second, &done).await.unwrap();
            assert_eq!((again.epoch, is_new), (ended.epoch, false));
        }
        self.check_log(&id).await;
        id
    }

    async fn create(&mut self, request_id: &str, mesh_step: &str, job_step: &str) -> String {
        let new = new_job(&self.jobs, request_id).await;
        self.acknowledge(mesh_step, &new.mesh);
        let id = self.jobs.create(new, vec![]).await.unwrap().id;
        if let Some(known) = self.known.get(job_step) {
            assert_eq!(&id, known, "the same request made another job");
        }
        self.acknowledge(job_step, &id);
        id
    }

    /// The lease that the worker was given, or that it asks for. A worker that asks again has dropped what it had.
    async fn claim(&mut self, id: &str, step: &str) -> Lease {
        let job = self.jobs.job(id).await.unwrap();
        let held = self.known.get(step).filter(|epoch| **epoch == job.epoch.to_string());
        if held.is_some() && job.state == State::Running {
            return Lease { job: id.into(), epoch: job.epoch, worker: "w".into() };
        }
        let (job, lease) = claim(&self.jobs, "w").await.unwrap();
        assert_eq!(job.id, id);
        self.acknowledge(step, &job.epoch.to_string());
        lease
    }

    async fn store(&self, lease: &Lease, bytes: &'static [u8]) {
        let artifact = Artifact {
            file: "lod-0.glb".into(),
            media_type: "model/gltf-binary".into(),
            size: bytes.len() as u64,
            blake3: blake3::hash(bytes).to_hex().to_string(),
        };
        self.jobs.put_artifact(lease, artifact, bytes_of(&[bytes])).await.unwrap();
    }

    /// No gaps, one success, and the records of the attempt that counts, with their bytes.
    async fn check_log(&self, id: &str) {
        let log = log_of(&self.jobs, id).await;
        assert!(log.iter().map(|event| event.seq).eq(1..=log.len() as u64), "{log:?}");
        let is_end = |event: &&Event| event.body.state().is_some_and(State::is_final);
        assert_eq!(log.iter().filter(is_end).count(), 1);
        let epoch = log.last().unwrap().epoch;
        let of_attempt = log.iter().filter(|event| event.epoch == epoch);
        let told: Vec<_> = of_attempt
            .filter_map(|event| match &event.body {
                Body::Worker(report) => Some(report.clone()),
                Body::Server(_) => None,
            })
            .collect();
        assert!(told == reports(), "the records of the last attempt are not whole");
    }

    /// Another job, which fails and is deleted.
    async fn delete_another(&mut self) {
        if self.known.contains_key("deleted") {
            return;
        }
        let id = match self.known.get("doomed") {
            Some(id) => id.clone(),
            None => self.create("a doomed job", "mesh", "doomed").await,
        };
        let state = match self.jobs.job(&id).await {
            // Deleted, and the answer lost.
            Err(Error::NotFound(_)) => None,
            job => Some(job.unwrap().state),
        };
        if state.is_some_and(|state| !state.is_final()) {
            let lease = self.claim(&id, "claim-doomed").await;
            self.store(&lease, b"in vain").await;
            let outcome = Outcome::Failed("EMPTY".into(), "no triangles".into());
            drop(self.jobs.complete(&lease, &outcome).await.unwrap());
        }
        if state.is_some() {
            self.jobs.delete(&id).await.unwrap();
        }
        self.acknowledge("deleted", &id);
    }

    /// The results of the job can be read, until their time is up; then nothing is left of them.
    async fn sweep(&mut self, id: &str) {
        if !self.jobs.job(id).await.unwrap().results_removed {
            let (artifact, blob) = self.jobs.artifact(id, "lod-0.glb").await.unwrap();
            let chunks = blob.read(0, artifact.size).await.unwrap();
            let bytes = chunks.try_collect::<Vec<_>>().await.unwrap().concat();
            assert_eq!(bytes, b"of the second attempt");
        }
        self.jobs.sweep_results().await.unwrap();
        self.jobs.sweep_checkpoints().await.unwrap();
        self.acknowledge("swept", id);
        let job = self.jobs.job(id).await.unwrap();
        assert!(job.results_removed);
        for epoch in 1..=job.epoch {
            let blobs = &self.jobs.0.blobs;
            let artifact = blobs.artifact(id, epoch, "lod-0.glb", 1);
            assert!(!is_there(&artifact).await, "the artifact of epoch {epoch} is still there");
            for n in 0..2 {
                let piece = blobs.piece(id, epoch, n, 1);
                assert!(!is_there(&piece).await, "a piece of epoch {epoch} is still there");
            }
        }
        self.check_log(id).await;
    }

    /// A start that removes the meshes that no job names; whoever wants one uploads it again. Of the jobs one
    /// is left.
    async fn forget_meshes(self, id: &str) {
        let unwanted = || bytes_of(&[b"nobody wants it"]);
        let announced = Announced::default;
        let mesh = self.jobs.put_mesh(LOCAL, announced(), unwanted()).await.unwrap();
        self.jobs.close().await;
        drop(self.jobs);
        let jobs = open(Duration::ZERO).await;
        assert!(jobs.find_mesh(LOCAL, &mesh.hash).await.unwrap().is_none());
        jobs.put_mesh(LOCAL, announced(), unwanted()).await.unwrap();
        assert!(jobs.0.blobs.has_mesh(&mesh.hash).await.unwrap());
        assert_eq!(jobs.0.blobs.jobs().await.unwrap(), [id.to_owned()]);
        assert_eq!(jobs.list(&Filter::default(), None, 10).await.unwrap().len(), 1);
    }
}

async fn is_there(blob: &Blob) -> bool {
    match blob.read(0, 1).await {
        Ok(chunks) => chunks.try_collect::<Vec<_>>().await.is_ok(),
        Err(_) => false,
    }
}
