//! Compressed buffer views (EXT_meshopt_compression and KHR_meshopt_compression), decoded at the
//! first need.
//!
//! Both extensions have the same form; the second adds a version of the vertex codec and a filter,
//! which are read under either name. The codecs are those of `meshopt`, which asserts what the
//! tables here check first.

use std::cell::{Cell, OnceCell};

use serde::Deserialize;

use super::{IoError, REMEDY, Source};

/// A buffer view's extensions, as far as they matter here.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Carrier {
    extensions: Extensions,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Extensions {
    #[serde(rename = "EXT_meshopt_compression")]
    ext: Option<Compression>,
    #[serde(rename = "KHR_meshopt_compression")]
    khr: Option<Compression>,
}

/// Where the compressed bytes are, and what they hold.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Compression {
    pub(super) buffer: usize,
    #[serde(default)]
    pub(super) byte_offset: u64,
    pub(super) byte_length: u64,
    byte_stride: u64,
    count: u64,
    mode: String,
    #[serde(default)]
    filter: Option<String>,
}

/// The compressed ones among a document's buffer views.
#[derive(Debug)]
pub(super) struct CompressedViews {
    views: Vec<Option<View>>,
    /// Bytes of all that has been decoded, or tried.
    n_bytes: Cell<u64>,
}

#[derive(Debug)]
struct View {
    compression: Compression,
    decoded: OnceCell<Vec<u8>>,
}

impl CompressedViews {
    pub(super) fn new(carriers: Vec<Carrier>) -> Self {
        let view = |carrier: Carrier| {
            let compression = carrier.extensions.khr.or(carrier.extensions.ext)?;
            Some(View { compression, decoded: OnceCell::new() })
        };
        Self { views: carriers.into_iter().map(view).collect(), n_bytes: Cell::new(0) }
    }

    /// `None` for a view that is not compressed.
    pub(super) fn get(&self, index: usize) -> Option<&Compression> {
        self.views.get(index)?.as_ref().map(|view| &view.compression)
    }

    /// The content of the compressed view `index`, which must have `n_bytes`.
    pub(super) fn decode(
        &self,
        source: &Source<'_>,
        index: usize,
        encoded: &[u8],
        n_bytes: u64,
        place: &str,
    ) -> Result<&[u8], IoError> {
        let Some(Some(view)) = self.views.get(index) else {
            return Err(source.malformed(place, "it is not compressed", REMEDY));
        };
        if view.decoded.get().is_none() {
            let bad = |problem: String| source.malformed(place, problem, REMEDY);
            let codec = check(&view.compression, encoded, n_bytes).map_err(bad)?;
            let sum = self.n_bytes.get().saturating_add(n_bytes);
            source.check_limit(place, "decompressed bytes", sum, source.limits.max_bytes)?;
            // Counted before, so that a bad view cannot be tried without end.
            self.n_bytes.set(sum);
            let decoded = (codec.decode)(encoded, view.compression.count as usize);
            let decoded = decoded.map_err(|e| bad(format!("its compressed data is bad ({e})")))?;
            let _ = view.decoded.set((codec.filter)(decoded));
        }
        Ok(view.decoded.get().map_or(&[], |bytes| bytes))
    }
}

type Decode = fn(&[u8], usize) -> meshopt::Result<Vec<u8>>;
type Filter = fn(Vec<u8>) -> Vec<u8>;

struct Codec {
    decode: Decode,
    filter: Filter,
}

/// A mode and a stride; what elements a count must be a multiple of, the fewest bytes that so many
/// elements take, and who decodes them.
struct Mode {
    name: &'static str,
    stride: u64,
    multiple: u64,
    least: fn(&Compression) -> u64,
    decode: Decode,
}

const INDEX_MODES: [Mode; 4] = [
    Mode {
        name: "TRIANGLES",
        stride: 2,
        multiple: 3,
        least: of_triangles,
        decode: triangles::<u16>,
    },
    Mode {
        name: "TRIANGLES",
        stride: 4,
        multiple: 3,
        least: of_triangles,
        decode: triangles::<u32>,
    },
    Mode { name: "INDICES", stride: 2, multiple: 1, least: of_indices, decode: indices::<u16> },
    Mode { name: "INDICES", stride: 4, multiple: 1, least: of_indices, decode: indices::<u32> },
];

/// A filter, the strides that it is for (0: any of ATTRIBUTES), and how it is undone.
const FILTERS: [(&str, u64, Filter); 6] = [
    ("OCTAHEDRAL", 4, |bytes| filtered::<[i8; 4]>(&bytes, meshopt::decode_filter_oct)),
    ("OCTAHEDRAL", 8, |bytes| filtered::<[i16; 4]>(&bytes, meshopt::decode_filter_oct)),
    ("QUATERNION", 8, |bytes| filtered::<[i16; 4]>(&bytes, meshopt::decode_filter_quat)),
    ("EXPONENTIAL", 0, |bytes| filtered::<[u32; 1]>(&bytes, meshopt::decode_filter_exp)),
    ("COLOR", 4, |bytes| filtered::<[u8; 4]>(&bytes, meshopt::decode_filter_color)),
    ("COLOR", 8, |bytes| filtered::<[u16; 4]>(&bytes, meshopt::decode_filter_color)),
];

/// Who decodes, if all that the extension demands is so.
fn check(it: &Compression, encoded: &[u8], n_bytes: u64) -> Result<Codec, String> {
    let Compression { byte_stride: stride, count, .. } = *it;
    let mode: String = it.mode.chars().take(32).collect();
    let (multiple, least, decode) = if it.mode == "ATTRIBUTES" {
        let found = VERTEX_DECODERS.iter().find(|(s, _)| *s == stride);
        found.map(|(_, decode)| (1, of_vertices as fn(&Compression) -> u64, *decode))
    } else {
        let found = INDEX_MODES.iter().find(|m| m.name == it.mode && m.stride == stride);
        found.map(|m| (m.multiple, m.least, m.decode))
    }
    .ok_or_else(|| format!("no compression of mode '{mode}' with a stride of {stride}"))?;
    let name = it.filter.as_deref().unwrap_or("NONE");
    let is_filter = |(n, s, _): &&(&str, u64, Filter)| {
        *n == name && (*s == stride || *s == 0) && it.mode == "ATTRIBUTES"
    };
    let filter = match FILTERS.iter().find(is_filter) {
        Some((_, _, filter)) => *filter,
        None if name == "NONE" => |bytes| bytes,
        None => {
            let name: String = name.chars().take(32).collect();
            return Err(format!("no filter '{name}' for mode '{mode}' with a stride of {stride}"));
        }
    };
    if count % multiple != 0 {
        return Err(format!("{count} elements are no multiple of {multiple}"));
    }
    if count.checked_mul(stride) != Some(n_bytes) {
        return Err(format!("{count} elements of {stride} bytes in a view of {n_bytes} bytes"));
    }
    let (least, have) = (least(it), encoded.len() as u64);
    if have < least {
        return Err(format!("{count} elements take {least} compressed bytes or more, not {have}"));
    }
    Ok(Codec { decode, filter })
}

/// A header, and a byte for each four of a stride and each block of at most 256.
fn of_vertices(it: &Compression) -> u64 {
    (it.count.div_ceil(256)).saturating_mul(it.byte_stride / 4).saturating_add(1)
}

/// A header, a byte for each, and a table of 16 bytes.
fn of_triangles(it: &Compression) -> u64 {
    it.count / 3 + 17
}

/// A header, a byte for each, and an end of four bytes.
fn of_indices(it: &Compression) -> u64 {
    it.count.saturating_add(5)
}

fn triangles<T: bytemuck::Pod + Default>(encoded: &[u8], n: usize) -> meshopt::Result<Vec<u8>> {
    Ok(bytemuck::cast_slice(&meshopt::decode_index_buffer::<T>(encoded, n)?).to_vec())
}

fn indices<T: bytemuck::Pod + meshopt::IndexType>(
    encoded: &[u8],
    n: usize,
) -> meshopt::Result<Vec<u8>> {
    Ok(bytemuck::cast_slice(&meshopt::decode_index_sequence::<T>(encoded, n)?).to_vec())
}

/// An element of `N` bytes.
#[derive(Clone)]
struct Element<const N: usize>([u8; N]);

impl<const N: usize> Default for Element<N> {
    fn default() -> Self {
        Self([0; N])
    }
}

fn vertices<const N: usize>(encoded: &[u8], n: usize) -> meshopt::Result<Vec<u8>> {
    let elements: Vec<Element<N>> = meshopt::decode_vertex_buffer(encoded, n)?;
    let mut bytes = Vec::with_capacity(N * n);
    elements.iter().for_each(|element| bytes.extend_from_slice(&element.0));
    Ok(bytes)
}

/// `meshopt` takes the stride from the type.
macro_rules! vertex_decoders {
    ($($n:literal)*) => { [$(($n, vertices::<$n> as Decode)),*] };
}

#[rustfmt::skip]
const VERTEX_DECODERS: [(u64, Decode); 64] = vertex_decoders!(
      4   8  12  16  20  24  28  32  36  40  44  48  52  56  60  64
     68  72  76  80  84  88  92  96 100 104 108 112 116 120 124 128
    132 136 140 144 148 152 156 160 164 168 172 176 180 184 188 192
    196 200 204 208 212 216 220 224 228 232 236 240 244 248 252 256
);

fn filtered<T: bytemuck::Pod>(bytes: &[u8], filter: fn(&mut [T])) -> Vec<u8> {
    let mut elements: Vec<T> = bytemuck::pod_collect_to_vec(bytes);
    filter(&mut elements);
    bytemuck::cast_slice(&elements).to_vec()
}
