//! Damaged files: an error or some mesh, never a panic.

use proptest::prelude::*;

use super::reference::{Extras, Rng, grid, sequence};
use crate::progressive::{
    ProgressiveError, ReadLimits, Reader, Writer, decode_collapse, header::Header, section::Streams,
};

fn file(seed: u64) -> Vec<u8> {
    let mut rng = Rng(seed);
    let extras = Extras {
        layers: seed.is_multiple_of(2),
        materials: seed.is_multiple_of(3),
        ugly: seed.is_multiple_of(5),
    };
    let mesh = grid(5, extras, &mut rng);
    let (_, records) = sequence(&mesh, 40, &mut rng);
    let mut writer = Writer::new(&mesh).unwrap();
    for record in &records {
        writer.push(record).unwrap();
    }
    writer.mark_level("last", true);
    writer.finish().unwrap()
}

/// Reads all there is.
fn read_all(bytes: &[u8]) -> Result<usize, ProgressiveError> {
    let reader = Reader::open(bytes)?;
    let _ = reader.extract(reader.header().n_base_faces / 2 + reader.header().n_faces / 2)?;
    let mut splits = reader.coarse_to_fine()?;
    while splits.split()?.is_some() {}
    let mut collapses = reader.fine_to_coarse()?;
    while collapses.collapse()?.is_some() {}
    Ok(collapses.to_mesh().faces.len())
}

/// The file with one stream of one section changed and every checksum right.
fn forge(bytes: &[u8], part: usize, stream: usize, edit: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
    let (mut header, body) = Header::parse(bytes, &ReadLimits::default()).unwrap();
    let n = header.blocks.len() + 1;
    let mut new_body = Vec::new();
    let mut sections = Vec::new();
    for (i, section) in
        std::iter::once(&header.base).chain(header.blocks.iter().map(|b| &b.section)).enumerate()
    {
        let mut streams = Streams::unpack(section, body, "x").unwrap();
        if i == part % n {
            edit(match stream % 3 {
                0 => &mut streams.shape,
                1 => &mut streams.ids,
                _ => &mut streams.digits,
            });
        }
        sections.push(streams.pack(&mut new_body).unwrap());
    }
    header.base = sections[0];
    for (block, section) in header.blocks.iter_mut().zip(&sections[1..]) {
        block.section = *section;
    }
    let mut file = header.to_bytes().unwrap();
    file.append(&mut new_body);
    file
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]

    #[test]
    fn flipped_and_cut_files_are_noticed(
        seed in 0..6_u64,
        at in any::<prop::sample::Index>(),
        bit in 0..8,
        cut in any::<bool>(),
    ) {
        let mut bytes = file(seed);
        let at = at.index(bytes.len());
        if cut {
            bytes.truncate(at);
        } else {
            bytes[at] ^= 1_u8 << bit;
        }
        prop_assert!(read_all(&bytes).is_err());
    }

    #[test]
    fn forged_files_never_panic(
        seed in 0..6_u64,
        part in any::<usize>(),
        stream in any::<usize>(),
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..4_u8), 1..4),
    ) {
        let forged = forge(&file(seed), part, stream, |bytes| {
            for (at, value, kind) in &edits {
                if bytes.is_empty() {
                    continue;
                }
                let at = at.index(bytes.len());
                match kind {
                    0 => bytes[at] = *value,
                    1 => bytes[at] = value % 8,
                    2 => bytes.insert(at, *value),
                    _ => drop(bytes.remove(at)),
                }
            }
        });
        let _ = read_all(&forged);
    }

    #[test]
    fn any_bytes_are_no_record_or_one(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = decode_collapse(&bytes);
    }

    #[test]
    fn forged_headers_never_panic(seed in 0..6_u64, field in 0..9, value in any::<u32>()) {
        let bytes = file(seed);
        let (mut header, body) = Header::parse(&bytes, &ReadLimits::default()).unwrap();
        let value = value >> (value % 29);
        match field {
            0 => header.n_vertices = value,
            1 => header.n_faces = value,
            2 => header.n_wedges = value,
            3 => header.n_all_wedges = value,
            4 => header.n_base_faces = value,
            5 => header.n_base_vertices = value,
            6 => header.n_base_wedges = value,
            7 => header.base.raw[value as usize % 3] = value,
            _ => header.has_face_materials ^= true,
        }
        let forged = [header.to_bytes().unwrap(), body.to_vec()].concat();
        let limits = ReadLimits {
            max_faces: 100_000, max_vertices: 100_000, max_attribute_values: 1_000_000,
            ..ReadLimits::default()
        };
        if let Ok(reader) = Reader::open_with(&forged, limits) {
            let _ = reader.extract(u32::MAX);
            let _ = reader.fine_to_coarse();
        }
    }
}

#[test]
fn errors_say_what_is_wrong() {
    let good = file(0);
    let error = |bytes: &[u8]| read_all(bytes).unwrap_err().to_string();
    assert!(read_all(&good).is_ok());
    assert!(error(b"").starts_with("not a progressive mesh"));
    assert!(error(b"glTF").starts_with("not a progressive mesh"));
    let mut later = good.clone();
    later[8] = 9;
    assert!(error(&later).starts_with("version 9 of the format; this build reads version 1"));
    assert!(error(&good[..20]).starts_with("header: "));
    assert!(error(&good[..good.len() - 1]).contains("fetch the file again"));
    let mut flipped = good.clone();
    *flipped.last_mut().unwrap() ^= 1;
    assert_eq!(error(&flipped), "block 0: the checksum does not agree; fetch the file again");
    let limits = ReadLimits { max_faces: 10, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap_err().to_string();
    assert_eq!(error, "53 triangles are over the limit of 10; raise the limit to read the file");
    let limits = ReadLimits { max_corner_visits: 10, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap().extract(99).unwrap_err().to_string();
    assert!(error.contains("corner visits"), "{error}");
}

/// A coarse level does not look at later bytes.
#[test]
fn a_prefix_serves_the_coarse_levels() {
    let good = file(1);
    let (header, _) = Header::parse(&good, &ReadLimits::default()).unwrap();
    let n_records: u64 = header.blocks.iter().map(|b| b.section.n_packed()).sum();
    let prefix = &good[..good.len() - n_records as usize];
    let reader = Reader::open(prefix).unwrap();
    let splits = reader.coarse_to_fine().unwrap();
    assert_eq!(splits.to_mesh().faces.len(), header.n_base_faces as usize);
    assert!(reader.extract(u32::MAX).unwrap_err().to_string().contains("fetch the file again"));
}
