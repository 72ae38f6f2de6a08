//! A pipeline that panics: what clients, the log and the worker see of it.

use std::{ops::ControlFlow, path::Path, time::Duration};

use lookalike::{
    jobs::{
        event::{Body, Report, ServerEvent},
        spec::Spec,
        state::State,
    },
    service::{client::Access, proto::v1},
    tape::Tape,
    worker::{
        agent::{self, WorkerConfig, WorkerError},
        pipeline::{self, DeviceChoice, Inputs, PipelineError},
    },
};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::support::{
    Client, Server, create, create_request, ended, log, small_torus, state, upload,
};

/// The real pipeline, but for a file of this name.
const CURSED: &str = "cursed.ply";

fn panics_on_the_cursed(
    spec: &Spec,
    inputs: &Inputs<'_>,
    out_dir: &Path,
    machine: (&DeviceChoice, &Tape),
    on: &mut dyn FnMut(Report) -> ControlFlow<()>,
) -> Result<(), PipelineError> {
    assert!(inputs.original.name != CURSED, "index 7 is out of bounds");
    pipeline::run(spec, inputs, out_dir, machine, on)
}

/// A worker, and a fresh one whenever it ends, as a supervisor does it.
async fn crew(url: String, scratch: std::path::PathBuf) -> u32 {
    let mut n_tainted = 0;
    loop {
        let config = WorkerConfig {
            host: String::new(),
            drain: Duration::from_secs(10),
            url: url.clone(),
            access: Access::default(),
            id: format!("incarnation-{n_tainted}"),
            device: DeviceChoice("cpu".into()),
            pipeline: panics_on_the_cursed,
            scratch: scratch.clone(),
            lock: None,
            supervised: false,
            give_up: Duration::from_secs(2),
            cpu_secs: 0,
        };
        match agent::run(config, CancellationToken::new()).await {
            Err(WorkerError::Tainted) => n_tainted += 1,
            // The server is gone: the test is over.
            _ => return n_tainted,
        }
    }
}

async fn create_cursed(client: &mut Client) -> String {
    let mesh = upload(client, small_torus()).await;
    let request = v1::CreateJobRequest { file_name: CURSED.into(), ..create_request(&mesh, "") };
    client.create_job(request).await.unwrap().into_inner().job.unwrap().name
}

#[tokio::test]
async fn a_panic_fails_the_job_and_not_the_next() {
    let mut server = Server::start_with(&["--workers=0", "--max-attempts=2"]);
    let mut client = server.client();
    let cursed = create_cursed(&mut client).await;
    let next = create(&mut client).await;
    let mut workers = JoinSet::new();
    workers.spawn(crew(server.url.clone(), server.dir.path().join("scratch")));

    let done = ended(&client, &cursed).await;
    assert_eq!((state(&done), done.attempt), (State::Failed, 2));
    let failure = done.failure.unwrap();
    assert_eq!(failure.reason, "POISONED");
    assert!(failure.text.contains("panicked: index 7 is out of bounds"), "{}", failure.text);

    let log = log(&mut client, &cursed, 0).await;
    let restarts: Vec<_> = log
        .iter()
        .filter_map(|event| match &event.body {
            Body::Server(ServerEvent::Restarted { lost_attempt, reason, text, .. }) => {
                Some((*lost_attempt, reason.as_str(), text.contains("index 7")))
            }
            _ => None,
        })
        .collect();
    assert_eq!(restarts, [(1, "ATTEMPT_FAILED", true)]);
    assert_eq!(log.last().unwrap().body.state(), Some(State::Failed));

    let done = ended(&client, &next).await;
    assert_eq!((state(&done), done.attempt), (State::Succeeded, 1));
    server.kill();
    let n_tainted = workers.join_next().await.unwrap().unwrap();
    assert_eq!(n_tainted, 2, "each panic ends its worker");
}
