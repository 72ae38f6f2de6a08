//! Everything that is stored, as a whole: leases, logs, restarts; on every store.

pub(super) mod crashes;
mod following;
#[path = "../../../tests/stores/postgres.rs"]
mod postgres;
#[path = "../../../tests/stores/s3.rs"]
pub(super) mod s3;
mod walk;

use std::{
    sync::{Mutex, OnceLock, PoisonError},
    time::Duration,
};

use futures::TryStreamExt;
use tempfile::TempDir;
use tokio::{
    sync::{mpsc, watch},
    time::timeout,
};
use tokio_util::bytes::Bytes;

use self::postgres::Cluster;
use super::{
    clients::{Announced, StoredMesh},
    error::Error,
    event::{Body, Event, Report, ServerEvent},
    lease::Lease,
    principal::LOCAL,
    spec::Spec,
    state::State,
    store::{Address, Artifact, Filter, NewJob, Outcome},
    *,
};

/// A PostgreSQL database of its own, in a cluster that all tests of this process share.
pub(super) fn database() -> Option<String> {
    static SHARED: OnceLock<Option<Mutex<Cluster>>> = OnceLock::new();
    let shared = SHARED.get_or_init(|| Cluster::start().map(Mutex::new)).as_ref()?;
    Some(shared.lock().unwrap_or_else(PoisonError::into_inner).create())
}

/// Where a test keeps what it stores.
pub(super) struct Home {
    dir: TempDir,
    database: Option<Address>,
}

impl Home {
    pub(super) fn on_sqlite() -> Self {
        Self { dir: tempfile::tempdir().unwrap(), database: None }
    }

    pub(super) fn on_postgres() -> Option<Self> {
        let database = Some(Address::parse(&database()?).unwrap());
        Some(Self { dir: tempfile::tempdir().unwrap(), database })
    }

    pub(super) fn places(&self) -> Places {
        Places { data_dir: self.dir.path().into(), database: self.database.clone(), bucket: None }
    }

    async fn open(&self) -> Jobs {
        let terms = Terms { lease: Duration::from_mins(1), ..Terms::default() };
        Jobs::open(self.places(), terms, Limits::default()).await.unwrap()
    }
}

/// Runs tests in each of the named homes, whose constructors may say that there is no such home.
macro_rules! in_homes {
    ([$($home:ident)*] $tests:tt) => { $(in_homes! { $home $tests })* };
    ($home:ident [$($test:ident,)*]) => {
        mod $home {
            $(#[tokio::test]
            async fn $test() {
                let home: Option<super::Home> = super::Home::$home().into();
                if let Some(home) = home {
                    super::$test(home).await;
                }
            })*
        }
    };
}
pub(super) use in_homes;

in_homes! { [on_sqlite on_postgres] [
    a_job_from_creation_to_its_artifacts,
    a_stale_lease_can_write_nothing,
    lost_attempts_are_told_and_poison_in_the_end,
    handing_back_and_server_restarts_do_not_poison,
    workers_that_outlive_the_server_keep_their_jobs,
    a_worker_that_asks_again_has_dropped_its_job,
    cancelled_jobs_keep_what_was_stored,
    requests_are_idempotent_and_checked_as_a_whole,
    damaged_transfers_leave_nothing,
    servers_share_a_database_but_not_their_directories,
    database_and_objects_belong_together,
    results_are_removed_with_their_bytes_and_logs_stay,
    jobs_go_when_their_time_is_up_unless_they_are_pinned,
] }

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
    NewJob {
        owner: LOCAL.into(),
        request_id,
        mesh,
        file_name,
        spec: Spec::new(vec![5]),
        priority: 0,
        labels: std::collections::BTreeMap::default(),
        webhook: String::new(),
        trace: String::new(),
    }
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
    jobs.follow("reader", id, 0).try_collect().await.unwrap()
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

async fn a_job_from_creation_to_its_artifacts(home: Home) {
    let jobs = home.open().await;
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
    assert!(jobs.complete(&lease, &done).await.unwrap().1);
    assert!(!jobs.complete(&lease, &done).await.unwrap().1, "a repetition");
    let (artifact, blob) = jobs.artifact(&job.id, "x").await.unwrap();
    let chunks: Vec<_> = blob.read(0, 9).await.unwrap().try_collect().await.unwrap();
    assert_eq!((artifact.size, chunks.concat().as_slice()), (1, b"1".as_slice()));
    let log = log_of(&jobs, &job.id).await;
    assert_eq!(log.iter().map(|event| event.seq).collect::<Vec<_>>(), (1..=7).collect::<Vec<_>>());
    let reports: Vec<_> = log.into_iter().map(|event| event.body).collect();
    let wanted = [note("a"), records(0, 7), records(1, 8), note("b")].map(Body::Worker);
    assert_eq!(reports[2..6], wanted);
}

async fn a_stale_lease_can_write_nothing(home: Home) {
    let jobs = home.open().await;
    let job = create(&jobs).await;
    let (_, old) = claim(&jobs, "w").await.unwrap();
    jobs.worker_gone("w").await.unwrap();
    for reclaimed in [false, true] {
        if reclaimed {
            // What was refused may hold the job's row until PostgreSQL has rolled it back.
            jobs.claim("v", Duration::from_mins(1)).await.unwrap().unwrap();
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

async fn lost_attempts_are_told_and_poison_in_the_end(home: Home) {
    let terms = Terms { lease: Duration::from_millis(1), ..Terms::default() };
    let jobs = Jobs::open(home.places(), terms, Limits::default()).await.unwrap();
    let job = create(&jobs).await;
    for attempt in 1..=3 {
        let (claimed, lease) = claim(&jobs, &format!("w{attempt}")).await.unwrap();
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
    let history = jobs.attempts(&job.id).await.unwrap().into_iter();
    let history: Vec<_> = history.map(|a| (a.attempt, a.worker, a.reason, a.counts)).collect();
    let lost = |n: u32| (n, format!("w{n}"), "LEASE_EXPIRED".to_owned(), true);
    assert_eq!(history, [lost(3), lost(2), lost(1)]);
}

async fn handing_back_and_server_restarts_do_not_poison(home: Home) {
    let mut jobs = home.open().await;
    let id = create(&jobs).await.id;
    for _ in 0..3 {
        let (_, lease) = claim(&jobs, "w").await.unwrap();
        jobs.complete(&lease, &Outcome::Released("drained".into())).await.unwrap();
        claim(&jobs, "v").await.unwrap();
        // The lock file of `v` is there and nobody holds it: `v` died with the server.
        fs::write(jobs.worker_lock("v"), "").unwrap();
        jobs.close().await;
        drop(jobs);
        jobs = home.open().await;
        assert!(!jobs.worker_lock("v").exists());
    }
    let job = jobs.job(&id).await.unwrap();
    assert_eq!((job.state, job.attempt, job.lost), (State::Queued, 6, 0));
}

async fn workers_that_outlive_the_server_keep_their_jobs(home: Home) {
    let jobs = home.open().await;
    create(&jobs).await;
    let alive = File::create(jobs.worker_lock("w")).unwrap();
    alive.try_lock().unwrap();
    let (_, lease) = claim(&jobs, "w").await.unwrap();
    let (_, remote) = {
        create(&jobs).await;
        claim(&jobs, "far-away").await.unwrap()
    };
    assert!(matches!(
        Jobs::open(home.places(), Terms::default(), Limits::default()).await,
        Err(Error::InUse(_))
    ));
    jobs.close().await;
    drop(jobs);
    let jobs = home.open().await;
    assert!(!jobs.heartbeat(&lease).await.unwrap().cancel);
    assert!(!jobs.heartbeat(&remote).await.unwrap().cancel);
    // The process that held the lock ends; that of the other worker cannot be seen from here.
    assert_eq!(jobs.sweep_leases().await.unwrap(), []);
    drop(alive);
    assert_eq!(jobs.sweep_leases().await.unwrap().len(), 1);
    assert!(jobs.heartbeat(&lease).await.is_err());
    assert!(!jobs.heartbeat(&remote).await.unwrap().cancel);
}

async fn a_worker_that_asks_again_has_dropped_its_job(home: Home) {
    let jobs = home.open().await;
    let id = create(&jobs).await.id;
    let (_, first) = claim(&jobs, "w").await.unwrap();
    let (again, _) = claim(&jobs, "w").await.unwrap();
    assert_eq!((again.id, again.epoch, again.lost), (id, 2, 1));
    assert!(jobs.heartbeat(&first).await.is_err());
}

async fn cancelled_jobs_keep_what_was_stored(home: Home) {
    let jobs = home.open().await;
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
    assert!(jobs.append(&lease, 0, vec![note("x")]).await.unwrap().orders.cancel);
    assert!(jobs.heartbeat(&lease).await.unwrap().cancel);
    jobs.complete(&lease, &Outcome::Cancelled).await.unwrap();
    assert_eq!(jobs.artifacts(&id).await.unwrap().len(), 1);
    jobs.delete(&id).await.unwrap();
    assert!(matches!(jobs.job(&id).await, Err(Error::NotFound(_))));
    assert!(!home.dir.path().join("objects/jobs").join(&id).exists());
}

async fn requests_are_idempotent_and_checked_as_a_whole(home: Home) {
    let jobs = home.open().await;
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
        priority: 0,
        labels: std::collections::BTreeMap::default(),
        webhook: String::new(),
        trace: String::new(),
    };
    let Err(Error::Invalid(faults)) = jobs.create(bad, vec![]).await else { panic!("accepted") };
    let fields: Vec<_> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert_eq!(fields, ["request_id", "mesh", "file_name", "spec.triangles"]);
}

async fn damaged_transfers_leave_nothing(home: Home) {
    let jobs = home.open().await;
    let announced = Announced { size: 7, hash: String::new(), ..Announced::default() };
    let short = jobs.put_mesh(LOCAL, announced, bytes_of(&[b"123456"])).await;
    assert!(matches!(short, Err(Error::Corrupt { .. })));
    assert!(!home.dir.path().join("objects/meshes").exists());
    assert_eq!(fs::read_dir(home.dir.path().join("objects/tmp")).unwrap().count(), 0);
}

async fn servers_share_a_database_but_not_their_directories(home: Home) {
    let Some(database) = home.database.clone() else { return };
    let here = home.open().await;
    let id = create(&here).await.id;
    // The other server has the same objects, by a link in place of a bucket.
    let dir = tempfile::tempdir().unwrap();
    std::os::unix::fs::symlink(home.dir.path().join("objects"), dir.path().join("objects"))
        .unwrap();
    let places = Places { data_dir: dir.path().into(), database: Some(database), bucket: None };
    let there = Jobs::open(places, Terms::default(), Limits::default()).await.unwrap();
    // Nothing but a call of the other server wakes these two.
    let mut grew = here.0.signals.watch_log(&id);
    let mut queue = there.0.signals.watch_queue();
    let minute = Duration::from_mins(1);
    let (_, lease) = claim(&there, "w").await.unwrap();
    timeout(minute, heard(&mut grew, || there.0.signals.log_grew(&id))).await.unwrap();
    timeout(minute, heard(&mut queue, || here.0.signals.queue_grew())).await.unwrap();
    let watching = here.follow("reader", &id, 0).try_collect::<Vec<_>>();
    let work = async {
        for first in 0..10 {
            there.append(&lease, first, vec![note("x")]).await.unwrap();
        }
        there.complete(&lease, &Outcome::Succeeded(vec![])).await.unwrap();
        let waiting = there.claim("w", minute);
        let (claimed, created) = tokio::join!(waiting, create(&here));
        assert_eq!(claimed.unwrap().unwrap().id, created.id);
    };
    let (log, ()) = tokio::join!(watching, work);
    assert_eq!(log.unwrap().len(), 13);
    // A worker of the other server is alive as far as this one can tell.
    here.close().await;
    drop(here);
    let here = home.open().await;
    assert_eq!(here.sweep_leases().await.unwrap(), []);
    assert_eq!(here.counts().await.unwrap()[1], (State::Running, 1));
}

/// Calls until it is heard: a server that has just started does not listen yet.
async fn heard(ear: &mut watch::Receiver<()>, call: impl Fn()) {
    ear.mark_unchanged();
    loop {
        call();
        if timeout(Duration::from_millis(100), ear.changed()).await.is_ok() {
            return;
        }
    }
}

async fn database_and_objects_belong_together(home: Home) {
    let jobs = home.open().await;
    create(&jobs).await;
    jobs.close().await;
    drop(jobs);
    let elsewhere = tempfile::tempdir().unwrap();
    let mut places = home.places();
    if places.database.is_none() {
        // Moved without its objects.
        let file = "jobs.sqlite3";
        fs::copy(home.dir.path().join(file), elsewhere.path().join(file)).unwrap();
    }
    places.data_dir = elsewhere.path().into();
    for _ in 0..2 {
        let refused = Jobs::open(places.clone(), Terms::default(), Limits::default()).await;
        assert!(matches!(refused, Err(Error::OtherObjects(_))), "{refused:?}");
    }
    // A directory of a time when neither had a name, and what it had.
    fs::remove_file(home.dir.path().join("objects/id")).unwrap();
    let store = home.places().store().await.unwrap();
    store.forget_objects().await;
    store.close().await;
    assert_eq!(home.open().await.counts().await.unwrap()[0], (State::Queued, 1));
}

async fn results_are_removed_with_their_bytes_and_logs_stay(home: Home) {
    let keep_results = Some(Duration::ZERO);
    let limits = Limits { keep_results, ..Limits::default() };
    let jobs = Jobs::open(home.places(), Terms::default(), limits).await.unwrap();
    let mut names = Vec::new();
    for worker in ["w1", "w2"] {
        create(&jobs).await;
        let (job, lease) = claim(&jobs, worker).await.unwrap();
        put(&jobs, &lease, "a.txt", b"bytes").await.unwrap();
        jobs.complete(&lease, &Outcome::Succeeded(vec!["a.txt".into()])).await.unwrap();
        names.push(job.id);
    }
    jobs.pin(&names[1], true).await.unwrap();
    let bytes = jobs.artifact(&names[0], "a.txt").await.unwrap().1;
    assert_eq!(jobs.sweep_results().await.unwrap(), 1);
    assert!(bytes.read(0, 9).await.is_err(), "the bytes are there");
    let gone = jobs.job(&names[0]).await.unwrap();
    assert!(gone.results_removed && log_of(&jobs, &gone.id).await.len() as u64 == gone.last_seq);
    assert!(matches!(jobs.artifact(&names[0], "a.txt").await, Err(Error::NotFound(_))));
    assert!(jobs.artifact(&names[1], "a.txt").await.is_ok());
    assert_eq!(jobs.sweep_results().await.unwrap(), 0);
    assert_eq!(jobs.sweep_jobs().await.unwrap(), 0, "jobs are kept for ever");
}

async fn jobs_go_when_their_time_is_up_unless_they_are_pinned(home: Home) {
    let limits = Limits { keep_jobs: Some(Duration::ZERO), ..Limits::default() };
    let jobs = Jobs::open(home.places(), Terms::default(), limits).await.unwrap();
    let mut names = Vec::new();
    for _ in 0..3 {
        names.push(create(&jobs).await.id);
    }
    let [old, pinned, waiting] = &names[..] else { panic!("{names:?}") };
    for id in [old, pinned] {
        jobs.cancel(id).await.unwrap();
    }
    jobs.pin(pinned, true).await.unwrap();
    assert_eq!(jobs.sweep_jobs().await.unwrap(), 1);
    assert!(matches!(jobs.job(old).await, Err(Error::NotFound(_))));
    assert!(jobs.job(pinned).await.is_ok() && jobs.job(waiting).await.is_ok());
}
