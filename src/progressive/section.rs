//! A part of the file: three streams of bytes of one kind each, compressed apart.
//!
//! Bytes of one kind compress better together: codes and masks in `shape`, ids in `ids`, the
//! digits of numbers in `digits`. Each stream is one Zstandard frame; the three follow each other,
//! and a CRC-32 covers them as they are in the file.

use std::io::Read;

use serde::{Deserialize, Serialize};

use super::{bytes::Cursor, error::ProgressiveError};

/// Fuzz builds store streams as they are and skip checksums: mutations must reach the decoder.
pub(super) const IS_FUZZING: bool = cfg!(fuzzing);

/// Level of compression: higher ones gain less than a percent here.
const ZSTD_LEVEL: i32 = 9;

/// Where a section is and how large its streams are, in the order shape, ids, digits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Section {
    /// First byte, counted from the end of the header.
    pub offset: u64,
    /// Bytes of each stream in the file.
    pub packed: [u32; 3],
    /// Bytes of each stream before compression.
    pub raw: [u32; 3],
    /// CRC-32 (IEEE) of the section as it is in the file.
    pub crc32: u32,
}

impl Section {
    /// Bytes in the file.
    pub fn n_packed(&self) -> u64 {
        self.packed.iter().map(|n| u64::from(*n)).sum()
    }

    /// Bytes before compression.
    pub fn n_raw(&self) -> u64 {
        self.raw.iter().map(|n| u64::from(*n)).sum()
    }
}

/// A section before compression.
#[derive(Clone, Debug, Default)]
pub(super) struct Streams {
    pub(super) shape: Vec<u8>,
    pub(super) ids: Vec<u8>,
    pub(super) digits: Vec<u8>,
}

impl Streams {
    pub(super) fn len(&self) -> usize {
        self.shape.len() + self.ids.len() + self.digits.len()
    }

    /// Appends the compressed streams to `body`.
    pub(super) fn pack(&self, body: &mut Vec<u8>) -> Result<Section, ProgressiveError> {
        let begin = body.len();
        let mut section = Section { offset: begin as u64, ..Section::default() };
        for (i, stream) in [&self.shape, &self.ids, &self.digits].into_iter().enumerate() {
            let packed = deflate(stream).map_err(|e| compression(&e))?;
            section.packed[i] = length(packed.len())?;
            section.raw[i] = length(stream.len())?;
            body.extend_from_slice(&packed);
        }
        section.crc32 = crc32fast::hash(&body[begin..]);
        Ok(section)
    }

    /// Checks and decompresses a section of `body`. Memory grows with what comes out, up to the
    /// stated size, which the caller has held against its limits.
    pub(super) fn unpack(
        section: &Section,
        body: &[u8],
        place: &str,
    ) -> Result<Self, ProgressiveError> {
        let end = section.offset.saturating_add(section.n_packed());
        let Some(bytes) = body.get(section.offset as usize..end as usize) else {
            let (need, have) = (end, body.len() as u64);
            return Err(ProgressiveError::Truncated { place: place.to_owned(), need, have });
        };
        if crc32fast::hash(bytes) != section.crc32 && !IS_FUZZING {
            return Err(ProgressiveError::Checksum { place: place.to_owned() });
        }
        let mut streams: [Vec<u8>; 3] = Default::default();
        let mut rest = bytes;
        for ((stream, packed), raw) in streams.iter_mut().zip(section.packed).zip(section.raw) {
            let (frame, after) = rest.split_at(packed as usize);
            rest = after;
            *stream = inflate(frame, raw).map_err(|e| compression(&e))?;
            if stream.len() != raw as usize && !IS_FUZZING {
                return Err(ProgressiveError::Damaged {
                    place: place.to_owned(),
                    problem: "a stream has another length than stated".to_owned(),
                });
            }
        }
        let [shape, ids, digits] = streams;
        Ok(Self { shape, ids, digits })
    }

    pub(super) fn cursors(&self) -> Cursors<'_> {
        self.cursors_after([0; 3])
    }

    fn cursors_after(&self, [shape, ids, digits]: [usize; 3]) -> Cursors<'_> {
        let rest = |stream, n| Cursor::new(<[u8]>::get(stream, n..).unwrap_or_default());
        Cursors {
            shape: rest(&self.shape, shape),
            ids: rest(&self.ids, ids),
            digits: rest(&self.digits, digits),
        }
    }
}

/// A section that is read record by record.
#[derive(Clone, Debug, Default)]
pub(super) struct Reading {
    streams: Streams,
    /// Bytes of each stream that have been read.
    n_taken: [usize; 3],
}

impl Reading {
    pub(super) fn new(streams: Streams) -> Self {
        Self { streams, n_taken: [0; 3] }
    }

    /// What has not been read yet.
    pub(super) fn rest(&self) -> Cursors<'_> {
        self.streams.cursors_after(self.n_taken)
    }

    /// Remembers that only the last `n_left` bytes of each stream are left.
    pub(super) fn leave(&mut self, n_left: [usize; 3]) {
        let lengths = [&self.streams.shape, &self.streams.ids, &self.streams.digits].map(Vec::len);
        for ((taken, length), left) in self.n_taken.iter_mut().zip(lengths).zip(n_left) {
            *taken = length - left;
        }
    }
}

/// Reads the three streams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cursors<'a> {
    pub(super) shape: Cursor<'a>,
    pub(super) ids: Cursor<'a>,
    pub(super) digits: Cursor<'a>,
}

impl Cursors<'_> {
    /// Bytes left in each stream.
    pub(super) fn n_left(&self) -> [usize; 3] {
        [self.shape, self.ids, self.digits].map(|cursor| cursor.n_left())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.n_left() == [0; 3]
    }
}

fn deflate(stream: &[u8]) -> std::io::Result<Vec<u8>> {
    if IS_FUZZING { Ok(stream.to_vec()) } else { zstd::bulk::compress(stream, ZSTD_LEVEL) }
}

/// At most one byte more than stated, so that the caller sees a frame that holds too much.
fn inflate(frame: &[u8], n_raw: u32) -> std::io::Result<Vec<u8>> {
    if IS_FUZZING {
        return Ok(frame.to_vec());
    }
    let mut stream = Vec::new();
    let decoder = zstd::stream::read::Decoder::with_buffer(frame)?;
    decoder.take(u64::from(n_raw) + 1).read_to_end(&mut stream)?;
    Ok(stream)
}

fn length(n: usize) -> Result<u32, ProgressiveError> {
    u32::try_from(n).map_err(|_| ProgressiveError::Compression {
        problem: format!("a stream of {n} bytes is over 4 GiB"),
    })
}

fn compression(error: &std::io::Error) -> ProgressiveError {
    ProgressiveError::Compression { problem: error.to_string() }
}
