//! What clients ask for: meshes in, jobs, artifacts out.

use std::time::Duration;

use tokio::{
    sync::mpsc,
    time::{sleep, timeout},
};
use tokio_util::bytes::Bytes;

use super::{
    Jobs,
    blobs::{Blob, Staged, Upload, is_hash, is_safe_name},
    error::{Error, Result},
    labels,
    points::{Point, pass},
    spec::Fault,
    store::{Artifact, Filter, Job, NewJob},
};

/// The object store is asked so often, and so long each time, whether the bytes of a mesh are still there.
const LOOKS: u32 = 5;
const LOOK: Duration = Duration::from_secs(2);

/// A mesh that is on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredMesh {
    /// BLAKE3, lower-case hexadecimal.
    pub hash: String,
    /// Bytes.
    pub size: u64,
    /// It was there before.
    pub existed: bool,
}

/// What the sender says it will send.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Announced {
    /// Bytes; 0 when unknown.
    pub size: u64,
    /// BLAKE3; empty when unknown.
    pub hash: String,
    /// The name of an upload that may be gone on with; empty for none.
    pub upload: String,
    /// Bytes that were sent before it broke off.
    pub offset: u64,
}

impl Announced {
    /// The upload by `owner` that may be gone on with, if it is one.
    fn upload_of(&self, owner: &str) -> Result<Option<Upload>> {
        let Self { size, hash, upload, offset } = self;
        let (size, offset) = (*size, *offset);
        if upload.is_empty() {
            // What has no name cannot be gone on with.
            return if offset == 0 { Ok(None) } else { Err(Error::Offset { offset, held: 0 }) };
        }
        if !is_safe_name(upload) || upload.len() > 64 {
            let text = "use 1 to 64 characters of [A-Za-z0-9._-], the first of which is no dot";
            return Err(Error::invalid("header.upload_id", text));
        }
        if size == 0 || !is_hash(hash) {
            let text = "an upload that may be gone on with needs its size and hash";
            return Err(Error::invalid("header", text));
        }
        Ok(Some(Upload { owner: owner.into(), id: upload.clone(), size, offset }))
    }

    /// Whether what came is what was announced.
    pub(super) fn check(&self, what: &str, size: u64, hash: &str) -> Result<()> {
        let fault = if self.size != 0 && self.size != size {
            format!("{size} bytes came, {} were announced", self.size)
        } else if !self.hash.is_empty() && self.hash != hash {
            format!("its hash is {hash}, {} was announced", self.hash)
        } else {
            return Ok(());
        };
        Err(Error::Corrupt { what: what.into(), fault })
    }
}

/// Priorities of jobs; 0 where nothing is said.
pub const PRIORITIES: std::ops::RangeInclusive<i32> = -10..=10;

impl Jobs {
    /// A mesh that is stored already, and that `owner` has uploaded.
    pub async fn find_mesh(&self, owner: &str, hash: &str) -> Result<Option<StoredMesh>> {
        if !is_hash(hash) {
            return Ok(None);
        }
        let size = self.0.store.owned_mesh_size(owner, hash).await?;
        Ok(size.map(|size| StoredMesh { hash: hash.into(), size, existed: true }))
    }

    /// [`Self::find_mesh`] for a client that means to use it: it counts as uploaded now.
    pub async fn reuse_mesh(&self, owner: &str, hash: &str) -> Result<Option<StoredMesh>> {
        let known = self.find_mesh(owner, hash).await?;
        if known.is_some() {
            self.0.store.touch_mesh(hash).await?;
        }
        Ok(known)
    }

    /// Stores the bytes that arrive on `chunks` until it closes, for `owner`.
    pub async fn put_mesh(
        &self,
        owner: &str,
        announced: Announced,
        chunks: mpsc::Receiver<Bytes>,
    ) -> Result<StoredMesh> {
        let limit = self.0.limits.max_mesh_bytes;
        let Some(upload) = announced.upload_of(owner)? else {
            let staged = self.0.blobs.stage(chunks, limit).await?;
            return self.keep_mesh(owner, &announced, staged).await;
        };
        let (jobs, owner) = (self.clone(), owner.to_owned());
        // What is whole is kept, even when its sender has left by then. What has no name is not: its end looks like a
        // stream that broke off.
        let kept = self.0.receiving.spawn(async move {
            let staged = jobs.0.blobs.go_on(upload, chunks, limit).await?;
            let _kept = jobs.0.keeping.token();
            jobs.keep_mesh(&owner, &announced, staged).await
        });
        kept.await?
    }

    /// Gives a mesh that is there as a whole its name, its row and its owner.
    async fn keep_mesh(
        &self,
        owner: &str,
        announced: &Announced,
        staged: Staged,
    ) -> Result<StoredMesh> {
        let (hash, size) = (staged.hash.clone(), staged.size);
        let limit = self.0.limits.max_owner_bytes;
        let allowed = match announced.check("the mesh", size, &hash) {
            Ok(()) => self.0.store.check_room(owner, &hash, size, limit).await,
            damaged => damaged,
        };
        if let Err(refusal) = allowed {
            // What has a name waits for a database that is away.
            if !refusal.is_passing() {
                staged.discard();
            }
            return Err(refusal);
        }
        pass(Point::UploadStaged);
        self.0.blobs.commit_mesh(staged).await?;
        pass(Point::UploadNamed);
        self.list_mesh(&hash, size).await?;
        pass(Point::UploadListed);
        // That somebody else has the same bytes is nobody's business.
        let existed = !self.0.store.own_mesh(owner, &hash, size, limit).await?;
        pass(Point::UploadOwned);
        Ok(StoredMesh { hash, size, existed })
    }

    /// Notes a mesh whose bytes have their name. Everybody's writes wait while a slow object store is asked, so it is not
    /// asked for long.
    async fn list_mesh(&self, hash: &str, size: u64) -> Result<()> {
        for _ in 0..LOOKS {
            let lock = self.0.store.lock_mesh(hash).await?;
            match timeout(LOOK, self.0.blobs.has_mesh(hash)).await {
                Ok(Ok(true)) => return lock.add(size).await.map(drop),
                // Another server may have swept it before a row told of it.
                Ok(Ok(false)) => {
                    let fault = "it was swept away on its way in".into();
                    return Err(Error::Corrupt { what: "the mesh".into(), fault });
                }
                Ok(Err(fault)) => return Err(fault),
                Err(_) => {}
            }
            drop(lock);
            sleep(LOOK).await;
        }
        Err(Error::UnderWay)
    }

    /// How many of the first bytes of an upload of `owner` are held by this server.
    pub async fn held_of_upload(&self, owner: &str, upload: &str) -> Result<u64> {
        if is_safe_name(upload) { self.0.blobs.held(owner, upload).await } else { Ok(0) }
    }

    /// Creates a job, unless the same request made it before. `faults` are those that the caller
    /// found already; all are reported together.
    pub async fn create(&self, new: NewJob, mut faults: Vec<Fault>) -> Result<Job> {
        let _turn = self.0.turns.of(&new.owner).await;
        faults.extend(self.faults_of(&new).await?);
        if !faults.is_empty() {
            return Err(Error::Invalid(faults));
        }
        let id = uuid::Uuid::now_v7().simple().to_string();
        let (job, is_new) = self.0.store.create(&id, &new, &self.0.limits).await?;
        pass(Point::CreateCommitted);
        if is_new {
            self.0.signals.queue_grew();
        }
        Ok(job)
    }

    async fn faults_of(&self, new: &NewJob) -> Result<Vec<Fault>> {
        let mut faults = Vec::new();
        let mut fault =
            |field: &str, text: String| faults.push(Fault { field: field.into(), text });
        let id = &new.request_id;
        if id.len() > 128 || !id.bytes().all(|c| c.is_ascii_graphic() || c == b' ') {
            fault("request_id", "use at most 128 printable ASCII characters".into());
        }
        if !PRIORITIES.contains(&new.priority) {
            let (low, high) = (PRIORITIES.start(), PRIORITIES.end());
            fault("priority", format!("{}: use {low} to {high}", new.priority));
        }
        labels::faults(&new.labels).into_iter().for_each(|text| fault("labels", text));
        for (prefix, mesh, file_name) in inputs(new) {
            if !is_hash(mesh) {
                let text = "use the name that UploadMesh returned, `meshes/{hash}`";
                fault(&format!("{prefix}mesh"), text.into());
            } else if self.find_mesh(&new.owner, mesh).await?.is_none() {
                let text = format!("meshes/{mesh} is not stored: upload it first");
                fault(&format!("{prefix}mesh"), text);
            }
            if !is_file_name(file_name) {
                let text = format!(
                    "`{}` is not a file name with an extension, such as `bunny.ply`",
                    file_name.escape_default()
                );
                fault(&format!("{prefix}file_name"), text);
            }
        }
        faults.extend(
            new.spec
                .validate()
                .into_iter()
                .map(|fault| Fault { field: format!("spec.{}", fault.field), text: fault.text }),
        );
        Ok(faults)
    }

    /// One job.
    pub async fn job(&self, id: &str) -> Result<Job> {
        self.0.store.job(id).await
    }

    /// Jobs that pass `filter`, newest first, older than the job numbered `before`.
    pub async fn list(&self, filter: &Filter, before: Option<i64>, limit: u32) -> Result<Vec<Job>> {
        self.0.store.list(filter, before, limit).await
    }

    /// Cancels a queued job, or asks the worker of a running one to stop; says whether this call
    /// ended the job.
    pub async fn cancel(&self, id: &str) -> Result<(Job, bool)> {
        let cancelled = self.0.store.cancel(id).await?;
        self.0.signals.log_grew(id);
        Ok(cancelled)
    }

    /// Queues a job anew that failed or was cancelled. One that waits or runs is left alone.
    pub async fn retry(&self, id: &str) -> Result<Job> {
        let (job, is_new) = self.0.store.retry(id, &self.0.limits).await?;
        if is_new {
            self.0.signals.log_grew(id);
            self.0.signals.queue_grew();
            self.0.blobs.remove_artifacts_before(id, job.epoch + 1).await?;
        }
        Ok(job)
    }

    /// Deletes an ended job with its log and artifacts.
    pub async fn delete(&self, id: &str) -> Result<()> {
        self.0.store.delete(id).await?;
        pass(Point::DeleteCommitted);
        self.0.signals.log_grew(id);
        self.0.blobs.remove_job(id).await
    }

    /// The artifacts of an ended job, by name; none before.
    pub async fn artifacts(&self, id: &str) -> Result<Vec<Artifact>> {
        Ok(self.0.store.artifacts(id).await?.1)
    }

    /// One artifact of an ended job, and its bytes.
    pub async fn artifact(&self, id: &str, file: &str) -> Result<(Artifact, Blob)> {
        let (job, artifacts) = self.0.store.artifacts(id).await?;
        let missing = || Error::NotFound(format!("jobs/{id}/artifacts/{file}"));
        let artifact = artifacts.into_iter().find(|a| a.file == file).ok_or_else(missing)?;
        let blob = self.0.blobs.artifact(id, job.epoch, &artifact.file, artifact.size);
        Ok((artifact, blob))
    }
}

/// The models that a job names: where in the request, hash, file name.
fn inputs(new: &NewJob) -> impl Iterator<Item = (&'static str, &str, &str)> {
    let simplified = new.spec.simplified.as_ref();
    let simplified = simplified.map(|i| ("spec.simplified.", &*i.mesh, &*i.file_name));
    std::iter::once(("", &*new.mesh, &*new.file_name)).chain(simplified)
}

/// One path component with an extension. It is shown and its extension read; it never names a file
/// of the server.
fn is_file_name(name: &str) -> bool {
    let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
    name.len() <= 255
        && !name.contains(['/', '\\'])
        && !name.chars().any(char::is_control)
        && is_safe_name(extension)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::jobs::{
        Limits,
        lease::Terms,
        principal::LOCAL,
        spec::{Input, Spec},
    };

    #[test]
    fn file_names_need_an_extension_and_no_folder() {
        for good in ["bunny.ply", "Ünïcode name.GLB", "a.b.obj", ".ply"] {
            assert!(is_file_name(good), "{good}");
        }
        for bad in ["", "bunny", "bunny.", "../x.ply", "a\\b.ply", "a\n.ply"] {
            assert!(!is_file_name(bad), "{bad:?}");
        }
    }

    #[tokio::test]
    async fn meshes_that_nobody_wants_go() {
        let dir = tempfile::tempdir().unwrap();
        let open = async |keep_meshes| {
            let limits = Limits { keep_meshes, ..Limits::default() };
            let jobs = Jobs::open(dir.path(), Terms::default(), limits).await.unwrap();
            jobs.sweep_orphans().await.unwrap();
            jobs
        };
        let put = async |jobs: &Jobs, bytes: &'static [u8]| {
            let (send, chunks) = mpsc::channel(1);
            send.try_send(Bytes::from_static(bytes)).unwrap();
            drop(send);
            jobs.put_mesh(LOCAL, Announced::default(), chunks).await.unwrap().hash
        };
        let jobs = open(Duration::from_hours(1)).await;
        let (used, unused) = (put(&jobs, b"used").await, put(&jobs, b"unused").await);
        let crude = put(&jobs, b"simplified").await;
        let input = Input { mesh: crude.clone(), file_name: "crude.ply".into() };
        let (file_name, spec) = ("a.ply".into(), Spec::optimizing(input));
        let (owner, request_id) = (LOCAL.into(), String::new());
        let new = NewJob {
            owner,
            request_id,
            mesh: used.clone(),
            file_name,
            spec,
            priority: 0,
            labels: labels::Labels::new(),
            webhook: String::new(),
            trace: String::new(),
        };
        jobs.create(new, vec![]).await.unwrap();
        jobs.close().await;
        drop(jobs);
        // Young as it is, it stays.
        let jobs = open(Duration::from_hours(1)).await;
        assert!(jobs.reuse_mesh(LOCAL, &unused).await.unwrap().is_some());
        assert!(jobs.0.blobs.has_mesh(&unused).await.unwrap());
        jobs.close().await;
        drop(jobs);
        // At an age of nothing only what a job names does.
        let jobs = open(Duration::ZERO).await;
        assert!(jobs.find_mesh(LOCAL, &unused).await.unwrap().is_none());
        assert!(!jobs.0.blobs.has_mesh(&unused).await.unwrap());
        for named in [used, crude] {
            assert!(jobs.find_mesh(LOCAL, &named).await.unwrap().is_some());
            assert!(jobs.0.blobs.has_mesh(&named).await.unwrap());
        }
    }
}
