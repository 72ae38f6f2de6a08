//! Materials: base colours and flags; what they give off is looked at, the rest is carried word for word and named in notes.

use std::collections::BTreeSet;

use gltf::json::material::Material as JsonMaterial;
use serde_json::Value;

use super::{super::texture_info, Document, Soup, texture::label};
use crate::mesh::{Material, TextureUse};

const BASE_COLOR_TEXTURE: &str = "/pbrMetallicRoughness/baseColorTexture";
const DIFFUSE_FACTOR: &str = "/extensions/KHR_materials_pbrSpecularGlossiness/diffuseFactor";
const DIFFUSE_TEXTURE: &str = "/extensions/KHR_materials_pbrSpecularGlossiness/diffuseTexture";

/// All materials in the order of the file; `verbatim` is their JSON. Returns the names of the extensions in them.
pub(super) fn read_materials(
    document: &Document<'_>,
    verbatim: Vec<Value>,
    soup: &mut Soup,
) -> BTreeSet<String> {
    let mut extensions = BTreeSet::new();
    for (i, (material, source)) in document.root.materials.iter().zip(verbatim).enumerate() {
        let name = material.name.clone().unwrap_or_default();
        let label = label("material", i, &name);
        texture_info::extensions(&source, &mut extensions);
        let material = Material {
            name,
            base_color: base_color(material, &source),
            base_texture: in_range(base_texture(&source), &label, soup),
            double_sided: material.double_sided,
            unlit: material.extensions.as_ref().is_some_and(|e| e.unlit.is_some()),
            source: Some(source),
        };
        note_what_is_left_out(&material, &label, soup);
        soup.materials.push(material);
    }
    extensions
}

/// The index that a primitive without a material gets: that of glTF's default material, which is
/// added at the first need, or 0 in a file without any.
pub(super) fn default_material(document: &Document<'_>, soup: &mut Soup) -> u32 {
    let n_own = document.root.materials.len();
    if n_own == 0 {
        return 0;
    }
    if soup.materials.len() == n_own {
        soup.materials.push(Material { double_sided: false, ..Material::default() });
    }
    n_own as u32
}

fn base_texture(source: &Value) -> Option<TextureUse> {
    let paths = [BASE_COLOR_TEXTURE, DIFFUSE_TEXTURE];
    paths.iter().find_map(|path| source.pointer(path).and_then(TextureUse::of_info))
}

/// The diffuse factor belongs to the diffuse texture, and stands in where nothing else is said.
fn base_color(material: &JsonMaterial, source: &Value) -> [f32; 4] {
    let has_other = match source.pointer(DIFFUSE_TEXTURE) {
        Some(_) => source.pointer(BASE_COLOR_TEXTURE).is_some(),
        None => source.get("pbrMetallicRoughness").is_some(),
    };
    match source.pointer(DIFFUSE_FACTOR).and_then(Value::as_array) {
        Some(factor) if !has_other => [0, 1, 2, 3].map(|i| {
            let value = factor.get(i).and_then(Value::as_f64).unwrap_or(1.0);
            finite_or_one(value as f32)
        }),
        _ => material.pbr_metallic_roughness.base_color_factor.0.map(finite_or_one),
    }
}

fn finite_or_one(factor: f32) -> f32 {
    if factor.is_finite() { factor } else { 1.0 }
}

fn in_range(found: Option<TextureUse>, label: &str, soup: &mut Soup) -> Option<TextureUse> {
    let (found, n) = (found?, soup.textures.len());
    if (found.texture as usize) < n {
        return Some(found);
    }
    let text = format!(
        "{label} names texture {}, but there are {n}: it is drawn without; export the model \
         again",
        found.texture
    );
    soup.notes.add("texture_reference_broken", text);
    None
}

fn note_what_is_left_out(material: &Material, label: &str, soup: &mut Soup) {
    let Some(source) = &material.source else { return };
    let glow = material.emission().and_then(|light| light.texture);
    if in_range(glow, label, soup).is_some() && material.glows_apart(&soup.textures) {
        let text = "an emissive texture has other coordinates than the base texture: pictures show the mean of its \
                    colours";
        soup.notes.add("emissive_texture_averaged", text);
    }
    let n_shown = usize::from(base_texture(source).is_some()) + usize::from(glow.is_some());
    if texture_info::count(source) > n_shown {
        let text = "pictures show base and emissive colours: normal, metallic-roughness, occlusion and other \
                    textures are carried, not evaluated";
        soup.notes.add("textures_not_evaluated", text);
    }
}
