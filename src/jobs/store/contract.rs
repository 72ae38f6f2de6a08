//! What a database has to do for several servers at once: one suite, on SQLite and on PostgreSQL.
//!
//! Each [`Store`] here is a server: its connections are its own.

mod lists;
mod queue;

use std::{collections::BTreeSet, time::Duration};

use futures::future::{join_all, try_join_all};
use tempfile::TempDir;

use super::*;
use crate::jobs::{
    Limits,
    audit::AuditEntry,
    error::Quota,
    event::Report,
    lease::{Lease, Terms},
    principal::LOCAL,
    spec::{Input, Spec},
    tests::{database, in_homes},
};

/// A database that several servers open.
pub(super) struct Home {
    address: Address,
    _dir: TempDir,
}

impl Home {
    fn on_sqlite() -> Self {
        let dir = tempfile::tempdir().unwrap();
        // What a URL would take for something else.
        let path = dir.path().join("a b?c#d%20é.sqlite3");
        Self { address: Address::file(&path).unwrap(), _dir: dir }
    }

    fn on_postgres() -> Option<Self> {
        let address = Address::parse(&database()?).unwrap();
        Some(Self { address, _dir: tempfile::tempdir().unwrap() })
    }

    async fn servers<const N: usize>(&self) -> [Store; N] {
        if !self.address.is_shared() {
            // One server makes the tables of SQLite: the data directory has one.
            Store::open(&self.address).await.unwrap().close().await;
        }
        let stores = join_all((0..N).map(|_| Store::open(&self.address))).await;
        let stores: Result<Vec<_>> = stores.into_iter().collect();
        stores.unwrap().try_into().unwrap()
    }
}

in_homes! { [on_sqlite on_postgres] [
    servers_that_start_together_agree_on_the_schema,
    a_request_repeated_on_all_servers_makes_one_job,
    the_cap_on_the_queue_is_exact,
    what_an_owner_may_have_is_exact,
    the_audit_table_keeps_what_is_young,
    every_job_is_claimed_once,
    logs_have_no_gaps_whoever_writes,
    numbers_are_committed_in_order,
    a_job_keeps_its_meshes,
    texts_are_kept_and_ordered_by_their_bytes,
    the_clock_is_the_database_s,
    expired_leases_are_lost_once,
    what_is_refused_holds_no_row,
    transactions_that_lose_are_tried_again,
    results_go_when_their_time_is_up_unless_pinned,
    webhooks_are_due_with_the_end_and_taken_once,
    webhooks_go_with_their_job_and_nobody_is_called_unasked,
    webhooks_of_one_owner_wait_for_themselves,
] }

impl Store {
    /// As a database that an earlier version left.
    pub(in crate::jobs) async fn forget_objects(&self) {
        sqlx::query("DELETE FROM objects").execute(&self.writers).await.unwrap();
    }
}

fn hash(name: &str) -> String {
    blake3::hash(name.as_bytes()).to_hex().to_string()
}

async fn add_mesh(store: &Store, name: &str) {
    store.lock_mesh(&hash(name)).await.unwrap().add(4).await.unwrap();
}

fn new_job(request_id: &str) -> NewJob {
    let (request_id, file_name) = (request_id.into(), "a.ply".into());
    let (owner, mesh) = (LOCAL.into(), hash("mesh"));
    NewJob {
        owner,
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

/// No more than so many jobs may wait.
fn queue_of(max_queued: u64) -> Limits {
    Limits { max_queued, ..Limits::default() }
}

/// Creates jobs `{prefix}0`, … without a request's name.
async fn create(store: &Store, prefix: &str, n_jobs: usize) -> Vec<Job> {
    add_mesh(store, "mesh").await;
    let mut jobs = Vec::new();
    for i in 0..n_jobs {
        let job = store.create(&format!("{prefix}{i}"), &new_job(""), &Limits::default()).await;
        jobs.push(job.unwrap().0);
    }
    jobs
}

async fn claim(store: &Store, worker: &str) -> Option<(Job, Lease)> {
    let job = store.claim(worker, &Terms::default()).await.unwrap().job.unwrap()?;
    let lease = Lease { job: job.id.clone(), epoch: job.epoch, worker: worker.into() };
    Some((job, lease))
}

fn notes(n_notes: usize) -> Vec<(Body, Option<SegmentRange>)> {
    let note = |i| Body::Worker(Report::Note { code: "NOTE".into(), text: format!("{i}\0") });
    (0..n_notes).map(|i| (note(i), None)).collect()
}

async fn servers_that_start_together_agree_on_the_schema(home: Home) {
    let stores: [Store; 4] = home.servers().await;
    create(&stores[0], "a", 1).await;
    for store in &stores {
        assert_eq!(store.job("a0").await.unwrap().n, 1);
        store.close().await;
    }
}

async fn a_request_repeated_on_all_servers_makes_one_job(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    let calls = (0..40).map(|i| {
        let store = &stores[i % 2];
        async move { store.create(&format!("j{i}"), &new_job("same"), &queue_of(100)).await }
    });
    let made = try_join_all(calls).await.unwrap();
    assert_eq!(made.iter().filter(|(_, is_new)| *is_new).count(), 1);
    assert!(made.iter().all(|(job, _)| *job == made[0].0));
    let other = NewJob { file_name: "b.ply".into(), ..new_job("same") };
    let refused = stores[1].create("x", &other, &queue_of(100)).await;
    assert!(matches!(refused, Err(Error::RequestIdReused(_))));
}

async fn the_cap_on_the_queue_is_exact(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    let calls = (0..20).map(|i| {
        let store = &stores[i % 2];
        async move { store.create(&format!("j{i}"), &new_job(""), &queue_of(7)).await }
    });
    let made = join_all(calls).await;
    assert_eq!(made.iter().filter(|made| made.is_ok()).count(), 7);
    let refused = made.iter().filter(|made| matches!(made, Err(Error::QueueFull(7))));
    assert_eq!(refused.count(), 13);
}

async fn what_an_owner_may_have_is_exact(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    let names: Vec<_> = (0..20).map(|i| format!("mesh{i}")).collect();
    for name in names.iter().map(String::as_str).chain(["mesh"]) {
        add_mesh(&stores[0], name).await;
    }
    let limits = Limits { max_owner_queued: 3, ..Limits::default() };
    let made = join_all((0..20).map(|i| {
        let (store, limits, owner) = (&stores[i % 2], &limits, ["ann", "bob"][i / 2 % 2].into());
        let new = NewJob { owner, ..new_job("") };
        async move { store.create(&format!("j{i}"), &new, limits).await }
    }));
    let made = made.await;
    assert_eq!(made.iter().filter(|made| made.is_ok()).count(), 6);
    let is_full = |error: &Error| matches!(error, Error::Quota { quota: Quota::Queued, limit: 3 });
    assert!(made.iter().filter_map(|made| made.as_ref().err()).all(is_full));
    // Each mesh has four bytes.
    let owned = names.iter().enumerate().map(|(i, name)| {
        let store = &stores[i % 2];
        async move { store.own_mesh("ann", &hash(name), 4, 19).await }
    });
    let owned = join_all(owned).await;
    assert_eq!(owned.iter().filter(|owned| matches!(owned, Ok(true))).count(), 4);
    assert_eq!(stores[1].stored_bytes("ann").await.unwrap(), 16);
    assert_eq!(stores[1].stored_bytes("bob").await.unwrap(), 0);
}

async fn the_audit_table_keeps_what_is_young(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    let [principal, owner, peer] = ["ann-laptop", "ann", "unix"].map(str::to_owned);
    // A stranger may ask for anything.
    let [method, resource, outcome] = ["GetJob", "jobs/\0é", "NOT_FOUND"].map(str::to_owned);
    let entry = AuditEntry { principal, owner, peer, method, resource, outcome };
    store.audit(&[entry]).await.unwrap();
    let resources = async || {
        let query = sqlx::query_scalar::<_, String>("SELECT resource FROM audit");
        query.fetch_all(&store.readers).await.unwrap()
    };
    store.forget_audit(Duration::from_hours(1)).await.unwrap();
    assert_eq!(resources().await, ["jobs/\u{fffd}é"]);
    tokio::time::sleep(Duration::from_millis(5)).await;
    store.forget_audit(Duration::ZERO).await.unwrap();
    assert_eq!(resources().await, [""; 0]);
}

async fn every_job_is_claimed_once(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 60).await;
    let workers = (0..8).map(|w| {
        let store = &stores[w % 2];
        async move {
            let mut claimed = Vec::new();
            // Another name each time: to ask again is to abandon the job.
            while let Some((job, _)) = claim(store, &format!("w{w}-{}", claimed.len())).await {
                claimed.push((job.id, job.epoch));
            }
            claimed
        }
    });
    let claimed: Vec<_> = join_all(workers).await.concat();
    assert_eq!(claimed.len(), 60);
    assert_eq!(claimed.into_iter().collect::<BTreeSet<_>>().len(), 60);
}

async fn logs_have_no_gaps_whoever_writes(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 1).await;
    let (_, lease) = claim(&stores[0], "w").await.unwrap();
    // The same hundred events twice over, by two servers, in batches that overlap.
    let events = notes(100);
    let write = async |store: &Store, step: usize| {
        let mut held = 0;
        while held < events.len() {
            let batch = &events[held..events.len().min(held + step)];
            match store.append(&lease, held as u64, batch).await {
                Ok(appended) => held = appended.held as usize,
                Err(error) => panic!("{error}"),
            }
            store.heartbeat(&lease, &Terms::default()).await.unwrap();
        }
    };
    // Far beyond what one statement may hold, at the end.
    let ((), (), cancelled) =
        tokio::join!(write(&stores[0], 7), write(&stores[1], 11), stores[1].cancel("a0"));
    assert!(cancelled.unwrap().0.cancel_requested);
    let many = stores[1].append(&lease, 100, &notes(9000)).await.unwrap();
    assert_eq!((many.held, many.orders.cancel), (9100, true));
    let log = stores[1].events("a0", 0, 20_000).await.unwrap();
    let seqs: Vec<_> = log.iter().map(|stored| stored.event.seq).collect();
    assert_eq!(seqs, (1..=9102).collect::<Vec<_>>());
    let bodies = log[2..102].iter().map(|stored| &stored.event.body);
    assert!(bodies.eq(events.iter().map(|(body, _)| body)));
    assert_eq!(stores[0].job("a0").await.unwrap().last_seq, 9102);
}

async fn numbers_are_committed_in_order(home: Home) {
    let stores: [Store; 3] = home.servers().await;
    create(&stores[2], "first", 1).await;
    let writers = async {
        tokio::join!(create(&stores[0], "a", 40), create(&stores[1], "b", 40));
    };
    // Whoever has seen a number has seen all that are smaller.
    let reader = async {
        let mut seen = 0;
        while seen < 81 {
            let listed = stores[2].list(&Filter::default(), None, 1000).await.unwrap();
            assert_eq!(listed[0].n - listed[listed.len() - 1].n + 1, listed.len() as i64);
            seen = listed.len();
        }
    };
    tokio::join!(writers, reader);
}

async fn a_job_keeps_its_meshes(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    for name in ["mesh", "crude", "unused"] {
        add_mesh(&store, name).await;
    }
    let input = Input { mesh: hash("crude"), file_name: "b.ply".into() };
    let new = NewJob { spec: Spec::optimizing(input), ..new_job("") };
    store.create("a", &new, &queue_of(9)).await.unwrap();
    assert_eq!(
        store.forget_meshes(Duration::from_hours(1), 9).await.unwrap(),
        Vec::<String>::new()
    );
    assert_eq!(store.forget_meshes(Duration::ZERO, 9).await.unwrap(), [hash("unused")]);
    // Forgotten between the caller's look and the creation.
    let late = NewJob { mesh: hash("unused"), ..new_job("") };
    let Err(Error::Invalid(faults)) = store.create("b", &late, &queue_of(9)).await else {
        panic!("created")
    };
    assert_eq!(faults[0].field, "mesh");
    assert_eq!(store.list(&Filter::default(), None, 9).await.unwrap().len(), 1);
}

async fn texts_are_kept_and_ordered_by_their_bytes(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    create(&store, "a", 1).await;
    let (_, lease) = claim(&store, "w").await.unwrap();
    let files = ["Z.glb", "_.glb", "a.glb", "b-1.glb", "b.glb"];
    for size in [1, 2] {
        for file in files.iter().rev() {
            let (file, media_type) = ((*file).into(), "text/\0plain".into());
            let artifact = Artifact { file, media_type, size, blake3: hash("x") };
            store.add_artifact(&lease, &artifact).await.unwrap();
        }
    }
    let outcome = Outcome::Failed("BAD\0".into(), "quote ' \" $1 ? \0 é".into());
    let (job, _) = store.complete(&lease, &outcome, 3).await.unwrap();
    assert_eq!(job.failure, ("BAD\u{fffd}".into(), "quote ' \" $1 ? \u{fffd} é".into()));
    let (again, artifacts) = store.artifacts("a0").await.unwrap();
    assert_eq!(again, job);
    assert!(artifacts.iter().map(|artifact| &*artifact.file).eq(files));
    assert!(artifacts.iter().all(|artifact| artifact.size == 2));
    assert!(matches!(store.job("\0").await, Err(Error::NotFound(_))));
}

async fn the_clock_is_the_database_s(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    let mut tx = store.begin().await.unwrap();
    let first = now_ms(&mut tx).await.unwrap();
    tokio::time::sleep(Duration::from_millis(30)).await;
    let then = now_ms(&mut tx).await.unwrap();
    // It goes on within a transaction, and it is in milliseconds since 1970.
    assert!((20..20_000).contains(&(then - first)), "{first} {then}");
    assert!(first > 1_700_000_000_000);
}

async fn expired_leases_are_lost_once(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 10).await;
    let short = Terms { lease: Duration::from_millis(1), ..Terms::default() };
    for w in 0..10 {
        stores[0].claim(&*format!("w{w}"), &short).await.unwrap().job.unwrap().unwrap();
    }
    tokio::time::sleep(Duration::from_millis(20)).await;
    let (a, b) = tokio::join!(stores[0].lose_expired(3), stores[1].lose_expired(3));
    assert_eq!(a.unwrap().len() + b.unwrap().len(), 10);
    for job in stores[1].list(&Filter::default(), None, 99).await.unwrap() {
        assert_eq!((job.state, job.lost, job.last_seq), (State::Queued, 1, 4));
    }
}

async fn what_is_refused_holds_no_row(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 1).await;
    let (_, mut stale) = claim(&stores[0], "w0").await.unwrap();
    for i in 1..40 {
        let handed_back = Outcome::Released(String::new());
        stores[0].complete(&stale, &handed_back, 3).await.unwrap();
        let refused = stores[i % 2].complete(&stale, &handed_back, 3).await;
        assert!(matches!(refused, Err(Error::Stale { .. })));
        // A claim skips rows that are locked.
        let (_, lease) = claim(&stores[(i + 1) % 2], &format!("w{i}")).await.unwrap();
        assert!(matches!(stores[0].cancel("none").await, Err(Error::NotFound(_))));
        stale = lease;
    }
}

async fn transactions_that_lose_are_tried_again(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 2).await;
    // They lock the same jobs, each in its own order.
    let rename = async |store: &Store, ids: [&str; 2]| {
        transaction!(store, tx, {
            for id in ids {
                find_to_write(&mut tx, id).await?;
                tokio::time::sleep(Duration::from_millis(200)).await;
                let update = sqlx::query("UPDATE jobs SET lost = lost + 1 WHERE id = $1");
                update.bind(id).execute(&mut *tx).await?;
            }
            Ok(())
        })
    };
    let (one, two) =
        tokio::join!(rename(&stores[0], ["a0", "a1"]), rename(&stores[1], ["a1", "a0"]));
    one.unwrap();
    two.unwrap();
    for id in ["a0", "a1"] {
        assert_eq!(stores[0].job(id).await.unwrap().lost, 2, "each has written once");
    }
}

fn to_be_told() -> NewJob {
    NewJob { webhook: "https://a.test/\0".into(), ..new_job("") }
}

async fn webhooks_are_due_with_the_end_and_taken_once(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    // Cancelled while they wait, cancelled at work, and failed.
    for id in ["a", "b", "c"] {
        stores[0].create(id, &to_be_told(), &Limits::default()).await.unwrap();
    }
    let take = async |store: &Store| store.take_calls(10, Duration::from_hours(1)).await.unwrap();
    let (_, lease) = claim(&stores[0], "w1").await.unwrap();
    let (_, other) = claim(&stores[1], "w2").await.unwrap();
    assert_eq!(take(&stores[0]).await, [], "no job has ended");
    stores[0].cancel("c").await.unwrap();
    stores[1].cancel(&lease.job).await.unwrap();
    stores[0].complete(&lease, &Outcome::Cancelled, 3).await.unwrap();
    let failed = Outcome::Failed("EMPTY_MESH".into(), "it has no triangles".into());
    stores[1].complete(&other, &failed, 3).await.unwrap();
    let taken = join_all((0..6).map(|i| take(&stores[i % 2]))).await.concat();
    let told: BTreeSet<_> =
        taken.iter().map(|call| (&*call.job.id, call.job.state.name())).collect();
    let ids: BTreeSet<_> = taken.iter().map(|call| call.id.as_str()).collect();
    assert_eq!(told, BTreeSet::from([("a", "CANCELLED"), ("b", "FAILED"), ("c", "CANCELLED")]));
    assert_eq!((taken.len(), ids.len(), taken[0].attempt), (3, 3, 1));
    assert_eq!(taken[0].url, "https://a.test/\u{fffd}");
    // One is heard, one is to be called at once, and of one nothing is heard.
    stores[1].end_call(&taken[0], &CallEnd::Delivered).await.unwrap();
    let again = CallEnd::Again("it answers 503".into(), Duration::ZERO);
    stores[1].end_call(&taken[1], &again).await.unwrap();
    let [second] = &take(&stores[0]).await[..] else { panic!("one is due") };
    assert_eq!((&second.id, &second.job.id, second.attempt), (&taken[1].id, &taken[1].job.id, 2));
    // Who was given up on comes too late.
    stores[1].end_call(&taken[1], &CallEnd::Delivered).await.unwrap();
    stores[1].end_call(second, &again).await.unwrap();
    let third = stores[0].take_calls(10, Duration::ZERO).await.unwrap();
    assert_eq!((third.len(), third[0].attempt), (1, 3));
    // Its server was killed: what it had is due again when its time is up.
    let fourth = take(&stores[1]).await;
    assert_eq!((fourth.len(), &fourth[0].id, fourth[0].attempt), (1, &third[0].id, 4));
    stores[0].end_call(&fourth[0], &CallEnd::GivenUp("it answers 410".into())).await.unwrap();
    assert_eq!(take(&stores[0]).await, []);
}

async fn webhooks_go_with_their_job_and_nobody_is_called_unasked(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    create(&store, "silent", 1).await;
    store.create("a", &to_be_told(), &Limits::default()).await.unwrap();
    for id in ["silent0", "a"] {
        store.cancel(id).await.unwrap();
    }
    store.delete("a").await.unwrap();
    assert_eq!(store.take_calls(10, Duration::ZERO).await.unwrap(), []);
}

async fn webhooks_of_one_owner_wait_for_themselves(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    add_mesh(&store, "mesh").await;
    for (id, owner) in [("a", "busy"), ("b", "busy"), ("c", "busy"), ("d", "calm")] {
        let new = NewJob { owner: owner.into(), ..to_be_told() };
        store.create(id, &new, &Limits::default()).await.unwrap();
        store.cancel(id).await.unwrap();
    }
    let taken = store.take_calls(2, Duration::from_hours(1)).await.unwrap();
    assert!(taken.iter().map(|call| &*call.job.id).eq(["a", "d"]), "{taken:?}");
}

async fn results_go_when_their_time_is_up_unless_pinned(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    create(&store, "a", 4).await;
    for id in ["a0", "a1", "a2"] {
        let (job, lease) = claim(&store, id).await.unwrap();
        assert_eq!(job.id, id);
        let [file, media_type, blake3] = ["x", "text/plain", "-"].map(str::to_owned);
        let artifact = Artifact { file, media_type, size: 1, blake3 };
        store.add_artifact(&lease, &artifact).await.unwrap();
        store.complete(&lease, &Outcome::Succeeded(vec!["x".into()]), 3).await.unwrap();
    }
    assert!(store.pin("a1", true).await.unwrap().pinned);
    let expired = async |kept_for| store.expired(kept_for, 10).await.unwrap();
    assert_eq!(expired(Duration::from_hours(1)).await, [""; 0]);
    assert_eq!(expired(Duration::ZERO).await, ["a0", "a2"], "a1 is pinned, a3 has not ended");
    // Pinned just in time.
    store.pin("a2", true).await.unwrap();
    assert_eq!(store.forget_results("a2").await.unwrap(), None);
    assert_eq!(store.forget_results("a3").await.unwrap(), None);
    assert!(store.forget_results("a0").await.unwrap().unwrap().results_removed);
    assert_eq!(store.artifacts("a0").await.unwrap().1, []);
    // Nobody noted that the bytes are gone: whoever looks next goes on, pinned or not.
    store.pin("a0", true).await.unwrap();
    assert_eq!(expired(Duration::ZERO).await, ["a0"]);
    assert!(store.forget_results("a0").await.unwrap().is_some());
    store.results_gone("a0").await.unwrap();
    assert_eq!(expired(Duration::ZERO).await, [""; 0]);
    store.pin("a2", false).await.unwrap();
    assert_eq!(expired(Duration::ZERO).await, ["a2"]);
    assert_eq!(store.artifacts("a1").await.unwrap().1.len(), 1);
}
