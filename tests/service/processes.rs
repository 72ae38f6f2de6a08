//! Processes that end, in peace or not.

use std::{
    process::Stdio,
    time::{Duration, Instant},
};

use lookalike::{
    jobs::{
        event::{Body, Event, ServerEvent},
        state::State,
    },
    service::proto::v1,
};
use rustix::process::Signal;

use crate::support::{
    JOB, Server, create, ended, eventually, free_ports, job, log, lookalike, reference, results,
    signal, small_torus, state,
};

pub(crate) async fn running(server: &Server, name: &str) {
    let mut client = server.client();
    eventually("the job to run", || {
        let mut client = client.clone();
        async move { (state(&job(&mut client, name).await) == State::Running).then_some(()) }
    })
    .await;
    // It stays true until somebody acts.
    assert!(job(&mut client, name).await.attempt > 0);
}

pub(crate) fn reasons(log: &[Event]) -> Vec<String> {
    let reason = |event: &Event| match &event.body {
        Body::Server(ServerEvent::StateChanged { reason, .. }) => Some(reason.clone()),
        Body::Server(ServerEvent::Restarted { .. }) => Some("RESTARTED".into()),
        Body::Worker(_) => None,
    };
    log.iter().filter_map(reason).collect()
}

#[tokio::test]
async fn a_killed_worker_costs_an_attempt_and_says_so() {
    let server = Server::start();
    let pid = server.workers_up(1).await[0];
    let mut client = server.client();
    let name = create(&mut client).await;
    running(&server, &name).await;
    signal(pid, Signal::KILL);
    let done = ended(&client, &name).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 2));
    let log = log(&mut client, &name, 0).await;
    let wanted = ["CREATED", "CLAIMED", "RESTARTED", "WORKER_EXITED", "CLAIMED", "COMPLETED"];
    assert_eq!(reasons(&log), wanted);
    let (Body::Server(ServerEvent::Restarted { rewind_to_seq, text, .. }), 1) = log
        .iter()
        .find_map(|event| {
            matches!(&event.body, Body::Server(ServerEvent::Restarted { .. }))
                .then(|| (event.body.clone(), event.epoch))
        })
        .unwrap()
    else {
        panic!("no restart in {log:?}")
    };
    assert_eq!(rewind_to_seq, 1);
    assert!(text.contains("the job starts over"), "{text}");
}

#[tokio::test]
async fn a_job_survives_the_death_of_its_server() {
    let mut server = Server::start();
    let mut client = server.client();
    let name = create(&mut client).await;
    running(&server, &name).await;
    server.kill();
    tokio::time::sleep(Duration::from_millis(300)).await;
    server.restart();
    let done = ended(&client, &name).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 1));
    assert_eq!(reasons(&log(&mut client, &name, 0).await), ["CREATED", "CLAIMED", "COMPLETED"]);
}

#[tokio::test]
async fn a_submission_outlasts_the_death_of_its_server() {
    let mut server = Server::start();
    let (file, out) = (server.file("torus.ply", &small_torus()), server.dir.path().join("out"));
    let out_text = out.display().to_string();
    let mut submit = server.command("submit", &[&[&*file, "--out", &out_text], &JOB[..]].concat());
    let submit = submit.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut client = server.client();
    eventually("the job", || {
        let mut client = client.clone();
        async move {
            let jobs = client.list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner();
            jobs.jobs.first().filter(|job| state(job) != State::Queued).map(drop)
        }
    })
    .await;
    server.kill();
    tokio::time::sleep(Duration::from_millis(200)).await;
    server.restart();
    let output = submit.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    assert_eq!(results(&out), reference(&server));
    let jobs = client.list_jobs(v1::ListJobsRequest::default()).await.unwrap().into_inner().jobs;
    assert_eq!(jobs.len(), 1);
}

#[tokio::test]
async fn workers_join_from_elsewhere_and_leave_in_peace() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let mut worker = lookalike();
    worker.args(["worker", "--device=cpu", "--connect", &server.url]);
    let mut worker = worker.stderr(Stdio::null()).spawn().unwrap();
    assert_eq!(state(&ended(&client, &name).await), State::Succeeded);
    let next = create(&mut client).await;
    running(&server, &next).await;
    signal(worker.id(), Signal::TERM);
    assert!(worker.wait().unwrap().success());
    let handed_back = job(&mut client, &next).await;
    assert_eq!((state(&handed_back), handed_back.attempt), (State::Queued, 1));
}

#[test]
fn workers_give_up_on_a_server_that_never_comes() {
    let [nobody] = free_ports();
    let url = format!("http://{nobody}");
    let output = lookalike().args(["worker", "--connect", &url, "--give-up-secs=1"]).output();
    let output = output.unwrap();
    assert_eq!(output.status.code(), Some(3), "{output:?}");
}

#[tokio::test]
async fn the_death_of_server_and_worker_costs_an_attempt_at_once() {
    // The lease alone would keep the job for an hour.
    let mut server =
        Server::start_with(&["--workers=1", "--lease-secs=3600", "--heartbeat-secs=1"]);
    let pids = server.workers_up(1).await;
    let mut client = server.client();
    let name = create(&mut client).await;
    running(&server, &name).await;
    server.kill();
    for pid in pids {
        signal(pid, Signal::KILL);
    }
    server.restart();
    let done = ended(&client, &name).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 2));
    assert!(reasons(&log(&mut client, &name, 0).await).contains(&"SERVER_RESTARTED".into()));
}

#[tokio::test]
async fn a_frozen_worker_loses_its_lease_and_learns_of_it() {
    let server = Server::start_with(&["--workers=2", "--lease-secs=0.6", "--heartbeat-secs=0.1"]);
    let pids = server.workers_up(2).await;
    let mut client = server.client();
    let name = create(&mut client).await;
    running(&server, &name).await;
    let owner = job_owner(&mut client, &name).await;
    let frozen = pids.into_iter().find(|&pid| command_of(pid).contains(&owner)).unwrap();
    signal(frozen, Signal::STOP);
    let done = ended(&client, &name).await;
    signal(frozen, Signal::CONT);
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 2));
    assert!(reasons(&log(&mut client, &name, 0).await).contains(&"LEASE_EXPIRED".into()));
    // Awake again, it changes nothing and takes the next job.
    let next = create(&mut client).await;
    assert_eq!(state(&ended(&client, &next).await), State::Succeeded);
    assert_eq!(job(&mut client, &name).await, done);
}

async fn job_owner(client: &mut crate::support::Client, name: &str) -> String {
    let request = v1::WatchJobRequest { name: name.into(), after_seq: 1 };
    let mut events = client.watch_job(request).await.unwrap().into_inner();
    match events.message().await.unwrap().unwrap().event.unwrap().body.unwrap() {
        v1::job_event::Body::StateChanged(claimed) => claimed.worker,
        other => panic!("the second entry is {other:?}"),
    }
}

fn command_of(pid: u32) -> String {
    let command = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
    String::from_utf8_lossy(&command).into_owned()
}

#[tokio::test]
async fn a_server_ends_in_peace_and_hands_its_jobs_back() {
    let mut server = Server::start_with(&["--workers=1", "--drain-secs=20"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    running(&server, &name).await;
    // A peer that is stuck (this thread waits below, and nobody polls its connection) must not hold
    // the server.
    let request = v1::WatchJobRequest { name: name.clone(), after_seq: 0 };
    let mut open = client.watch_job(request).await.unwrap().into_inner();
    open.message().await.unwrap();
    let (took, well) = server.terminate();
    assert!(well && took < Duration::from_secs(15), "{took:?}");
    assert_eq!(server.worker_pids(), Vec::<u32>::new());
    server.restart();
    let done = ended(&client, &name).await;
    assert_eq!(state(&done), State::Succeeded);
    let reasons = reasons(&log(&mut client, &name, 0).await);
    assert!(reasons.contains(&"RELEASED".into()), "{reasons:?}");
}

#[tokio::test]
async fn idle_workers_do_not_outlive_their_server() {
    let mut server = Server::start();
    server.workers_up(1).await;
    server.kill();
    eventually("the worker to end", || async { server.worker_pids().is_empty().then_some(()) })
        .await;
}

#[test]
fn a_second_server_is_refused() {
    let server = Server::start_with(&["--workers=0"]);
    let [listen, metrics] = free_ports();
    let start = Instant::now();
    let mut second = lookalike();
    second.args(["serve", "--listen", &listen, "--metrics-listen", &metrics, "--data-dir"]);
    let output = second.arg(server.data_dir()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("in use by another server"));
    assert!(start.elapsed() < Duration::from_secs(10));
}
