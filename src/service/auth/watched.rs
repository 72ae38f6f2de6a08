//! A file that is read again when it has changed.
//!
//! A change is noticed within [`LOOK`] of the next use. A file that cannot be read or makes no sense
//! any more leaves what held before, and says so in the log: whoever is replacing it may not be done.

use std::{
    fmt,
    fs::{self, Metadata},
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant, SystemTime},
};

/// How often files are looked at, at most.
const LOOK: Duration = Duration::from_millis(500);

type Parse<T> = Box<dyn Fn(&[Vec<u8>]) -> Result<T, String> + Send + Sync>;

/// What some files say together.
pub(in crate::service) struct Watched<T> {
    paths: Vec<PathBuf>,
    parse: Parse<T>,
    state: Mutex<State<T>>,
}

struct State<T> {
    stamps: Vec<Option<Stamp>>,
    looked: Instant,
    value: Arc<T>,
}

/// What changes when a file does.
type Stamp = (SystemTime, u64, u64);

impl<T> fmt::Debug for Watched<T> {
    /// What the files say may be secret.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watched").field("paths", &self.paths).finish_non_exhaustive()
    }
}

impl<T> Watched<T> {
    /// Reads the files now; the fault names the file.
    pub(in crate::service) fn open(
        paths: Vec<PathBuf>,
        parse: impl Fn(&[Vec<u8>]) -> Result<T, String> + Send + Sync + 'static,
    ) -> Result<Self, String> {
        let stamps = stamps(&paths);
        let parse: Parse<T> = Box::new(parse);
        let value = Arc::new(read(&paths, &parse)?);
        let state = Mutex::new(State { stamps, looked: Instant::now(), value });
        Ok(Self { paths, parse, state })
    }

    /// What the files say, now or a moment ago.
    pub(in crate::service) fn get(&self) -> Arc<T> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if state.looked.elapsed() >= LOOK {
            state.looked = Instant::now();
            let stamps = stamps(&self.paths);
            if stamps != state.stamps {
                state.stamps = stamps;
                match read(&self.paths, &self.parse) {
                    Ok(value) => {
                        tracing::info!(files = ?self.paths, "read again");
                        state.value = Arc::new(value);
                    }
                    Err(fault) => tracing::error!(%fault, "what was read before still holds"),
                }
            }
        }
        Arc::clone(&state.value)
    }
}

fn read<T>(paths: &[PathBuf], parse: &Parse<T>) -> Result<T, String> {
    let name = |path: &PathBuf| path.display().to_string();
    let bytes = |path| fs::read(path).map_err(|error| format!("{}: {error}", name(path)));
    let contents = paths.iter().map(bytes).collect::<Result<Vec<_>, String>>()?;
    let names = || paths.iter().map(name).collect::<Vec<_>>().join(", ");
    parse(&contents).map_err(|fault| format!("{}: {fault}", names()))
}

fn stamps(paths: &[PathBuf]) -> Vec<Option<Stamp>> {
    use std::os::unix::fs::MetadataExt;
    let stamp = |m: Metadata| (m.modified().unwrap_or(SystemTime::UNIX_EPOCH), m.len(), m.ino());
    paths.iter().map(|path| fs::metadata(path).ok().map(stamp)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_seen_and_nonsense_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("number");
        let number = |files: &[Vec<u8>]| {
            String::from_utf8_lossy(&files[0]).parse::<u32>().map_err(|e| e.to_string())
        };
        assert!(Watched::open(vec![path.clone()], number).unwrap_err().contains("number"));
        fs::write(&path, "1").unwrap();
        let watched = Watched::open(vec![path.clone()], number).unwrap();
        for (text, value) in [("22", 22), ("nonsense", 22), ("333", 333)] {
            fs::write(&path, text).unwrap();
            std::thread::sleep(LOOK);
            assert_eq!(*watched.get(), value, "after {text}");
        }
        fs::remove_file(&path).unwrap();
        std::thread::sleep(LOOK);
        assert_eq!(*watched.get(), 333);
    }
}
