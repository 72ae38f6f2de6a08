//! A tenant that misbehaves: each kind of abuse is refused with the right status, and the server and its other
//! tenants go on.

pub(crate) mod raw;

use std::{net::SocketAddr, time::Duration};

use futures::{StreamExt, stream};
use lookalike::{
    jobs::event::Report,
    service::{
        auth::Secret,
        client::{Access, Connection, connection},
        convert::report_to_wire,
        proto::{
            v1::{self, lookalike_service_client::LookalikeServiceClient},
            worker::v1::{self as wire, worker_service_client::WorkerServiceClient},
        },
        status::reason_of,
    },
};
use tempfile::TempDir;
use tokio::{net::TcpStream, time::timeout};
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::{
    auth::token,
    support::{Server, create_request, eventually, small_torus, upload_as, with_token},
};

type Client = LookalikeServiceClient<Connection>;

/// A server with a good tenant and a bad one.
struct Two {
    server: Server,
    good: Client,
    bad: Client,
    bad_token: String,
    worker_token: String,
    _folder: TempDir,
}

impl Two {
    fn start(flags: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let [good, bad] = ["good", "bad"].map(|name| token(folder.path(), name, name, "user"));
        let worker_token = token(folder.path(), "farm", "farm", "worker");
        let tokens = format!("--tokens={}", folder.path().join("tokens.toml").display());
        let server = Server::start_with(&[flags, &["--workers=0", &tokens]].concat());
        let (good, bad_token) = (with_token(&server, &good), bad);
        let bad = with_token(&server, &bad_token);
        Self { server, good, bad, bad_token, worker_token, _folder: folder }
    }

    /// The bad tenant on another connection.
    fn another_bad(&self) -> Client {
        with_token(&self.server, &self.bad_token)
    }

    fn address(&self) -> SocketAddr {
        self.server.url.strip_prefix("http://").unwrap().parse().unwrap()
    }

    /// The good tenant can do everything that it could.
    async fn check_good(&mut self) {
        let mesh = upload_as(&mut self.good, small_torus()).await;
        let created = self.good.create_job(create_request(&mesh, "")).await.unwrap();
        let name = created.into_inner().job.unwrap().name;
        let watch = v1::WatchJobRequest { name: name.clone(), after_seq: 0 };
        let mut events = self.good.watch_job(watch).await.unwrap().into_inner();
        assert_eq!(events.message().await.unwrap().unwrap().event.unwrap().seq, 1);
        self.good.cancel_job(v1::CancelJobRequest { name }).await.unwrap();
    }

    /// Memory of the server, in MiB.
    fn memory_mib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.server.pid()));
        let status = status.unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() >> 10
    }
}

/// The one reason of a refusal that says when to try again.
fn overload(status: &Status) -> String {
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    reason_of(status).unwrap()
}

#[tokio::test]
async fn a_long_queue_is_refused() {
    let mut two = Two::start(&["--max-owner-queued=30"]);
    let mesh = upload_as(&mut two.bad, small_torus()).await;
    let creations = (0..100).map(|_| {
        let (mut bad, request) = (two.bad.clone(), create_request(&mesh, ""));
        async move { bad.create_job(request).await }
    });
    let answers: Vec<_> = stream::iter(creations).buffer_unordered(32).collect().await;
    let (created, refused): (Vec<_>, Vec<_>) = answers.into_iter().partition(Result::is_ok);
    assert_eq!((created.len(), refused.len()), (30, 70));
    for status in refused.into_iter().map(Result::unwrap_err) {
        assert_eq!(overload(&status), "QUOTA");
        assert!(status.get_details_retry_info().is_some());
    }
    two.check_good().await;
}

#[tokio::test]
async fn giant_uploads_are_refused_and_leave_nothing() {
    use v1::upload_mesh_request::Part;
    let mut two = Two::start(&["--max-mesh-mib=1"]);
    for size in [0, 1 << 40] {
        let header = Part::Header(v1::UploadMeshHeader { size, ..Default::default() });
        let chunks = std::iter::repeat_n(Part::Chunk(vec![7; 256 << 10].into()), 64);
        let parts = std::iter::once(header).chain(chunks);
        let parts = parts.map(|part| v1::UploadMeshRequest { part: Some(part) });
        let refused = two.bad.upload_mesh(stream::iter(parts)).await.unwrap_err();
        assert_eq!(overload(&refused), "TOO_LARGE");
    }
    let staged = || std::fs::read_dir(two.server.data_dir().join("objects/tmp")).unwrap().count();
    eventually("staged bytes to go", || async { (staged() == 0).then_some(()) }).await;
    two.check_good().await;
}

/// One call more than a principal may have open, and a message that is larger than any may be.
#[tokio::test]
async fn a_thousand_streams_and_giant_messages_are_refused() {
    let mut two = Two::start(&["--max-streams=1000"]);
    let mesh = upload_as(&mut two.bad, small_torus()).await;
    let name = two.bad.create_job(create_request(&mesh, "")).await.unwrap();
    let name = name.into_inner().job.unwrap().name;
    let watch = v1::WatchJobRequest { name, after_seq: 0 };
    let before = two.memory_mib();
    // A connection has room for 256 calls: five of them.
    let mut open = Vec::new();
    for _ in 0..5 {
        let mut bad = two.another_bad();
        for _ in 0..200 {
            open.push(bad.watch_job(watch.clone()).await.unwrap());
        }
    }
    let refused = two.another_bad().watch_job(watch).await.unwrap_err();
    assert_eq!(overload(&refused), "TOO_MANY_STREAMS");
    let grown = two.memory_mib().saturating_sub(before);
    assert!(grown < 100, "1,000 open streams need {grown} MiB");
    let mut giant = create_request(&mesh, "");
    giant.file_name = "x".repeat(17 << 20);
    let refused = two.bad.create_job(giant).await.unwrap_err();
    assert_eq!(overload(&refused), "MESSAGE_TOO_LARGE");
    two.check_good().await;
}

/// Readers that never read hold a segment each, and the worker goes on.
#[tokio::test]
async fn slow_readers_hold_little_and_nobody_up() {
    const READERS: u64 = 200;
    let mut two = Two::start(&[]);
    let mesh = upload_as(&mut two.bad, small_torus()).await;
    let created = two.bad.create_job(create_request(&mesh, "")).await.unwrap().into_inner();
    let name = created.job.unwrap().name;
    let access = Access { token: Some(Secret::new(&two.worker_token)), ..Access::default() };
    let mut worker = WorkerServiceClient::new(connection(&two.server.url, &access).unwrap());
    let version = env!("CARGO_PKG_VERSION").into();
    let claim =
        wire::ClaimRequest { worker: "w".into(), version, wait_secs: 10.0, ..Default::default() };
    let lease = worker.claim(claim).await.unwrap().into_inner().assignment.unwrap().lease;
    let before = two.memory_mib();
    let mut open = Vec::new();
    for _ in 0..READERS {
        let watch = v1::WatchJobRequest { name: name.clone(), after_seq: 0 };
        open.push(two.bad.watch_job(watch).await.unwrap());
    }
    // 16 MiB of records, many times what a connection has room for.
    for i in 0..16 {
        let report = Report::Records { level: None, first: i, count: 1, bytes: vec![7; 1 << 20] };
        let events = vec![wire::WorkerEvent { body: Some(report_to_wire(report)) }];
        let request = wire::AppendEventsRequest { lease: lease.clone(), first_index: i, events };
        assert_eq!(worker.append_events(request).await.unwrap().into_inner().appended, i + 1);
    }
    two.check_good().await;
    let grown = two.memory_mib().saturating_sub(before);
    assert!(grown < 4 * READERS, "{READERS} slow readers need {grown} MiB");
    // One that begins to read finds everything.
    let mut late = open.pop().unwrap().into_inner();
    // The others fill the connection that it shares with them.
    drop(open);
    for seq in 1..=18 {
        assert_eq!(late.message().await.unwrap().unwrap().event.unwrap().seq, seq);
    }
}

/// A message that is another one: where a mesh's name belongs, there is a truth value.
#[tokio::test]
async fn messages_that_are_others_are_refused() {
    let mut two = Two::start(&[]);
    let access = Access { token: Some(Secret::new(&two.bad_token)), ..Access::default() };
    let mut grpc = tonic::client::Grpc::new(connection(&two.server.url, &access).unwrap());
    grpc.ready().await.unwrap();
    let wrong = v1::PinJobRequest { name: "jobs/x".into(), pinned: true };
    let codec = tonic_prost::ProstCodec::<v1::PinJobRequest, v1::CreateJobResponse>::default();
    let path = http::uri::PathAndQuery::from_static("/lookalike.v1.LookalikeService/CreateJob");
    let refused = grpc.unary(tonic::Request::new(wrong), path, codec).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument, "{refused:?}");
    assert_eq!(reason_of(&refused).as_deref(), Some("MALFORMED"));
    two.check_good().await;
}

#[tokio::test]
async fn malformed_frames_and_floods_end_their_connection_and_nothing_else() {
    let mut two = Two::start(&[]);
    let pid = two.server.pid();
    for (what, bytes, end) in raw::malformed() {
        assert_eq!(raw::send(two.address(), &bytes).await, end, "{what}");
    }
    two.check_good().await;
    assert!(std::fs::exists(format!("/proc/{pid}")).unwrap() && two.server.pid() == pid);
    assert!(!two.server.logged().contains("panicked"), "{}", two.server.logged());
}

/// Connections that say nothing keep nobody else away.
#[tokio::test]
async fn silent_connections_are_dropped() {
    let mut two = Two::start(&[]);
    let mut silent = Vec::new();
    for _ in 0..600 {
        silent.push(raw::connect(two.address()).await.unwrap());
    }
    timeout(Duration::from_secs(60), two.check_good()).await.unwrap();
    // All of them in the end.
    for connection in &silent {
        let is_closed = || async { matches!(connection.try_read(&mut [0]), Ok(0)).then_some(()) };
        eventually("a silent connection to be dropped", is_closed).await;
    }
}

/// Whether the server keeps the connection for a while.
async fn is_kept(connection: &TcpStream) -> bool {
    let closed = async {
        loop {
            connection.readable().await.unwrap();
            match connection.try_read(&mut [0; 64]) {
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
                Ok(1..) => {}
                Ok(0) | Err(_) => return,
            }
        }
    };
    timeout(Duration::from_millis(500), closed).await.is_err()
}

/// How many connections of so many stay, and whether others can still connect.
async fn check_crowd(flag: &str, n: usize, wanted: std::ops::RangeInclusive<usize>) {
    let mut two = Two::start(&[flag]);
    let mut connections = Vec::new();
    for _ in 0..n {
        // One that is cut off at once may not even come to be.
        connections.extend(raw::connect(two.address()).await.ok());
    }
    let kept = futures::future::join_all(connections.iter().map(is_kept)).await;
    let n_kept = kept.into_iter().filter(|kept| *kept).count();
    assert!(wanted.contains(&n_kept), "{flag}: {n_kept} of {n} are kept");
    two.check_good().await;
    two.another_bad().list_jobs(v1::ListJobsRequest::default()).await.unwrap();
}

/// Four seconds' worth at once, and one second's that waits.
#[tokio::test]
async fn connections_that_come_too_fast_are_cut_off() {
    check_crowd("--max-connections-per-sec=10", 100, 50..=60).await;
}

#[tokio::test]
async fn one_address_leaves_connections_for_others() {
    check_crowd("--max-connections=40", 100, 20..=20).await;
}

/// Calls without a token are answered ever later; those with one are not.
#[tokio::test]
async fn strangers_are_slowed_down() {
    let mut two = Two::start(&[]);
    let stranger =
        LookalikeServiceClient::new(connection(&two.server.url, &Access::default()).unwrap());
    let calls = (0..1200).map(|_| {
        let mut stranger = stranger.clone();
        async move { stranger.list_jobs(v1::ListJobsRequest::default()).await.unwrap_err().code() }
    });
    let start = std::time::Instant::now();
    let codes: Vec<_> = stream::iter(calls).buffer_unordered(16).collect().await;
    assert!(codes.iter().all(|code| *code == Code::Unauthenticated));
    // A thousand at once, then fifty a second, and whoever has waited two seconds.
    assert!(start.elapsed() > Duration::from_secs(2), "{:?}", start.elapsed());
    two.check_good().await;
}
