//! A server seen from a command: calls that survive its restart.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use clap::Args;
use futures::stream;
use lookalike::{
    jobs::event::Event,
    service::{
        auth::Secret,
        client::{Access, Backoff, BadTarget, Connection, connect, endpoint, is_transient},
        convert,
        proto::v1::{self, lookalike_service_client::LookalikeServiceClient},
        server::MAX_MESSAGE_BYTES,
        status::{OFFSET, reason_of},
    },
};
use prost::bytes::Bytes;
use tokio::{
    io::{AsyncWrite, AsyncWriteExt},
    time::Instant,
};
use tonic::{Response, Status};
use uuid::Uuid;

use super::exit::{Exit, Failure, refused, unreachable};

type Client = LookalikeServiceClient<Connection>;

/// A server that restarts is waited for this long.
const PATIENCE: Duration = Duration::from_mins(1);
/// Bytes of an upload's chunk.
const CHUNK: usize = 256 << 10;

/// Which server.
#[derive(Args, Clone, Debug)]
pub(crate) struct ServerArgs {
    /// The server's URL.
    #[arg(
        long,
        env = "LOOKALIKE_SERVER",
        default_value = "http://127.0.0.1:7420",
        value_name = "URL"
    )]
    server: String,
    #[command(flatten)]
    access: AccessArgs,
}

/// What a server asks of its callers.
#[derive(Args, Clone, Debug)]
pub(crate) struct AccessArgs {
    /// Says who calls. Better given by the environment: others can read command lines.
    #[arg(long, env = "LOOKALIKE_TOKEN", hide_env_values = true, value_name = "TOKEN")]
    token: Option<Secret>,
    /// The authority of the server's certificate, in PEM. Default: those that the system trusts.
    #[arg(long, env = "LOOKALIKE_CA", value_name = "FILE")]
    ca: Option<PathBuf>,
    /// This client's own certificate, in PEM.
    #[arg(long, env = "LOOKALIKE_CLIENT_CERT", value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// Its private key, in PEM.
    #[arg(long, env = "LOOKALIKE_CLIENT_KEY", value_name = "FILE")]
    tls_key: Option<PathBuf>,
}

impl AccessArgs {
    /// The same for a connection.
    pub(crate) fn access(&self) -> Access {
        let Self { token, ca, tls_cert: cert, tls_key: key } = self.clone();
        Access { token, ca, cert, key }
    }
}

/// A server that answered once.
#[derive(Clone, Debug)]
pub(crate) struct Remote {
    url: String,
    client: Client,
}

impl Remote {
    /// Connects now, so that a missing server is noticed before anything else is done.
    pub(crate) async fn connect(args: &ServerArgs) -> Result<Self, Failure> {
        let url = args.server.clone();
        let usage = |bad: BadTarget| Failure::new(Exit::Usage, bad.to_string());
        let access = args.access.access();
        let endpoint = endpoint(&url, &access).map_err(usage)?;
        let channel = connect(endpoint, &access).map_err(usage)?.await.map_err(|error| {
            let cause = std::error::Error::source(&error).map(ToString::to_string);
            unreachable(&url, &cause.unwrap_or_else(|| error.to_string()))
        })?;
        let client = Client::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        Ok(Self { url, client })
    }

    /// Calls until the server answers.
    pub(crate) async fn call<T, F>(&self, call: impl Fn(Client) -> F) -> Result<T, Failure>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let mut patience = Patience::new(self);
        loop {
            match call(self.client.clone()).await {
                Ok(answer) => return Ok(answer.into_inner()),
                Err(status) => patience.after(status, say).await?,
            }
        }
    }

    /// Stores a mesh; its name.
    pub(crate) async fn upload(&self, bytes: Bytes) -> Result<String, Failure> {
        let blake3 = blake3::hash(&bytes).to_hex().to_string();
        let size = bytes.len() as u64;
        // What is small is sent as a whole.
        let upload_id = (size > CHUNK as u64).then(|| Uuid::new_v4().simple().to_string());
        let upload_id = upload_id.unwrap_or_default();
        let mut header = v1::UploadMeshHeader { size, blake3, upload_id, offset: 0 };
        let mut patience = Patience::new(self);
        loop {
            match send(&mut self.client.clone(), &mut header, &bytes).await {
                Ok(answer) => return Ok(answer.into_inner().mesh),
                Err(status) => {
                    patience.reached(header.offset);
                    patience.after(status, say).await?;
                }
            }
        }
    }

    /// One job.
    pub(crate) async fn job(&self, name: &str) -> Result<v1::Job, Failure> {
        let request = v1::GetJobRequest { name: job_name(name) };
        let answer = self.call(|mut client| {
            let request = request.clone();
            async move { client.get_job(request).await }
        });
        self.present(answer.await?.job)
    }

    /// Asks for cancellation.
    pub(crate) async fn cancel(&self, name: &str) -> Result<v1::Job, Failure> {
        let request = v1::CancelJobRequest { name: job_name(name) };
        let answer = self.call(|mut client| {
            let request = request.clone();
            async move { client.cancel_job(request).await }
        });
        self.present(answer.await?.job)
    }

    /// What the protocol promises is there.
    pub(crate) fn present<T>(&self, part: Option<T>) -> Result<T, Failure> {
        let text =
            || format!("{} answered with less than it should: run the same version", self.url);
        part.ok_or_else(|| Failure::new(Exit::Failed, text()))
    }

    /// Follows a log after `after_seq` to its end, across restarts of the server.
    pub(crate) async fn follow(
        &self,
        name: &str,
        mut after_seq: u64,
        mut on: impl FnMut(Heard<'_>),
    ) -> Result<(), Failure> {
        let name = job_name(name);
        let mut patience = Patience::new(self);
        loop {
            let request = v1::WatchJobRequest { name: name.clone(), after_seq };
            let status = match self.client.clone().watch_job(request).await {
                Err(status) => status,
                Ok(answer) => {
                    let mut events = answer.into_inner();
                    loop {
                        match events.message().await {
                            Err(status) => break status,
                            Ok(None) => return Ok(()),
                            Ok(Some(message)) => {
                                let event = self.present(message.event)?;
                                patience.reset();
                                after_seq = event.seq;
                                // Entries of a newer server that we do not know are skipped.
                                if let Some(event) = convert::event_from_wire(event) {
                                    on(Heard::Entry(&event));
                                }
                            }
                        }
                    }
                }
            };
            let waited = patience.after(status, |text| on(Heard::Silence(text))).await;
            waited.map_err(|failure| failure.then(&go_on(&name, after_seq)))?;
        }
    }

    /// The artifacts of a job.
    pub(crate) async fn artifacts(&self, name: &str) -> Result<Vec<v1::Artifact>, Failure> {
        let parent = job_name(name);
        let mut request = v1::ListArtifactsRequest { parent, ..Default::default() };
        let mut artifacts = Vec::new();
        loop {
            let asked = self.call(|mut client| {
                let request = request.clone();
                async move { client.list_artifacts(request).await }
            });
            let page = asked.await?;
            artifacts.extend(page.artifacts);
            if page.next_page_token.is_empty() {
                return Ok(artifacts);
            }
            request.page_token = page.next_page_token;
        }
    }

    /// Fetches an artifact into `folder`: under its name only when it is whole.
    pub(crate) async fn fetch(
        &self,
        artifact: &v1::Artifact,
        folder: &Path,
    ) -> Result<(), Failure> {
        let file = artifact.name.rsplit('/').next().unwrap_or_default();
        if !lookalike::jobs::blobs::is_safe_name(file) {
            let text = format!("the server named an artifact `{}`: refused", file.escape_default());
            return Err(Failure::new(Exit::Failed, text));
        }
        let (path, part) = (folder.join(file), folder.join(format!(".{file}.part")));
        let fault = |error: std::io::Error| unwritable(&part, &artifact.name, &error);
        let mut out = tokio::fs::File::create(&part).await.map_err(fault)?;
        self.copy(artifact, &mut out, fault).await?;
        tokio::fs::rename(&part, &path).await.map_err(fault)
    }

    /// The bytes of an artifact of a job that has succeeded.
    pub(crate) async fn file(&self, job: &str, name: &str) -> Result<Vec<u8>, Failure> {
        let suffix = format!("/{name}");
        let artifact = self.artifacts(job).await?.into_iter().find(|a| a.name.ends_with(&suffix));
        let mut bytes = Vec::new();
        let fault = |error: std::io::Error| Failure::new(Exit::Failed, error.to_string());
        self.copy(&self.present(artifact)?, &mut bytes, fault).await?;
        Ok(bytes)
    }

    /// Writes an artifact to `out`; fails where it is not what it should be.
    async fn copy(
        &self,
        artifact: &v1::Artifact,
        out: &mut (impl AsyncWrite + Unpin),
        fault: impl Fn(std::io::Error) -> Failure,
    ) -> Result<(), Failure> {
        let mut hasher = blake3::Hasher::new();
        let mut patience = Patience::new(self);
        while let Err(status) = self.read(artifact, out, &mut hasher).await.map_err(&fault)? {
            patience.reached(hasher.count());
            patience.after(status, say).await?;
        }
        out.flush().await.map_err(&fault)?;
        if hasher.finalize().to_hex().as_str() != artifact.blake3 {
            let name = &artifact.name;
            let text = format!("{name} arrived damaged: fetch it again with `lookalike fetch`");
            return Err(Failure::new(Exit::Failed, text));
        }
        Ok(())
    }

    /// Reads on from what `hasher` has seen. The inner result is the server's.
    async fn read(
        &self,
        artifact: &v1::Artifact,
        out: &mut (impl AsyncWrite + Unpin),
        hasher: &mut blake3::Hasher,
    ) -> std::io::Result<Result<(), Status>> {
        let (name, offset) = (artifact.name.clone(), hasher.count());
        let request = v1::ReadArtifactRequest { name, offset, limit: 0 };
        let mut chunks = match self.client.clone().read_artifact(request).await {
            Ok(answer) => answer.into_inner(),
            Err(status) => return Ok(Err(status)),
        };
        loop {
            match chunks.message().await {
                Ok(Some(chunk)) => {
                    hasher.update(&chunk.data);
                    out.write_all(&chunk.data).await?;
                }
                Ok(None) => return Ok(Ok(())),
                Err(status) => return Ok(Err(status)),
            }
        }
    }
}

/// What following a log hears.
#[derive(Debug)]
pub(crate) enum Heard<'a> {
    /// An entry of the log.
    Entry(&'a Event),
    /// The server is away for now, in words.
    Silence(&'a str),
}

/// How long a server may be away.
struct Patience<'a> {
    remote: &'a Remote,
    backoff: Backoff,
    silent_since: Option<Instant>,
    reached: u64,
}

impl<'a> Patience<'a> {
    fn new(remote: &'a Remote) -> Self {
        Self { remote, backoff: Backoff::default(), silent_since: None, reached: 0 }
    }

    fn reset(&mut self) {
        self.backoff.reset();
        self.silent_since = None;
    }

    /// So many bytes have arrived in all. Where they are more than before, the next silence is another one.
    fn reached(&mut self, n_bytes: u64) {
        if n_bytes > self.reached {
            self.reached = n_bytes;
            self.reset();
        }
    }

    /// Waits after a failed call, unless another one is pointless; tells `say` when a silence begins.
    async fn after(&mut self, status: Status, say: impl FnOnce(&str)) -> Result<(), Failure> {
        let is_new = self.silent_since.is_none();
        let since = *self.silent_since.get_or_insert_with(Instant::now);
        if !is_transient(&status) || since.elapsed() > PATIENCE {
            return Err(refused(&self.remote.url, &status));
        }
        if is_new {
            let (url, secs) = (&self.remote.url, PATIENCE.as_secs());
            say(&format!("the server at {url} is away: waiting for up to {secs} s"));
        }
        self.backoff.pause().await;
        Ok(())
    }
}

/// `jobs/{id}`, also from the bare id.
pub(crate) fn job_name(text: &str) -> String {
    if text.starts_with("jobs/") { text.into() } else { format!("jobs/{text}") }
}

/// An artifact cannot be written to a file; it stays where it is.
fn unwritable(file: &Path, artifact: &str, error: &std::io::Error) -> Failure {
    use std::io::ErrorKind::{QuotaExceeded, StorageFull};
    let job = artifact.split("/artifacts/").next().unwrap_or_default();
    let mend = match error.kind() {
        StorageFull | QuotaExceeded => "free some space",
        _ => "choose another --out",
    };
    let file = file.display();
    let text = format!(
        "{file}: {error}; {mend}: results stay at the server, `lookalike fetch {job} --out DIR`"
    );
    Failure::new(Exit::Failed, text)
}

/// Tells the person at the terminal.
fn say(text: &str) {
    eprintln!("{text}");
}

/// How to go on after the server was away for too long.
fn go_on(job: &str, after_seq: u64) -> String {
    format!("once it answers, go on with `lookalike watch {job} --after-seq {after_seq}`")
}

/// Sends of a mesh what the server does not hold; the header says how much it does.
async fn send(
    client: &mut Client,
    header: &mut v1::UploadMeshHeader,
    bytes: &Bytes,
) -> Result<Response<v1::UploadMeshResponse>, Status> {
    header.offset = held(client, header).await?;
    let rest = bytes.slice(header.offset as usize..);
    let parts = upload_parts(header.clone(), rest);
    client.upload_mesh(stream::iter(parts)).await.map_err(asked_again)
}

/// What the server holds of an upload that has a name.
async fn held(client: &mut Client, header: &v1::UploadMeshHeader) -> Result<u64, Status> {
    if header.upload_id.is_empty() {
        return Ok(0);
    }
    let (mesh, upload_id) = (convert::mesh_name(&header.blake3), header.upload_id.clone());
    let answer = client.query_upload(v1::QueryUploadRequest { mesh, upload_id }).await?;
    // Where all of it is there, the header is enough.
    Ok(answer.into_inner().held.min(header.size))
}

/// Another server, or somebody else's upload, holds less than was said: that passes.
fn asked_again(status: Status) -> Status {
    match reason_of(&status).as_deref() {
        Some(OFFSET) => Status::unavailable(status.message()),
        _ => status,
    }
}

fn upload_parts(
    header: v1::UploadMeshHeader,
    bytes: Bytes,
) -> impl Iterator<Item = v1::UploadMeshRequest> {
    use v1::upload_mesh_request::Part;
    let n_chunks = bytes.len().div_ceil(CHUNK);
    let chunks = (0..n_chunks)
        .map(move |i| Part::Chunk(bytes.slice(i * CHUNK..bytes.len().min((i + 1) * CHUNK))));
    let parts = std::iter::once(Part::Header(header)).chain(chunks);
    parts.map(|part| v1::UploadMeshRequest { part: Some(part) })
}

#[cfg(test)]
mod tests {
    use std::io::{Error, ErrorKind};

    use lookalike::service::client;

    use super::*;

    #[tokio::test]
    async fn a_silence_after_progress_is_another_one() {
        let connection = client::connection("http://127.0.0.1:1", &Access::default()).unwrap();
        let remote = Remote { url: "http://127.0.0.1:1".into(), client: Client::new(connection) };
        let mut patience = Patience::new(&remote);
        let mut n_said = 0;
        for n_bytes in [0, 0, 5, 5, 6] {
            patience.reached(n_bytes);
            let waited = patience.after(Status::unavailable("away"), |_| n_said += 1).await;
            assert!(waited.is_ok(), "{waited:?}");
        }
        assert_eq!(n_said, 3);
    }

    #[test]
    fn whoever_cannot_write_learns_what_to_do() {
        for (kind, mend) in [
            (ErrorKind::StorageFull, "free some space"),
            (ErrorKind::QuotaExceeded, "free some space"),
            (ErrorKind::PermissionDenied, "choose another --out"),
        ] {
            let failure =
                unwritable(Path::new("out/.a.part"), "jobs/7/artifacts/a", &Error::from(kind));
            let text = failure.error.to_string();
            assert!(text.contains(mend), "{text}");
            assert!(text.ends_with("`lookalike fetch jobs/7 --out DIR`"), "{text}");
        }
    }
}
