//! Who gets which job: hosts that fail, shares and priorities, drain, retry.

use std::collections::BTreeMap;

use super::*;
use crate::jobs::lease::{Claimant, Loss, Orders};

in_homes! { [on_sqlite on_postgres] [
    a_host_that_loses_many_jobs_in_a_row_is_out_of_service,
    jobs_that_many_hosts_lose_are_bad_and_the_hosts_are_not,
    a_job_that_its_host_has_lost_goes_to_another,
    priority_comes_first_then_the_owner_with_least_then_age,
    who_has_had_much_waits_for_who_has_had_little,
    jobs_of_higher_priority_get_the_workers_of_lower_ones,
    a_drained_host_hands_its_job_back_and_gets_no_other,
    a_retry_queues_what_did_not_succeed_anew,
    the_queue_is_told_by_owner_and_priority,
] }

/// A new incarnation on `host` claims a job; how that ends.
async fn claim_on(store: &Store, host: &str, terms: &Terms) -> Result<Option<(Job, Lease)>> {
    let worker = format!("{host}-{}", uuid::Uuid::new_v4().simple());
    let who = Claimant { worker: worker.clone(), host: host.into(), version: "1.2.3".into() };
    let job = store.claim(&who, terms).await?.job?;
    Ok(job.map(|job| {
        let lease = Lease { job: job.id.clone(), epoch: job.epoch, worker };
        (job, lease)
    }))
}

/// A job that dies with its worker on `host`.
async fn dies_on(store: &Store, host: &str) -> Job {
    let (_, lease) = claim_on(store, host, &Terms::default()).await.unwrap().unwrap();
    let lost = store.lose_worker(&lease.worker, Loss::WorkerExited, 3).await.unwrap();
    lost.into_iter().next().unwrap()
}

/// What a refused claim says: why, and whether it is news.
fn refusal(claimed: Result<Option<(Job, Lease)>>) -> (String, bool) {
    match claimed {
        Err(Error::OutOfService { why, is_news, .. }) => (why, is_news),
        other => panic!("{other:?} is no refusal"),
    }
}

async fn a_host_that_loses_many_jobs_in_a_row_is_out_of_service(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 9).await;
    let terms = Terms::default();
    // Another job each time, and one done in between makes up for those before.
    for id in ["a0", "a1"] {
        assert_eq!(dies_on(&stores[0], "bad").await.id, id);
    }
    let (done, lease) = claim_on(&stores[1], "bad", &terms).await.unwrap().unwrap();
    stores[1].complete(&lease, &Outcome::Succeeded(vec![]), 3).await.unwrap();
    tokio::time::sleep(Duration::from_millis(5)).await;
    assert_eq!(done.id, "a2");
    for id in ["a3", "a4", "a5"] {
        assert_eq!(dies_on(&stores[1], "bad").await.id, id);
    }
    for is_first in [true, false] {
        let (why, is_news) = refusal(claim_on(&stores[0], "bad", &terms).await);
        assert!(is_news == is_first && why.contains("jobs/a3: WORKER_EXITED; jobs/a4"), "{why}");
    }
    let [worker] = &stores[1].workers().await.unwrap()[..] else { panic!("one host") };
    assert!(worker.quarantined_until_ms.is_some() && worker.why.contains("3 jobs in a row"));
    assert_eq!((&*worker.host, &*worker.version), ("bad", "1.2.3"));
    // Nobody has blamed the jobs so far that they would not run elsewhere.
    assert_eq!(claim_on(&stores[1], "good", &terms).await.unwrap().unwrap().0.id, "a0");
    assert!(stores[0].reinstate("bad").await.unwrap().quarantined_until_ms.is_none());
    let id = dies_on(&stores[0], "bad").await.id;
    assert_eq!(id, "a6", "it has lost those before");
    assert!(matches!(stores[0].reinstate("none").await, Err(Error::NotFound(_))));
    // A quarantine ends by itself.
    let short = Terms { quarantine: Duration::from_millis(1), max_in_a_row: 1, ..terms };
    assert!(refusal(claim_on(&stores[0], "bad", &short).await).1);
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert!(claim_on(&stores[0], "bad", &short).await.unwrap().is_some());
}

async fn jobs_that_many_hosts_lose_are_bad_and_the_hosts_are_not(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "bad", 4).await;
    for (i, host) in ["x", "y", "z"].iter().cycle().take(12).enumerate() {
        let job = dies_on(&stores[i % 2], host).await;
        let wanted = if i % 3 == 2 { State::Failed } else { State::Queued };
        assert_eq!((&*job.id, job.state), (&*format!("bad{}", i / 3), wanted));
    }
    let job = stores[1].job("bad3").await.unwrap();
    assert_eq!((job.failure.0.as_str(), job.lost), ("POISONED", 3));
    let attempts = stores[0].attempts("bad3", 9).await.unwrap();
    let hosts: Vec<_> = attempts.iter().map(|a| (a.attempt, &*a.host, &*a.reason)).collect();
    let exited = "WORKER_EXITED";
    assert_eq!(hosts, [(3, "z", exited), (2, "y", exited), (1, "x", exited)]);
    assert!(attempts.iter().all(|a| a.counts && a.ended_ms >= Some(a.started_ms)));
    // All hosts are in service.
    create(&stores[0], "good", 3).await;
    for host in ["x", "y", "z"] {
        claim_on(&stores[0], host, &Terms::default()).await.unwrap().unwrap();
    }
}

async fn a_job_that_its_host_has_lost_goes_to_another(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    create(&store, "a", 2).await;
    let terms = Terms::default();
    assert_eq!(dies_on(&store, "x").await.id, "a0");
    // The next one is younger, but not tried yet.
    let (job, lease) = claim_on(&store, "x", &terms).await.unwrap().unwrap();
    assert_eq!(job.id, "a1");
    store.complete(&lease, &Outcome::Succeeded(vec![]), 3).await.unwrap();
    // Alone, it tries again.
    assert_eq!(dies_on(&store, "x").await.lost, 2);
    // Not so when somebody else is there, though busy.
    create(&store, "b", 1).await;
    let (job, lease) = claim_on(&store, "y", &terms).await.unwrap().unwrap();
    assert_eq!(job.id, "a0");
    store.complete(&lease, &Outcome::Released("drained".into()), 3).await.unwrap();
    let (job, _) = claim_on(&store, "x", &terms).await.unwrap().unwrap();
    assert_eq!(job.id, "b0");
    assert_eq!(claim_on(&store, "x", &terms).await.unwrap(), None);
    // Nobody has heard of the other for the time of a lease.
    let short = Terms { lease: Duration::from_millis(1), ..terms };
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert_eq!(claim_on(&store, "x", &short).await.unwrap().unwrap().0.id, "a0");
}

/// Queues a job of an owner.
async fn queue(store: &Store, id: &str, owner: &str, priority: i32) {
    let new = NewJob { owner: owner.into(), priority, ..new_job("") };
    store.create(id, &new, &Limits::default()).await.unwrap();
}

async fn priority_comes_first_then_the_owner_with_least_then_age(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    let jobs = [
        ("a0", "ann", 0),
        ("a1", "ann", 0),
        ("a2", "ann", 0),
        ("b0", "bob", 0),
        ("b1", "bob", 0),
        ("low", "cid", -1),
        ("high", "ann", 7),
        ("c0", "cid", 0),
    ];
    for (id, owner, priority) in jobs {
        queue(&stores[0], id, owner, priority).await;
    }
    let mut order = Vec::new();
    while let Some((job, _)) = claim(&stores[order.len() % 2], &format!("w{}", order.len())).await {
        order.push(job.id);
    }
    // Ann has one at work by `high`; then everybody has one, and the oldest comes first.
    assert_eq!(order, ["high", "b0", "c0", "a0", "b1", "a1", "a2", "low"]);
}

async fn who_has_had_much_waits_for_who_has_had_little(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    for i in 0..3 {
        queue(&stores[0], &format!("a{i}"), "ann", 0).await;
    }
    let done = Outcome::Succeeded(vec![]);
    let mut order = Vec::new();
    // One worker; Bob comes late, and has short jobs.
    for i in 0..6 {
        let (job, lease) = claim(&stores[i % 2], "w").await.unwrap();
        if job.owner == "ann" {
            let update = "UPDATE jobs SET started_ms = started_ms - 3600000 WHERE id = $1";
            sqlx::query(update).bind(&job.id).execute(&stores[0].writers).await.unwrap();
        }
        stores[i % 2].complete(&lease, &done, 3).await.unwrap();
        order.push(job.id);
        if i == 0 {
            for i in 0..3 {
                queue(&stores[1], &format!("b{i}"), "bob", 0).await;
            }
        }
    }
    assert_eq!(order, ["a0", "b0", "b1", "b2", "a1", "a2"]);
}

async fn jobs_of_higher_priority_get_the_workers_of_lower_ones(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    let at_once = Terms { preempt_after: Duration::ZERO, ..Terms::default() };
    for (id, priority) in [("low", -1), ("old", 0), ("young", 0), ("equal", 5)] {
        queue(&stores[0], id, "ann", priority).await;
    }
    let mut leases = BTreeMap::new();
    for worker in ["w0", "w1", "w2", "w3"] {
        let (job, lease) = claim(&stores[0], worker).await.unwrap();
        leases.insert(job.id, lease);
        tokio::time::sleep(Duration::from_millis(3)).await;
    }
    let preempt = async |terms: &Terms| {
        tokio::time::sleep(Duration::from_millis(3)).await;
        let (a, b) = tokio::join!(stores[0].preempt(terms), stores[1].preempt(terms));
        let jobs = [a.unwrap(), b.unwrap()].concat();
        jobs.into_iter().map(|job| job.id).collect::<Vec<_>>()
    };
    for id in ["high0", "high1"] {
        queue(&stores[0], id, "bob", 5).await;
    }
    assert_eq!(preempt(&Terms::default()).await, [""; 0], "they have only just come");
    // The lowest makes room, and of equals the one that has done least.
    assert_eq!(preempt(&at_once).await, ["low", "young"]);
    assert_eq!(preempt(&at_once).await, [""; 0], "two are on their way");
    queue(&stores[0], "high2", "bob", 5).await;
    queue(&stores[0], "high3", "bob", 5).await;
    assert_eq!(preempt(&at_once).await, ["old"], "nobody makes room for an equal");
    let orders = stores[1].heartbeat(&leases["low"], &Terms::default()).await.unwrap();
    assert_eq!(orders, Orders { preempt: true, ..Orders::default() });
    let handed_back = Outcome::Released(String::new());
    let (low, _) = stores[1].complete(&leases["low"], &handed_back, 3).await.unwrap();
    assert_eq!((low.state, low.lost), (State::Queued, 0));
    assert_eq!(stores[0].attempts("low", 1).await.unwrap()[0].reason, "PREEMPTED");
    assert_eq!(claim(&stores[0], "w9").await.unwrap().0.id, "high0");
    // When it is its turn again nobody wants its worker.
    for id in ["high1", "high2", "high3"] {
        stores[0].cancel(id).await.unwrap();
    }
    let (low, lease) = claim(&stores[1], "w8").await.unwrap();
    assert_eq!((&*low.id, low.attempt), ("low", 2));
    let orders = stores[1].heartbeat(&lease, &Terms::default()).await.unwrap();
    assert_eq!(orders, Orders::default());
}

async fn a_drained_host_hands_its_job_back_and_gets_no_other(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    create(&stores[0], "a", 2).await;
    let terms = Terms::default();
    let (_, lease) = claim_on(&stores[0], "x", &terms).await.unwrap().unwrap();
    assert!(matches!(stores[1].drain("none").await, Err(Error::NotFound(_))));
    assert_eq!(stores[0].heartbeat(&lease, &terms).await.unwrap(), Orders::default());
    assert!(stores[1].drain("x").await.unwrap().drained);
    let orders = stores[0].heartbeat(&lease, &terms).await.unwrap();
    assert_eq!(orders, Orders { drain: true, ..Orders::default() });
    let (job, _) = stores[0].complete(&lease, &Outcome::Released(String::new()), 3).await.unwrap();
    assert_eq!((job.state, job.lost), (State::Queued, 0));
    // Another incarnation is no way around it, and an end of a quarantine neither.
    let (why, is_news) = refusal(claim_on(&stores[0], "x", &terms).await);
    assert!(why.contains("administrator") && !is_news, "{why}");
    let (_, other) = claim_on(&stores[1], "y", &terms).await.unwrap().unwrap();
    // It leaves before it has heard of its job.
    let lost = stores[1].lose_worker(&other.worker, Loss::Released, 3).await.unwrap();
    assert_eq!((lost.len(), lost[0].lost), (1, 0));
    assert!(!stores[1].reinstate("x").await.unwrap().drained);
    assert!(claim_on(&stores[0], "x", &terms).await.unwrap().is_some());
}

async fn a_retry_queues_what_did_not_succeed_anew(home: Home) {
    let stores: [Store; 2] = home.servers().await;
    add_mesh(&stores[0], "mesh").await;
    let room = Limits { max_owner_queued: 1, ..Limits::default() };
    stores[0].create("a", &to_be_told(), &room).await.unwrap();
    assert!(!stores[1].retry("a", &room).await.unwrap().1, "it waits already");
    for host in ["x", "y", "z"] {
        dies_on(&stores[0], host).await;
    }
    let poisoned = stores[1].job("a").await.unwrap();
    assert_eq!((&*poisoned.failure.0, poisoned.state), ("POISONED", State::Failed));
    let call = stores[0].take_calls(1, Duration::from_hours(1)).await.unwrap().remove(0);
    // There is room for one.
    stores[0].create("b", &new_job(""), &room).await.unwrap();
    let full = stores[0].retry("a", &room).await;
    assert!(matches!(full, Err(Error::Quota { quota: Quota::Queued, limit: 1 })));
    assert_eq!(stores[0].job("a").await.unwrap(), poisoned);
    stores[0].cancel("b").await.unwrap();
    // Asked twice at once, it is done once.
    let (one, two) = tokio::join!(stores[0].retry("a", &room), stores[1].retry("a", &room));
    let (one, two) = (one.unwrap(), two.unwrap());
    assert_eq!((one.1 ^ two.1, &one.0), (true, &two.0));
    let job = one.0;
    assert_eq!((job.state, job.lost, job.ended_ms, job.attempt), (State::Queued, 0, None, 3));
    assert_eq!(job.failure, (String::new(), String::new()));
    let log = stores[1].events("a", poisoned.last_seq, 9).await.unwrap();
    assert_eq!(log.len(), 2);
    assert!(matches!(&log[0].event.body,
        Body::Server(ServerEvent::Restarted { rewind_to_seq: 1, reason, .. }) if reason == "RETRIED"));
    assert_eq!(log[1].event.body.state(), Some(State::Queued));
    // What is heard of the call about its first end does not end the call about the next one.
    stores[0].end_call(&call, &CallEnd::Delivered).await.unwrap();
    assert_eq!(dies_on(&stores[0], "x").await.lost, 1, "what was lost before does not count");
    stores[0].cancel("a").await.unwrap();
    let next = stores[0].take_calls(9, Duration::from_hours(1)).await.unwrap();
    let told: Vec<_> = next.iter().map(|next| (&*next.job.id, next.attempt)).collect();
    assert!(told == [("a", 1)] && next[0].id != call.id, "{told:?}");
    assert_eq!(stores[0].retry("a", &room).await.unwrap().0.state, State::Queued);
    let (_, lease) = claim(&stores[0], "w").await.unwrap();
    stores[0].cancel("a").await.unwrap();
    assert!(matches!(stores[0].retry("a", &room).await, Err(Error::Illegal { .. })));
    stores[0].complete(&lease, &Outcome::Cancelled, 3).await.unwrap();
    stores[0].retry("a", &room).await.unwrap();
    let (job, lease) = claim(&stores[0], "w").await.unwrap();
    assert!(!job.cancel_requested && job.attempt == 6);
    stores[0].complete(&lease, &Outcome::Succeeded(vec![]), 3).await.unwrap();
    let refused = stores[1].retry("a", &room).await.unwrap_err();
    assert!(refused.to_string().contains("submit it again"), "{refused}");
}

async fn the_queue_is_told_by_owner_and_priority(home: Home) {
    let [store] = home.servers().await;
    assert_eq!(store.queue().await.unwrap(), []);
    add_mesh(&store, "mesh").await;
    for (id, owner, priority) in
        [("a", "bob", 0), ("b", "ann", 0), ("c", "ann", -2), ("d", "ann", 0), ("e", "zoe", 9)]
    {
        queue(&store, id, owner, priority).await;
    }
    claim(&store, "w").await.unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    let told = store.queue().await.unwrap();
    let rows: Vec<_> = told.iter().map(|w| (&*w.owner, w.priority, w.n_jobs)).collect();
    assert_eq!(rows, [("ann", -2, 1), ("ann", 0, 2), ("bob", 0, 1)]);
    assert!(told.iter().all(|w| (0.02..60.0).contains(&w.oldest_secs)), "{told:?}");
}
