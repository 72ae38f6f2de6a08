//! The data directory as a whole: a random walk against a model, leases, logs, restarts.

use std::{collections::BTreeMap, path::Path, time::Duration};

use futures::TryStreamExt;
use proptest::prelude::*;
use tokio::{runtime::Runtime, sync::mpsc};
use tokio_util::bytes::Bytes;

use super::{
    clients::{Announced, StoredMesh},
    error::Error,
    event::{Body, Event, Report, ServerEvent},
    lease::Lease,
    principal::LOCAL,
    spec::Spec,
    state::State,
    store::{Artifact, NewJob, Outcome},
    *,
};

async fn open(dir: &Path) -> Jobs {
    let terms = Terms { lease: Duration::from_mins(1), ..Terms::default() };
    Jobs::open(dir, terms, Limits::default()).await.unwrap()
}

fn bytes_of(chunks: &[&'static [u8]]) -> mpsc::Receiver<Bytes> {
    let (send, receive) = mpsc::channel(8);
    for chunk in chunks {
        send.try_send(Bytes::from_static(chunk)).unwrap();
    }
    receive
}

async fn put_mesh(jobs: &Jobs, owner: &str) -> StoredMesh {
    let chunks = bytes_of(&[b"a ", b"mesh"]);
    jobs.put_mesh(owner, Announced::default(), chunks).await.unwrap()
}

async fn new_job(jobs: &Jobs, request_id: &str) -> NewJob {
    let mesh = put_mesh(jobs, LOCAL).await.hash;
    let (request_id, file_name) = (request_id.into(), "a.ply".into());
    NewJob { owner: LOCAL.into(), request_id, mesh, file_name, spec: Spec::new(vec![5]) }
}

async fn create(jobs: &Jobs) -> Job {
    let new = new_job(jobs, "").await;
    jobs.create(new, vec![]).await.unwrap()
}

async fn claim(jobs: &Jobs, worker: &str) -> Option<(Job, Lease)> {
    let job = jobs.claim(worker, Duration::ZERO).await.unwrap()?;
    let lease = Lease { job: job.id.clone(), epoch: job.epoch, worker: worker.into() };
    Some((job, lease))
}

async fn log_of(jobs: &Jobs, id: &str) -> Vec<Event> {
    jobs.follow(id, 0).try_collect().await.unwrap()
}

fn note(text: &str) -> Report {
    Report::Note { code: "NOTE".into(), text: text.into() }
}

async fn put(jobs: &Jobs, lease: &Lease, file: &str, bytes: &'static [u8]) -> error::Result<()> {
    let (file, media_type) = (file.into(), "text/plain".into());
    let blake3 = blake3::hash(bytes).to_hex().to_string();
    let artifact = Artifact { file, media_type, size: bytes.len() as u64, blake3 };
    jobs.put_artifact(lease, artifact, bytes_of(&[bytes])).await
}

#[tokio::test]
async fn a_job_from_creation_to_its_artifacts() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let job = create(&jobs).await;
    let (_, lease) = claim(&jobs, "w").await.unwrap();
    let records =
        |first: u64, byte| Report::Records { level: None, first, count: 1, bytes: vec![byte; 9] };
    jobs.append(&lease, 0, vec![note("a"), records(0, 7), records(1, 8)]).await.unwrap();
    // The same batch again, and one that overlaps it.
    jobs.append(&lease, 0, vec![note("a"), records(0, 7), records(1, 8)]).await.unwrap();
    let held = jobs.append(&lease, 2, vec![records(1, 8), note("b")]).await.unwrap().held;
    assert_eq!(held, 4);
    let gap = jobs.append(&lease, 9, vec![note("c")]).await;
    assert!(matches!(gap, Err(Error::Gap { first: 9, held: 4 })));
    put(&jobs, &lease, "x", b"1").await.unwrap();
    assert_eq!(jobs.artifacts(&job.id).await.unwrap(), []);
    let missing = jobs.complete(&lease, &Outcome::Succeeded(vec!["y".into()])).await;
    assert!(matches!(missing, Err(Error::Invalid(_))));
    let done = Outcome::Succeeded(vec!["x".into()]);
    jobs.complete(&lease, &done).await.unwrap();
    jobs.complete(&lease, &done).await.unwrap();
    let (artifact, path) = jobs.artifact(&job.id, "x").await.unwrap();
    assert_eq!((artifact.size, fs::read(path).unwrap().as_slice()), (1, b"1".as_slice()));
    let log = log_of(&jobs, &job.id).await;
    assert_eq!(log.iter().map(|event| event.seq).collect::<Vec<_>>(), (1..=7).collect::<Vec<_>>());
    let reports: Vec<_> = log.into_iter().map(|event| event.body).collect();
    let wanted = [note("a"), records(0, 7), records(1, 8), note("b")].map(Body::Worker);
    assert_eq!(reports[2..6], wanted);
}

#[tokio::test]
async fn a_stale_lease_can_write_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let job = create(&jobs).await;
    let (_, old) = claim(&jobs, "w").await.unwrap();
    jobs.worker_gone("w").await.unwrap();
    for reclaimed in [false, true] {
        if reclaimed {
            claim(&jobs, "v").await.unwrap();
        }
        let outcome = Outcome::Succeeded(vec![]);
        let refusals = [
            jobs.heartbeat(&old).await.err(),
            jobs.input(&old, "").await.err(),
            jobs.append(&old, 0, vec![note("late")]).await.err(),
            put(&jobs, &old, "x", b"1").await.err(),
            jobs.complete(&old, &outcome).await.err(),
        ];
        for refusal in refusals {
            assert!(matches!(refusal, Some(Error::Stale { .. })), "{refusal:?}");
        }
    }
    assert_eq!(jobs.job(&job.id).await.unwrap().state, State::Running);
    jobs.cancel(&job.id).await.unwrap();
    jobs.worker_gone("v").await.unwrap();
    jobs.delete(&job.id).await.unwrap();
    assert!(matches!(jobs.heartbeat(&old).await, Err(Error::Stale { .. })));
}

#[tokio::test]
async fn lost_attempts_are_told_and_poison_in_the_end() {
    let dir = tempfile::tempdir().unwrap();
    let terms = Terms { lease: Duration::from_millis(1), ..Terms::default() };
    let jobs = Jobs::open(dir.path(), terms, Limits::default()).await.unwrap();
    let job = create(&jobs).await;
    for attempt in 1..=3 {
        let (claimed, lease) = claim(&jobs, "w").await.unwrap();
        assert_eq!((claimed.attempt, claimed.epoch), (attempt, u64::from(attempt)));
        jobs.append(&lease, 0, vec![note("work")]).await.unwrap();
        tokio::time::sleep(Duration::from_millis(5)).await;
        assert_eq!(jobs.sweep_leases().await.unwrap().len(), 1);
    }
    let job = jobs.job(&job.id).await.unwrap();
    assert_eq!((job.state, job.failure.0.as_str()), (State::Failed, "POISONED"));
    let log = log_of(&jobs, &job.id).await;
    let restarts: Vec<_> = log
        .iter()
        .filter_map(|event| match &event.body {
            Body::Server(ServerEvent::Restarted { rewind_to_seq, reason, .. }) => {
                Some((*rewind_to_seq, reason.as_str()))
            }
            _ => None,
        })
        .collect();
    assert_eq!(restarts, [(1, "LEASE_EXPIRED"); 2]);
}

#[tokio::test]
async fn handing_back_and_server_restarts_do_not_poison() {
    let dir = tempfile::tempdir().unwrap();
    let mut jobs = open(dir.path()).await;
    let id = create(&jobs).await.id;
    for _ in 0..3 {
        let (_, lease) = claim(&jobs, "w").await.unwrap();
        jobs.complete(&lease, &Outcome::Released("drained".into())).await.unwrap();
        claim(&jobs, "v").await.unwrap();
        // The lock file of `v` is there and nobody holds it: `v` died with the server.
        fs::write(jobs.worker_lock("v"), "").unwrap();
        jobs.close().await;
        drop(jobs);
        jobs = open(dir.path()).await;
        assert!(!jobs.worker_lock("v").exists());
    }
    let job = jobs.job(&id).await.unwrap();
    assert_eq!((job.state, job.attempt, job.lost), (State::Queued, 6, 0));
}

#[tokio::test]
async fn workers_that_outlive_the_server_keep_their_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    create(&jobs).await;
    let alive = File::create(jobs.worker_lock("w")).unwrap();
    alive.try_lock().unwrap();
    let (_, lease) = claim(&jobs, "w").await.unwrap();
    let (_, remote) = {
        create(&jobs).await;
        claim(&jobs, "far-away").await.unwrap()
    };
    assert!(matches!(
        Jobs::open(dir.path(), Terms::default(), Limits::default()).await,
        Err(Error::InUse(_))
    ));
    jobs.close().await;
    drop(jobs);
    let jobs = open(dir.path()).await;
    assert!(!jobs.heartbeat(&lease).await.unwrap());
    assert!(!jobs.heartbeat(&remote).await.unwrap());
    // The process that held the lock ends; that of the other worker cannot be seen from here.
    assert_eq!(jobs.sweep_leases().await.unwrap(), []);
    drop(alive);
    assert_eq!(jobs.sweep_leases().await.unwrap().len(), 1);
    assert!(jobs.heartbeat(&lease).await.is_err());
    assert!(!jobs.heartbeat(&remote).await.unwrap());
}

#[tokio::test]
async fn a_worker_that_asks_again_has_dropped_its_job() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let id = create(&jobs).await.id;
    let (_, first) = claim(&jobs, "w").await.unwrap();
    let (again, _) = claim(&jobs, "w").await.unwrap();
    assert_eq!((again.id, again.epoch, again.lost), (id, 2, 1));
    assert!(jobs.heartbeat(&first).await.is_err());
}

#[tokio::test]
async fn cancelled_jobs_keep_what_was_stored() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let queued = create(&jobs).await.id;
    // Only the first call ends it.
    for ends in [true, false] {
        let (job, has_ended) = jobs.cancel(&queued).await.unwrap();
        assert_eq!((job.state, has_ended), (State::Cancelled, ends));
    }
    let id = create(&jobs).await.id;
    let (_, lease) = claim(&jobs, "w").await.unwrap();
    let unasked = jobs.complete(&lease, &Outcome::Cancelled).await;
    assert!(matches!(unasked, Err(Error::Illegal { .. })));
    put(&jobs, &lease, "lod-0.glb", b"whole").await.unwrap();
    assert!(jobs.cancel(&id).await.unwrap().0.cancel_requested);
    assert!(jobs.append(&lease, 0, vec![note("x")]).await.unwrap().cancel_requested);
    assert!(jobs.heartbeat(&lease).await.unwrap());
    jobs.complete(&lease, &Outcome::Cancelled).await.unwrap();
    assert_eq!(jobs.artifacts(&id).await.unwrap().len(), 1);
    jobs.delete(&id).await.unwrap();
    assert!(matches!(jobs.job(&id).await, Err(Error::NotFound(_))));
    assert!(!dir.path().join("objects/jobs").join(&id).exists());
}

#[tokio::test]
async fn requests_are_idempotent_and_checked_as_a_whole() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let new = new_job(&jobs, "r").await;
    let first = jobs.create(new.clone(), vec![]).await.unwrap();
    assert_eq!(jobs.create(new.clone(), vec![]).await.unwrap(), first);
    let other = NewJob { spec: Spec::new(vec![6]), ..new };
    assert!(matches!(jobs.create(other, vec![]).await, Err(Error::RequestIdReused(_))));
    let bad = NewJob {
        owner: LOCAL.into(),
        request_id: "\n".into(),
        mesh: "0".repeat(64),
        file_name: "a/b".into(),
        spec: Spec::new(vec![]),
    };
    let Err(Error::Invalid(faults)) = jobs.create(bad, vec![]).await else { panic!("accepted") };
    let fields: Vec<_> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert_eq!(fields, ["request_id", "mesh", "file_name", "spec.triangles"]);
}

#[tokio::test]
async fn damaged_transfers_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let announced = Announced { size: 7, hash: String::new() };
    let short = jobs.put_mesh(LOCAL, announced, bytes_of(&[b"123456"])).await;
    assert!(matches!(short, Err(Error::Corrupt { .. })));
    assert_eq!(fs::read_dir(dir.path().join("objects/meshes")).unwrap().count(), 0);
    assert_eq!(fs::read_dir(dir.path().join("objects/tmp")).unwrap().count(), 0);
}

#[tokio::test]
async fn followers_see_everything_live_wherever_they_begin() {
    let dir = tempfile::tempdir().unwrap();
    let jobs = open(dir.path()).await;
    let id = create(&jobs).await.id;
    let live = jobs.follow(&id, 0).try_collect::<Vec<_>>();
    let work = async {
        let (_, lease) = claim(&jobs, "w").await.unwrap();
        for first in 0..20 {
            let bytes = vec![first as u8; 100];
            let records = Report::Records { level: None, first, count: 1, bytes };
            jobs.append(&lease, first, vec![records]).await.unwrap();
        }
        jobs.complete(&lease, &Outcome::Failed("BAD".into(), "bad".into())).await.unwrap();
    };
    let (live, ()) = tokio::join!(live, work);
    let live = live.unwrap();
    assert_eq!(live.last().unwrap().body.state(), Some(State::Failed));
    for after in 0..live.len() {
        let rest: Vec<_> = jobs.follow(&id, after as u64).try_collect().await.unwrap();
        assert_eq!(rest, live[after..]);
    }
    let past: Vec<_> = jobs.follow(&id, u64::MAX).try_collect().await.unwrap();
    assert_eq!(past, []);
    let missing = jobs.follow("none", 0).try_collect::<Vec<_>>().await;
    assert!(matches!(missing, Err(Error::NotFound(_))));
}

/// What the model knows of a job.
#[derive(Clone, Debug, PartialEq)]
struct Model {
    state: State,
    epoch: u64,
    lost: u32,
    cancel: bool,
    n_sent: u64,
}

#[derive(Clone, Copy, Debug)]
enum Step {
    Create,
    Claim(usize),
    Lose(usize),
    Append(usize),
    Succeed(usize),
    Release(usize),
    Cancel(usize),
    Delete(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let with = |step: fn(usize) -> Step| (0..4usize).prop_map(step);
    prop_oneof![
        Just(Step::Create),
        with(Step::Claim),
        with(Step::Lose),
        with(Step::Append),
        with(Step::Succeed),
        with(Step::Release),
        with(Step::Cancel),
        with(Step::Delete),
    ]
}

/// Jobs by order of creation, and what each worker believes to hold.
struct Walk {
    jobs: Jobs,
    new: NewJob,
    model: BTreeMap<String, Model>,
    leases: BTreeMap<usize, Lease>,
}

impl Walk {
    async fn take(&mut self, step: Step) {
        match step {
            Step::Create => {
                let id = self.jobs.create(self.new.clone(), vec![]).await.unwrap().id;
                let state = State::Queued;
                self.model.insert(id, Model { state, epoch: 0, lost: 0, cancel: false, n_sent: 0 });
            }
            Step::Claim(w) => self.claim(w).await,
            Step::Lose(w) => {
                self.jobs.worker_gone(&format!("w{w}")).await.unwrap();
                self.lose(w, 1);
            }
            Step::Append(w) => {
                let Some(lease) = self.leases.get(&w) else { return };
                let job = self.model.get_mut(&lease.job).filter(|job| holds(job, lease));
                let first = job.as_ref().map_or(0, |job| job.n_sent);
                let appended = self.jobs.append(lease, first, vec![note("x")]).await;
                assert_eq!(appended.is_ok(), job.is_some());
                if let Some(job) = job {
                    job.n_sent += 1;
                }
            }
            Step::Succeed(w) => {
                let Some(lease) = self.leases.remove(&w) else { return };
                let done = self.jobs.complete(&lease, &Outcome::Succeeded(vec![])).await;
                let job = self.model.get_mut(&lease.job).filter(|job| holds(job, &lease));
                assert_eq!(done.is_ok(), job.is_some());
                if let Some(job) = job {
                    job.state = State::Succeeded;
                }
            }
            Step::Release(w) => {
                let Some(lease) = self.leases.get(&w).cloned() else { return };
                let legal = self.model.get(&lease.job).is_some_and(|job| holds(job, &lease));
                let outcome = Outcome::Released(String::new());
                assert_eq!(self.jobs.complete(&lease, &outcome).await.is_ok(), legal);
                self.lose(w, 0);
            }
            Step::Cancel(i) => self.cancel(i).await,
            Step::Delete(i) => {
                let Some(id) = self.model.keys().nth(i).cloned() else { return };
                let legal = self.model[&id].state.is_final();
                assert_eq!(self.jobs.delete(&id).await.is_ok(), legal);
                if legal {
                    self.model.remove(&id);
                }
            }
        }
    }

    async fn claim(&mut self, w: usize) {
        self.lose(w, 1);
        let oldest = self.model.iter_mut().find(|(_, job)| job.state == State::Queued);
        let claimed = claim(&self.jobs, &format!("w{w}")).await;
        assert_eq!(claimed.as_ref().map(|(job, _)| &job.id), oldest.as_ref().map(|(id, _)| *id));
        if let (Some((_, lease)), Some((_, job))) = (claimed, oldest) {
            job.state = State::Running;
            job.epoch += 1;
            job.n_sent = 0;
            self.leases.insert(w, lease);
        }
    }

    /// Whatever worker `w` holds is lost, and counts `blame` against the job.
    fn lose(&mut self, w: usize, blame: u32) {
        let Some(lease) = self.leases.remove(&w) else { return };
        let Some(job) = self.model.get_mut(&lease.job).filter(|job| holds(job, &lease)) else {
            return;
        };
        job.lost += blame;
        job.state = match (job.cancel, job.lost) {
            (true, _) => State::Cancelled,
            (false, 3..) => State::Failed,
            (false, _) => State::Queued,
        };
    }

    async fn cancel(&mut self, i: usize) {
        let Some((id, job)) = self.model.iter_mut().nth(i) else { return };
        let legal = !matches!(job.state, State::Succeeded | State::Failed) || job.cancel;
        assert_eq!(self.jobs.cancel(id).await.is_ok(), legal);
        job.cancel |= legal;
        if job.state == State::Queued {
            job.state = State::Cancelled;
        }
    }

    async fn check(&self) {
        let listed = self.jobs.list(None, &[], None, 1000).await.unwrap();
        assert_eq!(listed.len(), self.model.len());
        for job in listed {
            let appended = job.appended;
            let (state, epoch, lost) = (job.state, job.epoch, job.lost);
            let cancel = job.cancel_requested;
            let found = Model { state, epoch, lost, cancel, n_sent: appended };
            assert_eq!(&found, &self.model[&job.id]);
        }
    }
}

fn holds(job: &Model, lease: &Lease) -> bool {
    job.state == State::Running && job.epoch == lease.epoch
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn random_walks_follow_the_model(steps in prop::collection::vec(step(), 1..60)) {
        Runtime::new().unwrap().block_on(async {
            let dir = tempfile::tempdir().unwrap();
            let jobs = open(dir.path()).await;
            let new = new_job(&jobs, "").await;
            let (model, leases) = (BTreeMap::new(), BTreeMap::new());
            let mut walk = Walk { jobs, new, model, leases };
            for step in steps {
                walk.take(step).await;
                walk.check().await;
            }
            for id in walk.model.keys() {
                let job = walk.jobs.job(id).await.unwrap();
                let log = walk.jobs.0.store.events(id, 0, 10_000).await.unwrap();
                let seqs: Vec<_> = log.iter().map(|stored| stored.event.seq).collect();
                assert_eq!(seqs, (1..=job.last_seq).collect::<Vec<_>>());
                let last = log.iter().rev().find_map(|stored| stored.event.body.state());
                assert_eq!(last, Some(job.state));
            }
        });
    }

    #[test]
    fn pages_neither_repeat_nor_skip(
        n_before in 1..20usize,
        sizes in prop::collection::vec((1..6u32, 0..4usize), 1..30),
    ) {
        Runtime::new().unwrap().block_on(async {
            let dir = tempfile::tempdir().unwrap();
            let jobs = open(dir.path()).await;
            let new = new_job(&jobs, "").await;
            let mut wanted = Vec::new();
            for _ in 0..n_before {
                wanted.insert(0, jobs.create(new.clone(), vec![]).await.unwrap().id);
            }
            let (mut before, mut seen) = (None, Vec::new());
            for (size, n_inserted) in sizes.into_iter().cycle().take(40) {
                let page = jobs.list(None, &[State::Queued], before, size).await.unwrap();
                before = page.last().map(|job| job.n).or(before);
                seen.extend(page.into_iter().map(|job| job.id));
                for _ in 0..n_inserted {
                    jobs.create(new.clone(), vec![]).await.unwrap();
                }
            }
            assert_eq!(seen, wanted);
        });
    }
}
