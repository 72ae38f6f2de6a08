//! The worker API over a real socket, spoken by the test itself.

use lookalike::{
    jobs::event::{Body, ServerEvent},
    service::{
        proto::{v1, worker::v1 as wire},
        status::reason_of,
    },
};
use tonic::{Code, Status};

use crate::support::{Server, create, job, log};

fn claim_as(worker: &str) -> wire::ClaimRequest {
    let version = env!("CARGO_PKG_VERSION").into();
    let (worker, build) = (worker.into(), "b".into());
    wire::ClaimRequest { worker, version, wait_secs: 5.0, build, host: String::new() }
}

async fn claim(server: &Server, worker: &str) -> wire::Assignment {
    let answer = server.worker_client().claim(claim_as(worker)).await.unwrap();
    answer.into_inner().assignment.expect("a job is queued")
}

fn artifact(lease: &wire::Lease, bytes: &'static [u8]) -> [wire::PutArtifactRequest; 2] {
    use wire::put_artifact_request::Part;
    let header = wire::PutArtifactHeader {
        lease: Some(lease.clone()),
        file: "lod-0.glb".into(),
        media_type: "model/gltf-binary".into(),
        size: bytes.len() as u64,
        blake3: blake3::hash(bytes).to_hex().to_string(),
    };
    [Part::Header(header), Part::Chunk(bytes.into())]
        .map(|part| wire::PutArtifactRequest { part: Some(part) })
}

fn piece(lease: &wire::Lease, n: u32, bytes: &'static [u8]) -> [wire::PutCheckpointRequest; 2] {
    use wire::put_checkpoint_request::Part;
    let header = wire::PutCheckpointHeader {
        lease: Some(lease.clone()),
        piece: n,
        size: bytes.len() as u64,
        blake3: blake3::hash(bytes).to_hex().to_string(),
        build: "b".into(),
    };
    [Part::Header(header), Part::Chunk(bytes.into())]
        .map(|part| wire::PutCheckpointRequest { part: Some(part) })
}

/// Every call that a worker can make on a job.
pub(crate) async fn every_call(server: &Server, lease: &wire::Lease) -> Vec<Result<(), Status>> {
    let mut client = server.worker_client();
    let lease = Some(lease.clone());
    let outcome = wire::complete_request::Outcome::Succeeded(wire::Succeeded { files: vec![] });
    let append = wire::AppendEventsRequest { lease: lease.clone(), ..Default::default() };
    let complete = wire::CompleteRequest { lease: lease.clone(), outcome: Some(outcome) };
    let put = futures::stream::iter(artifact(lease.as_ref().unwrap(), b"late"));
    let piece = futures::stream::iter(piece(lease.as_ref().unwrap(), 0, b"late"));
    let fetch = wire::FetchCheckpointRequest { lease: lease.clone() };
    vec![
        client.heartbeat(wire::HeartbeatRequest { lease: lease.clone() }).await.map(drop),
        client
            .fetch_mesh(wire::FetchMeshRequest { lease: lease.clone(), ..Default::default() })
            .await
            .map(drop),
        client.append_events(append).await.map(drop),
        client.put_artifact(put).await.map(drop),
        client.put_checkpoint(piece).await.map(drop),
        client.fetch_checkpoint(fetch).await.map(drop),
        client.complete(complete).await.map(drop),
    ]
}

#[tokio::test]
async fn a_stale_epoch_is_refused_on_every_call() {
    let server = Server::start_with(&["--workers=0", "--lease-secs=2", "--heartbeat-secs=0.1"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let old = claim(&server, "slow").await.lease.unwrap();
    // The lease runs out, and the job goes to the next one who asks.
    let new = claim(&server, "quick").await.lease.unwrap();
    assert_eq!((old.epoch, new.epoch), (1, 2));
    for refused in every_call(&server, &old).await {
        let status = refused.unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert_eq!(reason_of(&status).as_deref(), Some("STALE_LEASE"));
    }
    // The right epoch in the wrong hands is as stale.
    let thief = wire::Lease { worker: "thief".into(), ..new.clone() };
    assert!(every_call(&server, &thief).await.iter().all(Result::is_err));
    for accepted in every_call(&server, &new).await {
        accepted.unwrap();
    }
    assert_eq!(job(&mut client, &name).await.state, v1::JobState::Succeeded as i32);
}

#[tokio::test]
async fn only_the_files_of_the_completing_attempt_are_visible() {
    let server = Server::start_with(&["--workers=0", "--lease-secs=2", "--heartbeat-secs=0.1"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let mut worker = server.worker_client();
    let first = claim(&server, "first").await.lease.unwrap();
    worker.put_artifact(futures::stream::iter(artifact(&first, b"first"))).await.unwrap();
    let second = claim(&server, "second").await.lease.unwrap();
    worker.put_artifact(futures::stream::iter(artifact(&second, b"second"))).await.unwrap();
    let list = v1::ListArtifactsRequest { parent: name, ..Default::default() };
    let before = client.list_artifacts(list.clone()).await.unwrap().into_inner();
    assert_eq!(before.artifacts, []);
    let files = vec!["lod-0.glb".into()];
    let outcome = wire::complete_request::Outcome::Succeeded(wire::Succeeded { files });
    let complete = wire::CompleteRequest { lease: Some(second), outcome: Some(outcome) };
    // The answer is lost, and the call repeated.
    worker.complete(complete.clone()).await.unwrap();
    worker.complete(complete).await.unwrap();
    let after = client.list_artifacts(list).await.unwrap().into_inner().artifacts;
    assert_eq!(after.len(), 1);
    assert_eq!(after[0].size, b"second".len() as u64);
}

#[tokio::test]
async fn strangers_are_turned_away() {
    let server = Server::start_with(&["--workers=0"]);
    let mut worker = server.worker_client();
    for (name, version) in [("", "0.1.0"), ("a/b", "0.1.0"), ("w", "99.0.0"), ("w", "")] {
        let (worker_id, version) = (name.into(), version.into());
        let request = wire::ClaimRequest { worker: worker_id, version, ..Default::default() };
        assert_eq!(worker.claim(request).await.unwrap_err().code(), Code::InvalidArgument);
    }
    let no_lease = worker.heartbeat(wire::HeartbeatRequest { lease: None }).await;
    assert_eq!(no_lease.unwrap_err().code(), Code::InvalidArgument);
    let wait_secs = 0.0;
    let idle = worker.claim(wire::ClaimRequest { wait_secs, ..claim_as("w") }).await.unwrap();
    assert!(idle.into_inner().assignment.is_none());
}

/// What a worker of a build finds when it claims the job: pieces, and how the log says that it goes on.
async fn found_by(server: &Server, worker: &str, build: &str) -> (wire::Lease, Vec<Vec<u8>>) {
    let mut client = server.worker_client();
    let request = wire::ClaimRequest { build: build.into(), ..claim_as(worker) };
    let assignment = client.claim(request).await.unwrap().into_inner().assignment.unwrap();
    let lease = assignment.lease.unwrap();
    let fetch = wire::FetchCheckpointRequest { lease: Some(lease.clone()) };
    let mut chunks = client.fetch_checkpoint(fetch).await.unwrap().into_inner();
    let mut pieces = Vec::new();
    while let Some(chunk) = chunks.message().await.unwrap() {
        pieces.resize(chunk.piece as usize + 1, Vec::new());
        pieces[chunk.piece as usize].extend_from_slice(&chunk.data);
    }
    assert_eq!(pieces.len(), assignment.checkpoint_pieces as usize);
    (lease, pieces)
}

#[tokio::test]
async fn an_attempt_goes_on_where_the_lost_one_left_its_last_checkpoint() {
    let server = Server::start_with(&["--workers=0", "--max-attempts=9"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let mut worker = server.worker_client();
    let note = async |lease: &wire::Lease, first_index: u64| {
        let note = v1::Note { code: "N".into(), text: first_index.to_string() };
        let body = Some(wire::worker_event::Body::Note(note));
        let (lease, events) = (Some(lease.clone()), vec![wire::WorkerEvent { body }]);
        let append = wire::AppendEventsRequest { lease, first_index, events };
        server.worker_client().append_events(append).await.unwrap();
    };
    let (first, none) = found_by(&server, "w", "b").await;
    assert_eq!(none, [[0; 0]; 0]);
    note(&first, 0).await;
    let mut put = async |lease: &wire::Lease, n, bytes| {
        worker.put_checkpoint(futures::stream::iter(piece(lease, n, bytes))).await.map(drop)
    };
    put(&first, 0, b"one").await.unwrap();
    // The answer is lost, and the call repeated; a gap is refused.
    put(&first, 0, b"one").await.unwrap();
    assert_eq!(put(&first, 2, b"three").await.unwrap_err().code(), Code::InvalidArgument);
    note(&first, 1).await;
    // CREATED, CLAIMED, note, (piece), note; then the worker asks for other work: lost, claimed, resumed.
    let (second, pieces) = found_by(&server, "w", "b").await;
    assert_eq!(pieces, [b"one"]);
    put(&second, 1, b"two").await.unwrap();
    let (_, pieces) = found_by(&server, "w", "b").await;
    assert_eq!(pieces, [b"one", b"two"]);
    // Another build cannot go on from there, and neither can anybody after it.
    let (other, pieces) = found_by(&server, "w", "another").await;
    assert_eq!(pieces, [[0; 0]; 0]);
    put(&other, 0, b"new").await.unwrap();
    // What is left of the checkpoint goes with the end of the job.
    let outcome = wire::complete_request::Outcome::Succeeded(wire::Succeeded { files: vec![] });
    let complete = wire::CompleteRequest { lease: Some(other), outcome: Some(outcome) };
    worker.complete(complete).await.unwrap();
    let folders = server.files_below("objects/jobs");
    assert!(folders.iter().all(|file| !file.contains("checkpoint")), "{folders:?}");
    let restarts: Vec<_> = log(&mut client, &name, 0)
        .await
        .iter()
        .filter_map(|event| match &event.body {
            Body::Server(ServerEvent::Restarted {
                rewind_to_seq, reason, lost_attempt, ..
            }) => Some((*rewind_to_seq, *lost_attempt, reason.clone())),
            _ => None,
        })
        .collect();
    let told = |seq, lost, reason: &str| (seq, lost, reason.to_owned());
    let wanted = [told(3, 1, "RESUMED"), told(7, 2, "RESUMED"), told(1, 3, "STARTED_OVER")];
    assert_eq!(restarts, wanted);
}
