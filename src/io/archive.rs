//! ZIP archives: one model and the files that it names (materials, images, buffers).
//!
//! Nothing is written to disk, so names need no cleaning: directories and case are passed over
//! when one is looked for. Only the model and what it names are unpacked, each at most once. How
//! much may be unpacked follows from the size of the archive (see [`allowance`]), whatever its
//! entries state and however they overlap.

use std::{
    cmp::Reverse,
    collections::HashMap,
    io::Read,
    sync::{Arc, Mutex, PoisonError},
};

use flate2::bufread::DeflateDecoder;
use rawzip::{CompressionMethod, ZipArchive, ZipArchiveEntryWayfinder, ZipSliceArchive};

use super::{IoError, Limits, format, soup::Soup, source::Source};

const REMEDY: &str = "make the archive again";
/// What may be unpacked for each byte of an archive. Deflate reaches 1032, models hardly 20.
const MAX_RATIO: u64 = 256;
/// May always be unpacked, so that small files may be of any kind.
const FREE_BYTES: u64 = 1 << 20;
/// Of files that differ in their directories alone, this many are told apart.
const MAX_NAMESAKES: usize = 16;

/// Reads the one model of the archive.
pub(super) fn read(source: &Source<'_>) -> Result<Soup, IoError> {
    if source.beside.is_some() {
        return Err(source.unsupported("an archive in an archive", "pack the model itself"));
    }
    let archive = Archive::open(source)?;
    let model = archive.model()?;
    let file = format!("{}/{}", source.file, archive.shown(model));
    let bytes = archive.unpack(model)?;
    let inner =
        Source { file: &file, bytes: &bytes, limits: source.limits, beside: Some(&archive) };
    inner.check_size()?;
    let format = format::detect(&inner)?;
    let mut soup = (format.read)(&inner)?;
    let text = format!("'{}' in the archive is read as {}", archive.shown(model), format.name);
    soup.notes.add("read_from_archive", text);
    Ok(soup)
}

/// The directory of an archive, and what has been unpacked of it.
#[derive(Debug)]
pub(super) struct Archive<'a> {
    source: Source<'a>,
    zip: ZipSliceArchive<&'a [u8]>,
    entries: Vec<Entry>,
    /// Entries by their name without directories.
    by_name: HashMap<String, Vec<usize>>,
    unpacked: Mutex<Unpacked>,
}

#[derive(Debug)]
struct Entry {
    /// As [`normal`] has it.
    path: String,
    method: CompressionMethod,
    is_encrypted: bool,
    n_bytes: u64,
    wayfinder: ZipArchiveEntryWayfinder,
}

#[derive(Debug)]
struct Unpacked {
    n_bytes: u64,
    files: HashMap<usize, Arc<[u8]>>,
}

impl<'a> Archive<'a> {
    /// What it is held against.
    pub(super) fn limits(&self) -> &'a Limits {
        self.source.limits
    }

    /// Reads the directory.
    fn open(source: &Source<'a>) -> Result<Self, IoError> {
        let fault = |e: rawzip::Error| source.malformed("archive", e.to_string(), REMEDY);
        let zip = ZipArchive::from_slice(source.bytes).map_err(fault)?;
        let (mut entries, mut by_name) = (Vec::new(), HashMap::<String, Vec<usize>>::new());
        let mut records = zip.entries();
        let mut n_records = 0;
        while let Some(record) = records.next_entry().map_err(fault)? {
            n_records += 1;
            let limit = source.limits.max_archive_entries;
            source.check_limit("archive", "files", n_records, limit)?;
            let path = normal(&String::from_utf8_lossy(record.file_path().as_bytes()));
            if record.is_dir() || is_of_macos(&path) {
                continue;
            }
            let namesakes = by_name.entry(base(&path).to_owned()).or_default();
            if namesakes.len() < MAX_NAMESAKES {
                namesakes.push(entries.len());
            }
            entries.push(Entry {
                path,
                method: record.compression_method(),
                is_encrypted: record.flags().is_encrypted(),
                n_bytes: record.uncompressed_size_hint(),
                wayfinder: record.wayfinder(),
            });
        }
        let unpacked = Mutex::new(Unpacked { n_bytes: 0, files: HashMap::new() });
        Ok(Self { source: *source, zip, entries, by_name, unpacked })
    }

    /// The one entry that is a model by its extension.
    fn model(&self) -> Result<usize, IoError> {
        let is_model = |i: &usize| format::is_model(&self.entries[*i].path);
        let models: Vec<usize> = (0..self.entries.len()).filter(is_model).collect();
        if let [model] = models[..] {
            return Ok(model);
        }
        let shown: Vec<String> = models.iter().take(3).map(|i| self.shown(*i)).collect();
        let problem = match models.len() {
            0 => "it holds no .glb, .gltf, .ply, .obj or .stl file".to_owned(),
            n => format!("it holds {n} models, {} among them", shown.join(", ")),
        };
        Err(self.source.malformed("archive", problem, "pack one model with the files it names"))
    }

    /// What messages call an entry.
    pub(super) fn shown(&self, entry: usize) -> String {
        let path = self.entries.get(entry).map_or("", |e| &e.path);
        path.chars().filter(|c| !c.is_control()).take(80).collect()
    }

    /// The entry of that name. Case and directories do not matter, unless only they tell entries
    /// apart: then the one whose last directories agree, or else the first.
    pub(super) fn find(&self, name: &str) -> Option<usize> {
        let wanted = normal(name);
        let agree = |entry: &usize| {
            let pairs = self.entries[*entry].path.rsplit('/').zip(wanted.rsplit('/'));
            pairs.take_while(|(a, b)| a == b).count()
        };
        let namesakes = self.by_name.get(base(&wanted))?.iter().copied();
        namesakes.max_by_key(|entry| (agree(entry), Reverse(*entry)))
    }

    /// The entry that a relative URI names.
    pub(super) fn find_uri(&self, uri: &str) -> Option<usize> {
        self.find(uri).or_else(|| self.find(&percent_decoded(uri)))
    }

    /// The bytes of an entry, held against what may still be unpacked before and while they are.
    pub(super) fn unpack(&self, entry: usize) -> Result<Arc<[u8]>, IoError> {
        let mut unpacked = self.unpacked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(bytes) = unpacked.files.get(&entry) {
            return Ok(bytes.clone());
        }
        let place = format!("'{}' in the archive", self.shown(entry));
        let Some(found) = self.entries.get(entry) else {
            let n = self.entries.len() as u64;
            return Err(self.source.out_of_range(place, "files", entry as i64, n));
        };
        let n_bytes = unpacked.n_bytes.saturating_add(found.n_bytes);
        self.source.check_limit(&place, "unpacked bytes", n_bytes, allowance(&self.source))?;
        // Counted before, so that a bad entry cannot be tried without end.
        unpacked.n_bytes = n_bytes;
        let bytes: Arc<[u8]> = self.inflate(found, &place)?.into();
        unpacked.files.insert(entry, bytes.clone());
        Ok(bytes)
    }

    /// Bytes of all that has been unpacked.
    pub(super) fn n_unpacked(&self) -> u64 {
        self.unpacked.lock().unwrap_or_else(PoisonError::into_inner).n_bytes
    }

    fn inflate(&self, entry: &Entry, place: &str) -> Result<Vec<u8>, IoError> {
        let method = entry.method;
        let is_stored = method == CompressionMethod::STORE;
        if entry.is_encrypted || !is_stored && method != CompressionMethod::DEFLATE {
            let remedy = "make the archive with deflate and without a password";
            let how = format!("{place}: encryption or compression method {}", method.as_u16());
            return Err(self.source.unsupported(how, remedy));
        }
        let fault = |e: &dyn std::fmt::Display| {
            self.source.malformed(place, format!("it cannot be unpacked ({e})"), REMEDY)
        };
        let local = self.zip.get_entry(entry.wayfinder).map_err(|e| fault(&e))?;
        let data = local.data();
        let mut bytes = Vec::with_capacity(entry.n_bytes as usize);
        // One byte more than stated shows that the statement is wrong.
        let most = entry.n_bytes.saturating_add(1);
        if is_stored {
            local.verifying_reader(data.take(most)).read_to_end(&mut bytes)
        } else {
            let inflated = DeflateDecoder::new(data).take(most);
            local.verifying_reader(inflated).read_to_end(&mut bytes)
        }
        .map_err(|e| fault(&e))?;
        Ok(bytes)
    }
}

/// How many bytes may be unpacked in all.
fn allowance(source: &Source<'_>) -> u64 {
    let by_size = (source.bytes.len() as u64).saturating_mul(MAX_RATIO).saturating_add(FREE_BYTES);
    by_size.min(source.limits.max_bytes)
}

fn normal(name: &str) -> String {
    name.replace('\\', "/").to_lowercase()
}

fn base(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

/// What that system adds for itself.
fn is_of_macos(path: &str) -> bool {
    path.starts_with("__macosx/") || base(path).starts_with("._")
}

fn percent_decoded(uri: &str) -> String {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let Some((first, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|hex| str::from_utf8(hex).ok());
        let code = code.and_then(|hex| u8::from_str_radix(hex, 16).ok());
        let (byte, n_read) = code.filter(|_| *first == b'%').map_or((*first, 0), |code| (code, 2));
        bytes.push(byte);
        rest = &after[n_read..];
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
