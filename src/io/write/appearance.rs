//! Materials, textures, samplers and images of a GLB.
//!
//! A material that was read from a glTF is written as it was, but for textures that are not there
//! and sets of coordinates that have another number in the file. Textures keep their indices;
//! images without bytes, which glTF has no form for, are left out. Images that share bytes share a
//! buffer view.

use std::collections::{BTreeSet, HashMap};

use serde_json::{Map, Value, json};

use crate::{
    io::{picture::mime_of, texture_info},
    mesh::{Image, Material, Mesh, Semantic, Texture, TextureUse, Wrap},
};

/// Media types of images that only an extension may name.
const EXTENSIONS: [(&str, &str); 2] =
    [("image/webp", "EXT_texture_webp"), ("image/ktx2", "KHR_texture_basisu")];
const TRANSFORM: &str = "KHR_texture_transform";

/// The lists of a document that say what surfaces look like.
#[derive(Debug, Default)]
pub(super) struct Appearance {
    materials: Vec<Value>,
    textures: Vec<Value>,
    samplers: Vec<Value>,
    images: Vec<Value>,
    extensions_used: BTreeSet<String>,
    extensions_required: BTreeSet<String>,
}

impl Appearance {
    /// `put_view` makes a buffer view of an image's bytes and returns its index.
    pub(super) fn of(mesh: &Mesh, put_view: &mut dyn FnMut(&[u8]) -> usize) -> Self {
        let mut found = Self::default();
        if mesh.materials.is_empty() {
            return found;
        }
        let new_sets = new_sets(mesh);
        for material in &mesh.materials {
            let mut value = material_json(material);
            texture_info::retain(&mut value, &mut |texture, info| {
                renumber_sets(info, &new_sets);
                texture < mesh.textures.len() as u64
            });
            texture_info::extensions(&value, &mut found.extensions_used);
            found.materials.push(value);
        }
        let new_images = found.put_images(&mesh.images, put_view);
        for texture in &mesh.textures {
            found.put_texture(texture, &mesh.images, &new_images);
        }
        found
    }

    /// Where each image is in the file.
    fn put_images(
        &mut self,
        images: &[Image],
        put_view: &mut dyn FnMut(&[u8]) -> usize,
    ) -> Vec<Option<usize>> {
        let mut views = HashMap::new();
        let mut new_images = Vec::with_capacity(images.len());
        for image in images {
            if image.bytes.is_empty() {
                new_images.push(None);
                continue;
            }
            let view = *views.entry(image.bytes.as_ptr()).or_insert_with(|| put_view(&image.bytes));
            let mut value = json!({ "bufferView": view, "mimeType": mime(image) });
            name(&mut value, &image.name);
            new_images.push(Some(self.images.len()));
            self.images.push(value);
        }
        new_images
    }

    fn put_texture(&mut self, texture: &Texture, images: &[Image], new_images: &[Option<usize>]) {
        let mut value = json!({});
        name(&mut value, &texture.name);
        if let Some(sampler) = self.sampler(texture) {
            value["sampler"] = sampler.into();
        }
        let find = |index: Option<u32>| {
            let index = index? as usize;
            Some((images.get(index)?, (*new_images.get(index)?)?))
        };
        let fallback = find(texture.fallback);
        let found = find(texture.image);
        let extension = found.and_then(|(image, _)| {
            EXTENSIONS.iter().find_map(|(of, name)| (*of == mime(image)).then_some(*name))
        });
        match (found, extension) {
            (Some((_, source)), Some(name)) => {
                value["extensions"] = json!({ name: { "source": source } });
                self.extensions_used.insert(name.to_owned());
                match fallback {
                    Some((_, source)) => value["source"] = source.into(),
                    None => drop(self.extensions_required.insert(name.to_owned())),
                }
            }
            _ => {
                if let Some((_, source)) = found.or(fallback) {
                    value["source"] = source.into();
                }
            }
        }
        self.textures.push(value);
    }

    /// The index of the texture's sampler; `None` where the defaults do.
    fn sampler(&mut self, texture: &Texture) -> Option<usize> {
        let mut sampler = json!({});
        for (key, filter) in ["magFilter", "minFilter"].iter().zip(texture.filters) {
            if let Some(filter) = filter {
                sampler[key] = filter.into();
            }
        }
        for (key, wrap) in ["wrapS", "wrapT"].iter().zip(texture.wrap) {
            match wrap {
                Wrap::Repeat => {}
                Wrap::Mirror => sampler[key] = 33_648.into(),
                Wrap::Clamp => sampler[key] = 33_071.into(),
            }
        }
        if sampler == json!({}) {
            return None;
        }
        let known = self.samplers.iter().position(|s| *s == sampler);
        known.or_else(|| {
            self.samplers.push(sampler);
            Some(self.samplers.len() - 1)
        })
    }

    /// Names an extension that the document has elsewhere.
    pub(super) fn use_extension(&mut self, name: &str, is_required: bool) {
        self.extensions_used.insert(name.to_owned());
        if is_required {
            self.extensions_required.insert(name.to_owned());
        }
    }

    /// Adds what is there: glTF allows no empty lists.
    pub(super) fn put_into(self, document: &mut Value) {
        let strings = |set: BTreeSet<String>| set.into_iter().map(Value::from).collect();
        for (key, list) in [
            ("materials", self.materials),
            ("textures", self.textures),
            ("samplers", self.samplers),
            ("images", self.images),
            ("extensionsUsed", strings(self.extensions_used)),
            ("extensionsRequired", strings(self.extensions_required)),
        ] {
            if !list.is_empty() {
                document[key] = list.into();
            }
        }
    }
}

/// The media type, which glTF demands beside a buffer view.
fn mime(image: &Image) -> &str {
    match image.mime.as_str() {
        "" => mime_of(&image.bytes).unwrap_or("application/octet-stream"),
        mime => mime,
    }
}

fn name(value: &mut Value, name: &str) {
    if !name.is_empty() {
        value["name"] = name.into();
    }
}

/// Sets of texture coordinates whose number in the file is another, which the writer numbers
/// without gaps: old and new.
fn new_sets(mesh: &Mesh) -> HashMap<u64, usize> {
    let mut sets: Vec<u32> = mesh
        .layers
        .iter()
        .filter_map(|layer| match layer.semantic {
            Semantic::TexCoord(set) => Some(set),
            _ => None,
        })
        .collect();
    sets.sort_unstable();
    let numbered = sets.into_iter().enumerate().map(|(new, old)| (u64::from(old), new));
    numbered.filter(|(old, new)| *old != *new as u64).collect()
}

fn renumber_sets(info: &mut Map<String, Value>, new_sets: &HashMap<u64, usize>) {
    let renumber = |map: &mut Map<String, Value>| {
        let old = map.get("texCoord").and_then(Value::as_u64)?;
        let new = new_sets.get(&old)?;
        map.insert("texCoord".to_owned(), (*new).into())
    };
    renumber(info);
    let transform = info.get_mut("extensions").and_then(|e| e.get_mut(TRANSFORM));
    if let Some(Value::Object(transform)) = transform {
        renumber(transform);
    }
}

fn material_json(material: &Material) -> Value {
    if let Some(source @ Value::Object(_)) = &material.source {
        return source.clone();
    }
    let mut value = json!({
        "pbrMetallicRoughness": {
            "baseColorFactor": material.base_color.map(|c| c.clamp(0.0, 1.0)),
            "metallicFactor": 0.0,
        },
    });
    name(&mut value, &material.name);
    if let Some(texture) = &material.base_texture {
        value["pbrMetallicRoughness"]["baseColorTexture"] = texture_json(texture);
    }
    if material.double_sided {
        value["doubleSided"] = true.into();
    }
    if material.unlit {
        value["extensions"] = json!({ "KHR_materials_unlit": {} });
    }
    value
}

fn texture_json(texture: &TextureUse) -> Value {
    let mut value = json!({ "index": texture.texture });
    if texture.tex_coord != 0 {
        value["texCoord"] = texture.tex_coord.into();
    }
    let is_finite = texture.transform.as_flattened().iter().all(|v| v.is_finite());
    if texture.transform != TextureUse::IDENTITY && is_finite {
        value["extensions"] = json!({ TRANSFORM: transform_json(&texture.transform) });
    }
    value
}

/// The affine map as offset, rotation and scale; shear, which those lack, is lost.
fn transform_json(rows: &[[f32; 3]; 2]) -> Value {
    let [[a, b, x], [d, e, y]] = rows.map(|row| row.map(f64::from));
    let (width, height) = (libm::hypot(a, d), libm::hypot(b, e));
    let mirror = if a * e < b * d { -1.0 } else { 1.0 };
    let rotation = if width > 0.0 { libm::atan2(-d, a) } else { libm::atan2(b, e) };
    let mut value = json!({ "offset": [x, y], "scale": [width, height * mirror] });
    if rotation != 0.0 {
        value["rotation"] = rotation.into();
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn affine_maps_come_apart() {
        for (rows, expected) in [
            ([[2., 0., 0.5], [0., 3., 0.25]], json!({ "offset": [0.5, 0.25], "scale": [2., 3.] })),
            ([[2., 0., 0.], [0., -3., 0.]], json!({ "offset": [0., 0.], "scale": [2., -3.] })),
            (
                [[0., 3., 0.], [-2., 0., 0.]],
                json!({ "offset": [0., 0.], "scale": [2., 3.],
                        "rotation": std::f64::consts::FRAC_PI_2 }),
            ),
        ] {
            assert_eq!(transform_json(&rows), expected);
        }
    }
}
