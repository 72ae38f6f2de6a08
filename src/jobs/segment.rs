//! Record segments: the bytes of many record chunks packed into one immutable file.
//!
//! A segment holds at most 1 MiB before packing, or one chunk that is larger by itself. It is a zstd
//! frame of the chunks one after another; each chunk's row in the log says which range is its own.
//!
//! Knows nothing of what records are.

use super::{
    error::{Error, Result},
    event::{Body, Report},
    store::SegmentRange,
};

/// Most bytes of a segment before packing, unless a single chunk is larger.
pub const MAX_SEGMENT: usize = 1 << 20;
/// Fast: records are deltas already, and a worker waits for the answer.
const ZSTD_LEVEL: i32 = 3;

/// A segment to be written.
#[derive(Debug, PartialEq, Eq)]
pub struct Segment {
    /// Its file name: the same bytes at the same place of the log always get the same name.
    pub name: String,
    /// The packed bytes.
    pub packed: Vec<u8>,
}

/// Log entries without record bytes, and where those are.
pub type Entries = Vec<(Body, Option<SegmentRange>)>;

/// Splits a batch into log entries and the segments they refer to. `first` is the batch's first
/// event number.
pub fn pack(first: u64, reports: Vec<Report>) -> Result<(Vec<Segment>, Entries)> {
    let mut packer = Packer { first, raw: Vec::new(), segments: Vec::new(), waiting: Vec::new() };
    let mut entries = Vec::with_capacity(reports.len());
    for mut report in reports {
        if let Report::Records { bytes, .. } = &mut report {
            let bytes = std::mem::take(bytes);
            packer.add(entries.len(), &bytes, &mut entries)?;
        }
        entries.push((Body::Worker(report), None));
    }
    packer.flush(&mut entries)?;
    Ok((packer.segments, entries))
}

struct Packer {
    first: u64,
    raw: Vec<u8>,
    segments: Vec<Segment>,
    /// Entry, offset and length of each chunk in `raw`.
    waiting: Vec<(usize, u64, u64)>,
}

impl Packer {
    fn add(&mut self, entry: usize, bytes: &[u8], entries: &mut Entries) -> Result<()> {
        if self.raw.len() + bytes.len() > MAX_SEGMENT {
            self.flush(entries)?;
        }
        self.waiting.push((entry, self.raw.len() as u64, bytes.len() as u64));
        self.raw.extend_from_slice(bytes);
        Ok(())
    }

    fn flush(&mut self, entries: &mut Entries) -> Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let hash = blake3::hash(&self.raw).to_hex();
        let name = format!("{:08}-{:02}-{}.zst", self.first, self.segments.len(), &hash[..16]);
        let packed = zstd::bulk::compress(&self.raw, ZSTD_LEVEL).map_err(Error::io(&name))?;
        for (entry, offset, len) in self.waiting.drain(..) {
            if let Some((_, range)) = entries.get_mut(entry) {
                *range = Some(SegmentRange { segment: name.clone(), offset, len });
            }
        }
        self.segments.push(Segment { name, packed });
        self.raw.clear();
        Ok(())
    }
}

/// Unpacks a segment that [`pack`] made.
pub fn unpack(packed: &[u8]) -> std::io::Result<Vec<u8>> {
    zstd::decode_all(packed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn records(first: u64, bytes: Vec<u8>) -> Report {
        Report::Records { level: None, first, count: 1, bytes }
    }

    #[test]
    fn every_chunk_finds_its_bytes_again() {
        // Three small chunks share a segment with a note between them; the large one is alone.
        let chunks = [vec![1; 10], vec![], vec![2; 5], vec![3; MAX_SEGMENT + 1], vec![4; 7]];
        let mut reports: Vec<_> =
            chunks.iter().enumerate().map(|(i, c)| records(i as u64, c.clone())).collect();
        reports.insert(1, Report::Note { code: "A".into(), text: "b".into() });
        let (segments, entries) = pack(40, reports).unwrap();
        assert_eq!(segments.len(), 3);
        assert!(entries[1].1.is_none());
        let ranges: Vec<_> = entries.iter().filter_map(|(_, range)| range.as_ref()).collect();
        for (chunk, range) in chunks.iter().zip(&ranges) {
            let segment = segments.iter().find(|s| s.name == range.segment).unwrap();
            let raw = unpack(&segment.packed).unwrap();
            let bytes = &raw[range.offset as usize..][..range.len as usize];
            assert_eq!(bytes, chunk.as_slice());
        }
        assert_eq!(ranges.len(), chunks.len());
    }
}
