//! What a bad tenant does to a good one: the 99th percentile of the good one's submissions, alone and under each
//! kind of abuse.
//!
//! The bad one is a process of its own that yields to all others (`SCHED_IDLE`): it has the processor time that they
//! leave. Elsewhere it would have a machine of its own; what it takes from others is to be what the server gives it.

use std::{
    io::{BufRead as _, BufReader},
    net::SocketAddr,
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use futures::{
    StreamExt,
    future::{BoxFuture, ready},
    stream,
};
use lookalike::service::{
    client::Connection,
    proto::v1::{self, lookalike_service_client::LookalikeServiceClient},
};
use tempfile::TempDir;
use tokio::{task::JoinSet, time::sleep};
use tonic::{Code, Streaming};

use crate::{
    Size,
    figures::{worker_as, write_long_log},
    page::{Abused, Waits},
    raw,
    stores::Stores,
    support::{Server, create_request, lookalike, small_torus, torus, upload_as, with_token},
};

type Client = LookalikeServiceClient<Connection>;

/// Connections of a flood, and of an upload.
const N_FLOODS: usize = 8;
const N_UPLOADS: usize = 4;
/// A slow reader reads so often.
const READ_PAUSE: Duration = Duration::from_secs(1);
/// A good tenant submits so often.
const PAUSE: Duration = Duration::from_millis(20);

/// The flag, with the abuse, that makes a process the bad tenant; the rest is in the environment.
pub(crate) const BAD: &str = "--bad";
/// What the bad tenant says when it has begun.
const BEGUN: &str = "begun";

/// The bad tenant.
#[derive(Clone, serde::Serialize, serde::Deserialize)]
struct Bad {
    url: String,
    token: String,
    /// A mesh of its own, and a job.
    mesh: String,
    job: String,
    /// One that has ended and left a long log.
    long_job: String,
    n_queued: usize,
}

/// Begins an abuse, which goes on until it is dropped.
type Abuse = fn(Bad) -> BoxFuture<'static, JoinSet<()>>;

const ABUSES: [(&str, Abuse); 7] = [
    ("submits without a pause, 64 at a time", |bad| Box::pin(submissions(bad))),
    ("has 10,000 jobs waiting", |bad| Box::pin(queue(bad))),
    ("uploads files of 1 GiB, four at a time", |bad| Box::pin(ready(uploads(&bad)))),
    ("holds 1,000 streams open and reads none", |bad| Box::pin(streams(bad))),
    ("reads a long log slowly, 1,000 streams", |bad| Box::pin(slow_readers(bad))),
    ("sends malformed frames, eight connections", |bad| Box::pin(ready(malformed(&bad)))),
    ("floods with resets, eight connections", |bad| Box::pin(ready(resets(&bad)))),
];

/// How long the good tenant's submissions take under each abuse whose name has `part` in it, and right before it.
pub(crate) async fn take(stores: &mut Stores, size: Size, part: &str) -> Vec<Abused> {
    let folder = tempfile::tempdir().unwrap();
    let [good, bad, worker] = [("good", "user"), ("bad", "user"), ("worker", "worker")]
        .map(|(n, r)| token(&folder, n, r));
    let file = format!("--tokens={}", folder.path().join("tokens.toml").display());
    // All other limits as they are.
    let server = stores.server(&[&file, "--max-mesh-mib=512"]);
    let good = with_token(&server, &good);
    let mut client = with_token(&server, &bad);
    let mesh = upload_as(&mut client, torus(50, 40)).await;
    client.create_job(create_request(&mesh, "")).await.unwrap();
    let long_job = write_long_log(worker_as(&server, Some(&worker)), size.n_chunks).await;
    let created = client.create_job(create_request(&mesh, "")).await.unwrap().into_inner();
    let job = created.job.unwrap().name;
    let url = server.url.clone();
    let bad = Bad { url, token: bad, mesh, job, long_job, n_queued: size.n_queued };
    let mut rows = Vec::new();
    for (what, _) in ABUSES.iter().filter(|(what, _)| what.contains(part)) {
        let (mut alone, mut beset) = (Vec::new(), Vec::new());
        for _ in 0..size.n_rounds {
            alone.extend(submit(good.clone(), size.n_good).await);
            let abuse = Abuser::begin(what, &bad);
            beset.extend(submit(good.clone(), size.n_good).await);
            drop(abuse);
            // What was begun comes to its end.
            sleep(Duration::from_secs(1)).await;
        }
        let (alone, beset) = (Waits::of(alone), Waits::of(beset));
        eprintln!("{what}: {beset:?}, alone {alone:?}");
        rows.push(Abused { what, alone, beset });
    }
    check(&server);
    rows
}

/// The process of the bad tenant, until it is dropped.
struct Abuser(Child);

impl Abuser {
    fn begin(what: &str, bad: &Bad) -> Self {
        let mut command = Command::new("chrt");
        command.args(["--idle", "0"]).arg(std::env::current_exe().unwrap()).args([BAD, what]);
        command.env("BAD", serde_json::to_string(bad).unwrap()).stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut said = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut said).unwrap();
        assert_eq!(said.trim(), BEGUN);
        Self(child)
    }
}

impl Drop for Abuser {
    fn drop(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

/// What the process of the bad tenant does, until it is killed.
pub(crate) async fn misbehave(what: &str) {
    let bad: Bad = serde_json::from_str(&std::env::var("BAD").unwrap()).unwrap();
    let (_, begin) = ABUSES.iter().find(|(name, _)| *name == what).unwrap();
    let mut tasks = begin(bad).await;
    println!("{BEGUN}");
    while let Some(ended) = tasks.join_next().await {
        ended.unwrap();
    }
    std::future::pending::<()>().await;
}

/// The server is the one that was started, and nothing in it has panicked.
fn check(server: &Server) {
    assert!(Path::new(&format!("/proc/{}/stat", server.pid())).exists());
    assert!(!server.logged().contains("panicked"));
}

fn token(folder: &TempDir, name: &str, role: &str) -> String {
    let mut command: Command = lookalike();
    command.args(["token", name, "--owner", name, "--role", role, "--tokens"]);
    let output = command.arg(folder.path().join("tokens.toml")).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap().trim().into()
}

/// Milliseconds that each submission of the good tenant takes.
async fn submit(mut good: Client, n: usize) -> Vec<f64> {
    let mesh = upload_as(&mut good, small_torus()).await;
    let mut waits = Vec::with_capacity(n);
    for _ in 0..n {
        let start = Instant::now();
        good.create_job(create_request(&mesh, "")).await.unwrap();
        waits.push(start.elapsed().as_secs_f64() * 1e3);
        sleep(PAUSE).await;
    }
    waits
}

impl Bad {
    fn client(&self) -> Client {
        let access = lookalike::service::client::Access {
            token: Some(lookalike::service::auth::Secret::new(&self.token)),
            ..Default::default()
        };
        let connection = lookalike::service::client::connection(&self.url, &access).unwrap();
        LookalikeServiceClient::new(connection)
    }

    fn address(&self) -> SocketAddr {
        self.url.strip_prefix("http://").unwrap().parse().unwrap()
    }
}

async fn submissions(bad: Bad) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    for _ in 0..4 {
        let (client, mesh) = (bad.client(), bad.mesh.clone());
        tasks.spawn(async move {
            let endless = std::iter::repeat(()).map(|()| {
                let (mut client, request) = (client.clone(), create_request(&mesh, ""));
                async move { drop(client.create_job(request).await) }
            });
            stream::iter(endless).buffer_unordered(16).for_each(async |()| {}).await;
        });
    }
    sleep(Duration::from_millis(200)).await;
    tasks
}

async fn queue(bad: Bad) -> JoinSet<()> {
    let client = bad.client();
    let creations = (0..bad.n_queued).map(|_| {
        let (mut client, request) = (client.clone(), create_request(&bad.mesh, ""));
        async move {
            // It may make so many a second.
            while let Err(status) = client.create_job(request.clone()).await {
                assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
            }
        }
    });
    stream::iter(creations).buffer_unordered(16).for_each(async |()| {}).await;
    JoinSet::new()
}

fn uploads(bad: &Bad) -> JoinSet<()> {
    use v1::upload_mesh_request::Part;
    let mut tasks = JoinSet::new();
    for _ in 0..N_UPLOADS {
        let mut client = bad.client();
        tasks.spawn(async move {
            loop {
                let header = Part::Header(v1::UploadMeshHeader::default());
                let chunks = std::iter::repeat_n(Part::Chunk(vec![7; 256 << 10].into()), 4096);
                let parts = std::iter::once(header).chain(chunks);
                let parts = parts.map(|part| v1::UploadMeshRequest { part: Some(part) });
                let refused = client.upload_mesh(stream::iter(parts)).await;
                assert!(refused.is_err(), "larger than any may be");
            }
        });
    }
    tasks
}

async fn streams(bad: Bad) -> JoinSet<()> {
    let open = watch(&bad, &bad.job).await;
    JoinSet::from_iter([async move {
        let _open = open;
        std::future::pending::<()>().await;
    }])
}

/// Each reads an entry now and then: what it has not read piles up somewhere.
async fn slow_readers(bad: Bad) -> JoinSet<()> {
    let read = async |mut entries: Streaming<v1::WatchJobResponse>| {
        while entries.message().await.unwrap().is_some() {
            sleep(READ_PAUSE).await;
        }
    };
    watch(&bad, &bad.long_job).await.into_iter().map(read).collect()
}

/// A thousand streams of a job's log, on five connections.
async fn watch(bad: &Bad, job: &str) -> Vec<Streaming<v1::WatchJobResponse>> {
    let mut open = Vec::new();
    for _ in 0..5 {
        let mut client = bad.client();
        for _ in 0..200 {
            let watch = v1::WatchJobRequest { name: job.into(), after_seq: 0 };
            open.push(client.watch_job(watch).await.unwrap().into_inner());
        }
    }
    open
}

fn malformed(bad: &Bad) -> JoinSet<()> {
    let address = bad.address();
    flood(move |i| {
        let table = raw::malformed();
        let bytes = table[i % table.len()].1.clone();
        Box::pin(async move {
            raw::send(address, &bytes).await;
        })
    })
}

fn resets(bad: &Bad) -> JoinSet<()> {
    let (address, bytes) = (bad.address(), raw::reset_flood(1000));
    flood(move |_| {
        let bytes = bytes.clone();
        Box::pin(async move {
            raw::send(address, &bytes).await;
        })
    })
}

fn flood(
    once: impl Fn(usize) -> BoxFuture<'static, ()> + Clone + Send + Sync + 'static,
) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    for i in 0..N_FLOODS {
        let once = once.clone();
        tasks.spawn(async move {
            let mut i = i;
            loop {
                once(i).await;
                i += 1;
            }
        });
    }
    tasks
}
