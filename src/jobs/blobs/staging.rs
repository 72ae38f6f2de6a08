//! Bytes that arrive are written to a local folder first: until they are whole nobody knows their
//! hash, and memory is bounded whatever their size.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use super::{local::create_dirs, partial::Claim};
use crate::jobs::error::{Error, Result};

/// So many bytes are written before the disk has to have them. A file that waits in memory for its end, however
/// large, would then keep every commit of the database waiting that shares the disk.
const UNSYNCED: u64 = 1 << 20;
/// So many bytes of a large file are given up at a time. Freed at once, they would keep commits waiting as well
/// (measured: 512 MiB for 20 to 30 ms).
const FREED: u64 = 8 << 20;
/// Between two of them.
const PAUSE: Duration = Duration::from_millis(2);
/// One after the other: many at once would fill the disk's own queue, in which commits wait too.
static FLUSH: Mutex<()> = Mutex::new(());

/// The folder.
#[derive(Debug)]
pub(super) struct Staging {
    folder: PathBuf,
    n_staged: AtomicU64,
}

/// Bytes on disk under a temporary name. Without a claim they are removed unless they are committed; with one they stay,
/// for another stream to go on with, unless they are discarded.
#[derive(Debug)]
pub struct Staged {
    pub(super) path: PathBuf,
    /// BLAKE3, lower-case hexadecimal.
    pub hash: String,
    /// Bytes.
    pub size: u64,
    pub(super) stays: bool,
    pub(super) claim: Option<Claim>,
}

impl Staged {
    /// They are not what they should be, or they are kept elsewhere.
    pub fn discard(mut self) {
        self.stays = false;
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        // An orphan that cannot be removed now is swept at the next start.
        match self.size {
            _ if self.stays => {}
            0..=FREED => drop(fs::remove_file(&self.path)),
            size => {
                let (path, claim) = (self.path.clone(), self.claim.take());
                // Without a thread to spare it is an orphan.
                let _ = thread::Builder::new().spawn(move || {
                    give_up(&path, size);
                    drop(claim);
                });
            }
        }
    }
}

/// Removes a large file, piece by piece.
fn give_up(path: &Path, size: u64) {
    if let Ok(file) = File::options().write(true).open(path) {
        let mut left = size;
        while left > FREED && file.set_len(left - FREED).is_ok() {
            left -= FREED;
            thread::sleep(PAUSE);
        }
    }
    let _ = fs::remove_file(path);
}

impl Staging {
    /// Opens the folder, sweeping what was being written at the last end.
    pub(super) fn open(folder: &Path) -> Result<Self> {
        if folder.exists() {
            fs::remove_dir_all(folder).map_err(Error::io(folder))?;
        }
        create_dirs(folder)?;
        Ok(Self { folder: folder.into(), n_staged: AtomicU64::new(0) })
    }

    /// Writes what arrives on `chunks` until it closes; at most `limit` bytes. Blocks.
    pub(super) fn receive(&self, mut chunks: mpsc::Receiver<Bytes>, limit: u64) -> Result<Staged> {
        let mut writer = self.writer()?;
        while let Some(chunk) = chunks.blocking_recv() {
            writer.write(&chunk, limit)?;
        }
        writer.finish()
    }

    /// Writes `bytes`. Blocks.
    pub(super) fn write(&self, bytes: &[u8]) -> Result<Staged> {
        let mut writer = self.writer()?;
        writer.write(bytes, u64::MAX)?;
        writer.finish()
    }

    fn writer(&self) -> Result<Writer> {
        let n = self.n_staged.fetch_add(1, Ordering::Relaxed);
        let path = self.folder.join(n.to_string());
        let file = File::create(&path).map_err(Error::io(&path))?;
        let staged = Staged { path, hash: String::new(), size: 0, stays: false, claim: None };
        Ok(Writer { file, hasher: blake3::Hasher::new(), n_unsynced: 0, staged })
    }
}

/// A file that is being written.
pub(super) struct Writer {
    file: File,
    hasher: blake3::Hasher,
    n_unsynced: u64,
    staged: Staged,
}

impl Writer {
    /// Goes on behind the first `size` bytes of a file, which stays whatever happens.
    pub(super) fn after(mut file: File, path: &Path, size: u64) -> Result<Self> {
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(&mut file).map_err(Error::io(path))?;
        let path = path.into();
        let staged = Staged { path, hash: String::new(), size, stays: true, claim: None };
        Ok(Self { file, hasher, n_unsynced: 0, staged })
    }

    /// Bytes so far.
    pub(super) fn size(&self) -> u64 {
        self.staged.size
    }

    /// Makes sure that they are on disk.
    pub(super) fn sync(&self) -> Result<()> {
        self.file.sync_all().map_err(Error::io(&self.staged.path))
    }

    /// At most `limit` bytes in all.
    pub(super) fn write(&mut self, bytes: &[u8], limit: u64) -> Result<()> {
        self.staged.size += bytes.len() as u64;
        if self.staged.size > limit {
            return Err(Error::TooLarge { what: "the transfer".into(), limit });
        }
        self.hasher.update(bytes);
        self.file.write_all(bytes).map_err(Error::io(&self.staged.path))?;
        self.n_unsynced += bytes.len() as u64;
        if self.n_unsynced >= UNSYNCED {
            self.n_unsynced = 0;
            let _turn = FLUSH.lock().unwrap_or_else(PoisonError::into_inner);
            self.file.sync_data().map_err(Error::io(&self.staged.path))?;
        }
        Ok(())
    }

    /// All bytes are there.
    pub(super) fn finish(mut self) -> Result<Staged> {
        self.sync()?;
        self.staged.hash = self.hasher.finalize().to_hex().to_string();
        Ok(self.staged)
    }

    /// [`Self::finish`] of a file that others might write.
    pub(super) fn finish_claimed(mut self, claim: Claim) -> Result<Staged> {
        self.staged.claim = Some(claim);
        self.finish()
    }
}
