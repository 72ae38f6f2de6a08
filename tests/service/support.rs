//! A server process that a test may kill, a command line, a mesh, and what to compare.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs,
    io::{BufRead, BufReader},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use lookalike::{
    jobs::{event::Event, spec::Spec, state::State},
    service::{
        auth::Secret,
        client::{self, Access, Connection},
        convert::{event_from_wire, spec_to_wire, state_from_wire},
        proto::{
            v1::{self, lookalike_service_client::LookalikeServiceClient},
            worker::v1::worker_service_client::WorkerServiceClient,
        },
    },
};
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use tonic::transport::Channel;

pub(crate) type Client = LookalikeServiceClient<Channel>;

/// Flags of a job that takes a moment, and the same as a specification.
pub(crate) const JOB: [&str; 7] = [
    "--triangles=500,200",
    "--views=12",
    "--image-size=128",
    "--effort=fast",
    "--seed=7",
    "--lambda=0.3",
    "--optimize-evaluations=3000",
];

pub(crate) fn job_spec() -> Spec {
    let mut spec = Spec::new(vec![500, 200]);
    spec.render.n_views = 12;
    spec.render.image_size = 128;
    spec.effort = lookalike::jobs::spec::Effort::Fast;
    spec.seed = 7;
    spec.lambda = 0.3;
    spec.optimize.max_evaluations = Some(3000);
    spec
}

/// A job that takes long enough to be cancelled.
pub(crate) const LONG_JOB: [&str; 4] =
    ["--triangles=2000", "--views=24", "--image-size=512", "--effort=best"];

/// A torus of `2 · n_around · n_through` triangles, as binary PLY.
pub(crate) fn torus(n_around: u32, n_through: u32) -> Vec<u8> {
    let mut ply = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\n\
         property float y\nproperty float z\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        n_around * n_through,
        2 * n_around * n_through
    )
    .into_bytes();
    let angle = |i: u32, n: u32| std::f32::consts::TAU * i as f32 / n as f32;
    for i in 0..n_around {
        for j in 0..n_through {
            let (u, v) = (angle(i, n_around), angle(j, n_through));
            let ring = 1.0 + 0.4 * v.cos() * (1.0 + 0.2 * (5.0 * u).sin());
            for x in [ring * u.cos(), ring * u.sin(), 0.4 * v.sin()] {
                ply.extend(x.to_le_bytes());
            }
        }
    }
    let at = |i: u32, j: u32| (i % n_around) * n_through + j % n_through;
    for i in 0..n_around {
        for j in 0..n_through {
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            for face in [[a, b, c], [a, c, d]] {
                ply.push(3);
                for vertex in face {
                    ply.extend(vertex.to_le_bytes());
                }
            }
        }
    }
    ply
}

/// A torus of 5,000 triangles.
pub(crate) fn small_torus() -> Vec<u8> {
    torus(50, 50)
}

/// A server process, its data directory and its workers.
pub(crate) struct Server {
    pub(crate) dir: TempDir,
    pub(crate) url: String,
    pub(crate) metrics: String,
    flags: Vec<String>,
    environment: Vec<(String, String)>,
    child: Child,
}

impl Server {
    /// Starts with one worker on the native evaluator.
    pub(crate) fn start() -> Self {
        Self::start_with(&["--workers=1"])
    }

    pub(crate) fn start_with(flags: &[&str]) -> Self {
        Self::start_in(flags, Vec::new())
    }

    pub(crate) fn start_in(flags: &[&str], environment: Vec<(String, String)>) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let [listen, metrics] = free_ports();
        let mut all = vec![format!("--listen={listen}"), format!("--metrics-listen={metrics}")];
        all.push(format!("--data-dir={}", dir.path().join("data").display()));
        all.push("--device=cpu".into());
        all.extend(flags.iter().map(|flag| (*flag).into()));
        let child = spawn(&all, &environment, &dir.path().join("log"));
        let is_tls = flags.iter().any(|flag| flag.starts_with("--tls-cert"));
        let scheme = if is_tls { "https" } else { "http" };
        Self { dir, url: format!("{scheme}://{listen}"), metrics, flags: all, environment, child }
    }

    /// SIGKILL, and nothing else: workers live on.
    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// After [`Self::kill`] or [`Self::terminate`].
    pub(crate) fn restart(&mut self) {
        self.child = spawn(&self.flags, &self.environment, &self.dir.path().join("log"));
    }

    /// SIGTERM; how long it took to end, and whether it ended well.
    pub(crate) fn terminate(&mut self) -> (Duration, bool) {
        let start = Instant::now();
        signal(self.child.id(), Signal::TERM);
        let status = self.child.wait().unwrap();
        (start.elapsed(), status.success())
    }

    pub(crate) fn data_dir(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    /// What the server and its workers have logged.
    pub(crate) fn logged(&self) -> String {
        fs::read_to_string(self.dir.path().join("log")).unwrap()
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// The processes of the workers that live.
    pub(crate) fn worker_pids(&self) -> Vec<u32> {
        self.worker_processes().into_iter().map(|(_, pid)| pid).collect()
    }

    /// The same, with the workers' identities.
    pub(crate) fn worker_processes(&self) -> Vec<(String, u32)> {
        let locks = fs::read_dir(self.data_dir().join("workers")).into_iter().flatten().flatten();
        let worker = |lock: fs::DirEntry| {
            let id = lock.path().file_stem()?.to_str()?.to_owned();
            Some((id, fs::read_to_string(lock.path()).ok()?.parse().ok()?))
        };
        locks.filter_map(worker).filter(|&(_, pid)| self.owns(pid)).collect()
    }

    /// Whether the process is a worker of this data directory, and not a later owner of the number.
    fn owns(&self, pid: u32) -> bool {
        let command = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let command = String::from_utf8_lossy(&command).into_owned();
        command.contains(&*self.data_dir().to_string_lossy())
    }

    /// Waits until the workers have started and locked their files.
    pub(crate) async fn workers_up(&self, n_workers: usize) -> Vec<u32> {
        eventually("workers", || async {
            Some(self.worker_pids()).filter(|pids| pids.len() >= n_workers)
        })
        .await
    }

    pub(crate) fn client(&self) -> Client {
        LookalikeServiceClient::new(client::channel(&self.url).unwrap())
    }

    pub(crate) fn worker_client(&self) -> WorkerServiceClient<Channel> {
        WorkerServiceClient::new(client::channel(&self.url).unwrap())
    }

    /// A command for this server.
    pub(crate) fn command(&self, name: &str, flags: &[&str]) -> Command {
        let mut command = lookalike();
        command.arg(name).arg("--server").arg(&self.url).args(flags);
        command
    }

    pub(crate) fn run(&self, name: &str, flags: &[&str]) -> Output {
        self.command(name, flags).output().unwrap()
    }

    /// Writes a file into the test's folder; its path.
    /// All files below a folder of the data directory.
    pub(crate) fn files_below(&self, folder: &str) -> Vec<String> {
        let mut folders = vec![self.data_dir().join(folder)];
        let mut files = Vec::new();
        while let Some(folder) = folders.pop() {
            // One that goes meanwhile has no files.
            for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
                let path = entry.path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    files.push(path.display().to_string());
                }
            }
        }
        files
    }

    pub(crate) fn file(&self, name: &str, bytes: &[u8]) -> String {
        let path = self.dir.path().join(name);
        fs::write(&path, bytes).unwrap();
        path.display().to_string()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.worker_pids().into_iter().for_each(|pid| signal(pid, Signal::KILL));
    }
}

pub(crate) fn lookalike() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lookalike"));
    command.stdin(Stdio::null()).env_remove("RUST_LOG");
    command
}

/// Starts a server that adds to `log`, and waits until it listens.
fn spawn(flags: &[String], environment: &[(String, String)], log: &Path) -> Child {
    let log = fs::File::options().create(true).append(true).open(log).unwrap();
    let mut command = lookalike();
    command.envs(environment.iter().cloned());
    command.arg("serve").args(flags).stdout(Stdio::piped()).stderr(log);
    let mut child = command.spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.starts_with("listening on http"), "the server said {line:?}");
    child
}

pub(crate) fn signal(pid: u32, signal: Signal) {
    // It may have ended just now.
    let _ = kill_process(Pid::from_raw(pid as i32).unwrap(), signal);
}

/// Ports that were free a moment ago.
pub(crate) fn free_ports<const N: usize>() -> [String; N] {
    let held = [(); N].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    held.map(|listener| listener.local_addr().unwrap().to_string())
}

/// Tries until there is something, for at most a minute.
pub(crate) async fn eventually<T, F>(what: &str, mut attempt: impl FnMut() -> F) -> T
where
    F: Future<Output = Option<T>>,
{
    let deadline = Instant::now() + Duration::from_mins(1);
    loop {
        if let Some(found) = attempt().await {
            return found;
        }
        assert!(Instant::now() < deadline, "waited too long for {what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// A client of a server that asks who calls.
pub(crate) fn with_token(server: &Server, token: &str) -> LookalikeServiceClient<Connection> {
    let access = Access { token: Some(Secret::new(token)), ..Access::default() };
    LookalikeServiceClient::new(client::connection(&server.url, &access).unwrap())
}

/// Stores a mesh; its name.
pub(crate) async fn upload(client: &mut Client, bytes: Vec<u8>) -> String {
    upload_parts(bytes, async |parts| client.upload_mesh(parts).await).await
}

/// The same for a client that says who it is.
pub(crate) async fn upload_as(
    client: &mut LookalikeServiceClient<Connection>,
    bytes: Vec<u8>,
) -> String {
    upload_parts(bytes, async |parts| client.upload_mesh(parts).await).await
}

async fn upload_parts(
    bytes: Vec<u8>,
    send: impl AsyncFnOnce(
        futures::stream::Iter<std::array::IntoIter<v1::UploadMeshRequest, 2>>,
    ) -> Result<tonic::Response<v1::UploadMeshResponse>, tonic::Status>,
) -> String {
    use v1::upload_mesh_request::Part;
    let header = v1::UploadMeshHeader { size: bytes.len() as u64, ..Default::default() };
    let parts = [Part::Header(header), Part::Chunk(bytes.into())];
    let parts = parts.map(|part| v1::UploadMeshRequest { part: Some(part) });
    send(futures::stream::iter(parts)).await.unwrap().into_inner().mesh
}

pub(crate) fn create_request(mesh: &str, request_id: &str) -> v1::CreateJobRequest {
    v1::CreateJobRequest {
        request_id: request_id.into(),
        mesh: mesh.into(),
        file_name: "torus.ply".into(),
        spec: Some(spec_to_wire(&job_spec())),
        webhook_url: String::new(),
        priority: 0,
        labels: std::collections::HashMap::new(),
    }
}

/// Queues [`JOB`] on the small torus; its name.
pub(crate) async fn create(client: &mut Client) -> String {
    let mesh = upload(client, small_torus()).await;
    let created = client.create_job(create_request(&mesh, "")).await.unwrap();
    created.into_inner().job.unwrap().name
}

pub(crate) async fn job(client: &mut Client, name: &str) -> v1::Job {
    let request = v1::GetJobRequest { name: name.into() };
    client.get_job(request).await.unwrap().into_inner().job.unwrap()
}

pub(crate) fn state(job: &v1::Job) -> State {
    state_from_wire(job.state).unwrap()
}

/// Waits until the job has ended, through restarts of the server.
pub(crate) async fn ended<T>(client: &LookalikeServiceClient<T>, name: &str) -> v1::Job
where
    T: tonic::client::GrpcService<tonic::body::Body> + Clone,
    T::Error: Into<tonic::codegen::StdError>,
    T::ResponseBody: tonic::codegen::Body<Data = tonic::codegen::Bytes> + Send + 'static,
    <T::ResponseBody as tonic::codegen::Body>::Error: Into<tonic::codegen::StdError> + Send,
{
    eventually(name, || async {
        let request = v1::GetJobRequest { name: name.into() };
        let job = client.clone().get_job(request).await.ok()?.into_inner().job?;
        state(&job).is_final().then_some(job)
    })
    .await
}

/// The log of a job after `after_seq`, to its end.
pub(crate) async fn log(client: &mut Client, name: &str, after_seq: u64) -> Vec<Event> {
    let request = v1::WatchJobRequest { name: name.into(), after_seq };
    let mut events = client.watch_job(request).await.unwrap().into_inner();
    let mut log = Vec::new();
    while let Some(message) = events.message().await.unwrap() {
        log.push(event_from_wire(message.event.unwrap()).unwrap());
    }
    log
}

/// The files of a folder, without what the clock writes into them.
pub(crate) fn results(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        let bytes = fs::read(entry.path()).unwrap();
        match name.as_str() {
            // Times, and a plot of them.
            "report.json" | "energy.svg" => {}
            "energy.csv" => drop(files.insert(name, without_seconds(&bytes))),
            _ => drop(files.insert(name, bytes)),
        }
    }
    assert!(files.contains_key("lod-0.glb"), "{:?}", files.keys());
    files
}

fn without_seconds(csv: &[u8]) -> Vec<u8> {
    let text = std::str::from_utf8(csv).unwrap();
    let header = text.lines().next().unwrap().split(',');
    let seconds = header.clone().position(|column| column == "seconds").unwrap();
    text.lines()
        .fold(String::new(), |mut kept, line| {
            let columns = line.split(',').enumerate().filter(|(i, _)| *i != seconds);
            let columns: Vec<_> = columns.map(|(_, column)| column).collect();
            let _ = writeln!(kept, "{}", columns.join(","));
            kept
        })
        .into_bytes()
}

/// What [`JOB`] makes of the small torus, without a server.
pub(crate) fn reference(server: &Server) -> BTreeMap<String, Vec<u8>> {
    reference_of(server, &JOB)
}

/// The same of another job with the same mesh.
pub(crate) fn reference_of(server: &Server, flags: &[&str]) -> BTreeMap<String, Vec<u8>> {
    let (file, out) =
        (server.file("torus.ply", &small_torus()), server.dir.path().join("reference"));
    let mut command = lookalike();
    command.arg("run").arg(file).arg("--device=cpu").arg("--out").arg(&out).args(flags);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    results(&out)
}
