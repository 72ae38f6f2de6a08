//! Who gets which job, over real processes: bad workers and bad jobs, drain, preemption, retry.

use std::{
    ops::ControlFlow,
    path::Path,
    process::{Child, Stdio},
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use lookalike::{
    jobs::{event::Report, spec::Spec, state::State},
    service::{client::Access, proto::v1},
    tape::Tape,
    worker::{
        agent::{self, WorkerConfig, WorkerError},
        pipeline::{DeviceChoice, Inputs, PipelineError},
    },
};
use rustix::process::Signal;
use serde_json::json;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::{
    api::http_get,
    processes::{reasons, running},
    support::{
        Client, LONG_JOB, Server, create, create_request, ended, eventually, job, log, lookalike,
        signal, small_torus, state, upload,
    },
    web::Web,
};

/// A worker of this test's own process, which runs `pipeline` for every job.
fn config(
    server: &Server,
    host: &str,
    pipeline: lookalike::worker::pipeline::Pipeline,
) -> WorkerConfig {
    WorkerConfig {
        url: server.url.clone(),
        access: Access::default(),
        id: format!("{host}-{}", uuid::Uuid::new_v4().simple()),
        host: host.into(),
        device: DeviceChoice("cpu".into()),
        pipeline,
        scratch: server.dir.path().join(format!("scratch-{host}")),
        lock: None,
        supervised: false,
        give_up: Duration::from_secs(5),
        drain: Duration::from_millis(100),
        cpu_secs: 0,
    }
}

/// A worker process on `host`.
fn worker(server: &Server, host: &str) -> Child {
    let mut worker = lookalike();
    worker.args(["worker", "--device=cpu", "--connect", &server.url, "--host", host]);
    worker.stderr(Stdio::null()).spawn().unwrap()
}

fn end(mut worker: Child) {
    signal(worker.id(), Signal::TERM);
    assert!(worker.wait().unwrap().success());
}

fn said(server: &Server, command: &str, flags: &[&str]) -> String {
    let output = server.run(command, flags);
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn breaks(
    _: &Spec,
    _: &Inputs<'_>,
    _: &Path,
    _: (&DeviceChoice, &Tape),
    _: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    panic!("the device is gone")
}

#[tokio::test]
async fn a_bad_worker_is_taken_out_of_service_and_its_jobs_are_done_elsewhere() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let mut names = Vec::new();
    for _ in 0..3 {
        names.push(create(&mut client).await);
    }
    for _ in 0..3 {
        let ended = agent::run(config(&server, "bad", breaks), CancellationToken::new()).await;
        assert!(matches!(ended, Err(WorkerError::Tainted)), "{ended:?}");
    }
    // The next incarnation gets nothing, and does not end for it.
    let stop = CancellationToken::new();
    let mut idle = JoinSet::new();
    idle.spawn(agent::run(config(&server, "bad", breaks), stop.clone()));
    let line = eventually("the quarantine", || async {
        let workers = said(&server, "workers", &[]);
        workers.contains("QUARANTINED").then_some(workers)
    })
    .await;
    assert!(line.contains("workers/bad") && line.contains(&names[0]), "{line}");
    let good = worker(&server, "good");
    for name in &names {
        let done = ended(&client, name).await;
        assert_eq!((state(&done), done.attempt), (State::Succeeded, 2));
    }
    let request = v1::GetJobRequest { name: names[0].clone() };
    let history = client.get_job(request).await.unwrap().into_inner().attempts;
    let history: Vec<_> = history.iter().map(|a| (&*a.host, &*a.reason, a.counts)).collect();
    let (done, failed) = ("COMPLETED", "ATTEMPT_FAILED");
    assert_eq!(history, [("workers/good", done, false), ("workers/bad", failed, true)]);
    let metrics = http_get(&server.metrics, "/metrics");
    assert!(metrics.contains("lookalike_quarantines_total 1"), "{metrics}");
    assert!(metrics.contains("lookalike_workers{state=\"quarantined\"} 1"), "{metrics}");
    assert!(server.logged().contains("out of service"));
    let line = said(&server, "workers", &["reinstate", "bad"]);
    assert!(line.contains("IN_SERVICE"), "{line}");
    end(good);
    create(&mut client).await;
    let ended = idle.join_next().await.unwrap().unwrap();
    assert!(matches!(ended, Err(WorkerError::Tainted)), "it is in service again: {ended:?}");
    stop.cancel();
}

#[tokio::test]
async fn a_drained_worker_hands_its_job_back_until_it_is_reinstated() {
    let server =
        Server::start_with(&["--workers=0", "--checkpoint-secs=0", "--heartbeat-secs=0.1"]);
    let mut client = server.client();
    let first = worker(&server, "first");
    let name = create_long(&mut client, &server, 0).await;
    running(&server, &name).await;
    let line = said(&server, "workers", &["drain", "workers/first"]);
    assert!(line.contains("DRAINED"), "{line}");
    eventually("the job to be handed back", || {
        let (mut client, name) = (client.clone(), name.clone());
        async move { (state(&job(&mut client, &name).await) == State::Queued).then_some(()) }
    })
    .await;
    // The process lives, and works no more; whoever else comes does.
    let small = create(&mut client).await;
    let cancelled = v1::CancelJobRequest { name: name.clone() };
    client.cancel_job(cancelled).await.unwrap();
    let second = worker(&server, "second");
    let done = ended(&client, &small).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 1));
    let wanted = ["CREATED", "CLAIMED", "RESTARTED", "RELEASED", "CANCELLED"];
    assert_eq!(reasons(&log(&mut client, &name, 0).await), wanted);
    end(second);
    let small = create(&mut client).await;
    said(&server, "workers", &["reinstate", "first"]);
    assert_eq!(state(&ended(&client, &small).await), State::Succeeded);
    end(first);
}

/// Queues a job that takes long; its name.
async fn create_long(client: &mut Client, server: &Server, priority: i32) -> String {
    let file = server.file("torus.ply", &small_torus());
    let priority = format!("--priority={priority}");
    let flags = [&[&*file, "--no-wait", &priority], &LONG_JOB[..]].concat();
    let name = said(server, "submit", &flags).trim().to_owned();
    // A worker may be faster than the command line.
    assert!(!state(&job(client, &name).await).is_final());
    name
}

#[tokio::test]
async fn a_worker_that_ends_while_it_is_given_a_job_loses_none() {
    // The lease alone would keep a job that was lost on the way for an hour.
    let server = Server::start_with(&["--workers=0", "--lease-secs=3600", "--heartbeat-secs=1"]);
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    for round in 0..12_u64 {
        let asks = worker(&server, &format!("host-{round}"));
        eventually("the worker to ask", || async {
            said(&server, "workers", &[]).contains(&format!("host-{round}")).then_some(())
        })
        .await;
        let created = client.create_job(create_request(&mesh, "")).await.unwrap();
        let name = created.into_inner().job.unwrap().name;
        tokio::time::sleep(Duration::from_micros(round * 400)).await;
        end(asks);
        let left = job(&mut client, &name).await;
        assert!([State::Queued, State::Succeeded].contains(&state(&left)), "{left:?}");
        let request = v1::GetJobRequest { name: name.clone() };
        let history = client.get_job(request).await.unwrap().into_inner().attempts;
        assert!(history.iter().all(|attempt| !attempt.counts), "{history:?}");
        // It does not get into the way of the next round.
        let _ = client.cancel_job(v1::CancelJobRequest { name }).await;
    }
}

static IS_OVER: AtomicBool = AtomicBool::new(false);

/// Does not listen.
fn goes_on(
    _: &Spec,
    _: &Inputs<'_>,
    _: &Path,
    _: (&DeviceChoice, &Tape),
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    let _ = on(Report::Note { code: "DEAF".into(), text: "nobody stops me".into() });
    while !IS_OVER.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(10));
    }
    Err(PipelineError::Cancelled)
}

#[tokio::test]
async fn a_pipeline_that_does_not_stop_loses_its_job_and_its_process() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let drain = CancellationToken::new();
    let mut agents = JoinSet::new();
    agents.spawn(agent::run(config(&server, "deaf", goes_on), drain.clone()));
    running(&server, &name).await;
    drain.cancel();
    let ended = agents.join_next().await.unwrap().unwrap();
    assert!(matches!(ended, Err(WorkerError::Stuck)), "{ended:?}");
    let left = job(&mut client, &name).await;
    assert_eq!((state(&left), left.attempt), (State::Queued, 1));
    IS_OVER.store(true, Ordering::Relaxed);
    let events = v1::WatchJobRequest { name, after_seq: left.last_seq - 1 };
    let last = client.watch_job(events).await.unwrap().into_inner().message().await.unwrap();
    let Some(v1::job_event::Body::StateChanged(last)) = last.unwrap().event.unwrap().body else {
        panic!("the last event is of another kind")
    };
    assert_eq!(last.reason, "RELEASED");
    assert!(last.text.contains("did not stop in time"), "{}", last.text);
}

#[tokio::test]
async fn a_job_of_high_priority_gets_the_worker_of_one_of_low_priority() {
    let flags =
        ["--workers=1", "--heartbeat-secs=0.1", "--preempt-after-secs=0.2", "--checkpoint-secs=0"];
    let server = Server::start_with(&flags);
    let mut client = server.client();
    let low = create_long(&mut client, &server, -3).await;
    running(&server, &low).await;
    let mesh = upload(&mut client, small_torus()).await;
    let request = v1::CreateJobRequest { priority: 3, ..create_request(&mesh, "") };
    let high = client.create_job(request).await.unwrap().into_inner().job.unwrap();
    assert_eq!(high.priority, 3);
    let done = ended(&client, &high.name).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 1));
    client.cancel_job(v1::CancelJobRequest { name: low.clone() }).await.unwrap();
    assert_eq!(state(&ended(&client, &low).await), State::Cancelled);
    let reasons = reasons(&log(&mut client, &low, 0).await);
    assert_eq!(reasons[..4], ["CREATED", "CLAIMED", "RESTARTED", "PREEMPTED"]);
    let bad = v1::CreateJobRequest { priority: 11, ..create_request(&mesh, "") };
    let refused = client.create_job(bad).await.unwrap_err();
    assert!(refused.message().contains("priority: 11: use -10 to 10"), "{refused:?}");
}

#[tokio::test]
async fn what_did_not_succeed_can_be_retried() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let cancelled = create(&mut client).await;
    client.cancel_job(v1::CancelJobRequest { name: cancelled.clone() }).await.unwrap();
    let first = log(&mut client, &cancelled, 0).await;
    let line = said(&server, "retry", &[&cancelled]);
    assert!(line.contains("QUEUED"), "{line}");
    // Who has seen the first end sees the second, and who begins anew sees both.
    let whole = client.clone();
    let watching = log(&mut client, &cancelled, first.len() as u64);
    let work = async {
        let worker = worker(&server, "w");
        assert_eq!(state(&ended(&whole, &cancelled).await), State::Succeeded);
        worker
    };
    let (rest, worker) = tokio::join!(watching, work);
    let wanted = ["CREATED", "CANCELLED", "RESTARTED", "RETRIED", "CLAIMED", "COMPLETED"];
    assert_eq!(reasons(&[first, rest].concat()), wanted);
    assert_eq!(reasons(&log(&mut client, &cancelled, 0).await), wanted);
    // It fails whenever it is tried, and says so each time.
    let mesh = upload(&mut client, b"no mesh".to_vec()).await;
    let created = client.create_job(create_request(&mesh, "")).await.unwrap();
    let bad = created.into_inner().job.unwrap().name;
    let failed = ended(&client, &bad).await;
    let answer = Web::new(&server, None).post(&format!("/api/v1/{bad}:retry"), json!({})).await;
    assert_eq!(answer.status(), 200);
    let again = eventually("the second end", || {
        let (mut client, bad) = (client.clone(), bad.clone());
        async move {
            Some(job(&mut client, &bad).await).filter(|j| j.attempt == 2 && state(j).is_final())
        }
    })
    .await;
    assert_eq!((&again.failure, state(&again)), (&failed.failure, State::Failed));
    let refused = server.run("retry", &[&cancelled]);
    let text = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.status.code() == Some(1) && text.contains("submit it again"), "{text}");
    end(worker);
}
