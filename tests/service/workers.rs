//! The worker API over a real socket, spoken by the test itself.

use lookalike::service::{
    proto::{v1, worker::v1 as wire},
    status::reason_of,
};
use tonic::{Code, Status};

use crate::support::{Server, create, job};

fn claim_as(worker: &str) -> wire::ClaimRequest {
    let version = env!("CARGO_PKG_VERSION").into();
    wire::ClaimRequest { worker: worker.into(), version, wait_secs: 5.0 }
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

/// Every call that a worker can make on a job.
pub(crate) async fn every_call(server: &Server, lease: &wire::Lease) -> Vec<Result<(), Status>> {
    let mut client = server.worker_client();
    let lease = Some(lease.clone());
    let outcome = wire::complete_request::Outcome::Succeeded(wire::Succeeded { files: vec![] });
    let append = wire::AppendEventsRequest { lease: lease.clone(), ..Default::default() };
    let complete = wire::CompleteRequest { lease: lease.clone(), outcome: Some(outcome) };
    let put = futures::stream::iter(artifact(lease.as_ref().unwrap(), b"late"));
    vec![
        client.heartbeat(wire::HeartbeatRequest { lease: lease.clone() }).await.map(drop),
        client
            .fetch_mesh(wire::FetchMeshRequest { lease: lease.clone(), ..Default::default() })
            .await
            .map(drop),
        client.append_events(append).await.map(drop),
        client.put_artifact(put).await.map(drop),
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
        let request =
            wire::ClaimRequest { worker: name.into(), version: version.into(), wait_secs: 0.0 };
        assert_eq!(worker.claim(request).await.unwrap_err().code(), Code::InvalidArgument);
    }
    let no_lease = worker.heartbeat(wire::HeartbeatRequest { lease: None }).await;
    assert_eq!(no_lease.unwrap_err().code(), Code::InvalidArgument);
    let wait_secs = 0.0;
    let idle = worker.claim(wire::ClaimRequest { wait_secs, ..claim_as("w") }).await.unwrap();
    assert!(idle.into_inner().assignment.is_none());
}
