//! The object directory: meshes by content, record segments and artifacts by job and epoch.
//!
//! 1. A file under its final name is whole: it was written under a temporary name, synced, renamed,
//!    and its folder was synced.
//! 2. A file is in place before the database row that tells of it; what has no row is an orphan and
//!    may be swept.
//! 3. Names in paths come from the server or passed [`is_safe_name`].
//!
//! Everything here blocks: call it off the async threads. Knows nothing of what the bytes mean.

use std::{
    fs::{self, File},
    io::{self, Read, Write},
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
};

use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use super::error::{Error, Result};

/// Longest file name of an artifact.
const MAX_NAME: usize = 128;

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

/// The object directory.
#[derive(Debug)]
pub struct Blobs {
    root: PathBuf,
    n_staged: AtomicU64,
}

/// Bytes on disk under a temporary name, removed unless committed.
#[derive(Debug)]
pub struct Staged {
    path: PathBuf,
    /// BLAKE3, lower-case hexadecimal.
    pub hash: String,
    /// Bytes.
    pub size: u64,
    committed: bool,
}

impl Drop for Staged {
    fn drop(&mut self) {
        if !self.committed {
            // An orphan that cannot be removed now is swept at the next start.
            let _ = fs::remove_file(&self.path);
        }
    }
}

impl Blobs {
    /// Opens the directory, creating it and sweeping what was being written at the last end.
    pub fn open(root: &Path) -> Result<Self> {
        let staging = root.join("tmp");
        if staging.exists() {
            fs::remove_dir_all(&staging).map_err(Error::io(&staging))?;
        }
        for folder in ["tmp", "meshes", "jobs"] {
            create_dirs(&root.join(folder))?;
        }
        Ok(Self { root: root.into(), n_staged: AtomicU64::new(0) })
    }

    /// The file of a mesh.
    pub fn mesh(&self, hash: &str) -> PathBuf {
        self.root.join("meshes").join(hash.get(..2).unwrap_or("--")).join(hash)
    }

    /// The file of an artifact.
    pub fn artifact(&self, job: &str, epoch: u64, file: &str) -> PathBuf {
        self.epoch(job, epoch).join("artifacts").join(file)
    }

    /// The file of a record segment.
    pub fn segment(&self, job: &str, epoch: u64, segment: &str) -> PathBuf {
        self.epoch(job, epoch).join("segments").join(segment)
    }

    fn job(&self, job: &str) -> PathBuf {
        self.root.join("jobs").join(job)
    }

    fn epoch(&self, job: &str, epoch: u64) -> PathBuf {
        self.job(job).join(epoch.to_string())
    }

    /// Writes what arrives on `chunks` until it closes; at most `limit` bytes.
    pub fn stage(&self, mut chunks: mpsc::Receiver<Bytes>, limit: u64) -> Result<Staged> {
        let mut staging = Staging::create(self.temporary())?;
        while let Some(chunk) = chunks.blocking_recv() {
            staging.write(&chunk, limit)?;
        }
        staging.finish()
    }

    /// Writes `bytes`.
    pub fn stage_bytes(&self, bytes: &[u8]) -> Result<Staged> {
        let mut staging = Staging::create(self.temporary())?;
        staging.write(bytes, u64::MAX)?;
        staging.finish()
    }

    fn temporary(&self) -> PathBuf {
        let n = self.n_staged.fetch_add(1, Ordering::Relaxed);
        self.root.join("tmp").join(n.to_string())
    }

    /// Gives staged bytes their final name, replacing what had it.
    pub fn commit(&self, mut staged: Staged, path: &Path) -> Result<()> {
        let folder = path.parent().unwrap_or(&self.root);
        create_dirs(folder)?;
        fs::rename(&staged.path, path).map_err(Error::io(path))?;
        staged.committed = true;
        sync_dir(folder)
    }

    /// Removes the file of a mesh.
    pub fn remove_mesh(&self, hash: &str) -> Result<()> {
        let path = self.mesh(hash);
        match fs::remove_file(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                Err(Error::Io { path, source })
            }
            _ => Ok(()),
        }
    }

    /// Removes every file of a job.
    pub fn remove_job(&self, job: &str) -> Result<()> {
        remove_dir(&self.job(job))
    }

    /// Removes the artifacts of the attempts before `epoch`, which nobody can read.
    pub fn remove_artifacts_before(&self, job: &str, epoch: u64) -> Result<()> {
        (1..epoch).try_for_each(|old| remove_dir(&self.epoch(job, old).join("artifacts")))
    }

    /// The ids of all jobs that have files.
    pub fn jobs(&self) -> Result<Vec<String>> {
        let folder = self.root.join("jobs");
        let entries = fs::read_dir(&folder).map_err(Error::io(&folder))?;
        let names = entries.filter_map(io::Result::ok).map(|entry| entry.file_name());
        Ok(names.filter_map(|name| name.into_string().ok()).collect())
    }

    /// Reads a whole file.
    pub fn read(&self, path: &Path) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut file = File::open(path).map_err(Error::io(path))?;
        file.read_to_end(&mut bytes).map_err(Error::io(path))?;
        Ok(bytes)
    }
}

struct Staging {
    file: File,
    hasher: blake3::Hasher,
    staged: Staged,
}

impl Staging {
    fn create(path: PathBuf) -> Result<Self> {
        let file = File::create(&path).map_err(Error::io(&path))?;
        let staged = Staged { path, hash: String::new(), size: 0, committed: false };
        Ok(Self { file, hasher: blake3::Hasher::new(), staged })
    }

    fn write(&mut self, bytes: &[u8], limit: u64) -> Result<()> {
        self.staged.size += bytes.len() as u64;
        if self.staged.size > limit {
            return Err(Error::TooLarge { what: "the transfer".into(), limit });
        }
        self.hasher.update(bytes);
        self.file.write_all(bytes).map_err(Error::io(&self.staged.path))
    }

    fn finish(mut self) -> Result<Staged> {
        self.file.sync_all().map_err(Error::io(&self.staged.path))?;
        self.staged.hash = self.hasher.finalize().to_hex().to_string();
        Ok(self.staged)
    }
}

/// Creates a folder and its parents, each durably.
fn create_dirs(folder: &Path) -> Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    if let Some(parent) = folder.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_dirs(parent)?;
    }
    match fs::create_dir(folder) {
        // Another thread may create it at the same time.
        Err(source) if source.kind() != io::ErrorKind::AlreadyExists => {
            Err(Error::Io { path: folder.into(), source })
        }
        _ => folder.parent().map_or(Ok(()), sync_dir),
    }
}

fn sync_dir(folder: &Path) -> Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    File::open(folder).and_then(|dir| dir.sync_all()).map_err(Error::io(folder))
}

fn remove_dir(folder: &Path) -> Result<()> {
    match fs::remove_dir_all(folder) {
        Err(source) if source.kind() != io::ErrorKind::NotFound => {
            Err(Error::Io { path: folder.into(), source })
        }
        _ => Ok(()),
    }
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

    #[test]
    fn staged_bytes_vanish_unless_committed() {
        let dir = tempfile::tempdir().unwrap();
        let blobs = Blobs::open(dir.path()).unwrap();
        let staged = blobs.stage_bytes(b"abc").unwrap();
        assert_eq!((staged.size, staged.hash.as_str()), (3, &*blake3::hash(b"abc").to_hex()));
        let (hash, temporary) = (staged.hash.clone(), staged.path.clone());
        blobs.commit(staged, &blobs.mesh(&hash)).unwrap();
        assert_eq!(blobs.read(&blobs.mesh(&hash)).unwrap(), b"abc");
        assert!(!temporary.exists());
        let dropped = blobs.stage_bytes(b"def").unwrap();
        let temporary = dropped.path.clone();
        drop(dropped);
        assert!(!temporary.exists());
    }

    #[test]
    fn transfers_are_capped() {
        let dir = tempfile::tempdir().unwrap();
        let blobs = Blobs::open(dir.path()).unwrap();
        let (send, receive) = mpsc::channel(4);
        send.try_send(Bytes::from_static(b"0123456789")).unwrap();
        drop(send);
        assert!(matches!(blobs.stage(receive, 9), Err(Error::TooLarge { limit: 9, .. })));
        assert_eq!(fs::read_dir(dir.path().join("tmp")).unwrap().count(), 0);
    }
}
