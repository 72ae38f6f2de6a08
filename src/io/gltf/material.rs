//! Materials: colour factors and flags; textures are named in a note.

use gltf::json::{
    material::{AlphaMode, Material as JsonMaterial},
    validation::Checked,
};

use super::{Document, Soup};
use crate::mesh::Material;

/// All materials in the order of the file.
pub(super) fn read_materials(document: &Document<'_>, soup: &mut Soup) {
    for material in &document.root.materials {
        note_what_is_left_out(material, soup);
        soup.materials.push(Material {
            name: material.name.clone().unwrap_or_default(),
            base_color: material.pbr_metallic_roughness.base_color_factor.0.map(finite_or_one),
            double_sided: material.double_sided,
            unlit: material.extensions.as_ref().is_some_and(|e| e.unlit.is_some()),
            ..Material::default()
        });
    }
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

fn finite_or_one(factor: f32) -> f32 {
    if factor.is_finite() { factor } else { 1.0 }
}

fn note_what_is_left_out(material: &JsonMaterial, soup: &mut Soup) {
    let pbr = &material.pbr_metallic_roughness;
    let has_texture = pbr.base_color_texture.is_some()
        || pbr.metallic_roughness_texture.is_some()
        || material.normal_texture.is_some()
        || material.occlusion_texture.is_some()
        || material.emissive_texture.is_some();
    if has_texture {
        let text = "textures are not carried: materials keep their colour factors";
        soup.notes.add("textures_ignored", text);
    }
    if !matches!(material.alpha_mode, Checked::Valid(AlphaMode::Opaque)) {
        soup.notes.add("alpha_ignored", "alpha masks and blending are ignored: all is opaque");
    }
}
