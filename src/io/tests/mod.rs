//! Readers and writers together: formats, hostile input, round trips, the real models.

mod archives;
mod assemblies;
mod bad_input;
mod compressed;
mod formats;
mod gltf_scenes;
mod models;
mod mutations;
mod packed;
mod pictures;
mod quantized;
mod round_trip;
mod skins;
mod textures;

use std::io::Cursor;

use image::{ImageFormat, Rgb, RgbImage};
use serde_json::{Value, json};

use super::{Ingest, IoError, Limits, read};
use crate::mesh::Mesh;

/// Reads with the default limits; what comes out must obey the invariants of a mesh.
fn load(name: &str, bytes: &[u8]) -> Result<Ingest, IoError> {
    let ingest = read(name, bytes, &Limits::default())?;
    assert_valid(&ingest.mesh);
    Ok(ingest)
}

fn error_of(name: &str, bytes: &[u8]) -> IoError {
    match load(name, bytes) {
        Ok(ingest) => panic!("{name} was read: {:?}", ingest.report),
        Err(error) => error,
    }
}

/// Invariants 1 to 5 of [`Mesh`], and no unreferenced vertex or wedge.
fn assert_valid(mesh: &Mesh) {
    let mut is_used = vec![false; mesh.positions.len()];
    for [a, b, c] in &mesh.faces {
        assert!(a != b && b != c && c != a, "repeated vertex");
        for v in [a, b, c] {
            is_used[*v as usize] = true;
        }
    }
    assert!(is_used.iter().all(|u| *u), "unreferenced vertex");
    assert!(mesh.positions.iter().all(|p| p.is_finite()));
    let mut is_used = vec![false; mesh.n_wedges()];
    mesh.face_wedges.iter().flatten().for_each(|w| is_used[*w as usize] = true);
    assert!(is_used.iter().all(|u| *u), "unreferenced wedge");
    let n_face_wedges = if mesh.layers.is_empty() { 0 } else { mesh.faces.len() };
    assert_eq!(mesh.face_wedges.len(), n_face_wedges);
    for layer in &mesh.layers {
        assert_eq!(layer.values.len(), mesh.n_wedges() * layer.width);
        assert!(layer.values.iter().all(|v| v.is_finite()));
    }
    assert!(mesh.face_materials.is_empty() || mesh.face_materials.len() == mesh.faces.len());
    let n_materials = mesh.materials.len().max(1) as u32;
    assert!(mesh.face_materials.iter().all(|m| *m < n_materials));
}

/// A GLB of a JSON text and a binary chunk.
fn glb(json: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 28 + text.len() + bin.len();
    let word = |n: usize| (n as u32).to_le_bytes();
    let parts: [&[u8]; 9] = [
        b"glTF\x02\0\0\0",
        &word(length),
        &word(text.len()),
        b"JSON",
        &text,
        &word(bin.len()),
        b"BIN\0",
        bin,
        b"",
    ];
    parts.concat()
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The corners of the unit square, which 0 1 2 and 2 1 3 cut in two, and after them those
/// indices as 16-bit integers: 48 + 12 bytes.
fn square_bin() -> Vec<u8> {
    let mut bin = bytes_of(&[0., 0., 0., 1., 0., 0., 0., 1., 0., 1., 1., 0.]);
    bin.extend([0_u16, 1, 2, 2, 1, 3].iter().flat_map(|i| i.to_le_bytes()));
    bin
}

/// A document that places the square of [`square_bin`] once.
fn square_json() -> Value {
    json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "name": "square", "primitives": [{
            "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 48 },
            { "buffer": 0, "byteOffset": 48, "byteLength": 12 },
        ],
        "buffers": [{ "byteLength": 60 }],
    })
}

/// The square with texture coordinates and a texture for each of the images; material 0 shows
/// the first. `edit` has the last word.
fn textured_glb(images: &[Vec<u8>], edit: impl FnOnce(&mut Value)) -> Vec<u8> {
    let (mut json, mut bin) = (square_json(), square_bin());
    let coordinates = bytes_of(&[0., 0., 1., 0., 0., 1., 1., 1.]);
    for bytes in [&coordinates].into_iter().chain(images) {
        let view = json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": bytes.len() });
        json["bufferViews"].as_array_mut().unwrap().push(view);
        bin.extend(bytes);
        bin.resize(bin.len().next_multiple_of(4), 0);
    }
    json["buffers"][0]["byteLength"] = bin.len().into();
    let accessor = json!({ "bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2" });
    json["accessors"].as_array_mut().unwrap().push(accessor);
    let primitive = &mut json["meshes"][0]["primitives"][0];
    primitive["attributes"]["TEXCOORD_0"] = 2.into();
    primitive["material"] = 0.into();
    json["images"] = (0..images.len()).map(|i| json!({ "bufferView": 3 + i })).collect();
    json["textures"] = (0..images.len()).map(|i| json!({ "source": i })).collect();
    json["materials"] = json!([{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }]);
    edit(&mut json);
    glb(&json, &bin)
}

/// A picture of one colour.
fn encoded(format: ImageFormat, [width, height]: [u32; 2], rgb: [u8; 3]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    RgbImage::from_pixel(width, height, Rgb(rgb)).write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn png() -> Vec<u8> {
    encoded(ImageFormat::Png, [3, 2], [200, 100, 50])
}

fn square_glb() -> Vec<u8> {
    glb(&square_json(), &square_bin())
}
