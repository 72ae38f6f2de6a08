//! The GLB container and the buffers of a document.

use std::sync::Arc;

use base64::{
    Engine,
    alphabet::STANDARD,
    engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig},
};
use gltf::json;

use super::{
    IoError, REMEDY, Source,
    compressed::{Carrier, CompressedViews},
};

const JSON_CHUNK: u32 = 0x4E4F_534A;
/// What to do where another file is needed.
pub(super) const PACK_REMEDY: &str = "pack the model as GLB, or in a ZIP with its files";
const BIN_CHUNK: u32 = 0x004E_4942;

/// The JSON text and the binary chunk.
pub(super) fn split_glb<'a>(source: &Source<'a>) -> Result<(&'a [u8], Option<&'a [u8]>), IoError> {
    let bytes = source.bytes;
    let (Some(version), Some(length)) = (word(bytes, 4), word(bytes, 8)) else {
        return Err(source.truncated("GLB header", 12, bytes.len() as u64));
    };
    if version != 2 {
        let problem = format!("version {version} instead of 2");
        return Err(source.malformed("GLB header", problem, "convert the model to glTF 2.0"));
    }
    let Some(bytes) = bytes.get(..length as usize) else {
        return Err(source.truncated("GLB header", length.into(), bytes.len() as u64));
    };
    let (kind, json, rest) = chunk(source, bytes, 12)?;
    if kind != JSON_CHUNK {
        return Err(source.malformed("GLB, first chunk", "it is not JSON", REMEDY));
    }
    if rest >= bytes.len() {
        return Ok((json, None));
    }
    let (kind, bin, _) = chunk(source, bytes, rest)?;
    Ok((json, (kind == BIN_CHUNK).then_some(bin)))
}

/// Kind, content and end of the chunk at `at`.
fn chunk<'a>(
    source: &Source<'_>,
    bytes: &'a [u8],
    at: usize,
) -> Result<(u32, &'a [u8], usize), IoError> {
    let place = || format!("GLB chunk at byte {at}");
    let have = bytes.len().saturating_sub(at) as u64;
    let (Some(length), Some(kind)) = (word(bytes, at), word(bytes, at + 4)) else {
        return Err(source.truncated(place(), 8, have));
    };
    let begin = at + 8;
    let end = begin + length as usize;
    match bytes.get(begin..end) {
        Some(content) => Ok((kind, content, end)),
        None => Err(source.truncated(place(), 8 + u64::from(length), have)),
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at.checked_add(4)?)?.try_into().ok().map(u32::from_le_bytes)
}

/// The content of each buffer, or why it cannot be had (said only when something needs it, since
/// a buffer may hold images alone).
pub(super) struct Buffers<'a> {
    contents: Vec<Buffer<'a>>,
    compressed: CompressedViews,
}

enum Buffer<'a> {
    Bytes(Content<'a>),
    External(String),
    Absent,
}

enum Content<'a> {
    Chunk(&'a [u8]),
    Decoded(Vec<u8>),
    /// A file of the archive that the document is in.
    Beside(Arc<[u8]>),
}

impl Content<'_> {
    fn bytes(&self) -> &[u8] {
        match self {
            Self::Chunk(bytes) => bytes,
            Self::Decoded(bytes) => bytes,
            Self::Beside(bytes) => bytes,
        }
    }
}

impl<'a> Buffers<'a> {
    /// Takes the binary chunk and decodes data URIs; of other files, only those in the same archive
    /// are read.
    pub(super) fn load(
        source: &Source<'_>,
        root: &json::Root,
        bin: Option<&'a [u8]>,
        views: Vec<Carrier>,
    ) -> Result<Self, IoError> {
        let mut buffers = Vec::new();
        for (i, buffer) in root.buffers.iter().enumerate() {
            let beside = |uri: &String| Some((source.beside?, source.beside?.find_uri(uri)?));
            let content = match (&buffer.uri, bin) {
                (Some(uri), _) if uri.starts_with("data:") => {
                    Content::Decoded(decode(uri).ok_or_else(|| {
                        source.malformed(format!("buffer {i}"), "its base64 text is bad", REMEDY)
                    })?)
                }
                (Some(uri), _) if let Some((archive, entry)) = beside(uri) => {
                    Content::Beside(archive.unpack(entry)?)
                }
                (Some(uri), _) => {
                    buffers.push(Buffer::External(uri.chars().take(80).collect()));
                    continue;
                }
                (None, Some(bin)) if i == 0 => Content::Chunk(bin),
                (None, _) => {
                    buffers.push(Buffer::Absent);
                    continue;
                }
            };
            let (need, have) = (buffer.byte_length.0, content.bytes().len() as u64);
            if have < need {
                return Err(source.truncated(format!("buffer {i}"), need, have));
            }
            buffers.push(Buffer::Bytes(content));
        }
        Ok(Self { contents: buffers, compressed: CompressedViews::new(views) })
    }

    /// The bytes of a buffer view.
    pub(super) fn view(
        &self,
        source: &Source<'_>,
        root: &json::Root,
        index: usize,
        place: &str,
    ) -> Result<&[u8], IoError> {
        let Some(view) = root.buffer_views.get(index) else {
            let n = root.buffer_views.len() as u64;
            return Err(source.out_of_range(place, "buffer views", index as i64, n));
        };
        let place = format!("{place}: buffer view {index}");
        if let Some(compressed) = self.compressed.get(index) {
            let (begin, length) = (compressed.byte_offset, compressed.byte_length);
            let encoded = self.range(source, compressed.buffer, begin, length, &place)?;
            return self.compressed.decode(source, index, encoded, view.byte_length.0, &place);
        }
        let begin = view.byte_offset.map_or(0, |o| o.0);
        self.range(source, view.buffer.value(), begin, view.byte_length.0, &place)
    }

    fn range(
        &self,
        source: &Source<'_>,
        buffer: usize,
        begin: u64,
        length: u64,
        place: &str,
    ) -> Result<&[u8], IoError> {
        let bytes: &[u8] = match self.contents.get(buffer) {
            Some(Buffer::Bytes(content)) => content.bytes(),
            Some(Buffer::External(uri)) => {
                let feature = format!("{place}: the external buffer '{uri}'");
                return Err(source.unsupported(feature, PACK_REMEDY));
            }
            Some(Buffer::Absent) => {
                let problem = "its buffer has neither a URI nor a binary chunk";
                return Err(source.malformed(place, problem, "pack the model as GLB"));
            }
            None => {
                let n = self.contents.len() as u64;
                return Err(source.out_of_range(place, "buffers", buffer as i64, n));
            }
        };
        let end = begin.saturating_add(length);
        let found = bytes.get(begin as usize..end as usize);
        found.ok_or_else(|| source.truncated(place, end, bytes.len() as u64))
    }
}

/// The content of a base64 data URI, padded or not.
pub(super) fn decode(uri: &str) -> Option<Vec<u8>> {
    let (_, text) = uri.split_once(";base64,")?;
    let config = GeneralPurposeConfig::new()
        .with_decode_padding_mode(DecodePaddingMode::Indifferent)
        .with_decode_allow_trailing_bits(true);
    GeneralPurpose::new(&STANDARD, config).decode(text).ok()
}
