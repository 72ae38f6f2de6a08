//! Logs of jobs, and the spans that are made of them.

use std::{collections::BTreeMap, time::Duration};

use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use super::*;
use crate::{
    jobs::{
        Limits,
        clients::Announced,
        lease::{Lease, Terms},
        principal::LOCAL,
        spec::Spec,
        store::{NewJob, Outcome},
    },
    telemetry::trace::Value,
};

const CALLER: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

/// Jobs in a folder, and one of them that was created by a call with this `traceparent`.
async fn created(trace: &str) -> (tempfile::TempDir, Jobs, String) {
    let dir = tempfile::tempdir().unwrap();
    let jobs = Jobs::open(dir.path(), Terms::default(), Limits::default()).await.unwrap();
    let (send, chunks) = mpsc::channel(1);
    send.try_send(Bytes::from_static(b"mesh")).unwrap();
    drop(send);
    let mesh = jobs.put_mesh(LOCAL, Announced::default(), chunks).await.unwrap().hash;
    let new = NewJob {
        owner: LOCAL.into(),
        request_id: String::new(),
        mesh,
        file_name: "a.ply".into(),
        spec: Spec::new(vec![5]),
        priority: 0,
        labels: std::collections::BTreeMap::default(),
        webhook: String::new(),
        trace: trace.into(),
    };
    let id = jobs.create(new, vec![]).await.unwrap().id;
    (dir, jobs, id)
}

async fn claim(jobs: &Jobs, worker: &str) -> Lease {
    let job = jobs.claim(worker, Duration::ZERO).await.unwrap().unwrap();
    Lease { job: job.id, epoch: job.epoch, worker: worker.into() }
}

fn sample(stage: &str, level: Option<u32>, evaluations: u64) -> Report {
    Report::Sample(EnergySample {
        stage: stage.into(),
        evaluations,
        seconds: 1.0,
        triangles: 500,
        energy: Some(77),
        d2: Some(0.5),
        level,
        energy_ratio: None,
        d2_unseen: None,
        turn: None,
    })
}

fn progress(stage: &str) -> Report {
    Report::Progress { stage: stage.into(), fraction: 0.5, eta_secs: None }
}

fn work() -> Vec<Report> {
    let note = |code: &str, text: &str| Report::Note { code: code.into(), text: text.into() };
    let file = Report::Artifact { name: "a".into(), media_type: "b".into(), size: 1 };
    vec![
        note("MODEL_READ", "…"),
        sample("memoryless", None, 0),
        note("DEVICE_CHOSEN", "native, 16 lanes"),
        progress("image"),
        sample("image", None, 40),
        sample("image", None, 60),
        progress("optimize"),
        sample("optimize", Some(0), 100),
        progress("optimize"),
        sample("optimize", Some(1), 130),
        file,
    ]
}

/// The spans as `name < parent`, and that of each name.
fn tree(told: &[Span]) -> (Vec<String>, BTreeMap<String, Span>) {
    let name_of = |id| {
        let parent = told.iter().find(|span| span.at.span == id);
        parent.map_or_else(|| format!("{id:016x}"), |span| span.name.clone())
    };
    let line = |s: &Span| format!("{} < {}", s.name, s.parent.map_or("-".into(), name_of));
    let by_name = told.iter().map(|span| (span.name.clone(), span.clone())).collect();
    (told.iter().map(line).collect(), by_name)
}

fn said<'s>(span: &'s Span, name: &str) -> Option<&'s Value> {
    span.attributes.iter().find(|attribute| attribute.0 == name).map(|attribute| &attribute.1)
}

#[tokio::test]
async fn a_job_is_a_tree_below_the_call_that_created_it() {
    let (_dir, jobs, id) = created(CALLER).await;
    let lease = claim(&jobs, "w").await;
    jobs.append(&lease, 0, work()).await.unwrap();
    let (done, _) = jobs.complete(&lease, &Outcome::Succeeded(vec![])).await.unwrap();
    let told = told(&jobs, &id, done.last_seq).await.unwrap();
    let (lines, spans) = tree(&told);
    let wanted = [
        "queue < job",
        "attempt < job",
        "prepare < attempt",
        "memoryless < attempt",
        "image < attempt",
        "optimize < attempt",
        "optimize < attempt",
        "write < attempt",
        "job < 00f067aa0ba902b7",
    ];
    assert_eq!(lines, wanted);
    let caller = TraceContext::parse(CALLER).unwrap();
    assert!(told.iter().all(|span| span.at.trace == caller.trace && span.end >= span.start));
    assert!(told.iter().all(|span| span.error.is_none()));
    let device = Value::from("native, 16 lanes");
    assert_eq!(said(&spans["attempt"], "lookalike.device"), Some(&device));
    let evaluations = |span: &Span| said(span, "lookalike.evaluations").cloned();
    let optimize = |level: u32| {
        let is_level = |s: &&Span| said(s, "lookalike.level") == Some(&level.into());
        evaluations(told.iter().find(is_level).unwrap())
    };
    assert_eq!(evaluations(&spans["image"]), Some(60_u64.into()));
    assert_eq!((optimize(0), optimize(1)), (Some(100_u64.into()), Some(30_u64.into())));
    assert_eq!(said(&spans["job"], "lookalike.state"), Some(&"SUCCEEDED".into()));
}

#[tokio::test]
async fn attempts_and_retries_fit_together_whoever_tells_of_them() {
    let (_dir, jobs, id) = created("").await;
    let first = claim(&jobs, "w1").await;
    jobs.append(&first, 0, vec![progress("image")]).await.unwrap();
    let lost = jobs.worker_gone("w1").await.unwrap().remove(0);
    let lost = told(&jobs, &id, lost.last_seq).await.unwrap();
    assert_eq!(tree(&lost).0.len(), 4, "{lost:?}");
    let second = claim(&jobs, "w2").await;
    let failed = Outcome::Failed("NO".into(), "use another".into());
    let (failed, _) = jobs.complete(&second, &failed).await.unwrap();
    let failed = told(&jobs, &id, failed.last_seq).await.unwrap();
    jobs.retry(&id).await.unwrap();
    let (cancelled, _) = jobs.cancel(&id).await.unwrap();
    let again = told(&jobs, &id, cancelled.last_seq).await.unwrap();
    // Its id numbers its trace, and nothing is above it.
    let trace = u128::from_str_radix(&id, 16).unwrap();
    let job = failed.last().unwrap();
    assert_eq!((job.name.as_str(), job.parent, job.at.trace), ("job", None, trace));
    let attempts: Vec<_> =
        [&lost, &failed].into_iter().flatten().filter(|s| s.name == "attempt").collect();
    let errors: Vec<_> = attempts.iter().map(|s| s.error.as_deref().unwrap()).collect();
    assert_eq!(errors, ["WORKER_EXITED", "NO"]);
    assert!(attempts.iter().all(|attempt| attempt.parent == Some(job.at.span)));
    assert_eq!(tree(&again).0, ["queue < job", "job < -"]);
    let all: Vec<_> = [lost, failed, again].concat();
    assert!(all.iter().all(|span| span.at.trace == trace));
    let ids: std::collections::BTreeSet<_> = all.iter().map(|span| span.at.span).collect();
    assert_eq!(ids.len(), all.len());
}

#[tokio::test]
async fn a_job_that_nobody_wants_to_see_is_not_told_of() {
    let (_dir, jobs, id) = created(&CALLER.replace("-01", "-00")).await;
    let (spans, mut kept) = Spans::kept();
    let stop = CancellationToken::new();
    let (traces, task) = trace_jobs(jobs.clone(), spans, stop.clone());
    let (job, _) = jobs.cancel(&id).await.unwrap();
    traces.ended(&job);
    stop.cancel();
    task.await;
    assert!(kept.try_recv().is_err());
}
