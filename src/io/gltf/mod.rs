//! glTF 2.0, packed (GLB) or as JSON with embedded buffers: the default scene, in world space.
//!
//! Every node that holds a mesh places it once, with the product of the transforms from the root,
//! and is a part of its own of the mesh; the tree of nodes is kept by name.
//! A transform that mirrors turns the triangles round, so that they stay counter-clockwise seen
//! from outside. Meshes with a skin are in the pose that they were bound in (`skin`). Morph targets,
//! animations, cameras and lights are left out with a note.
//! Materials, textures and images keep their order, so that materials can be carried word for
//! word; of what they say, base colours are evaluated.
//!
//! The JSON is read by the schema of the `gltf` crate (see `schema`) without its validation (which panics on
//! some dangling indices); every index is looked up with a check instead.

mod accessor;
mod compressed;
mod container;
mod draco;
mod material;
mod primitive;
mod scene;
mod schema;
mod skin;
mod texture;

use std::{cell::Cell, collections::BTreeSet};

use gltf::json;

use super::{
    IoError,
    soup::Soup,
    source::{Source, without_mark},
};
use container::Buffers;

const REMEDY: &str = "export the model again and run it through the glTF validator";

/// Reads the packed form.
pub(super) fn read_glb(source: &Source<'_>) -> Result<Soup, IoError> {
    let (json, bin) = container::split_glb(source)?;
    read_document(source, json, bin)
}

/// Reads the JSON form.
pub(super) fn read_gltf(source: &Source<'_>) -> Result<Soup, IoError> {
    read_document(source, without_mark(source.bytes), None)
}

/// A parsed document and its buffers.
struct Document<'a> {
    source: &'a Source<'a>,
    root: json::Root,
    buffers: Buffers<'a>,
    compressed: Vec<draco::Carrier>,
    /// Bytes of all values that no bytes of the file stand behind.
    n_zero_bytes: Cell<u64>,
}

fn read_document(source: &Source<'_>, json: &[u8], bin: Option<&[u8]>) -> Result<Soup, IoError> {
    let n_objects = json.split(|b| *b == b'{').count() as u64 - 1;
    source.check_limit("JSON", "objects", n_objects, source.limits.max_json_objects)?;
    let is_value = |b: &&u8| matches!(b, b',' | b'[' | b'{');
    let n_values = json.iter().filter(is_value).count() as u64;
    source.check_limit("JSON", "values", n_values, source.limits.max_json_values)?;
    let (root, verbatim) = schema::parse(source, json)?;
    let mut soup = Soup::default();
    check_extensions(source, &root)?;
    let buffers = Buffers::load(source, &root, bin, verbatim.buffer_views)?;
    let (compressed, n_zero_bytes) = (verbatim.meshes, Cell::new(0));
    let document = Document { source, root, buffers, compressed, n_zero_bytes };
    texture::read_images(&document, &mut soup);
    texture::read_textures(&document, &verbatim.textures, &mut soup);
    let carried = material::read_materials(&document, verbatim.materials, &mut soup);
    for placement in scene::placements(&document, &mut soup)? {
        primitive::read_mesh(&document, &mut soup, &placement)?;
    }
    note_what_is_left_out(&document.root, &carried, &mut soup);
    if soup.patches.is_empty() {
        return Err(source.no_triangles("no node of the scene places a mesh with triangles"));
    }
    Ok(soup)
}

/// Extensions that may be required, besides those that are read: they change nothing here.
const HARMLESS: [&str; 2] = ["KHR_lights_punctual", "KHR_xmp_json_ld"];

/// Extensions that are read. Those of materials are carried, whatever they are.
const READ: [&str; 7] = [
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "EXT_texture_webp",
];

/// How many of the extensions in use are looked at.
const MAX_NAMES: usize = 1024;

/// Required extensions that are known, with what to do about them.
const REFUSED: [(&str, &str); 1] =
    [("EXT_mesh_gpu_instancing", "save the model with one node per instance")];

fn check_extensions(source: &Source<'_>, root: &json::Root) -> Result<(), IoError> {
    let is_harmless = |name: &str| {
        READ.contains(&name) || HARMLESS.contains(&name) || name.starts_with("KHR_materials_")
    };
    let Some(name) = root.extensions_required.iter().find(|n| !is_harmless(n)) else {
        return Ok(());
    };
    let known = REFUSED.iter().find(|(n, _)| n == name);
    let remedy = known.map_or("save the model without this extension", |(_, remedy)| remedy);
    let shown: String = name.chars().take(64).collect();
    Err(source.unsupported(format!("the required extension {shown}"), remedy))
}

/// `carried` has the extensions that materials are carried with.
fn note_what_is_left_out(root: &json::Root, carried: &BTreeSet<String>, soup: &mut Soup) {
    let read = root.scene.map_or(0, |scene| scene.value());
    let others = root.scenes.iter().enumerate().filter(|(i, s)| *i != read && !s.nodes.is_empty());
    let rows = [
        (root.animations.len(), "animations_ignored", "animations are ignored"),
        (root.cameras.len(), "cameras_ignored", "cameras are ignored"),
        (others.count(), "scenes_ignored", "scenes other than the default one are ignored"),
    ];
    for (n, code, text) in rows {
        if n > 0 {
            soup.notes.add(code, text);
        }
    }
    note_extensions(root, carried, soup);
}

fn note_extensions(root: &json::Root, carried: &BTreeSet<String>, soup: &mut Soup) {
    let used = [
        ("EXT_mesh_gpu_instancing", "instancing_ignored", "each node is placed once"),
        (
            "KHR_materials_pbrSpecularGlossiness",
            "specular_glossiness_not_evaluated",
            "its diffuse colour is drawn where a material has no base colour texture; the rest is \
             carried, not evaluated",
        ),
        ("MSFT_lod", "levels_ignored", "the finest level is read, the others are left out"),
    ];
    // Some files name extensions of materials that none of theirs has.
    let of_materials =
        |name: &str| name.starts_with("KHR_materials_") && name != "KHR_materials_variants";
    for name in root.extensions_used.iter().take(MAX_NAMES) {
        if let Some((extension, code, text)) = used.into_iter().find(|(known, ..)| known == name) {
            soup.notes.add(code, format!("{extension}: {text}"));
        } else if !READ.contains(&name.as_str()) && !carried.contains(name) && !of_materials(name) {
            let shown: String = name.chars().take(64).collect();
            let text = format!("extension {shown} is not read: what it says is left out");
            soup.notes.add("extension_ignored", text);
        }
    }
}
