//! The header of a PLY file: a few lines of text that describe the rest.

use super::{IoError, REMEDY, Source};

/// A header longer than this is refused: it cannot be one.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// How the values are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    Little,
    Big,
}

/// Type of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    const NAMES: [(&str, Self); 16] = [
        ("char", Self::I8),
        ("int8", Self::I8),
        ("uchar", Self::U8),
        ("uint8", Self::U8),
        ("short", Self::I16),
        ("int16", Self::I16),
        ("ushort", Self::U16),
        ("uint16", Self::U16),
        ("int", Self::I32),
        ("int32", Self::I32),
        ("uint", Self::U32),
        ("uint32", Self::U32),
        ("float", Self::F32),
        ("float32", Self::F32),
        ("double", Self::F64),
        ("float64", Self::F64),
    ];

    fn named(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(n, _)| *n == name).map(|(_, s)| *s)
    }

    /// Bytes in a binary file.
    pub(super) fn n_bytes(self) -> u64 {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The integer that stands for full intensity of a colour; `None` for floating point.
    pub(super) fn full_scale(self) -> Option<f64> {
        match self {
            Self::I8 => Some(127.0),
            Self::U8 => Some(255.0),
            Self::I16 => Some(32_767.0),
            Self::U16 => Some(65_535.0),
            Self::I32 => Some(2_147_483_647.0),
            Self::U32 => Some(4_294_967_295.0),
            Self::F32 | Self::F64 => None,
        }
    }
}

/// One value or a counted list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

#[derive(Debug)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
}

#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
}

#[derive(Debug)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// Names of images, as MeshLab writes them in comments.
    pub(super) texture_files: Vec<String>,
    /// Where the values begin.
    pub(super) body_offset: usize,
    /// Lines of the header.
    pub(super) n_lines: usize,
}

/// Parses up to `end_header`.
pub(super) fn parse(source: &Source<'_>) -> Result<Header, IoError> {
    let text = &source.bytes[..source.bytes.len().min(MAX_HEADER_BYTES)];
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut texture_files = Vec::new();
    let mut offset = 0;
    let mut n_lines = 0;
    while let Some(length) = text[offset..].iter().position(|b| *b == b'\n') {
        let line = String::from_utf8_lossy(&text[offset..offset + length]);
        offset += length + 1;
        n_lines += 1;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let bad = |problem: &str| {
            source.malformed(format!("header, line {n_lines}"), problem.to_owned(), REMEDY)
        };
        match words.as_slice() {
            ["comment", "TextureFile", _, ..] => {
                let name = line.split_once("TextureFile").map_or("", |(_, name)| name.trim());
                texture_files.push(name.to_owned());
            }
            [] | ["ply" | "comment" | "obj_info", ..] => {}
            ["format", name, ..] => {
                encoding = Some(encoding_named(name).ok_or_else(|| bad("unknown encoding"))?);
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| bad("the count is not a number"))?;
                if elements.iter().any(|e| e.name == *name) {
                    return Err(bad("there is an element of this name already"));
                }
                elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ["property", rest @ ..] => {
                let property = property_of(rest).ok_or_else(|| bad("unknown kind of property"))?;
                let element = elements.last_mut().ok_or_else(|| bad("property of no element"))?;
                element.properties.push(property);
            }
            ["end_header"] => {
                let encoding = encoding.ok_or_else(|| bad("no line 'format'"))?;
                let body_offset = offset;
                return Ok(Header { encoding, elements, texture_files, body_offset, n_lines });
            }
            _ => return Err(bad("unknown keyword")),
        }
    }
    Err(source.malformed("header", "no line 'end_header'", REMEDY))
}

fn encoding_named(name: &str) -> Option<Encoding> {
    match name {
        "ascii" => Some(Encoding::Ascii),
        "binary_little_endian" => Some(Encoding::Little),
        "binary_big_endian" => Some(Encoding::Big),
        _ => None,
    }
}

fn property_of(words: &[&str]) -> Option<Property> {
    let (kind, name) = match words {
        ["list", count, item, name] => {
            (Kind::List { count: Scalar::named(count)?, item: Scalar::named(item)? }, name)
        }
        [scalar, name] => (Kind::Scalar(Scalar::named(scalar)?), name),
        _ => return None,
    };
    Some(Property { name: (*name).to_owned(), kind })
}
