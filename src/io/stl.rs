//! STL, binary and ASCII. Normals and attribute bytes are not used: STL stores no vertices, so
//! its normals are those of the facets, which the positions give exactly.
//!
//! Many binary files begin with `solid`, so a file is binary when its length agrees with the
//! count at byte 80, whatever it begins with. A file that is called STL may be longer or, which is refused, cut
//! short. Text has no zero byte; its keywords may be in capitals.

use glam::DVec3;

use super::{
    IoError,
    soup::{Patch, Soup},
    source::{Source, without_mark},
};

const HEADER_BYTES: usize = 84;
const FACET_BYTES: usize = 50;
const REMEDY: &str = "export the model again as binary STL";

/// Whether the length fits the count of a binary file, or the text is that of an ASCII file.
pub(super) fn looks_like(bytes: &[u8]) -> bool {
    is_binary(bytes) || is_ascii(bytes)
}

/// Whether a file that is called STL can be a binary one whose length does not fit its count: it has facets, and is
/// no text.
pub(super) fn may_be(bytes: &[u8]) -> bool {
    stated_count(bytes).is_some_and(|n| n > 0) && bytes.iter().take(HEADER_BYTES).any(|b| *b == 0)
}

fn is_ascii(bytes: &[u8]) -> bool {
    let text = without_mark(bytes).trim_ascii_start();
    let begin = &text[..text.len().min(1024)];
    let has_word = |w: &[u8]| begin.windows(w.len()).any(|x| x.eq_ignore_ascii_case(w));
    let is_solid = begin.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    is_solid && !begin.contains(&0) && (has_word(b"facet") || has_word(b"endsolid"))
}

fn is_binary(bytes: &[u8]) -> bool {
    stated_count(bytes).is_some_and(|n| bytes.len() as u64 == length_for(n))
}

fn stated_count(bytes: &[u8]) -> Option<u32> {
    bytes.get(80..HEADER_BYTES)?.try_into().ok().map(u32::from_le_bytes)
}

fn length_for(n_facets: u32) -> u64 {
    HEADER_BYTES as u64 + FACET_BYTES as u64 * u64::from(n_facets)
}

/// Reads either kind.
pub(super) fn read(source: &Source<'_>) -> Result<Soup, IoError> {
    let mut soup = Soup::of_one_instance();
    let positions = if !is_binary(source.bytes) && is_ascii(source.bytes) {
        read_ascii(source, &mut soup)?
    } else {
        read_binary(source, &mut soup)?
    };
    let n_facets = positions.len() as u32 / 3;
    let triangles = (0..n_facets).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    let place = "facets (three vertices each)".to_owned();
    soup.push(source, Patch { place, positions, triangles, ..Patch::default() })?;
    Ok(soup)
}

fn read_binary(source: &Source<'_>, soup: &mut Soup) -> Result<Vec<DVec3>, IoError> {
    let have = source.bytes.len() as u64;
    let Some(n_facets) = stated_count(source.bytes) else {
        return Err(source.truncated("header", HEADER_BYTES as u64, have));
    };
    let need = length_for(n_facets);
    if have < need {
        return Err(source.truncated(format!("{n_facets} binary facets"), need, have));
    }
    if have > need {
        soup.notes.add("trailing_bytes", "bytes after the last facet are ignored");
    }
    soup.claim(source, "header", u64::from(n_facets) * 3, n_facets.into())?;
    let facets = source.bytes[HEADER_BYTES..need as usize].chunks_exact(FACET_BYTES);
    // 12 bytes of normal, 36 of corners, 2 of attributes.
    Ok(facets.flat_map(|f| f[12..48].chunks_exact(12).map(point_of)).collect())
}

fn point_of(bytes: &[u8]) -> DVec3 {
    let mut x = [0.0; 3];
    for (x, b) in x.iter_mut().zip(bytes.as_chunks::<4>().0) {
        *x = f32::from_le_bytes(*b).into();
    }
    DVec3::from_array(x)
}

/// What the first word of a line says.
#[derive(Clone, Copy)]
enum Keyword {
    Vertex,
    Begin,
    End,
}

impl Keyword {
    const NAMES: [(&[u8], Self); 5] = [
        (b"vertex", Self::Vertex),
        (b"outer", Self::Begin),
        (b"facet", Self::Begin),
        (b"endloop", Self::End),
        (b"endfacet", Self::End),
    ];

    fn of(word: &[u8]) -> Option<Self> {
        let named = Self::NAMES.iter().find(|(name, _)| word.eq_ignore_ascii_case(name));
        named.map(|(_, keyword)| *keyword)
    }
}

fn read_ascii(source: &Source<'_>, soup: &mut Soup) -> Result<Vec<DVec3>, IoError> {
    let mut positions = Vec::new();
    let mut n_in_loop = 0;
    for (i, line) in source.bytes.split(|b| *b == b'\n').enumerate() {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
        let place = || format!("line {}", i + 1);
        match words.next().and_then(Keyword::of) {
            Some(Keyword::Vertex) => {
                let p = parse_point(words).ok_or_else(|| {
                    source.malformed(place(), "a vertex needs three numbers", REMEDY)
                })?;
                n_in_loop += 1;
                soup.claim(source, "facets", 1, u64::from(n_in_loop == 3))?;
                positions.push(p);
            }
            Some(Keyword::End) if n_in_loop % 3 != 0 => {
                let problem = format!("the facet has {n_in_loop} vertices instead of 3");
                return Err(source.malformed(place(), problem, REMEDY));
            }
            Some(Keyword::Begin) => n_in_loop = 0,
            _ => {}
        }
    }
    if positions.len() % 3 != 0 {
        return Err(source.malformed("end of file", "the last facet is not complete", REMEDY));
    }
    Ok(positions)
}

fn parse_point<'a>(mut words: impl Iterator<Item = &'a [u8]>) -> Option<DVec3> {
    let mut x = [0.0; 3];
    for x in &mut x {
        // Single precision, as the binary form has it.
        let value: f32 = str::from_utf8(words.next()?).ok()?.parse().ok()?;
        *x = value.into();
    }
    Some(DVec3::from_array(x))
}
