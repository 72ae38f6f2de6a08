//! Who may do what: every kind of caller and every method of both APIs, as one table.

use std::{fs, path::Path, time::Duration};

use base64::{Engine, engine::general_purpose::URL_SAFE_NO_PAD};
use lookalike::{
    jobs::state::State,
    service::{
        auth::Secret,
        client::{Access, Connection, connection},
        proto::{
            v1::{self, lookalike_service_client::LookalikeServiceClient},
            worker::v1::{self as wire, worker_service_client::WorkerServiceClient},
        },
        status::reason_of,
    },
};
use ring::signature::{Ed25519KeyPair, KeyPair};
use serde_json::json;
use tempfile::TempDir;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::{
    Server, create_request, ended, lookalike, small_torus, state, upload_as, with_token,
};

pub(crate) type Client = LookalikeServiceClient<Connection>;
type Worker = WorkerServiceClient<Connection>;

/// Makes a token with the command line; it is shown once.
pub(crate) fn token(folder: &Path, name: &str, owner: &str, role: &str) -> String {
    let file = folder.join("tokens.toml");
    let mut command = lookalike();
    command.args(["token", name, "--owner", owner, "--role", role, "--tokens"]).arg(file);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap().trim().into()
}

/// A JWKS file with one key, and a JWT of it that ended long ago, or will not for long.
fn jwt(folder: &Path, exp: u64) -> String {
    let pair = Ed25519KeyPair::from_seed_unchecked(&[7; 32]).unwrap();
    let x = URL_SAFE_NO_PAD.encode(pair.public_key());
    let keys = json!({"keys": [{"kty": "OKP", "crv": "Ed25519", "kid": "k", "x": x}]});
    fs::write(folder.join("keys.json"), keys.to_string()).unwrap();
    let claims = json!({"iss": "i", "aud": "a", "exp": exp, "sub": "ann", "role": "user"});
    let part = |value: serde_json::Value| URL_SAFE_NO_PAD.encode(value.to_string());
    let message = format!("{}.{}", part(json!({"alg": "EdDSA", "kid": "k"})), part(claims));
    let signature = URL_SAFE_NO_PAD.encode(pair.sign(message.as_bytes()).as_ref());
    format!("{message}.{signature}")
}

/// A server that asks who calls, and one caller of each kind.
pub(crate) struct Guarded {
    pub(crate) server: Server,
    folder: TempDir,
    /// In the order of the table's columns.
    pub(crate) tokens: [Option<String>; 8],
}

pub(crate) const CALLERS: [&str; 8] =
    ["anonymous", "wrong token", "expired JWT", "bob", "viewer", "ann", "worker", "admin"];
pub(crate) const ANN: usize = 5;
const WORKER: usize = 6;

impl Guarded {
    pub(crate) fn start(flags: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let tokens = [
            None,
            Some("lkl_wrong".into()),
            Some(jwt(at, 1_000_000_000)),
            Some(token(at, "bob", "bob", "user")),
            Some(token(at, "ann-screen", "ann", "viewer")),
            Some(token(at, "ann", "ann", "user")),
            Some(token(at, "farm", "farm", "worker")),
            Some(token(at, "ops", "ops", "admin")),
        ];
        let file = |flag: &str, name: &str| format!("--{flag}={}", at.join(name).display());
        let (principals, jwks) = (file("tokens", "tokens.toml"), file("jwks", "keys.json"));
        let mut all = vec![&*principals, &*jwks, "--jwt-issuer=i", "--jwt-audience=a"];
        all.extend(flags);
        Self { server: Server::start_with(&all), folder, tokens }
    }

    fn connection(&self, caller: usize) -> Connection {
        let token = self.tokens[caller].clone().map(Secret::new);
        connection(&self.server.url, &Access { token, ..Access::default() }).unwrap()
    }

    pub(crate) fn client(&self, caller: usize) -> Client {
        LookalikeServiceClient::new(self.connection(caller))
    }

    fn worker(&self, caller: usize) -> Worker {
        WorkerServiceClient::new(self.connection(caller))
    }

    /// A job of Ann's that waits.
    pub(crate) async fn queued(&self) -> String {
        let mut ann = self.client(ANN);
        let mesh = upload_as(&mut ann, small_torus()).await;
        ann.create_job(create_request(&mesh, "")).await.unwrap().into_inner().job.unwrap().name
    }

    /// A job of Ann's that a worker has ended, with a result.
    pub(crate) async fn done(&self) -> String {
        let name = self.queued().await;
        let mut worker = self.worker(WORKER);
        let claimed = worker.claim(claim("done")).await.unwrap().into_inner();
        let lease = claimed.assignment.unwrap().lease.unwrap();
        worker.put_artifact(futures::stream::iter(artifact(&lease))).await.unwrap();
        let succeeded = wire::Succeeded { files: vec!["x".into()] };
        let outcome = Some(wire::complete_request::Outcome::Succeeded(succeeded));
        let request = wire::CompleteRequest { lease: Some(lease), outcome };
        worker.complete(request).await.unwrap();
        name
    }

    /// The rows of the audit table that fit.
    async fn audited(&self, method: &str, outcome: &str) -> Vec<(String, String, String)> {
        let path = self.server.data_dir().join("jobs.sqlite3");
        let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path).read_only(true);
        let pool = sqlx::SqlitePool::connect_with(options).await.unwrap();
        let query = "SELECT principal, owner, resource FROM audit \
                     WHERE method = $1 AND outcome = $2 ORDER BY id";
        sqlx::query_as(query).bind(method).bind(outcome).fetch_all(&pool).await.unwrap()
    }
}

fn claim(worker: &str) -> wire::ClaimRequest {
    wire::ClaimRequest {
        worker: worker.into(),
        version: env!("CARGO_PKG_VERSION").into(),
        ..Default::default()
    }
}

fn artifact(lease: &wire::Lease) -> Vec<wire::PutArtifactRequest> {
    use wire::put_artifact_request::Part;
    let header = wire::PutArtifactHeader {
        lease: Some(lease.clone()),
        file: "x".into(),
        media_type: "text/plain".into(),
        size: 1,
        blake3: blake3::hash(b"x").to_hex().to_string(),
    };
    let parts = [Part::Header(header), Part::Chunk(b"x".to_vec().into())];
    parts.map(|part| wire::PutArtifactRequest { part: Some(part) }).into()
}

fn piece(lease: &wire::Lease) -> Vec<wire::PutCheckpointRequest> {
    use wire::put_checkpoint_request::Part;
    let header = wire::PutCheckpointHeader { lease: Some(lease.clone()), ..Default::default() };
    let parts = [Part::Header(header), Part::Chunk(b"x".to_vec().into())];
    parts.map(|part| wire::PutCheckpointRequest { part: Some(part) }).into()
}

/// Calls a method of the public API about `job`, or about the job that is `done`.
async fn call(client: &mut Client, method: &str, mesh: &str, job: &str, done: &str) -> Code {
    use v1::upload_mesh_request::Part;
    let name = job.to_owned();
    let answer: Result<(), Status> = match method {
        "UploadMesh" => {
            let parts = [Part::Header(v1::UploadMeshHeader::default()), Part::Chunk("x".into())];
            let parts = parts.map(|part| v1::UploadMeshRequest { part: Some(part) });
            client.upload_mesh(futures::stream::iter(parts)).await.map(drop)
        }
        "QueryUpload" => {
            let mesh = mesh.to_owned();
            client
                .query_upload(v1::QueryUploadRequest { mesh, upload_id: String::new() })
                .await
                .map(drop)
        }
        "CreateJob" => client.create_job(create_request(mesh, "")).await.map(drop),
        "GetJob" => client.get_job(v1::GetJobRequest { name }).await.map(drop),
        "ListJobs" => client.list_jobs(v1::ListJobsRequest::default()).await.map(drop),
        "WatchJob" => client.watch_job(v1::WatchJobRequest { name, after_seq: 0 }).await.map(drop),
        "CancelJob" => client.cancel_job(v1::CancelJobRequest { name }).await.map(drop),
        "RetryJob" => client.retry_job(v1::RetryJobRequest { name }).await.map(drop),
        "PinJob" => client.pin_job(v1::PinJobRequest { name, pinned: true }).await.map(drop),
        "ListWorkers" => client.list_workers(v1::ListWorkersRequest::default()).await.map(drop),
        "DrainWorker" => {
            let request = v1::DrainWorkerRequest { name: "workers/done".into() };
            client.drain_worker(request).await.map(drop)
        }
        "ReinstateWorker" => {
            let request = v1::ReinstateWorkerRequest { name: "workers/done".into() };
            client.reinstate_worker(request).await.map(drop)
        }
        "DeleteJob" => {
            let request = v1::DeleteJobRequest { name, allow_missing: false };
            client.delete_job(request).await.map(drop)
        }
        "ListArtifacts" => {
            let request = v1::ListArtifactsRequest { parent: name, ..Default::default() };
            client.list_artifacts(request).await.map(drop)
        }
        "ReadArtifact" => {
            let name = format!("{done}/artifacts/x");
            let request = v1::ReadArtifactRequest { name, offset: 0, limit: 0 };
            client.read_artifact(request).await.map(drop)
        }
        other => panic!("{other} is not called"),
    };
    answer.map_or_else(|status| status.code(), |()| Code::Ok)
}

/// Calls a method of the worker API, under a lease that nobody holds.
async fn work(worker: &mut Worker, method: &str, caller: &str) -> Code {
    let job = format!("jobs/{}", "0".repeat(32));
    let lease = wire::Lease { job, epoch: 1, worker: "w".into() };
    let held = Some(lease.clone());
    let answer: Result<(), Status> = match method {
        "Claim" => worker.claim(claim(&caller.replace(' ', "-"))).await.map(drop),
        "Heartbeat" => worker.heartbeat(wire::HeartbeatRequest { lease: held }).await.map(drop),
        "FetchMesh" => {
            let request = wire::FetchMeshRequest { lease: held, mesh: String::new() };
            worker.fetch_mesh(request).await.map(drop)
        }
        "AppendEvents" => {
            let request = wire::AppendEventsRequest { lease: held, ..Default::default() };
            worker.append_events(request).await.map(drop)
        }
        "PutArtifact" => {
            worker.put_artifact(futures::stream::iter(artifact(&lease))).await.map(drop)
        }
        "Leave" => worker.leave(wire::LeaveRequest { worker: "nobody".into() }).await.map(drop),
        "PutCheckpoint" => {
            worker.put_checkpoint(futures::stream::iter(piece(&lease))).await.map(drop)
        }
        "FetchCheckpoint" => {
            let request = wire::FetchCheckpointRequest { lease: held };
            worker.fetch_checkpoint(request).await.map(drop)
        }
        "Complete" => {
            let outcome =
                Some(wire::complete_request::Outcome::Succeeded(wire::Succeeded::default()));
            worker.complete(wire::CompleteRequest { lease: held, outcome }).await.map(drop)
        }
        other => panic!("{other} is not called"),
    };
    answer.map_or_else(|status| status.code(), |()| Code::Ok)
}

const O: Code = Code::Ok;
const U: Code = Code::Unauthenticated;
const P: Code = Code::PermissionDenied;
const N: Code = Code::NotFound;
/// The mesh is Ann's, and for others it is not there.
const I: Code = Code::InvalidArgument;
/// The call came as far as its lease, which is stale.
const F: Code = Code::FailedPrecondition;

#[rustfmt::skip]
pub(crate) const PUBLIC: [(&str, [Code; 8]); 15] = [
    // method          anonymous wrong expired bob viewer ann worker admin
    ("UploadMesh",    [U, U, U, O, P, O, P, O]),
    ("QueryUpload",   [U, U, U, O, P, O, P, O]),
    ("CreateJob",     [U, U, U, I, P, O, P, I]),
    ("GetJob",        [U, U, U, N, O, O, P, O]),
    ("ListJobs",      [U, U, U, O, O, O, P, O]),
    ("WatchJob",      [U, U, U, N, O, O, P, O]),
    ("CancelJob",     [U, U, U, N, P, O, P, O]),
    ("RetryJob",      [U, U, U, N, P, O, P, O]),
    ("PinJob",        [U, U, U, N, P, O, P, O]),
    ("DeleteJob",     [U, U, U, N, P, O, P, O]),
    ("ListArtifacts", [U, U, U, N, O, O, P, O]),
    ("ReadArtifact",  [U, U, U, N, O, O, P, O]),
    ("ListWorkers",   [U, U, U, P, P, P, P, O]),
    ("DrainWorker",   [U, U, U, P, P, P, P, O]),
    ("ReinstateWorker", [U, U, U, P, P, P, P, O]),
];

#[rustfmt::skip]
const WORK: [(&str, [Code; 8]); 9] = [
    ("Claim",         [U, U, U, P, P, P, O, O]),
    ("Heartbeat",     [U, U, U, P, P, P, F, F]),
    ("FetchMesh",     [U, U, U, P, P, P, F, F]),
    ("AppendEvents",  [U, U, U, P, P, P, F, F]),
    ("PutArtifact",   [U, U, U, P, P, P, F, F]),
    ("PutCheckpoint",   [U, U, U, P, P, P, F, F]),
    ("FetchCheckpoint", [U, U, U, P, P, P, F, F]),
    ("Complete",      [U, U, U, P, P, P, F, F]),
    ("Leave",         [U, U, U, P, P, P, O, O]),
];

#[tokio::test]
async fn every_method_admits_whom_it_should() {
    let guarded = Guarded::start(&["--workers=0"]);
    let done = guarded.done().await;
    let mesh = upload_as(&mut guarded.client(ANN), small_torus()).await;
    for (method, wanted) in PUBLIC {
        for (caller, wanted) in wanted.into_iter().enumerate() {
            let job = guarded.queued().await;
            if method == "DeleteJob" {
                let request = v1::CancelJobRequest { name: job.clone() };
                guarded.client(ANN).cancel_job(request).await.unwrap();
            }
            let code = call(&mut guarded.client(caller), method, &mesh, &job, &done).await;
            assert_eq!(code, wanted, "{method} by {}", CALLERS[caller]);
        }
    }
    for (method, wanted) in WORK {
        for (caller, wanted) in wanted.into_iter().enumerate() {
            let code = work(&mut guarded.worker(caller), method, CALLERS[caller]).await;
            assert_eq!(code, wanted, "{method} by {}", CALLERS[caller]);
        }
    }
    // What changed something is on record, and so is who was refused.
    let ann = |resource: &str| ("ann".to_owned(), "ann".to_owned(), resource.to_owned());
    assert!(guarded.audited("UploadMesh", "OK").await.contains(&ann(&mesh)));
    assert_eq!(guarded.audited("DeleteJob", "OK").await.len(), 2);
    assert_eq!(guarded.audited("CancelJob", "NOT_FOUND").await[0].0, "bob");
    assert_eq!(guarded.audited("GetJob", "UNAUTHENTICATED").await[0].0, "");
    assert_eq!(guarded.audited("Complete", "PERMISSION_DENIED").await.len(), 3);
    assert_eq!(guarded.audited("GetJob", "OK").await, []);
}

#[tokio::test]
async fn secrets_are_not_logged_and_lists_show_ones_own() {
    let guarded = Guarded::start(&["--workers=0"]);
    let name = guarded.queued().await;
    let list = async |caller: usize, owner: &str| {
        let request = v1::ListJobsRequest { owner: owner.into(), ..Default::default() };
        let jobs = guarded.client(caller).list_jobs(request).await.unwrap().into_inner().jobs;
        jobs.into_iter().map(|job| (job.name, job.owner)).collect::<Vec<_>>()
    };
    let anns = [(name.clone(), "ann".to_owned())];
    for (caller, owner, wanted) in
        [(3, "", &anns[..0]), (3, "ann", &[]), (4, "", &anns), (7, "ann", &anns), (7, "bob", &[])]
    {
        assert_eq!(list(caller, owner).await, wanted, "{} asks for {owner:?}", CALLERS[caller]);
    }
    for caller in 0..CALLERS.len() {
        let request = v1::GetJobRequest { name: name.clone() };
        let _ = guarded.client(caller).get_job(request).await;
    }
    let refused = guarded.client(2).get_job(v1::GetJobRequest { name }).await.unwrap_err();
    assert!(refused.message().contains("expired"), "{}", refused.message());
    let (log, principals) =
        (guarded.server.logged(), fs::read_to_string(tokens_of(&guarded)).unwrap());
    assert!(log.contains("PERMISSION_DENIED") && log.contains("UNAUTHENTICATED"), "{log}");
    for token in guarded.tokens.iter().flatten() {
        assert!(!log.contains(token.as_str()) && !principals.contains(token.as_str()));
    }
}

fn tokens_of(guarded: &Guarded) -> std::path::PathBuf {
    guarded.folder.path().join("tokens.toml")
}

#[tokio::test]
async fn tokens_come_and_go_while_the_server_runs() {
    let guarded = Guarded::start(&["--workers=0"]);
    let file = tokens_of(&guarded);
    let new = token(file.parent().unwrap(), "late", "ann", "user");
    let known = || async {
        let mut client = with_token(&guarded.server, &new);
        client.list_jobs(v1::ListJobsRequest::default()).await.map(drop)
    };
    tokio::time::sleep(Duration::from_millis(600)).await;
    known().await.unwrap();
    fs::write(&file, "").unwrap();
    tokio::time::sleep(Duration::from_millis(600)).await;
    assert_eq!(known().await.unwrap_err().code(), Code::Unauthenticated);
    // Good JWTs do not depend on that file.
    let good = jwt(file.parent().unwrap(), 4_102_444_800);
    let mut client = with_token(&guarded.server, &good);
    client.list_jobs(v1::ListJobsRequest::default()).await.unwrap();
}

#[tokio::test]
async fn too_much_is_refused_with_a_time_to_come_back() {
    let guarded = Guarded::start(&[
        "--workers=0",
        "--max-requests-per-sec=5",
        "--max-streams=1",
        "--max-owner-queued=1",
    ]);
    let name = guarded.queued().await;
    let mut ann = guarded.client(ANN);
    let mesh = upload_as(&mut ann, small_torus()).await;
    let refusal = |status: Status| {
        assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
        assert!(status.get_details_retry_info().unwrap().retry_delay.unwrap() > Duration::ZERO);
        reason_of(&status).unwrap()
    };
    let second = ann.create_job(create_request(&mesh, "")).await.unwrap_err();
    assert_eq!(refusal(second), "QUOTA");
    let watch = v1::WatchJobRequest { name, after_seq: 0 };
    let mut open = ann.watch_job(watch.clone()).await.unwrap().into_inner();
    open.message().await.unwrap();
    assert_eq!(refusal(ann.watch_job(watch.clone()).await.unwrap_err()), "TOO_MANY_STREAMS");
    drop(open);
    let mut hurried = None;
    for _ in 0..20 {
        hurried = ann.list_jobs(v1::ListJobsRequest::default()).await.err().or(hurried);
    }
    assert_eq!(refusal(hurried.unwrap()), "RATE_LIMITED");
    // Others have a share of their own.
    guarded.client(3).list_jobs(v1::ListJobsRequest::default()).await.unwrap();
    tokio::time::sleep(Duration::from_millis(600)).await;
    ann.watch_job(watch).await.unwrap();
}

#[tokio::test]
async fn local_workers_need_no_token_and_are_confined() {
    let guarded = Guarded::start(&["--workers=1", "--worker-memory-mib=2048"]);
    let name = guarded.queued().await;
    let pids = guarded.server.workers_up(1).await;
    let read = |file: &str| fs::read_to_string(format!("/proc/{}/{file}", pids[0])).unwrap();
    assert_eq!(state(&ended(&guarded.client(ANN), &name).await), State::Succeeded);
    let (limits, status) = (read("limits"), read("status"));
    for (limit, wanted) in [
        ("Max data size", (2048_u64 << 20).to_string()),
        ("Max core file size", "0".into()),
        ("Max open files", "4096".into()),
    ] {
        let line = limits.lines().find(|line| line.starts_with(limit)).unwrap();
        let hard = line[limit.len()..].split_whitespace().nth(1).unwrap();
        assert_eq!(hard, wanted, "{line}");
    }
    for (key, wanted) in [("Seccomp:", "2"), ("NoNewPrivs:", "1")] {
        let line = status.lines().find(|line| line.starts_with(key)).unwrap();
        assert_eq!(line.split_whitespace().nth(1), Some(wanted), "{line}");
    }
    let mode = |name: &str| {
        use std::os::unix::fs::PermissionsExt;
        let path = guarded.server.data_dir().join("workers").join(name);
        fs::metadata(path).unwrap().permissions().mode() & 0o777
    };
    assert_eq!((mode(""), mode("grpc.sock")), (0o700, 0o600));
    // On that socket nobody is more than a worker.
    let socket = guarded.server.data_dir().join("workers/grpc.sock");
    let token = guarded.tokens[7].clone().map(Secret::new);
    let access = Access { token, ..Access::default() };
    let local = connection(&format!("unix:{}", socket.display()), &access).unwrap();
    let mut client = LookalikeServiceClient::new(local);
    let refused = client.get_job(v1::GetJobRequest { name }).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
}

#[tokio::test]
async fn a_worker_that_needs_too_much_memory_takes_only_its_job_with_it() {
    let server = Server::start_with(&["--workers=1", "--worker-memory-mib=48", "--max-attempts=1"]);
    let mut client = server.client();
    // 180,000 triangles do not fit.
    let mesh = crate::support::upload(&mut client, crate::support::torus(300, 300)).await;
    let created = client.create_job(create_request(&mesh, "")).await.unwrap();
    let name = created.into_inner().job.unwrap().name;
    let failed = ended(&client, &name).await;
    assert_eq!(failed.failure.unwrap().reason, "POISONED");
    let small = crate::support::create(&mut client).await;
    assert!(ended(&client, &small).await.attempt > 0);
}
