//! Objects in a directory: staged bytes are synced, renamed, and their folder is synced.

use std::{
    fs::{self, File},
    io::{self, SeekFrom},
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
    time::SystemTime,
};

use futures::{StreamExt, future::BoxFuture, stream, stream::BoxStream};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::bytes::{Bytes, BytesMut};

use super::{Objects, Staged, staging::Staging};
use crate::jobs::error::{Error, Result};

/// Bytes of a chunk read.
const CHUNK: usize = 256 << 10;

/// The directory.
#[derive(Debug)]
pub(super) struct Local {
    root: PathBuf,
    staging: Arc<Staging>,
}

impl Local {
    /// Opens the directory, creating it. Files are staged on the same file system.
    pub(super) fn open(root: &Path, staging: Arc<Staging>) -> Result<Self> {
        create_dirs(root)?;
        Ok(Self { root: root.into(), staging })
    }

    fn path(&self, key: &str) -> PathBuf {
        self.root.join(key)
    }
}

impl Objects for Local {
    fn commit(&self, staged: Staged, key: String) -> BoxFuture<'_, Result<()>> {
        let path = self.path(&key);
        Box::pin(blocking(move || rename(staged, &path)))
    }

    fn put(&self, bytes: Vec<u8>, key: String) -> BoxFuture<'_, Result<()>> {
        let (path, staging) = (self.path(&key), Arc::clone(&self.staging));
        Box::pin(blocking(move || rename(staging.write(&bytes)?, &path)))
    }

    fn read(
        &self,
        key: String,
        range: Range<u64>,
    ) -> BoxFuture<'_, Result<BoxStream<'static, Result<Bytes>>>> {
        let path = self.path(&key);
        Box::pin(async move {
            let mut file = tokio::fs::File::open(&path).await.map_err(Error::io(&path))?;
            file.seek(SeekFrom::Start(range.start)).await.map_err(Error::io(&path))?;
            let file = file.take(range.end.saturating_sub(range.start));
            let chunks = stream::try_unfold((file, path), |(mut file, path)| async move {
                let mut chunk = BytesMut::with_capacity(CHUNK);
                let n_read = file.read_buf(&mut chunk).await.map_err(Error::io(&path))?;
                Ok((n_read > 0).then(|| (chunk.freeze(), (file, path))))
            });
            Ok(chunks.boxed())
        })
    }

    fn exists(&self, key: String) -> BoxFuture<'_, Result<bool>> {
        let path = self.path(&key);
        Box::pin(blocking(move || path.try_exists().map_err(Error::io(path))))
    }

    fn remove(&self, key: String) -> BoxFuture<'_, Result<()>> {
        let path = self.path(&key);
        Box::pin(blocking(move || absent_is_fine(fs::remove_file(&path), &path)))
    }

    fn remove_folder(&self, key: String) -> BoxFuture<'_, Result<()>> {
        let path = self.path(&key);
        Box::pin(blocking(move || absent_is_fine(fs::remove_dir_all(&path), &path)))
    }

    fn folders(&self, key: String) -> BoxFuture<'_, Result<Vec<String>>> {
        let path = self.path(&key);
        Box::pin(blocking(move || Ok(entries(&path)?.into_iter().map(|(name, _)| name).collect())))
    }

    fn files(&self, key: String) -> BoxFuture<'_, Result<Vec<(String, SystemTime)>>> {
        let path = self.path(&key);
        Box::pin(blocking(move || {
            let mut files = Vec::new();
            for (_, folder) in entries(&path)? {
                for (name, file) in entries(&folder)? {
                    let written = file.metadata().and_then(|data| data.modified());
                    files.push((name, written.map_err(Error::io(file))?));
                }
            }
            Ok(files)
        }))
    }
}

/// Runs what blocks on a thread that may block.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    tokio::task::spawn_blocking(work).await?
}

/// Gives staged bytes their final name, replacing what had it.
fn rename(mut staged: Staged, path: &Path) -> Result<()> {
    let folder = path.parent().unwrap_or(path);
    create_dirs(folder)?;
    fs::rename(&staged.path, path).map_err(Error::io(path))?;
    staged.stays = true;
    sync_dir(folder)
}

/// Names and paths of what is in a folder; nothing where it is absent.
pub(super) fn entries(folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    let entries = match fs::read_dir(folder) {
        Err(source) if source.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(Error::io(folder))?,
    };
    let entries = entries.filter_map(io::Result::ok);
    Ok(entries.filter_map(|e| Some((e.file_name().into_string().ok()?, e.path()))).collect())
}

/// Creates a folder and its parents, each durably.
pub(super) fn create_dirs(folder: &Path) -> Result<()> {
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

fn absent_is_fine(done: io::Result<()>, path: &Path) -> Result<()> {
    match done {
        Err(source) if source.kind() != io::ErrorKind::NotFound => {
            Err(Error::Io { path: path.into(), source })
        }
        _ => Ok(()),
    }
}
