//! What browsers and scripts meet on the gRPC port: HTTP/JSON, Server-Sent Events, gRPC-Web.

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpStream},
    time::Duration,
};

use lookalike::service::proto::{v1, worker::v1 as wire};
use prost::Message;
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};
use tonic::Code;

use crate::{
    auth::{ANN, CALLERS, Guarded, PUBLIC},
    support::{
        Client, Server, create, create_request, ended, eventually, job, log, small_torus, state,
        upload, upload_as,
    },
};

/// A caller of the routes.
pub(crate) struct Web {
    http: reqwest::Client,
    url: String,
    token: Option<String>,
}

impl Web {
    pub(crate) fn new(server: &Server, token: Option<String>) -> Self {
        // The client asks for a provider of TLS even where there is none to speak.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().no_proxy().build().unwrap();
        Self { http, url: server.url.clone(), token }
    }

    pub(crate) async fn send(
        &self,
        verb: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: impl Into<reqwest::Body>,
    ) -> Response {
        let verb: Method = verb.parse().unwrap();
        let request = self.http.request(verb, format!("{}{path}", self.url)).body(body);
        let request = headers.iter().fold(request, |request, (k, v)| request.header(*k, *v));
        let token = self.token.iter();
        token.fold(request, reqwest::RequestBuilder::bearer_auth).send().await.unwrap()
    }

    async fn get(&self, path: &str) -> Response {
        self.send("GET", path, &[], "").await
    }

    pub(crate) async fn post(&self, path: &str, body: Value) -> Response {
        self.send("POST", path, &[("content-type", "application/json")], body.to_string()).await
    }

    async fn get_json(&self, path: &str) -> Value {
        let answer = self.get(path).await;
        assert_eq!(answer.status(), 200, "{path}");
        json_of(answer).await
    }
}

async fn json_of(answer: Response) -> Value {
    assert_eq!(header(&answer, "content-type"), "application/json");
    serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap()
}

fn header<'a>(answer: &'a Response, name: &str) -> &'a str {
    answer.headers().get(name).map_or("", |value| value.to_str().unwrap())
}

fn new_job(mesh: &str) -> Value {
    json!({"mesh": mesh, "fileName": "torus.ply", "requestId": "r1", "spec": {"simplify": {
        "triangles": [500, 200], "effort": "EFFORT_FAST", "render": {"nViews": 12, "imageSize": 128},
        "optimization": {"maxEvaluations": "3000"}}}})
}

/// What a route answers, as a gRPC code.
async fn code_of(answer: Response) -> Code {
    if answer.status().is_success() {
        return Code::Ok;
    }
    let status = answer.status();
    let body = json_of(answer).await;
    assert_eq!(body["details"][0]["domain"], "lookalike", "{body}");
    let code = Code::from(i32::try_from(body["code"].as_i64().unwrap()).unwrap());
    let wanted = match code {
        Code::Unauthenticated => 401,
        Code::PermissionDenied => 403,
        Code::NotFound => 404,
        Code::InvalidArgument => 400,
        other => panic!("{other:?} is not looked for"),
    };
    assert_eq!(status, wanted);
    code
}

/// Calls the route of a method about `job`, or about the job that is `done`.
async fn route(web: &Web, method: &str, mesh: &str, job: &str, done: &str) -> Response {
    let at = |path: &str| format!("/api/v1/{path}");
    match method {
        "UploadMesh" => {
            let kind = [("content-type", "application/octet-stream")];
            web.send("POST", &at("meshes"), &kind, "x").await
        }
        "QueryUpload" => web.get(&at(&format!("{mesh}:upload"))).await,
        "CreateJob" => web.post(&at("jobs"), new_job(mesh)).await,
        "GetJob" => web.get(&at(job)).await,
        "ListJobs" => web.get(&at("jobs")).await,
        "WatchJob" => web.get(&at(&format!("{job}/events"))).await,
        "CancelJob" => web.post(&at(&format!("{job}:cancel")), json!({})).await,
        "RetryJob" => web.post(&at(&format!("{job}:retry")), json!({})).await,
        "PinJob" => web.post(&at(&format!("{job}:pin")), json!({"pinned": true})).await,
        "DeleteJob" => web.send("DELETE", &at(job), &[], "").await,
        "ListArtifacts" => web.get(&at(&format!("{job}/artifacts"))).await,
        "ListWorkers" => web.get(&at("workers")).await,
        "DrainWorker" => web.post(&at("workers/done:drain"), json!({})).await,
        "ReinstateWorker" => web.post(&at("workers/done:reinstate"), json!({})).await,
        "ReadArtifact" => web.get(&at(&format!("{done}/artifacts/x"))).await,
        other => panic!("{other} is not called"),
    }
}

/// Calls a method by gRPC-Web; the code, and the first message.
async fn grpc_web(web: &Web, method: &str, message: &impl Message) -> (Code, Vec<u8>) {
    let path = format!("/lookalike.v1.LookalikeService/{method}");
    let message = message.encode_to_vec();
    let mut frame = vec![0];
    frame.extend(u32::try_from(message.len()).unwrap().to_be_bytes());
    frame.extend(message);
    let kind = [("content-type", "application/grpc-web+proto"), ("x-grpc-web", "1")];
    let answer = web.send("POST", &path, &kind, frame).await;
    assert_eq!(answer.status(), 200, "{method}");
    if let Some(code) = answer.headers().get("grpc-status") {
        return (Code::from_bytes(code.as_bytes()), Vec::new());
    }
    let frames = answer.bytes().await.unwrap();
    let first = 5 + u32::from_be_bytes(frames[1..5].try_into().unwrap()) as usize;
    // The last frame has the top bit set and holds what HTTP/2 has as trailers.
    let trailers = String::from_utf8_lossy(&frames[first..]).into_owned();
    let code = trailers.split("grpc-status:").nth(1).unwrap().trim().as_bytes()[0];
    (Code::from_bytes(&[code]), frames[5..first].to_vec())
}

#[tokio::test]
async fn routes_and_grpc_web_admit_whom_grpc_admits() {
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
            let web = Web::new(&guarded.server, guarded.tokens[caller].clone());
            let answer = route(&web, method, &mesh, &job, &done).await;
            assert_eq!(code_of(answer).await, wanted, "{method} by {}", CALLERS[caller]);
            if method == "GetJob" {
                let (code, _) = grpc_web(&web, method, &v1::GetJobRequest { name: job }).await;
                assert_eq!(code, wanted, "{method} by {} (gRPC-Web)", CALLERS[caller]);
            }
        }
    }
    // Nobody hears of faults in what they may not send.
    let stranger = Web::new(&guarded.server, None);
    let refused = stranger.post("/api/v1/jobs", json!({"colour": "red"})).await;
    assert_eq!(header(&refused, "www-authenticate"), "Bearer");
    assert_eq!(code_of(refused).await, Code::Unauthenticated);
    let log = guarded.server.logged();
    assert!(guarded.tokens.iter().flatten().all(|token| !log.contains(token.as_str())));
}

#[tokio::test]
async fn a_job_by_http_alone() {
    let server = Server::start();
    let web = Web::new(&server, None);
    let kind = [("content-type", "application/octet-stream")];
    let torus = small_torus();
    let path = format!("/api/v1/meshes?size={}", torus.len());
    let stored = json_of(web.send("POST", &path, &kind, torus).await).await;
    let mesh = stored["mesh"].as_str().unwrap();
    let created = json_of(web.post("/api/v1/jobs", new_job(mesh)).await).await;
    let name = created["job"]["name"].as_str().unwrap().to_owned();
    assert_eq!(created["job"]["spec"]["simplify"]["effort"], "EFFORT_FAST");
    // The same request makes no second job.
    let again = json_of(web.post("/api/v1/jobs", new_job(mesh)).await).await;
    assert_eq!(again["job"]["name"], *name);
    // The log ends by itself, and is what gRPC says that it is.
    let events = web.get(&format!("/api/v1/{name}/events")).await;
    assert_eq!(header(&events, "content-type"), "text/event-stream");
    let whole = events.text().await.unwrap();
    let ids = ids(&whole);
    let wanted: Vec<u64> =
        log(&mut server.client(), &name, 0).await.iter().map(|e| e.seq).collect();
    assert_eq!(ids, wanted);
    assert!(whole.ends_with("event: end\ndata: {}\n\n"), "{whole}");
    assert!(whole.contains(r#""state":"JOB_STATE_SUCCEEDED""#));
    // From any entry on; what the browser says counts more than the page's address.
    let half = ids.len() / 2;
    let rest = ids[half..].to_vec();
    for (query, last) in [(ids[half] - 1, None), (0, Some((ids[half] - 1).to_string()))] {
        let path = format!("/api/v1/{name}/events?after_seq={query}");
        let headers: Vec<_> = last.iter().map(|last| ("last-event-id", last.as_str())).collect();
        let text = web.send("GET", &path, &headers, "").await.text().await.unwrap();
        assert_eq!(self::ids(&text), rest);
    }
    let job = web.get_json(&format!("/api/v1/{name}")).await;
    assert_eq!(job["job"]["state"], "JOB_STATE_SUCCEEDED");
    let artifacts = web.get_json(&format!("/api/v1/{name}/artifacts")).await;
    let files = artifacts["artifacts"].as_array().unwrap();
    assert!(files.iter().any(|file| file["name"] == format!("{name}/artifacts/lod-0.glb")));
    assert_eq!(web.send("DELETE", &format!("/api/v1/{name}"), &[], "").await.status(), 200);
    assert_eq!(web.get(&format!("/api/v1/{name}")).await.status(), 404);
}

fn ids(events: &str) -> Vec<u64> {
    events.lines().filter_map(|line| line.strip_prefix("id: ")?.parse().ok()).collect()
}

#[tokio::test]
async fn artifacts_are_files_with_ranges_and_tags() {
    let server = Server::start();
    let mut client = server.client();
    let name = create(&mut client).await;
    ended(&client, &name).await;
    let web = Web::new(&server, None);
    let path = format!("/api/v1/{name}/artifacts/lod-0.glb");
    let whole = web.get(&path).await;
    assert_eq!(header(&whole, "content-type"), "model/gltf-binary");
    let (tag, len) =
        (header(&whole, "etag").to_owned(), header(&whole, "content-length").to_owned());
    let bytes = whole.bytes().await.unwrap();
    assert_eq!(
        (tag.clone(), len),
        (format!("\"{}\"", blake3::hash(&bytes)), bytes.len().to_string())
    );
    let n = bytes.len();
    let tail = format!("bytes={}-", n - 3);
    let past = format!("bytes={n}-");
    let all = 0..n;
    type Row<'a> = (&'a [(&'a str, &'a str)], StatusCode, std::ops::Range<usize>);
    let table: [Row<'_>; 10] = [
        (&[("range", "bytes=0-0")], StatusCode::PARTIAL_CONTENT, 0..1),
        (&[("range", "bytes=4-11")], StatusCode::PARTIAL_CONTENT, 4..12),
        (&[("range", &tail)], StatusCode::PARTIAL_CONTENT, n - 3..n),
        (&[("range", "bytes=-5")], StatusCode::PARTIAL_CONTENT, n - 5..n),
        (&[("range", "bytes=0-1,4-5")], StatusCode::OK, all.clone()),
        (&[("range", "bytes=4-11"), ("if-range", &tag)], StatusCode::PARTIAL_CONTENT, 4..12),
        (&[("range", "bytes=4-11"), ("if-range", "\"other\"")], StatusCode::OK, all.clone()),
        (&[("if-none-match", "\"other\"")], StatusCode::OK, all),
        (&[("if-none-match", &tag)], StatusCode::NOT_MODIFIED, 0..0),
        (&[("range", &past)], StatusCode::RANGE_NOT_SATISFIABLE, 0..0),
    ];
    for (headers, status, range) in table {
        let answer = web.send("GET", &path, headers, "").await;
        assert_eq!(answer.status(), status, "{headers:?}");
        let said = match status {
            StatusCode::PARTIAL_CONTENT => format!("bytes {}-{}/{n}", range.start, range.end - 1),
            StatusCode::RANGE_NOT_SATISFIABLE => format!("bytes */{n}"),
            _ => String::new(),
        };
        assert_eq!(header(&answer, "content-range"), said, "{headers:?}");
        if status.is_success() {
            assert_eq!(answer.bytes().await.unwrap(), bytes[range], "{headers:?}");
        }
    }
    let head = web.send("HEAD", &path, &[], "").await;
    assert_eq!((header(&head, "content-length"), head.status().as_u16()), (&*n.to_string(), 200));
    assert_eq!(web.get(&format!("/api/v1/{name}/artifacts/none")).await.status(), 404);
}

#[tokio::test]
async fn lists_are_paged_and_filtered_and_faults_are_named() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    let mut names = Vec::new();
    for _ in 0..5 {
        let created = client.create_job(create_request(&mesh, "")).await.unwrap();
        names.insert(0, created.into_inner().job.unwrap().name);
    }
    let web = Web::new(&server, None);
    web.post(&format!("/api/v1/{}:cancel", names[0]), json!({})).await;
    let (mut found, mut token) = (Vec::new(), String::new());
    loop {
        let query = "page_size=2&states=JOB_STATE_QUEUED&states=JOB_STATE_RUNNING";
        let page = web.get_json(&format!("/api/v1/jobs?{query}&page_token={token}")).await;
        let jobs = page["jobs"].as_array().unwrap();
        assert!(jobs.len() <= 2);
        found.extend(jobs.iter().map(|job| job["name"].as_str().unwrap().to_owned()));
        match page["nextPageToken"].as_str() {
            Some(next) => token = next.into(),
            None => break,
        }
    }
    assert_eq!(found, names[1..]);
    let twice = web.post(&format!("/api/v1/{}:cancel", names[0]), json!({})).await;
    assert_eq!(json_of(twice).await["job"]["state"], "JOB_STATE_CANCELLED");
    let bad = json!({"mesh": mesh, "fileName": "torus.ply", "spec": {"simplify": {
        "triangles": [500, 1], "render": {"imageSize": 7}}}});
    let refused = json_of(web.post("/api/v1/jobs", bad).await).await;
    let violations = refused["details"][1]["fieldViolations"].as_array().unwrap().iter();
    let fields: Vec<_> = violations.map(|v| v["field"].as_str().unwrap()).collect();
    assert!(fields.contains(&"spec.simplify.render.image_size"), "{fields:?}");
    for (path, status, text) in [
        ("/api/v1/jobs?colour=red", 400, "page_size, page_token, states, owner"),
        ("/api/v1/jobs?page_token=@", 400, "not a token"),
        ("/api/v1/nothing", 404, "no route"),
        ("/index.html", 404, "no route"),
        ("/api/v1/meshes", 405, "use POST"),
        ("/api/v1/jobs/0/events", 404, "does not exist"),
    ] {
        let answer = web.get(path).await;
        assert_eq!(answer.status(), status, "{path}");
        let body = json_of(answer).await;
        assert!(body["message"].as_str().unwrap().contains(text), "{path}: {body}");
    }
    let greeting = web.get("/").await.text().await.unwrap();
    assert!(greeting.contains("/api/v1/jobs lists jobs"), "{greeting}");
    let (code, message) = grpc_web(&web, "ListJobs", &v1::ListJobsRequest::default()).await;
    assert_eq!(code, Code::Ok);
    assert_eq!(v1::ListJobsResponse::decode(&*message).unwrap().jobs.len(), 5);
}

#[tokio::test]
async fn pages_of_other_origins_change_nothing() {
    const HERE: &str = "http://farm.test:8080";
    let closed = Server::start_with(&["--workers=0"]);
    let open = Server::start_with(&["--workers=0", "--allow-origin", HERE]);
    let asks = [("origin", HERE), ("access-control-request-method", "POST")];
    for (server, allowed) in [(&closed, ""), (&open, HERE)] {
        let web = Web::new(server, None);
        for path in ["/api/v1/jobs", "/lookalike.v1.LookalikeService/CreateJob"] {
            let leave = web.send("OPTIONS", path, &asks, "").await;
            assert_eq!(header(&leave, "access-control-allow-origin"), allowed, "{path}");
        }
        let list = web.send("GET", "/api/v1/jobs", &asks[..1], "").await;
        assert_eq!(header(&list, "access-control-allow-origin"), allowed);
        let other = [("origin", "http://evil.test"), ("access-control-request-method", "POST")];
        let leave = web.send("OPTIONS", "/api/v1/jobs", &other, "").await;
        assert_eq!(header(&leave, "access-control-allow-origin"), "");
        // What forms can send.
        for kind in ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data"] {
            for path in ["jobs", "jobs/0:cancel", "meshes"] {
                let path = format!("/api/v1/{path}");
                let answer = web.send("POST", &path, &[("content-type", kind)], "{}").await;
                assert_eq!(answer.status(), 415, "{path}, {kind}");
            }
        }
        // A name that its owner points at this machine.
        let (list, named) = ("/api/v1/jobs", [("host", "evil.test")]);
        assert_eq!(web.send("GET", list, &named, "").await.status(), 403);
        let known = if allowed.is_empty() { 403 } else { 200 };
        assert_eq!(web.send("GET", list, &[("host", "farm.test")], "").await.status(), known);
    }
}

#[tokio::test]
async fn calls_are_named_in_the_log_and_in_the_answer() {
    let server = Server::start_with(&["--workers=0", "--log-json"]);
    let web = Web::new(&server, None);
    let mesh = upload(&mut server.client(), small_torus()).await;
    let named = [("content-type", "application/json"), ("x-request-id", "trace-7")];
    let created = web.send("POST", "/api/v1/jobs", &named, new_job(&mesh).to_string()).await;
    assert_eq!(header(&created, "x-request-id"), "trace-7");
    let name = json_of(created).await["job"]["name"].as_str().unwrap().to_owned();
    // Whoever names no call finds the name that it was given.
    let refused = web.get("/api/v1/jobs/0").await;
    assert_eq!(header(&refused, "x-request-id").len(), 36);
    let log = server.logged();
    let lines = log.lines().map(|line| serde_json::from_str::<Value>(line).expect(line));
    let line = lines.into_iter().find(|line| line["message"] == "job created").unwrap();
    assert_eq!(
        (&line["span"]["id"], &line["span"]["method"]),
        (&"trace-7".into(), &"CreateJob".into())
    );
    assert_eq!(format!("jobs/{}", line["job"].as_str().unwrap()), name);
}

/// A request by hand, of which the test reads and writes as much as it likes.
fn raw(server: &Server, head: &str, body: &[u8]) -> TcpStream {
    let address = server.url.strip_prefix("http://").unwrap();
    let mut socket = TcpStream::connect(address).unwrap();
    write!(socket, "{head}\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    socket.write_all(body).unwrap();
    socket
}

#[tokio::test]
async fn uploads_that_break_off_store_nothing() {
    let server = Server::start_with(&["--workers=0"]);
    let head = "POST /api/v1/meshes HTTP/1.1\r\ncontent-type: application/octet-stream\r\n\
                content-length: 10";
    let mut socket = raw(&server, head, b"hello");
    socket.shutdown(Shutdown::Write).unwrap();
    let mut answer = String::new();
    let _ = socket.read_to_string(&mut answer);
    assert!(!answer.starts_with("HTTP/1.1 200"), "{answer}");
    let web = Web::new(&server, None);
    let kind = [("content-type", "application/octet-stream")];
    let stored = json_of(web.send("POST", "/api/v1/meshes", &kind, "hello").await).await;
    assert_eq!(stored["existed"], Value::Null, "half of an upload was taken for all of it");
    let other = format!("/api/v1/meshes?blake3={}", "0".repeat(64));
    assert_eq!(web.send("POST", &other, &kind, "hello").await.status(), 500);
}

#[tokio::test]
async fn readers_that_stall_delay_nobody_and_miss_nothing() {
    let server = Server::start();
    let mut client: Client = server.client();
    let name = create(&mut client).await;
    let head = format!("GET /api/v1/{name}/events HTTP/1.1");
    let mut stalled = raw(&server, &head, b"");
    let done = ended(&client, &name).await;
    assert_eq!(state(&done), lookalike::jobs::state::State::Succeeded);
    let mut text = String::new();
    stalled.read_to_string(&mut text).unwrap();
    let last = job(&mut client, &name).await.last_seq;
    assert_eq!(ids(&text), (1..=last).collect::<Vec<_>>());
}

// Whoever waits for the server must not keep its other clients from leaving.
#[tokio::test(flavor = "multi_thread")]
async fn open_logs_are_told_of_the_end_of_the_server() {
    let mut server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let name = create(&mut client).await;
    let web = Web::new(&server, None);
    let mut open = web.get(&format!("/api/v1/{name}/events")).await;
    let mut text = String::new();
    while !text.contains("id: 1\n") {
        text += std::str::from_utf8(&open.chunk().await.unwrap().unwrap()).unwrap();
    }
    let (took, is_well) = server.terminate();
    assert!(is_well && took < Duration::from_secs(3), "{took:?}");
    text += &open.text().await.unwrap();
    assert!(text.contains("event: fault\n") && text.contains("SHUTTING_DOWN"), "{text}");
    server.restart();
    // As a browser does.
    let again = eventually("the server", || async {
        let path = format!("/api/v1/{name}/events");
        let mut again = web.send("GET", &path, &[("last-event-id", "0")], "").await;
        Some(String::from_utf8(again.chunk().await.ok()??.to_vec()).unwrap())
    });
    assert!(again.await.starts_with("retry: "));
}

// Whoever waits for the server must not keep its other clients from leaving.
#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_stalls_does_not_hold_up_the_end() {
    let mut server = Server::start_with(&["--workers=0"]);
    let name = create(&mut server.client()).await;
    let mut worker = server.worker_client();
    // More than the buffers of both ends hold.
    store_artifact(&mut worker, 32).await;
    let mut stalled = raw(&server, &format!("GET /api/v1/{name}/artifacts/x HTTP/1.1"), b"");
    stalled.read_exact(&mut [0; 12]).unwrap();
    let (took, is_well) = server.terminate();
    assert!(is_well && took < Duration::from_secs(10), "{took:?}");
}

/// Ends the job that waits, with an artifact `x` of so many MiB.
async fn store_artifact(
    worker: &mut wire::worker_service_client::WorkerServiceClient<tonic::transport::Channel>,
    n_mib: usize,
) {
    use wire::put_artifact_request::Part;
    let claim = wire::ClaimRequest {
        worker: "w".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        ..Default::default()
    };
    let claimed = worker.claim(claim).await.unwrap().into_inner();
    let lease = claimed.assignment.unwrap().lease;
    let bytes = vec![7; n_mib << 20];
    let header = wire::PutArtifactHeader {
        lease: lease.clone(),
        file: "x".into(),
        media_type: "text/plain".into(),
        size: bytes.len() as u64,
        blake3: blake3::hash(&bytes).to_hex().to_string(),
    };
    let chunks = bytes.chunks(1 << 20).map(|chunk| Part::Chunk(chunk.to_vec().into()));
    let parts = [Part::Header(header)].into_iter().chain(chunks);
    let parts: Vec<_> = parts.map(|part| wire::PutArtifactRequest { part: Some(part) }).collect();
    worker.put_artifact(futures::stream::iter(parts)).await.unwrap();
    let succeeded = wire::Succeeded { files: vec!["x".into()] };
    let outcome = Some(wire::complete_request::Outcome::Succeeded(succeeded));
    worker.complete(wire::CompleteRequest { lease, outcome }).await.unwrap();
}
