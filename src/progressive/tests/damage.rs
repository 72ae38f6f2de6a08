//! Damaged files: an error or some mesh, never a panic.

use proptest::prelude::*;
use serde_json::json;

use super::{
    edits::random_edits,
    reference::{Extras, Rng, grid, sequence},
};
use crate::progressive::{
    Block, ProgressiveError, ReadLimits, Reader, Writer, decode_collapse, decode_edit,
    header::Header, section::Streams,
};

/// A chain of collapses whose first and last meshes are levels with edits.
fn file(seed: u64) -> Vec<u8> {
    let mut rng = Rng(seed);
    let extras = Extras {
        layers: seed.is_multiple_of(2),
        materials: seed.is_multiple_of(3),
        parts: seed < 3,
        ugly: seed.is_multiple_of(5),
    };
    let mesh = grid(5, extras, &mut rng);
    let (levels, records) = sequence(&mesh, 40, &mut rng);
    let mut writer = Writer::new(&mesh).unwrap();
    writer.mark_level("first");
    for record in &records {
        writer.push(record).unwrap();
    }
    writer.mark_level("last");
    for (name, level) in [("last", levels.last().unwrap()), ("first", &mesh)] {
        writer.begin_edits(name, level).unwrap();
        for record in random_edits(level, 30, &mut rng).1 {
            writer.push_edit(record.edit()).unwrap();
        }
    }
    writer.finish().unwrap()
}

/// All blocks of a file, as they lie in it: those of the level marked last were recorded first.
fn blocks(header: &mut Header) -> Vec<&mut Block> {
    let edits = header.levels.iter_mut().rev().filter_map(|level| level.edits.as_mut());
    header.blocks.iter_mut().chain(edits.flat_map(|edits| &mut edits.blocks)).collect()
}

/// Reads all there is.
fn read_all(bytes: &[u8]) -> Result<usize, ProgressiveError> {
    let reader = Reader::open(bytes)?;
    let _ = reader.extract(reader.header().n_base_faces / 2 + reader.header().n_faces / 2)?;
    let mut splits = reader.coarse_to_fine()?;
    while splits.split()?.is_some() {}
    let mut collapses = reader.fine_to_coarse()?;
    while collapses.collapse()?.is_some() {}
    for level in &reader.header().levels {
        let _ = reader.extract_level(&level.name)?;
        let mut edits = reader.edits_backward(&level.name)?;
        while edits.undo()?.is_some() {}
    }
    Ok(collapses.to_mesh().faces.len())
}

/// The file with one stream of one section changed and every checksum right.
fn forge(bytes: &[u8], part: usize, stream: usize, edit: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
    let (mut header, body) = Header::parse(bytes, &ReadLimits::default()).unwrap();
    let old: Vec<_> = header
        .parts
        .into_iter()
        .chain([header.base])
        .chain(blocks(&mut header).into_iter().map(|block| block.section))
        .collect();
    let n = old.len();
    // Images come first.
    let mut new_body = body[..old[0].offset as usize].to_vec();
    let mut sections = Vec::new();
    for (i, section) in old.iter().enumerate() {
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
    let mut sections = sections.into_iter();
    header.parts = header.parts.and_then(|_| sections.next());
    header.base = sections.next().unwrap();
    for (block, section) in blocks(&mut header).into_iter().zip(sections) {
        block.section = section;
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
        if let Ok((_, n_bytes)) = decode_edit(&bytes) {
            prop_assert!(n_bytes <= bytes.len());
        }
    }

    #[test]
    fn forged_headers_never_panic(seed in 0..6_u64, field in 0..21_usize, value in any::<u32>()) {
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
            8 => header.has_face_materials ^= true,
            9 => header.levels[0].record = value,
            10 | 11 => header.images.iter_mut().for_each(|image| image.blob = Some(value)),
            12 => header.blobs.iter_mut().for_each(|blob| blob.n_bytes = value.into()),
            13 => header.blobs.iter_mut().for_each(|blob| blob.offset = value.into()),
            19 => header.parts.iter_mut().for_each(|s| s.raw[value as usize % 3] = value),
            20 => header.parts.iter_mut().for_each(|s| s.offset = value.into()),
            14 => header.textures.iter_mut().for_each(|texture| texture.image = Some(value)),
            _ => {
                let edits = header.levels[0].edits.as_mut().unwrap();
                let block = &mut edits.blocks[0];
                match field {
                    15 => edits.n_edits = value,
                    16 => edits.faces = value,
                    17 => (edits.n_edits, block.n_records) = (value, value),
                    _ => block.section.raw[value as usize % 3] = value,
                }
            }
        }
        let forged = [header.to_bytes().unwrap(), body.to_vec()].concat();
        let limits = ReadLimits {
            max_faces: 100_000, max_vertices: 100_000, max_attribute_values: 1_000_000,
            ..ReadLimits::default()
        };
        if let Ok(reader) = Reader::open_with(&forged, limits) {
            let _ = reader.extract(u32::MAX);
            let _ = reader.fine_to_coarse();
            let _ = ["first", "last"].map(|name| reader.extract_level(name));
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
    assert!(error(&later).starts_with("version 9 of the format; this build reads version 2"));
    assert!(error(&good[..20]).starts_with("header: "));
    assert!(error(&good[..good.len() - 1]).contains("fetch the file again"));
    let mut flipped = good.clone();
    *flipped.last_mut().unwrap() ^= 1;
    assert_eq!(
        error(&flipped),
        "block 0 of the edits of 'first': the checksum does not agree; fetch the file again"
    );
    let limits = ReadLimits { max_faces: 10, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap_err().to_string();
    assert_eq!(error, "53 triangles are over the limit of 10; raise the limit to read the file");
    let limits = ReadLimits { max_corner_visits: 10, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap().extract(99).unwrap_err().to_string();
    assert!(error.contains("corner visits"), "{error}");
    let limits = ReadLimits { max_edits: 10, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap_err().to_string();
    assert!(error.contains("edits of a level are over the limit of 10"), "{error}");
    let limits = ReadLimits { max_faces: 53, ..ReadLimits::default() };
    let error = Reader::open_with(&good, limits).unwrap().extract_level("first").unwrap_err();
    assert!(error.to_string().contains("triangles are over the limit of 53"), "{error}");
}

/// Images are checked before anything of their size is made.
#[test]
fn images_are_checked() {
    let good = file(0);
    let (header, body) = Header::parse(&good, &ReadLimits::default()).unwrap();
    assert_eq!((header.images.len(), header.blobs.len()), (4, 2));
    type Row = (&'static str, fn(&mut Header));
    let rows: [Row; 5] = [
        ("images: the checksum does not agree", |h| h.blobs[0].crc32 ^= 1),
        ("images: 18446744073709551615 bytes are needed", |h| h.blobs[1].n_bytes = u64::MAX),
        ("images: 18446744073709551615 bytes are needed", |h| h.blobs[0].offset = u64::MAX),
        ("bytes are needed but", |h| h.blobs = h.blobs.repeat(1000)),
        ("an image names bytes that are not there", |h| h.images[2].blob = Some(2)),
    ];
    for (said, change) in rows {
        let mut forged = header.clone();
        change(&mut forged);
        let forged = [forged.to_bytes().unwrap(), body.to_vec()].concat();
        let error = read_all(&forged).unwrap_err().to_string();
        assert!(error.contains(said), "{said}: {error}");
    }
    // A file from before textures and parts has none of the fields.
    let mut old = header;
    (old.images, old.blobs, old.textures, old.parts) = Default::default();
    let old = [old.to_bytes().unwrap(), body.to_vec()].concat();
    assert!(read_all(&old).is_ok());
    let json = String::from_utf8_lossy(&old).into_owned();
    assert!(!json.contains("\"images\"") && !json.contains("\"blobs\""));
    assert!(!json.contains("\"parts\""));
}

/// Each triangle has one part, or all have the same.
#[test]
fn parts_are_checked() {
    let good = file(0);
    let n_faces = Reader::open(&good).unwrap().header().n_faces as u8;
    for (runs, said) in [
        (&[][..], None),
        (&[3, n_faces], None),
        (&[4, n_faces], Some("a triangle names a part that is not there")),
        (&[1, n_faces - 1, 0, 1], None),
        (&[1, n_faces - 1], Some("fewer parts than triangles")),
        (&[1, n_faces - 1, 0, 2], Some("more parts than triangles")),
        (&[1], Some("the data end too early")),
    ] {
        // The section of parts is the first one.
        let forged = forge(&good, 0, 1, |ids| runs.clone_into(ids));
        let error = read_all(&forged).err().map(|error| error.to_string());
        let wanted = said.map(|said| format!("parts: {said}; the file is damaged"));
        assert_eq!(error, wanted, "{runs:?}");
    }
    let forged = forge(&good, 0, 0, |json| *json = b"{\"nodes\": 1}".to_vec());
    assert!(read_all(&forged).unwrap_err().to_string().starts_with("parts: invalid type"));
}

/// A material whose JSON could not be read again is refused at once.
#[test]
fn materials_must_be_readable() {
    let extras = Extras { layers: false, materials: true, parts: true, ugly: false };
    let nested = |depth| (0..depth).fold(json!(1), |inner, _| json!([inner]));
    let of_source = |source| {
        let mut mesh = grid(2, extras, &mut Rng(1));
        mesh.materials[0].source = Some(source);
        Writer::new(&mesh).map(|_| ()).map_err(|error| error.to_string())
    };
    assert_eq!(of_source(nested(100)), Ok(()));
    assert!(of_source(nested(126)).unwrap_err().contains("nested too deep"));
    assert!(of_source(json!("x".repeat(33 << 20))).unwrap_err().contains("32 MiB"));
}

/// A coarse level does not look at later bytes.
#[test]
fn a_prefix_serves_the_coarse_levels() {
    let good = file(1);
    let (header, _) = Header::parse(&good, &ReadLimits::default()).unwrap();
    let mut all = header.clone();
    let n_after: u64 = blocks(&mut all).iter().map(|b| b.section.n_packed()).sum();
    let prefix = &good[..good.len() - n_after as usize];
    let reader = Reader::open(prefix).unwrap();
    let splits = reader.coarse_to_fine().unwrap();
    assert_eq!(splits.to_mesh().faces.len(), header.n_base_faces as usize);
    assert!(reader.extract(u32::MAX).unwrap_err().to_string().contains("fetch the file again"));
}
