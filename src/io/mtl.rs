//! Wavefront MTL: diffuse colours and their images, from the archive that the OBJ is in.
//!
//! `Kd` is a linear factor, as Blender takes it; black beside an image stands for white, as
//! exporters write it for images that are shown as they are. `Ke` is what glTF calls emission.
//! Other properties that change what surfaces look like are noted. A line that cannot be read is
//! passed over with a note: geometry is worth reading without it.

use std::collections::HashMap;

use serde_json::{Value, json};

use super::{
    IoError,
    archive::Archive,
    picture::for_gltf,
    soup::{Notes, Soup},
    source::without_mark,
};
use crate::mesh::{Image, Material, Texture, TextureUse, Wrap};

/// Materials by name.
pub(super) type Library = HashMap<Vec<u8>, Definition>;

/// What is read of a material.
#[derive(Debug, Default)]
pub(super) struct Definition {
    diffuse: Option<[f32; 3]>,
    map: Option<Map>,
    /// What is given off; 1 is full scale.
    emission: [f32; 3],
    /// Whether an image says where.
    has_emission_map: bool,
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
const LEFT_OUT: [(&[&[u8]], &str, &str); 4] = [
    (
        &[b"Ks", b"Pr", b"Pm", b"Ps", b"Pc", b"aniso"],
        "shading_not_evaluated",
        "highlights, roughness, metalness, sheen and clearcoat (Ks, Pr, Pm, Ps, Pc) are left out: \
         all is matt",
    ),
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

/// Of these, the ones that say nothing where they are 0.
const NOTHING_AT_ZERO: [&[u8]; 5] = [b"Ks", b"Pm", b"Ps", b"Pc", b"aniso"];

impl Definition {
    /// Takes a statement; `false` if it cannot be read.
    fn statement(&mut self, key: &[u8], rest: &[u8], notes: &mut Notes) -> bool {
        self.has_emission_map |= key == b"map_Ke";
        match key {
            b"Kd" => match numbers(rest) {
                // Fewer than three mean the same for all.
                Some((values, _)) => {
                    self.diffuse = Some(values.map(|c| (c as f32).clamp(0.0, 1.0)));
                }
                None => return false,
            },
            b"Ke" => match numbers(rest) {
                Some((values, _)) => {
                    self.emission = values.map(|c| (c as f32).clamp(0.0, f32::MAX));
                }
                None => return false,
            },
            b"map_Kd" | b"map_kd" => match Map::parse(rest, notes) {
                Some(map) => self.map = Some(map),
                None => return false,
            },
            b"d" if number(rest) == Some(1.0) => {}
            b"Tr" if number(rest) == Some(0.0) => {}
            _ if NOTHING_AT_ZERO.contains(&key)
                && matches!(numbers(rest), Some(([0.0, 0.0, 0.0], _))) => {}
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

    /// Fills in the colours of a material that has its texture.
    fn fill_in(&self, material: &mut Material, notes: &mut Notes) {
        match self.diffuse {
            Some([0.0, 0.0, 0.0]) if material.base_texture.is_some() => {
                let text = "Kd 0 0 0 beside map_Kd is read as white: the image is shown as it is";
                notes.add("black_factor_ignored", text);
            }
            Some([r, g, b]) => material.base_color = [r, g, b, 1.0],
            None => {}
        }
        if self.emission == [0.0; 3] {
            return;
        }
        if self.has_emission_map {
            let text = "Ke beside map_Ke is left out: its image, which says where, is not read";
            notes.add("emission_ignored", text);
        } else {
            material.source = Some(glowing(material, self.emission));
        }
    }
}

/// A material that gives off light, as a glTF has it: that is where light is looked up.
fn glowing(material: &Material, emission: [f32; 3]) -> Value {
    let strength = emission.into_iter().fold(1.0, f32::max);
    let mut source = json!({
        "name": material.name,
        "pbrMetallicRoughness": {
            "baseColorFactor": material.base_color,
            "metallicFactor": 0.0,
        },
        "emissiveFactor": emission.map(|c| c / strength),
        "doubleSided": material.double_sided,
    });
    if strength > 1.0 {
        let extension = json!({ "emissiveStrength": strength });
        source["extensions"] = json!({ "KHR_materials_emissive_strength": extension });
    }
    if let Some(texture) = &material.base_texture {
        source["pbrMetallicRoughness"]["baseColorTexture"] = texture_info(texture);
    }
    source
}

/// A texture as [`Map::transform`] lays it on: neither turned nor sheared.
fn texture_info(texture: &TextureUse) -> Value {
    let mut info = json!({ "index": texture.texture });
    if texture.transform != TextureUse::IDENTITY {
        let [[width, _, x], [_, height, y]] = texture.transform;
        let transform = json!({ "offset": [x, y], "scale": [width, height] });
        info["extensions"] = json!({ "KHR_texture_transform": transform });
    }
    info
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
    let mut textures = Textures::new(archive);
    for (index, name) in names {
        let Some(definition) = find(library, name) else {
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
        definition.fill_in(material, &mut soup.notes);
    }
    Ok(())
}

/// A definition by its name; or, where there is none, by what stands before a comment.
fn find<'a>(library: &'a Library, name: &[u8]) -> Option<&'a Definition> {
    let bare = || {
        let comment = name.windows(2).position(|pair| pair == b" #")?;
        library.get(name[..comment].trim_ascii_end())
    };
    library.get(name).or_else(bare)
}

/// Images and textures that are in the soup already.
pub(super) struct Textures<'a> {
    archive: &'a Archive<'a>,
    /// Images by entry of the archive.
    images: HashMap<usize, Option<u32>>,
    /// Textures by image and whether it is clamped.
    by_wrap: HashMap<(u32, bool), u32>,
    /// Of images that were decoded to become others.
    n_pixels: u64,
}

impl<'a> Textures<'a> {
    pub(super) fn new(archive: &'a Archive<'a>) -> Self {
        Self { archive, images: HashMap::new(), by_wrap: HashMap::new(), n_pixels: 0 }
    }

    /// An image of the archive as it is; `None`, with a note, where it is not there.
    pub(super) fn plain(
        &mut self,
        file: &str,
        soup: &mut Soup,
    ) -> Result<Option<TextureUse>, IoError> {
        let map =
            Map { file: file.to_owned(), scale: [1.0; 2], offset: [0.0; 2], is_clamped: false };
        self.texture_use(&map, soup)
    }

    /// `None`, with a note, where no GLB can hold it.
    fn image(
        &mut self,
        (entry, file): (usize, &str),
        soup: &mut Soup,
    ) -> Result<Option<u32>, IoError> {
        if let Some(image) = self.images.get(&entry) {
            return Ok(*image);
        }
        let (bytes, name) = (self.archive.unpack(entry)?, self.archive.shown(entry));
        let image = match for_gltf(&bytes, file, self.archive.limits(), &mut self.n_pixels) {
            Ok((mime, converted)) => {
                let bytes = converted.map_or(bytes, Into::into);
                let mime = mime.to_owned();
                soup.images.push(Image { name, mime, bytes, pixels: None });
                Some(soup.images.len() as u32 - 1)
            }
            Err(reason) => {
                let shown: String = name.chars().take(80).collect();
                soup.notes
                    .add("image_unreadable", format!("image '{shown}' is left out: {reason}"));
                None
            }
        };
        self.images.insert(entry, image);
        Ok(image)
    }

    /// `None`, with a note, where the image is not in the archive, or is left out.
    fn texture_use(&mut self, map: &Map, soup: &mut Soup) -> Result<Option<TextureUse>, IoError> {
        let Some(entry) = self.archive.find(&map.file) else {
            let shown: String = map.file.chars().take(80).collect();
            let text = format!("image '{shown}' is not in the archive; pack it with the model");
            soup.notes.add("image_missing", text);
            return Ok(None);
        };
        let Some(image) = self.image((entry, &map.file), soup)? else { return Ok(None) };
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
