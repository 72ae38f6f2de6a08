//! Uploads that broke off and can be gone on with.
//!
//! 1. What is held is named by its owner and by a name that the sender made up: nobody goes on with, or learns of, what is
//!    another's, and senders of the same bytes do not meet.
//! 2. Of several streams of one upload the last one to begin writes; those before it find out with their next chunk, or
//!    at their end. A connection that is dead and does not know it so keeps its sender out no longer. Once a stream has
//!    brought all bytes, nobody writes the file until it has its final name or is gone: what was hashed is what is kept.
//! 3. What is held may be damaged (the power went): the hash of the whole tells in the end, and then it is removed.
//! 4. An owner has at most [`MOST`] of them, each for [`STAY`].

use std::{
    collections::HashMap,
    fs::{self, File},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use tokio::sync::mpsc;
use tokio_util::bytes::Bytes;

use super::{
    local::{create_dirs, entries},
    staging::{Staged, Writer},
};
use crate::jobs::error::{Error, Result};

/// Broken uploads of one owner.
const MOST: usize = 16;
/// How long they stay.
const STAY: Duration = Duration::from_hours(24);

/// An upload: all of these bytes, from `offset` on.
#[derive(Clone, Debug)]
pub struct Upload {
    /// Whose.
    pub owner: String,
    /// A name that its sender made up (see [`super::is_safe_name`]).
    pub id: String,
    /// Bytes of the whole.
    pub size: u64,
    /// Bytes that were sent before.
    pub offset: u64,
}

/// The folder of what is held.
#[derive(Debug)]
pub(super) struct Partials {
    folder: PathBuf,
    writers: Arc<Writers>,
}

/// Who writes, by name.
type Writers = Mutex<HashMap<String, Arc<Seat>>>;

/// One stream of an upload.
#[derive(Debug, Default)]
struct Seat {
    phase: Mutex<Phase>,
    /// Held while the file is touched.
    writing: Mutex<()>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    Writes,
    /// Another stream writes instead.
    Over,
    /// All bytes are there.
    Whole,
}

impl Seat {
    /// Writes no more; what it did until now.
    fn leave(&self, next: Phase) -> Phase {
        let mut phase = lock(&self.phase);
        let before = *phase;
        if before == Phase::Writes {
            *phase = next;
        }
        before
    }
}

/// Nobody else writes a file while this is there.
#[derive(Debug)]
pub(super) struct Claim {
    writers: Arc<Writers>,
    name: String,
    seat: Arc<Seat>,
}

impl Drop for Claim {
    fn drop(&mut self) {
        let mut writers = lock(&self.writers);
        if writers.get(&self.name).is_some_and(|seat| Arc::ptr_eq(seat, &self.seat)) {
            writers.remove(&self.name);
        }
    }
}

impl Partials {
    /// Opens the folder, and removes what has stayed long enough.
    pub(super) fn open(folder: &Path) -> Result<Self> {
        create_dirs(folder)?;
        let partials = Self { folder: folder.into(), writers: Arc::default() };
        partials.sweep_old()?;
        Ok(partials)
    }

    /// Removes what has stayed long enough.
    pub(super) fn sweep_old(&self) -> Result<()> {
        self.sweep("", usize::MAX)
    }

    /// How many of the first bytes are held.
    pub(super) fn held(&self, owner: &str, id: &str) -> u64 {
        fs::metadata(self.folder.join(name_of(owner, id))).map_or(0, |found| found.len())
    }

    /// Writes what arrives on `chunks` until it closes. What breaks off is held. Blocks.
    pub(super) fn receive(
        &self,
        upload: &Upload,
        mut chunks: mpsc::Receiver<Bytes>,
        limit: u64,
    ) -> Result<Staged> {
        if self.held(&upload.owner, &upload.id) == 0 {
            self.sweep(prefix_of(&upload.owner).as_str(), MOST - 1)?;
        }
        let (claim, mut writer) = self.begin(upload)?;
        while let Some(chunk) = chunks.blocking_recv() {
            let _writing = lock(&claim.seat.writing);
            if *lock(&claim.seat.phase) == Phase::Over {
                return Err(taken_over());
            }
            writer.write(&chunk, limit.min(upload.size))?;
        }
        let n_came = writer.size();
        if n_came < upload.size {
            writer.sync()?;
            let fault = format!("{n_came} of {} bytes came", upload.size);
            return Err(Error::Corrupt { what: "the transfer".into(), fault });
        }
        // From here on nobody takes it over.
        if claim.seat.leave(Phase::Whole) == Phase::Over {
            return Err(taken_over());
        }
        writer.finish_claimed(claim)
    }

    /// From now on this is who writes, behind what is held.
    fn begin(&self, upload: &Upload) -> Result<(Claim, Writer)> {
        let name = name_of(&upload.owner, &upload.id);
        let path = self.folder.join(&name);
        let seat = Arc::<Seat>::default();
        // Whoever comes next waits until this one has begun, which waits until the one before has written its chunk.
        let _writing = lock(&seat.writing);
        let before = self.take_over(&name, &seat)?;
        let claim = Claim { writers: Arc::clone(&self.writers), name, seat: Arc::clone(&seat) };
        before.iter().for_each(|before| drop(lock(&before.writing)));
        let held = self.held(&upload.owner, &upload.id);
        if upload.offset > held {
            return Err(Error::Offset { offset: upload.offset, held });
        }
        let mut options = File::options();
        let options = options.create(true).truncate(false).read(true).write(true);
        let file = options.open(&path).map_err(Error::io(&path))?;
        file.set_len(upload.offset).map_err(Error::io(&path))?;
        Ok((claim, Writer::after(file, &path, upload.offset)?))
    }

    /// Puts a stream in the place of the one that writes, if any, which it returns.
    fn take_over(&self, name: &str, seat: &Arc<Seat>) -> Result<Option<Arc<Seat>>> {
        let mut writers = lock(&self.writers);
        if writers.get(name).is_some_and(|before| before.leave(Phase::Over) == Phase::Whole) {
            return Err(Error::UnderWay);
        }
        Ok(writers.insert(name.into(), Arc::clone(seat)))
    }

    /// Removes what begins with this and has stayed too long, and the oldest beyond so many. What is being written
    /// stays.
    fn sweep(&self, prefix: &str, most: usize) -> Result<()> {
        let written = |path: &Path| fs::metadata(path).and_then(|found| found.modified()).ok();
        let is_idle = |name: &String| !lock(&self.writers).contains_key(name);
        let mut found: Vec<(SystemTime, String, PathBuf)> = entries(&self.folder)?
            .into_iter()
            .filter(|(name, _)| name.starts_with(prefix) && is_idle(name))
            .filter_map(|(name, path)| Some((written(&path)?, name, path)))
            .collect();
        found.sort();
        let n_over = found.len().saturating_sub(most);
        let old = SystemTime::now() - STAY;
        for (k, (when, name, path)) in found.into_iter().enumerate() {
            if k < n_over || when < old {
                let swept = self.folder.join(format!("swept-{}", uuid::Uuid::new_v4().simple()));
                let writers = lock(&self.writers);
                let is_as_found = !writers.contains_key(&name) && written(&path) == Some(when);
                if is_as_found && fs::rename(&path, &swept).is_ok() {
                    // Large files take their time, in which others begin and end.
                    drop(writers);
                    fs::remove_file(&swept).map_err(Error::io(&swept))?;
                }
            }
        }
        Ok(())
    }
}

fn taken_over() -> Error {
    let fault = "another stream of the same upload goes on with it".into();
    Error::Corrupt { what: "the transfer".into(), fault }
}

/// Whoever panicked here had written whole chunks.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn prefix_of(owner: &str) -> String {
    let hash = blake3::hash(owner.as_bytes()).to_hex();
    format!("{}-", &hash[..32])
}

fn name_of(owner: &str, id: &str) -> String {
    prefix_of(owner) + id
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 1000;

    fn bytes() -> Vec<u8> {
        (0..SIZE).map(|k| (k * 7 % 251) as u8).collect()
    }

    fn upload(owner: &str, offset: usize) -> Upload {
        Upload { owner: owner.into(), id: "a".into(), size: SIZE as u64, offset: offset as u64 }
    }

    /// Sends a range of the bytes, then closes.
    fn send(partials: &Partials, upload: &Upload, end: usize) -> Result<Staged> {
        let (send, chunks) = mpsc::channel(64);
        let start = upload.offset as usize;
        for chunk in bytes()[start..end].chunks(50) {
            send.try_send(Bytes::copy_from_slice(chunk)).unwrap();
        }
        drop(send);
        partials.receive(upload, chunks, u64::MAX)
    }

    fn partials() -> (tempfile::TempDir, Partials) {
        let dir = tempfile::tempdir().unwrap();
        let partials = Partials::open(&dir.path().join("partial")).unwrap();
        (dir, partials)
    }

    #[test]
    fn what_breaks_off_is_gone_on_with() {
        let (dir, partials) = partials();
        let fault = send(&partials, &upload("ann", 0), 300).unwrap_err();
        assert!(fault.to_string().contains("300 of 1000"), "{fault}");
        // The server is killed; nobody else's is there.
        let partials = Partials::open(&dir.path().join("partial")).unwrap();
        assert_eq!((partials.held("ann", "a"), partials.held("bob", "a")), (300, 0));
        assert!(matches!(
            send(&partials, &upload("ann", 301), SIZE),
            Err(Error::Offset { offset: 301, held: 300 })
        ));
        // Sent again from a place before: what was behind it does not count.
        assert!(send(&partials, &upload("ann", 200), 250).is_err());
        assert_eq!(partials.held("ann", "a"), 250);
        let staged = send(&partials, &upload("ann", 250), SIZE).unwrap();
        let hash = blake3::hash(&bytes()).to_hex().to_string();
        assert_eq!((staged.size, &staged.hash), (SIZE as u64, &hash));
        assert_eq!(fs::read(&staged.path).unwrap(), bytes());
        // Where it cannot be stored now, the next stream needs its header alone.
        drop(staged);
        assert_eq!(partials.held("ann", "a"), SIZE as u64);
        let staged = send(&partials, &upload("ann", SIZE), SIZE).unwrap();
        assert_eq!(staged.hash, hash);
        staged.discard();
        assert_eq!(partials.held("ann", "a"), 0, "nobody wanted it");
    }

    /// Whoever wrote behind the end of another stream would replace what was hashed.
    #[test]
    fn what_is_whole_is_nobodys_to_write() {
        let (_dir, partials) = partials();
        let staged = send(&partials, &upload("ann", 0), SIZE).unwrap();
        for offset in [0, 500, SIZE] {
            let fault = send(&partials, &upload("ann", offset), SIZE).unwrap_err();
            assert!(matches!(fault, Error::UnderWay), "{fault}");
        }
        assert_eq!(fs::read(&staged.path).unwrap(), bytes());
        drop(staged);
        assert!(send(&partials, &upload("ann", 0), SIZE).is_ok());
    }

    /// Two streams bring all bytes; the first one ends last.
    #[test]
    fn a_stream_that_was_taken_over_keeps_nothing() {
        let (_dir, partials) = partials();
        let (send_first, chunks) = mpsc::channel(64);
        std::thread::scope(|scope| {
            let first = scope.spawn(|| partials.receive(&upload("ann", 0), chunks, u64::MAX));
            send_first.blocking_send(Bytes::from(bytes())).unwrap();
            while partials.held("ann", "a") < SIZE as u64 {
                std::thread::yield_now();
            }
            let other = send(&partials, &upload("ann", 0), 900).unwrap_err();
            assert!(other.to_string().contains("900 of 1000"), "{other}");
            drop(send_first);
            let fault = first.join().unwrap().unwrap_err();
            assert!(fault.to_string().contains("another stream"), "{fault}");
        });
        assert_eq!(partials.held("ann", "a"), 900);
    }

    #[test]
    fn the_last_stream_to_begin_is_the_one_that_writes() {
        let (_dir, partials) = partials();
        let (send_first, chunks) = mpsc::channel(64);
        std::thread::scope(|scope| {
            let first = scope.spawn(|| partials.receive(&upload("ann", 0), chunks, u64::MAX));
            send_first.blocking_send(Bytes::from(bytes()[..100].to_vec())).unwrap();
            while partials.held("ann", "a") < 100 {
                std::thread::yield_now();
            }
            let staged = send(&partials, &upload("ann", 100), SIZE).unwrap();
            // The dead connection was alive after all.
            send_first.blocking_send(Bytes::from(bytes()[100..200].to_vec())).unwrap();
            drop(send_first);
            assert!(first.join().unwrap().is_err());
            assert_eq!(fs::read(&staged.path).unwrap(), bytes());
        });
    }

    #[test]
    fn an_owner_holds_so_many_and_no_more() {
        let (_dir, partials) = partials();
        for k in 0..MOST + 3 {
            let one = Upload { id: k.to_string(), ..upload("ann", 0) };
            assert!(send(&partials, &one, 10).is_err());
        }
        assert!(send(&partials, &upload("bob", 0), 10).is_err());
        assert_eq!(entries(&partials.folder).unwrap().len(), MOST + 1);
    }

    #[test]
    fn more_than_was_announced_is_refused() {
        let (_dir, partials) = partials();
        let small = Upload { size: 90, ..upload("ann", 0) };
        assert!(matches!(send(&partials, &small, 100), Err(Error::TooLarge { limit: 90, .. })));
    }
}
