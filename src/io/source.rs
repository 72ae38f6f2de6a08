//! The file that is being read, and the errors about it.

use super::{IoError, Limits, archive::Archive};

/// Bytes, their name and what they may ask for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source<'a> {
    pub(super) file: &'a str,
    pub(super) bytes: &'a [u8],
    pub(super) limits: &'a Limits,
    /// The archive that the file is in, where it may name others.
    pub(super) beside: Option<&'a Archive<'a>>,
}

/// A text without the byte-order mark of UTF-8 that some programs begin it with.
pub(super) fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)
}

impl Source<'_> {
    /// Bytes of the file and of what has been unpacked beside it.
    pub(super) fn n_bytes(&self) -> u64 {
        let own = self.bytes.len() as u64;
        self.beside.map_or(own, |archive| own.saturating_add(archive.n_unpacked()))
    }

    /// Refuses an empty file and one over the limit.
    pub(super) fn check_size(&self) -> Result<(), IoError> {
        let count = self.bytes.len() as u64;
        if count == 0 {
            return Err(IoError::Empty { file: self.file.to_owned() });
        }
        self.check_limit("the whole file", "bytes", count, self.limits.max_bytes)
    }

    /// `Err` when `count` is over `limit`.
    pub(super) fn check_limit(
        &self,
        place: &str,
        what: &'static str,
        count: u64,
        limit: u64,
    ) -> Result<(), IoError> {
        if count <= limit {
            return Ok(());
        }
        Err(IoError::TooLarge {
            file: self.file.to_owned(),
            place: place.to_owned(),
            what,
            count,
            limit,
        })
    }

    pub(super) fn malformed(
        &self,
        place: impl Into<String>,
        problem: impl Into<String>,
        remedy: &'static str,
    ) -> IoError {
        IoError::Malformed {
            file: self.file.to_owned(),
            place: place.into(),
            problem: problem.into(),
            remedy,
        }
    }

    pub(super) fn truncated(&self, place: impl Into<String>, need: u64, have: u64) -> IoError {
        IoError::Truncated { file: self.file.to_owned(), place: place.into(), need, have }
    }

    pub(super) fn unsupported(&self, feature: impl Into<String>, remedy: &'static str) -> IoError {
        IoError::Unsupported { file: self.file.to_owned(), feature: feature.into(), remedy }
    }

    pub(super) fn out_of_range(
        &self,
        place: impl Into<String>,
        what: &'static str,
        index: i64,
        len: u64,
    ) -> IoError {
        IoError::IndexOutOfRange {
            file: self.file.to_owned(),
            place: place.into(),
            what,
            index,
            len,
        }
    }

    pub(super) fn no_triangles(&self, reason: impl Into<String>) -> IoError {
        IoError::NoTriangles { file: self.file.to_owned(), reason: reason.into() }
    }
}
