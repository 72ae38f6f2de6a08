//! Wavefront MTL: diffuse colours and their images, from the archive that the OBJ is in.
//!
//! `Kd` is a linear factor, as Blender takes it; black beside an image stands for white, as
//! exporters write it for images that are shown as they are. Other properties are noted. A line
//! that cannot be read is passed over with a note: geometry is worth reading without it.

use std::collections::HashMap;

use super::{
    IoError,
    archive::Archive,
    picture::mime_of,
    soup::{Notes, Soup},
    source::without_mark,
};
use crate::mesh::{Image, Texture, TextureUse, Wrap};

/// Materials by name.
pub(super) type Library = HashMap<Vec<u8>, Definition>;

/// What is read of a material.
#[derive(Debug, Default)]
pub(super) struct Definition {
    diffuse: Option<[f32; 3]>,
    map: Option<Map>,
}

/// An image and how it is laid on: coordinates are `scale * (u, v) + offset`, v upwards.
#[derive(Debug, PartialEq)]
struct Map {
    file: String,
    scale: [f64; 2],
    offset: [f64; 2],
    is_clamped: bool,
}

/// Reads the libraries (entries of the archive); of materials that share a name the first counts.
pub(super) fn read(
    archive: &Archive<'_>,
    libraries: &[usize],
    notes: &mut Notes,
) -> Result<Library, IoError> {
    let mut library = Library::new();
    for entry in libraries {
        let bytes = archive.unpack(*entry)?;
        let file = archive.shown(*entry);
        let mut current: Option<(Vec<u8>, Definition)> = None;
        for (i, line) in without_mark(&bytes).split(|b| *b == b'\n').enumerate() {
            let (key, rest) = split_word(line.trim_ascii());
            if key == b"newmtl" {
                let started = (rest.to_vec(), Definition::default());
                if let Some((name, definition)) = current.replace(started) {
                    library.entry(name).or_insert(definition);
                }
            } else if let Some((_, definition)) = &mut current
                && !definition.statement(key, rest, notes)
            {
                let shown = line[..line.len().min(40)].escape_ascii();
                let text = format!("{file}, line {}: '{shown}' cannot be read", i + 1);
                notes.add("mtl_line_ignored", text);
            }
        }
        if let Some((name, definition)) = current {
            library.entry(name).or_insert(definition);
        }
    }
    Ok(library)
}

/// Statements that are known and left out, with what is said about them.
const LEFT_OUT: [(&[&[u8]], &str, &str); 3] = [
    (
        &[b"d", b"Tr", b"map_d"],
        "alpha_ignored",
        "opacity (d, Tr, map_d) is left out: all is opaque",
    ),
    (
        &[b"map_Ka", b"map_Ks", b"map_Ke", b"map_Ns", b"map_Pr", b"map_Pm", b"refl", b"decal"],
        "textures_not_evaluated",
        "images other than map_Kd are left out",
    ),
    (
        &[b"map_Bump", b"map_bump", b"bump", b"norm", b"disp", b"map_disp", b"map_Kn"],
        "textures_not_evaluated",
        "bump, normal and displacement images are left out",
    ),
];

impl Definition {
    /// Takes a statement; `false` if it cannot be read.
    fn statement(&mut self, key: &[u8], rest: &[u8], notes: &mut Notes) -> bool {
        match key {
            b"Kd" => match numbers(rest) {
                // Fewer than three mean the same for all.
                Some((values, _)) => {
                    self.diffuse = Some(values.map(|c| (c as f32).clamp(0.0, 1.0)));
                }
                None => return false,
            },
            b"map_Kd" | b"map_kd" => match Map::parse(rest, notes) {
                Some(map) => self.map = Some(map),
                None => return false,
            },
            b"d" if number(rest) == Some(1.0) => {}
            b"Tr" if number(rest) == Some(0.0) => {}
            _ => {
                for (keys, code, text) in LEFT_OUT {
                    if keys.contains(&key) {
                        notes.add(code, text);
                    }
                }
            }
        }
        true
    }
}

/// What follows an option of an image: up to three numbers, or so many words.
enum Takes {
    Numbers,
    Words(usize),
}

const OPTIONS: [(&[u8], Takes); 14] = [
    (b"-s", Takes::Numbers),
    (b"-o", Takes::Numbers),
    (b"-t", Takes::Numbers),
    (b"-clamp", Takes::Words(1)),
    (b"-blendu", Takes::Words(1)),
    (b"-blendv", Takes::Words(1)),
    (b"-boost", Takes::Words(1)),
    (b"-mm", Takes::Words(2)),
    (b"-texres", Takes::Words(1)),
    (b"-bm", Takes::Words(1)),
    (b"-imfchan", Takes::Words(1)),
    (b"-cc", Takes::Words(1)),
    (b"-type", Takes::Words(1)),
    (b"-colorspace", Takes::Words(1)),
];

impl Map {
    /// Options, then the file's name, which may have spaces.
    fn parse(mut rest: &[u8], notes: &mut Notes) -> Option<Self> {
        let (mut scale, mut offset, mut is_clamped) = ([1.0; 2], [0.0; 2], false);
        loop {
            let (option, after) = split_word(rest);
            let Some((_, takes)) = OPTIONS.iter().find(|(name, _)| *name == option) else { break };
            match (option, takes) {
                (b"-s" | b"-o", _) => {
                    let ([u, v, _], n) = numbers(after)?;
                    let is_scale = option == b"-s";
                    let v = if n > 1 { v } else { f64::from(u8::from(is_scale)) };
                    *(if is_scale { &mut scale } else { &mut offset }) = [u, v];
                }
                (b"-clamp", _) => is_clamped = split_word(after).0 == b"on",
                (option, _) => {
                    let shown = String::from_utf8_lossy(option);
                    notes.add("map_option_ignored", format!("map_Kd's option {shown} is left out"));
                }
            }
            let n_words = match takes {
                Takes::Numbers => numbers(after)?.1,
                Takes::Words(n) => *n,
            };
            rest = (0..n_words).fold(after, |rest, _| split_word(rest).1);
        }
        let file = String::from_utf8_lossy(rest.trim_ascii()).trim_matches('"').to_owned();
        (!file.is_empty()).then_some(Self { file, scale, offset, is_clamped })
    }

    /// In the mesh, v counts downwards: v' = 1 - (s (1 - v) + o).
    fn transform(&self) -> [[f32; 3]; 2] {
        let ([su, sv], [ou, ov]) = (self.scale, self.offset);
        let rows = [[su, 0.0, ou], [0.0, sv, 1.0 - sv - ov]];
        let rows = rows.map(|row| row.map(|value| value as f32));
        if rows.as_flattened().iter().all(|v| v.is_finite()) { rows } else { TextureUse::IDENTITY }
    }
}

/// Fills in the materials that the OBJ names; `names` has them in the order of their indices.
pub(super) fn apply(
    archive: &Archive<'_>,
    library: &Library,
    names: &[(u32, &[u8])],
    soup: &mut Soup,
) -> Result<(), IoError> {
    let mut textures = Textures { archive, images: HashMap::new(), by_wrap: HashMap::new() };
    for (index, name) in names {
        let Some(definition) = library.get(*name) else {
            let shown: String = String::from_utf8_lossy(name).chars().take(64).collect();
            let text = format!("material '{shown}' is in no material library: it is white");
            soup.notes.add("material_undefined", text);
            continue;
        };
        let base_texture = match &definition.map {
            Some(map) => textures.texture_use(map, soup)?,
            None => None,
        };
        let Some(material) = soup.materials.get_mut(*index as usize) else { continue };
        material.base_texture = base_texture;
        match definition.diffuse {
            Some([0.0, 0.0, 0.0]) if base_texture.is_some() => {
                let text = "Kd 0 0 0 beside map_Kd is read as white: the image is shown as it is";
                soup.notes.add("black_factor_ignored", text);
            }
            Some([r, g, b]) => material.base_color = [r, g, b, 1.0],
            None => {}
        }
    }
    Ok(())
}

/// Images and textures that are in the soup already.
struct Textures<'a> {
    archive: &'a Archive<'a>,
    /// Images by entry of the archive.
    images: HashMap<usize, u32>,
    /// Textures by image and whether it is clamped.
    by_wrap: HashMap<(u32, bool), u32>,
}

impl Textures<'_> {
    fn image(&mut self, entry: usize, soup: &mut Soup) -> Result<u32, IoError> {
        if let Some(image) = self.images.get(&entry) {
            return Ok(*image);
        }
        let bytes = self.archive.unpack(entry)?;
        let mime = mime_of(&bytes).unwrap_or_default().to_owned();
        let name = self.archive.shown(entry);
        soup.images.push(Image { name, mime, bytes, pixels: None });
        let image = soup.images.len() as u32 - 1;
        self.images.insert(entry, image);
        Ok(image)
    }

    /// `None`, with a note, where the image is not in the archive.
    fn texture_use(&mut self, map: &Map, soup: &mut Soup) -> Result<Option<TextureUse>, IoError> {
        let Some(entry) = self.archive.find(&map.file) else {
            let shown: String = map.file.chars().take(80).collect();
            let text = format!("image '{shown}' is not in the archive; pack it with the model");
            soup.notes.add("image_missing", text);
            return Ok(None);
        };
        let image = self.image(entry, soup)?;
        let texture = *self.by_wrap.entry((image, map.is_clamped)).or_insert_with(|| {
            let wrap = if map.is_clamped { Wrap::Clamp } else { Wrap::Repeat };
            let wrap = [wrap; 2];
            soup.textures.push(Texture { image: Some(image), wrap, ..Texture::default() });
            soup.textures.len() as u32 - 1
        });
        Ok(Some(TextureUse { texture, tex_coord: 0, transform: map.transform() }))
    }
}

/// The first word and what follows it.
pub(super) fn split_word(text: &[u8]) -> (&[u8], &[u8]) {
    let text = text.trim_ascii_start();
    let end = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
    let (word, rest) = text.split_at(end);
    (word, rest.trim_ascii())
}

fn number(text: &[u8]) -> Option<f64> {
    str::from_utf8(split_word(text).0).ok()?.parse().ok().filter(|x: &f64| x.is_finite())
}

/// One to three numbers, of which the last fills the rest, and how many there are.
fn numbers(mut text: &[u8]) -> Option<([f64; 3], usize)> {
    let mut values = [number(text)?; 3];
    let mut n = 0;
    while let Some(value) = number(text).filter(|_| n < 3) {
        values[n..].fill(value);
        n += 1;
        text = split_word(text).1;
    }
    Some((values, n))
}
