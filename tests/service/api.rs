//! The public API over a real socket.

use std::{
    collections::{BTreeMap, BTreeSet},
    io::{Read, Write},
    net::TcpStream,
};

use futures::{StreamExt, future::join_all, stream};
use lookalike::{
    jobs::{
        event::{Body, Report},
        spec::Spec,
        state::State,
    },
    service::{
        convert::spec_to_wire,
        proto::v1,
        status::{faults_of, reason_of},
    },
};
use tonic::Code;
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_reflection::pb::v1::{
    ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
    server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
};

use crate::support::{
    Server, create, create_request, ended, eventually, job, log, small_torus, state, upload,
};

#[tokio::test]
async fn a_log_reads_the_same_live_later_and_from_anywhere() {
    let server = Server::start();
    let mut client = server.client();
    let name = create(&mut client).await;
    let live = log(&mut client, &name, 0).await;
    assert_eq!(live.last().unwrap().body.state(), Some(State::Succeeded));
    let seqs: Vec<_> = live.iter().map(|event| event.seq).collect();
    assert_eq!(seqs, (1..=live.len() as u64).collect::<Vec<_>>());
    for after in [0, 1, live.len() / 3, live.len() - 1, live.len()] {
        assert_eq!(log(&mut client, &name, after as u64).await, live[after..]);
    }
    let mut next_record = BTreeMap::new();
    for event in &live {
        if let Body::Worker(Report::Records { level, first, count, bytes }) = &event.body {
            let next = next_record.entry(*level).or_insert(0);
            assert_eq!(*first, *next);
            assert!(!bytes.is_empty());
            *next += u64::from(*count);
        }
    }
    assert!(next_record[&None] > 0, "the job streamed no collapses");
    assert!(next_record[&Some(0)] > 0, "the job streamed no edits of its first level");
    let has_sample = |body: &Body| matches!(body, Body::Worker(Report::Sample(_)));
    assert!(live.iter().any(|event| has_sample(&event.body)));
}

#[tokio::test]
async fn a_hundred_duplicates_make_one_job() {
    let server = Server::start_with(&["--workers=0"]);
    let mesh = upload(&mut server.client(), small_torus()).await;
    let clients: Vec<_> = (0..10).map(|_| server.client()).collect();
    let requests = (0..100).map(|i| {
        let (mut client, request) = (clients[i % 10].clone(), create_request(&mesh, "the one"));
        async move { client.create_job(request).await.unwrap().into_inner().job.unwrap().name }
    });
    let names: BTreeSet<_> = join_all(requests).await.into_iter().collect();
    assert_eq!(names.len(), 1);
    let all = server.client().list_jobs(v1::ListJobsRequest::default()).await.unwrap();
    assert_eq!(all.into_inner().jobs.len(), 1);
    let mut other = create_request(&mesh, "the one");
    other.file_name = "other.ply".into();
    let refused = server.client().create_job(other).await.unwrap_err();
    assert_eq!(refused.code(), Code::AlreadyExists);
}

#[tokio::test]
async fn every_fault_of_a_request_is_listed() {
    let server = Server::start_with(&["--workers=0"]);
    let mut spec = Spec::new(vec![0]);
    spec.lambda = 2.0;
    spec.render.image_size = 63;
    let request = v1::CreateJobRequest {
        request_id: "\u{7f}".into(),
        mesh: format!("meshes/{}", "0".repeat(64)),
        file_name: String::new(),
        spec: Some(spec_to_wire(&spec)),
        webhook_url: String::new(),
        priority: 0,
        labels: std::collections::HashMap::new(),
    };
    let status = server.client().create_job(request).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert_eq!(reason_of(&status).as_deref(), Some("INVALID"));
    let fields: Vec<_> = faults_of(&status).into_iter().map(|fault| fault.field).collect();
    let wanted = [
        "request_id",
        "mesh",
        "file_name",
        "spec.simplify.triangles[0]",
        "spec.simplify.surface_weight",
        "spec.simplify.render.image_size",
    ];
    assert_eq!(fields, wanted);
    let empty = server.client().create_job(v1::CreateJobRequest::default()).await.unwrap_err();
    assert!(faults_of(&empty).iter().any(|fault| fault.field == "spec"));
}

#[tokio::test]
async fn pages_are_stable_while_jobs_are_created() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let mut wanted = Vec::new();
    for _ in 0..7 {
        wanted.insert(0, create(&mut client).await);
    }
    let mut request = v1::ListJobsRequest { page_size: 3, ..Default::default() };
    let mut seen = Vec::new();
    loop {
        let page = client.list_jobs(request.clone()).await.unwrap().into_inner();
        seen.extend(page.jobs.into_iter().map(|job| job.name));
        create(&mut client).await;
        if page.next_page_token.is_empty() {
            break;
        }
        request.page_token = page.next_page_token;
    }
    assert_eq!(seen, wanted);
    request.states = vec![v1::JobState::Failed.into()];
    assert_eq!(client.list_jobs(request.clone()).await.unwrap_err().code(), Code::InvalidArgument);
    request.page_token.clear();
    assert_eq!(client.list_jobs(request).await.unwrap().into_inner().jobs, []);
}

#[tokio::test]
async fn jobs_are_found_by_what_they_are_called() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    let call = |batch: &str| {
        let labels = [("batch".to_owned(), batch.to_owned())].into();
        v1::CreateJobRequest { labels, ..create_request(&mesh, "") }
    };
    let mut names = Vec::new();
    for batch in ["7", "8", "7"] {
        let job = client.create_job(call(batch)).await.unwrap().into_inner().job.unwrap();
        assert_eq!(job.labels["batch"], batch);
        names.push(job.name);
    }
    let mut request =
        v1::ListJobsRequest { page_size: 1, labels: vec!["batch=7".into()], ..Default::default() };
    let mut seen = Vec::new();
    loop {
        let page = client.list_jobs(request.clone()).await.unwrap().into_inner();
        seen.extend(page.jobs.into_iter().map(|job| job.name));
        if page.next_page_token.is_empty() {
            break;
        }
        request.page_token = page.next_page_token;
    }
    assert_eq!(seen, [names[2].clone(), names[0].clone()]);
    let mut bad = call("7");
    bad.labels.insert("a b".into(), String::new());
    let refused = client.create_job(bad).await.unwrap_err();
    assert_eq!(faults_of(&refused)[0].field, "labels");
    let unreadable = v1::ListJobsRequest { labels: vec!["batch".into()], ..Default::default() };
    let refused = client.list_jobs(unreadable).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    let jobs = |flags: &[&str]| String::from_utf8(server.run("jobs", flags).stdout).unwrap();
    let listed = jobs(&["--label=batch=8", "--json"]);
    assert!(listed.contains(&names[1]) && listed.lines().count() == 1, "{listed}");
    assert_eq!(jobs(&["--from=2100-01-01T00:00:00Z"]), "");
}

#[tokio::test]
async fn jobs_are_cancelled_and_deleted() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let delete = v1::DeleteJobRequest { name: name.clone(), allow_missing: false };
    let early = client.delete_job(delete.clone()).await.unwrap_err();
    assert_eq!(reason_of(&early).as_deref(), Some("ILLEGAL_TRANSITION"));
    // Twice, and counted once.
    for _ in 0..2 {
        let request = v1::CancelJobRequest { name: name.clone() };
        let cancelled = client.cancel_job(request).await.unwrap().into_inner().job.unwrap();
        assert_eq!(state(&cancelled), State::Cancelled);
    }
    let page = http_get(&server.metrics, "/metrics");
    assert!(page.contains("lookalike_ended_jobs_total{state=\"CANCELLED\"} 1"), "{page}");
    assert_eq!(log(&mut client, &name, 0).await.len(), 2);
    client.delete_job(delete.clone()).await.unwrap();
    let again = client.delete_job(delete.clone()).await.unwrap_err();
    assert_eq!(again.code(), Code::NotFound);
    client.delete_job(v1::DeleteJobRequest { allow_missing: true, ..delete }).await.unwrap();
    let watch = client.watch_job(v1::WatchJobRequest { name, after_seq: 0 }).await;
    assert_eq!(watch.unwrap_err().code(), Code::NotFound);
}

#[tokio::test]
async fn artifacts_are_read_in_ranges() {
    let server = Server::start();
    let mut client = server.client();
    let name = create(&mut client).await;
    assert_eq!(state(&ended(&client, &name).await), State::Succeeded);
    let mut request = v1::ListArtifactsRequest { parent: name.clone(), ..Default::default() };
    let artifacts = client.list_artifacts(request.clone()).await.unwrap().into_inner().artifacts;
    // The same a page at a time.
    let mut paged = Vec::new();
    request.page_size = 2;
    loop {
        let page = client.list_artifacts(request.clone()).await.unwrap().into_inner();
        assert!((1..=2).contains(&page.artifacts.len()));
        paged.extend(page.artifacts);
        if page.next_page_token.is_empty() {
            break;
        }
        request.page_token = page.next_page_token;
    }
    assert_eq!(paged, artifacts);
    request.page_token = "@".into();
    assert_eq!(client.list_artifacts(request).await.unwrap_err().code(), Code::InvalidArgument);
    let lod = artifacts.iter().find(|a| a.name.ends_with("/lod-0.glb")).unwrap();
    let read = async |offset, limit| {
        let request = v1::ReadArtifactRequest { name: lod.name.clone(), offset, limit };
        let mut chunks = server.client().read_artifact(request).await?.into_inner();
        let mut bytes = Vec::new();
        while let Some(chunk) = chunks.message().await? {
            bytes.extend_from_slice(&chunk.data);
        }
        Ok::<_, tonic::Status>(bytes)
    };
    let whole = read(0, 0).await.unwrap();
    assert_eq!(whole.len() as u64, lod.size);
    assert_eq!(blake3::hash(&whole).to_hex().as_str(), lod.blake3);
    assert_eq!(read(5, 10).await.unwrap(), whole[5..15]);
    assert_eq!(read(lod.size - 2, 10).await.unwrap(), whole[whole.len() - 2..]);
    assert_eq!(read(lod.size, 0).await.unwrap(), b"");
    assert_eq!(read(lod.size + 1, 0).await.unwrap_err().code(), Code::InvalidArgument);
    let done = job(&mut client, &name).await;
    assert_eq!((done.fraction, done.attempt), (1.0, 1));
}

#[tokio::test]
async fn uploads_are_checked_and_stored_once() {
    use v1::upload_mesh_request::Part;
    let server = Server::start_with(&["--workers=0", "--max-mesh-mib=1"]);
    let send = async |parts: Vec<Part>| {
        let parts = parts.into_iter().map(|part| v1::UploadMeshRequest { part: Some(part) });
        server
            .client()
            .upload_mesh(futures::stream::iter(parts))
            .await
            .map(tonic::Response::into_inner)
    };
    let header = |size, blake3: &str| {
        let blake3 = blake3.into();
        Part::Header(v1::UploadMeshHeader { size, blake3, ..Default::default() })
    };
    let chunk = |bytes: &'static [u8]| Part::Chunk(bytes.into());
    let first = send(vec![header(6, ""), chunk(b"abc"), chunk(b"def")]).await.unwrap();
    let hash = blake3::hash(b"abcdef").to_hex();
    assert_eq!((first.mesh, first.existed), (format!("meshes/{hash}"), false));
    assert!(send(vec![header(0, ""), chunk(b"abcdef")]).await.unwrap().existed);
    // Known bytes need not be sent again.
    assert!(send(vec![header(0, hash.as_str())]).await.unwrap().existed);
    let other = "0".repeat(64);
    let refusals = [
        (send(vec![header(7, ""), chunk(b"abcdeg")]).await, Code::DataLoss),
        (send(vec![header(0, &other), chunk(b"abcdeg")]).await, Code::DataLoss),
        (send(vec![chunk(b"abcdeg")]).await, Code::InvalidArgument),
        (send(vec![header(0, ""), header(0, "")]).await, Code::InvalidArgument),
        (send(vec![]).await, Code::InvalidArgument),
        (
            send(vec![header(0, ""), Part::Chunk(vec![0; 1 << 20].into()), chunk(b"x")]).await,
            Code::ResourceExhausted,
        ),
    ];
    for (refusal, code) in refusals {
        assert_eq!(refusal.unwrap_err().code(), code);
    }
}

#[tokio::test]
async fn health_reflection_and_metrics_answer() {
    let server = Server::start();
    let mut client = server.client();
    let name = create(&mut client).await;
    ended(&client, &name).await;
    let channel = lookalike::service::client::channel(&server.url).unwrap();
    for service in ["", "lookalike.v1.LookalikeService", "lookalike.worker.v1.WorkerService"] {
        let request = HealthCheckRequest { service: service.into() };
        let answer = HealthClient::new(channel.clone()).check(request).await.unwrap();
        assert_eq!(answer.into_inner().status, 1, "{service} is not serving");
    }
    let request = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let answers = ServerReflectionClient::new(channel)
        .server_reflection_info(futures::stream::iter([request]))
        .await;
    let answer = answers.unwrap().into_inner().message().await.unwrap().unwrap();
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else {
        panic!("no list of services: {answer:?}")
    };
    let names: Vec<_> = list.service.into_iter().map(|service| service.name).collect();
    assert!(names.contains(&"lookalike.v1.LookalikeService".into()), "{names:?}");
    assert!(names.contains(&"lookalike.worker.v1.WorkerService".into()), "{names:?}");
    let page = http_get(&server.metrics, "/metrics");
    for line in [
        "lookalike_jobs{state=\"SUCCEEDED\"} 1",
        "lookalike_jobs{state=\"QUEUED\"} 0",
        "lookalike_claims_total 1",
        "lookalike_evaluations_total{stage=\"image\"}",
        "lookalike_stage_seconds{stage=\"image\"}",
        "lookalike_evaluations_per_second",
        "lookalike_energy",
        "lookalike_device_attempts_total{device=\"",
        "lookalike_received_bytes_total{what=\"mesh\"}",
        "lookalike_received_bytes_total{what=\"records\"}",
        "lookalike_received_bytes_total{what=\"artifact\"}",
        "lookalike_sent_bytes_total{what=\"mesh\"}",
    ] {
        assert!(page.contains(line), "{line} is not on the page:\n{page}");
    }
    assert!(http_get(&server.metrics, "/readyz").ends_with("ready\n"));
}

pub(crate) fn http_get(address: &str, path: &str) -> String {
    let mut socket = TcpStream::connect(address).unwrap();
    write!(socket, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    answer
}

/// Part of an upload: these bytes, from here on.
fn upload_part(
    (bytes, offset): (&[u8], usize),
    end: usize,
) -> impl Iterator<Item = v1::UploadMeshRequest> + use<> {
    use v1::upload_mesh_request::Part;
    let header = v1::UploadMeshHeader {
        size: bytes.len() as u64,
        blake3: blake3::hash(bytes).to_hex().to_string(),
        upload_id: "by-hand".into(),
        offset: offset as u64,
    };
    let chunks = bytes[offset..end].chunks(1 << 16).map(|c| Part::Chunk(c.to_vec().into()));
    let parts: Vec<_> = std::iter::once(Part::Header(header)).chain(chunks).collect();
    parts.into_iter().map(|part| v1::UploadMeshRequest { part: Some(part) })
}

#[tokio::test]
async fn an_upload_that_breaks_off_is_gone_on_with() {
    let mut server = Server::start_with(&["--workers=0"]);
    let client = server.client();
    let bytes: Vec<u8> = (0..20_u32 << 20).map(|k| (k * 7 % 253) as u8).collect();
    let mesh = format!("meshes/{}", blake3::hash(&bytes).to_hex());
    let query = v1::QueryUploadRequest { mesh: mesh.clone(), upload_id: "by-hand".into() };
    // The connection lasts, and no more comes.
    let first = stream::iter(upload_part((&bytes, 0), 12 << 20)).chain(stream::pending());
    let mut sender = client.clone();
    let upload = async { sender.upload_mesh(first).await.map(drop) };
    let arrived = eventually("the bytes", || {
        let (mut client, query) = (client.clone(), query.clone());
        async move {
            let held = client.query_upload(query).await.unwrap().into_inner().held;
            (held == 12 << 20).then_some(())
        }
    });
    tokio::select! {
        answer = upload => panic!("{answer:?}"),
        () = arrived => {}
    }
    server.kill();
    server.restart();
    let answer = eventually("the server", || {
        let (mut client, query) = (server.client(), query.clone());
        async move { client.query_upload(query).await.ok() }
    });
    let held = answer.await.into_inner();
    assert_eq!((held.held, held.is_stored), (12 << 20, false));
    let mut client = server.client();
    let gap = stream::iter(upload_part((&bytes, 13 << 20), bytes.len()));
    let refused = client.upload_mesh(gap).await.unwrap_err();
    assert_eq!(reason_of(&refused).as_deref(), Some("OFFSET"));
    let rest = stream::iter(upload_part((&bytes, 12 << 20), bytes.len()));
    let stored = client.upload_mesh(rest).await.unwrap().into_inner();
    assert_eq!((stored.mesh, stored.size), (mesh, bytes.len() as u64));
    let held = client.query_upload(query).await.unwrap().into_inner();
    assert_eq!((held.held, held.is_stored), (bytes.len() as u64, true));
}
