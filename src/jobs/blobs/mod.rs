//! Objects: meshes by content, record segments, checkpoints and artifacts by job and epoch; in a directory or in a
//! bucket.
//!
//! 1. An object under its final name is whole and durable: its bytes were staged or sent first, and got
//!    the name as the last step.
//! 2. An object is in place before the database row that tells of it; what has no row is an orphan and
//!    may be swept.
//! 3. Names in keys come from the server or passed [`is_safe_name`].
//! 4. Bytes are moved in pieces: memory does not grow with an object's size.
//!
//! Knows nothing of what the bytes mean.

mod bucket;
mod local;
mod partial;
mod staging;

#[cfg(test)]
mod contract;

use std::{fmt::Debug, ops::Range, path::Path, sync::Arc, time::SystemTime};

use futures::{TryStreamExt, future::BoxFuture, stream::BoxStream};
use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use self::{bucket::Bucket, local::Local, partial::Partials, staging::Staging};
use super::error::Result;

pub use bucket::BucketName;
pub use partial::Upload;
pub use staging::Staged;

/// Longest file name of an artifact.
const MAX_NAME: usize = 128;

/// Where objects carry their name.
const ID: &str = "id";

/// Whether a name can be a file of its own in any folder: 1 to 128 characters of `[A-Za-z0-9._-]`,
/// the first of which is no dot.
pub fn is_safe_name(name: &str) -> bool {
    let allowed = |c: u8| c.is_ascii_alphanumeric() || b"._-".contains(&c);
    (1..=MAX_NAME).contains(&name.len()) && name.bytes().all(allowed) && !name.starts_with('.')
}

/// Whether a text is a BLAKE3 hash: 64 lower-case hexadecimal digits.
pub fn is_hash(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|c| matches!(c, b'0'..=b'9' | b'a'..=b'f'))
}

/// What keeps objects. Keys are names with slashes between them.
trait Objects: Debug + Send + Sync {
    /// Gives staged bytes their name, replacing what had it.
    fn commit(&self, staged: Staged, key: String) -> BoxFuture<'_, Result<()>>;
    /// [`Self::commit`] for a few bytes.
    fn put(&self, bytes: Vec<u8>, key: String) -> BoxFuture<'_, Result<()>>;
    /// The bytes of a range that begins within the object, or at its end.
    fn read(
        &self,
        key: String,
        range: Range<u64>,
    ) -> BoxFuture<'_, Result<BoxStream<'static, Result<Bytes>>>>;
    fn exists(&self, key: String) -> BoxFuture<'_, Result<bool>>;
    /// Removes an object; it may be absent.
    fn remove(&self, key: String) -> BoxFuture<'_, Result<()>>;
    /// Removes all objects below a key.
    fn remove_folder(&self, key: String) -> BoxFuture<'_, Result<()>>;
    /// The names of the folders right below a key.
    fn folders(&self, key: String) -> BoxFuture<'_, Result<Vec<String>>>;
    /// The names of the objects two levels below a key, and when they were written.
    fn files(&self, key: String) -> BoxFuture<'_, Result<Vec<(String, SystemTime)>>>;
}

/// One object, found by its row.
#[derive(Clone, Debug)]
pub struct Blob {
    objects: Arc<dyn Objects>,
    key: String,
    size: u64,
}

impl Blob {
    /// The bytes from `offset` on, at most `limit` of them.
    pub async fn read(&self, offset: u64, limit: u64) -> Result<BoxStream<'static, Result<Bytes>>> {
        let start = offset.min(self.size);
        let range = start..start.saturating_add(limit).min(self.size);
        self.objects.read(self.key.clone(), range).await
    }
}

/// All objects.
#[derive(Clone, Debug)]
pub struct Blobs {
    staging: Arc<Staging>,
    partials: Arc<Partials>,
    objects: Arc<dyn Objects>,
}

impl Blobs {
    /// Opens the objects of a directory, or of a bucket by way of the directory, sweeping what was
    /// being written at the last end.
    pub fn open(folder: &Path, bucket: Option<&BucketName>) -> Result<Self> {
        let staging = Arc::new(Staging::open(&folder.join("tmp"))?);
        let objects: Arc<dyn Objects> = match bucket {
            Some(name) => Arc::new(Bucket::open(name, environment())?),
            None => Arc::new(Local::open(folder, Arc::clone(&staging))?),
        };
        let partials = Arc::new(Partials::open(&folder.join("partial"))?);
        Ok(Self { staging, partials, objects })
    }

    /// The name that these objects carry; none when they are new.
    pub async fn id(&self) -> Result<Option<String>> {
        if !self.objects.exists(ID.into()).await? {
            return Ok(None);
        }
        let bytes = self.gather(ID.into()).await?;
        Ok(Some(String::from_utf8_lossy(&bytes).trim().to_owned()))
    }

    /// Names these objects.
    pub async fn set_id(&self, id: &str) -> Result<()> {
        self.objects.put(id.into(), ID.into()).await
    }

    /// Whether objects can be written, read and removed.
    pub async fn probe(bucket: &BucketName) -> Result<()> {
        let bucket = Bucket::open(bucket, environment())?;
        let key = format!("probe-{}", uuid::Uuid::new_v4().simple());
        bucket.put(key.clone().into(), key.clone()).await?;
        bucket.read(key.clone(), 0..u64::MAX).await?.try_collect::<Vec<_>>().await?;
        bucket.remove(key).await
    }

    /// Writes what arrives on `chunks` until it closes; at most `limit` bytes.
    pub async fn stage(&self, chunks: mpsc::Receiver<Bytes>, limit: u64) -> Result<Staged> {
        let staging = Arc::clone(&self.staging);
        tokio::task::spawn_blocking(move || staging.receive(chunks, limit)).await?
    }

    /// [`Self::stage`] of an upload that may break off and be gone on with.
    pub async fn go_on(
        &self,
        upload: Upload,
        chunks: mpsc::Receiver<Bytes>,
        limit: u64,
    ) -> Result<Staged> {
        let partials = Arc::clone(&self.partials);
        tokio::task::spawn_blocking(move || partials.receive(&upload, chunks, limit)).await?
    }

    /// How many of the first bytes of an upload of `owner` are held here.
    pub async fn held(&self, owner: &str, id: &str) -> Result<u64> {
        let (partials, owner, id) = (Arc::clone(&self.partials), owner.to_owned(), id.to_owned());
        Ok(tokio::task::spawn_blocking(move || partials.held(&owner, &id)).await?)
    }

    /// Removes the uploads that broke off long ago.
    pub async fn sweep_uploads(&self) -> Result<()> {
        let partials = Arc::clone(&self.partials);
        tokio::task::spawn_blocking(move || partials.sweep_old()).await?
    }

    /// Keeps a mesh under its hash.
    pub async fn commit_mesh(&self, staged: Staged) -> Result<()> {
        let key = mesh_key(&staged.hash);
        self.objects.commit(staged, key).await
    }

    /// Whether the bytes of a mesh are there.
    pub async fn has_mesh(&self, hash: &str) -> Result<bool> {
        self.objects.exists(mesh_key(hash)).await
    }

    /// A mesh.
    pub fn mesh(&self, hash: &str, size: u64) -> Blob {
        self.blob(mesh_key(hash), size)
    }

    /// Removes the bytes of a mesh.
    pub async fn remove_mesh(&self, hash: &str) -> Result<()> {
        self.objects.remove(mesh_key(hash)).await
    }

    /// The hashes of all meshes, and when they were written.
    pub async fn meshes(&self) -> Result<Vec<(String, SystemTime)>> {
        self.objects.files("meshes".into()).await
    }

    /// Keeps an artifact.
    pub async fn commit_artifact(
        &self,
        staged: Staged,
        job: &str,
        epoch: u64,
        file: &str,
    ) -> Result<()> {
        self.objects.commit(staged, artifact_key(job, epoch, file)).await
    }

    /// An artifact.
    pub fn artifact(&self, job: &str, epoch: u64, file: &str, size: u64) -> Blob {
        self.blob(artifact_key(job, epoch, file), size)
    }

    /// Keeps a record segment.
    pub async fn put_segment(
        &self,
        bytes: Vec<u8>,
        job: &str,
        epoch: u64,
        segment: &str,
    ) -> Result<()> {
        self.objects.put(bytes, segment_key(job, epoch, segment)).await
    }

    /// The bytes of a record segment.
    pub async fn segment(&self, job: &str, epoch: u64, segment: &str) -> Result<Vec<u8>> {
        self.gather(segment_key(job, epoch, segment)).await
    }

    /// Keeps a piece of a checkpoint.
    pub async fn commit_piece(&self, staged: Staged, job: &str, epoch: u64, n: u32) -> Result<()> {
        self.objects.commit(staged, piece_key(job, epoch, n)).await
    }

    /// A piece of a checkpoint.
    pub fn piece(&self, job: &str, epoch: u64, n: u32, size: u64) -> Blob {
        self.blob(piece_key(job, epoch, n), size)
    }

    /// Removes the checkpoint of a job whose last epoch is this one.
    pub async fn remove_pieces(&self, job: &str, epoch: u64) -> Result<()> {
        for epoch in 1..=epoch {
            self.objects.remove_folder(pieces_key(job, epoch)).await?;
        }
        Ok(())
    }

    /// All bytes of a small object.
    async fn gather(&self, key: String) -> Result<Vec<u8>> {
        let chunks = self.objects.read(key, 0..u64::MAX).await?;
        let chunks: Vec<Bytes> = chunks.try_collect().await?;
        Ok(chunks.concat())
    }

    /// Removes every object of a job.
    pub async fn remove_job(&self, job: &str) -> Result<()> {
        self.objects.remove_folder(format!("jobs/{job}")).await
    }

    /// Removes the artifacts of the attempts before `epoch`, which nobody can read.
    pub async fn remove_artifacts_before(&self, job: &str, epoch: u64) -> Result<()> {
        for old in 1..epoch {
            self.objects.remove_folder(format!("jobs/{job}/{old}/artifacts")).await?;
        }
        Ok(())
    }

    /// The ids of all jobs that have objects.
    pub async fn jobs(&self) -> Result<Vec<String>> {
        self.objects.folders("jobs".into()).await
    }

    fn blob(&self, key: String, size: u64) -> Blob {
        Blob { objects: Arc::clone(&self.objects), key, size }
    }
}

/// What is text in it.
fn environment() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os().filter_map(|(k, v)| Some((k.into_string().ok()?, v.into_string().ok()?)))
}

fn mesh_key(hash: &str) -> String {
    format!("meshes/{}/{hash}", hash.get(..2).unwrap_or("--"))
}

fn artifact_key(job: &str, epoch: u64, file: &str) -> String {
    format!("jobs/{job}/{epoch}/artifacts/{file}")
}

fn segment_key(job: &str, epoch: u64, segment: &str) -> String {
    format!("jobs/{job}/{epoch}/segments/{segment}")
}

fn pieces_key(job: &str, epoch: u64) -> String {
    format!("jobs/{job}/{epoch}/checkpoint")
}

fn piece_key(job: &str, epoch: u64, n: u32) -> String {
    format!("{}/{n:06}", pieces_key(job, epoch))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_leave_their_folder() {
        for good in ["lod-0.glb", "a", "A_1.b-c", &"x".repeat(128)] {
            assert!(is_safe_name(good), "{good}");
        }
        for bad in ["", ".", "..", ".hidden", "a/b", "a\\b", "é", "a b", "a\0", &"x".repeat(129)] {
            assert!(!is_safe_name(bad), "{bad:?}");
        }
    }
}
