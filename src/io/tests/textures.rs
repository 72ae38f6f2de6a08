//! Textures: read from glTF, carried, written to GLB.

use base64::{Engine, engine::general_purpose::STANDARD};

use super::{models::model, *};
use crate::{
    io::write_glb,
    mesh::{Material, Texture, TextureUse, Wrap},
};

/// The JSON chunk of a GLB.
fn json_of(glb: &[u8]) -> Value {
    let n = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + n]).unwrap()
}

/// Written and read again: the same appearance. Returns the JSON that was written.
#[track_caller]
fn check_trip(mesh: &Mesh) -> Value {
    let bytes = write_glb(mesh).unwrap();
    let again = load("a.glb", &bytes).unwrap().mesh;
    assert_eq!(again.materials, mesh.materials);
    assert_eq!(again.textures, mesh.textures);
    assert_eq!(again.images, mesh.images);
    assert_eq!(write_glb(&again).unwrap().len(), bytes.len());
    json_of(&bytes)
}

#[test]
fn everything_is_carried() {
    let images = [
        png(),
        encoded(ImageFormat::Jpeg, [8, 8], [1; 3]),
        encoded(ImageFormat::WebP, [2, 2], [5; 3]),
    ];
    let materials = json!([
        { "name": "a", "alphaMode": "BLEND", "extras": { "k": [1, 2.5, null], "extensions": { "X": 1 } },
          "pbrMetallicRoughness": {
              "baseColorFactor": [0.1, 0.2, 0.3, 0.4], "metallicFactor": 0.123_456_789_012_345,
              "baseColorTexture": { "index": 2, "texCoord": 0, "extensions": {
                  "KHR_texture_transform": { "offset": [0.5, 0], "scale": [2, 2] } } } } },
        { "normalTexture": { "index": 1, "scale": 0.5 },
          "extensions": { "KHR_materials_ior": { "ior": 1.4 } } },
        {},
    ]);
    let bytes = textured_glb(&images, |json| {
        json["materials"] = materials.clone();
        json["samplers"] = json!([
            { "wrapS": 33071, "wrapT": 33648, "magFilter": 9728, "minFilter": 9987 },
            { "wrapS": 10497 },
        ]);
        json["textures"] = json!([
            { "name": "t0", "sampler": 0, "source": 1 },
            { "sampler": 1, "source": 0 },
            { "sampler": 0, "source": 0, "extensions": { "EXT_texture_webp": { "source": 2 } } },
        ]);
        json["images"][1]["name"] = "second".into();
    });
    let Ingest { mesh, report, .. } = load("a.glb", &bytes).unwrap();
    let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
    assert_eq!(codes, ["textures_not_evaluated"]);
    let sources: Vec<_> = mesh.materials.iter().map(|m| m.source.clone().unwrap()).collect();
    assert_eq!(json!(sources), materials);
    let wrap = [Wrap::Clamp, Wrap::Mirror];
    let filters = [Some(9728), Some(9987)];
    let texture = Texture { wrap, filters, ..Texture::default() };
    let expected = [
        Texture { name: "t0".to_owned(), image: Some(1), ..texture.clone() },
        Texture { image: Some(0), ..Texture::default() },
        Texture { image: Some(2), fallback: Some(0), ..texture },
    ];
    assert_eq!(mesh.textures, expected);
    let transform = [[2.0, 0.0, 0.5], [0.0, 2.0, 0.0]];
    let base_texture = Some(TextureUse { texture: 2, tex_coord: 0, transform });
    assert_eq!(mesh.materials[0].base_texture, base_texture);
    let read: Vec<_> = mesh.images.iter().map(|i| (i.mime.as_str(), i.bytes.to_vec())).collect();
    let [a, b, c] = images;
    assert_eq!(read, [("image/png", a), ("image/jpeg", b), ("image/webp", c)]);
    assert!(mesh.images[2].pixels.is_some() && mesh.images[0].pixels.is_none());
    let json = check_trip(&mesh);
    assert_eq!(json["materials"], materials);
    let used = json!(["EXT_texture_webp", "KHR_materials_ior", "KHR_texture_transform"]);
    assert_eq!((&json["extensionsUsed"], json.get("extensionsRequired")), (&used, None));
    assert_eq!(json["samplers"].as_array().unwrap().len(), 1);
}

/// A WebP image without a fallback must be understood.
#[test]
fn webp_alone_is_required() {
    let bytes = textured_glb(&[encoded(ImageFormat::WebP, [2, 2], [5; 3])], |json| {
        json["extensionsRequired"] = json!(["EXT_texture_webp"]);
        json["textures"] = json!([{ "extensions": { "EXT_texture_webp": { "source": 0 } } }]);
    });
    let json = check_trip(&load("a.glb", &bytes).unwrap().mesh);
    assert_eq!(json["extensionsRequired"], json!(["EXT_texture_webp"]));
    assert_eq!(json["textures"][0].get("source"), None);
}

/// Reads the square after an edit; the notes must be these, and a trip changes nothing but what
/// is not there.
#[track_caller]
fn check_broken(edit: impl FnOnce(&mut Value), code: &str, said: &str) -> Mesh {
    let Ingest { mesh, report, .. } = load("a.glb", &textured_glb(&[png(), png()], edit)).unwrap();
    let text: Vec<_> = report.notes.iter().map(|n| (n.code, n.text.as_str())).collect();
    let is_said = text.iter().any(|(c, t)| *c == code && t.contains(said));
    assert!(is_said, "{code}, {said}: {text:#?}");
    let again = load("a.glb", &write_glb(&mesh).unwrap()).unwrap();
    let codes: Vec<_> = again.report.notes.iter().map(|n| n.code).collect();
    assert!(codes.is_empty(), "what was written is whole: {codes:?}");
    mesh
}

#[test]
fn broken_references_count_as_absent() {
    let code = "texture_reference_broken";
    let base = "/materials/0/pbrMetallicRoughness/baseColorTexture";
    let mesh = check_broken(
        |json| json.pointer_mut(base).unwrap()["index"] = 7.into(),
        code,
        "material 0 names texture 7, but there are 2",
    );
    assert!(mesh.materials[0].base_texture.is_none() && mesh.materials[0].source.is_some());
    let mesh = check_broken(
        |json| json["textures"][0]["source"] = 7.into(),
        code,
        "texture 0 names image 7, but there are 2",
    );
    assert_eq!(mesh.textures[0].image, None);
    let mesh = check_broken(
        |json| {
            json["materials"][0]["emissiveFactor"] = json!([1, 1, 1]);
            json["materials"][0]["emissiveTexture"] = json!({ "index": 7 });
        },
        code,
        "material 0 names texture 7, but there are 2",
    );
    assert!(mesh.glow_of(&mesh.materials[0]).is_some_and(|glow| glow.texture.is_none()));
    check_broken(
        |json| json["textures"][0]["sampler"] = 7.into(),
        code,
        "texture 0 names sampler 7, but there are 0",
    );
    check_broken(
        |json| json["textures"][0]["extensions"] = json!({ "EXT_texture_webp": { "source": 9 } }),
        code,
        "texture 0 names image 9, but there are 2",
    );
}

#[test]
fn images_that_are_not_there_are_named() {
    let code = "image_missing";
    let named = |image: Value| {
        move |json: &mut Value| {
            json["images"][0] = image;
            json["images"][0]["name"] = "bark".into();
        }
    };
    for (image, said) in [
        (json!({ "uri": "bark.png" }), "it is in another file, 'bark.png'; pack the model as GLB"),
        (json!({ "uri": "data:image/png;base64,*" }), "its base64 text is bad"),
        (json!({ "bufferView": 99 }), "its bytes (buffer view 99) are not in the file"),
        (json!({}), "it has no bytes"),
    ] {
        let mesh = check_broken(named(image), code, &format!("image 0 'bark' is left out: {said}"));
        assert!(mesh.images[0].bytes.is_empty() && mesh.images[0].pixels.is_none());
        assert_eq!(mesh.textures[0].image, Some(0), "indices stay");
    }
    // Views that overlap cannot swell what is kept.
    let overlap = |json: &mut Value| {
        let view = json["bufferViews"][3].clone();
        for i in 0..200 {
            json["bufferViews"].as_array_mut().unwrap().push(view.clone());
            json["images"].as_array_mut().unwrap().push(json!({ "bufferView": 5 + i }));
        }
        // The text of the views counts as bytes of the file.
        json["bufferViews"][4]["byteOffset"] = 0.into();
        let n = json["buffers"][0]["byteLength"].clone();
        (5..205).for_each(|i| {
            json["bufferViews"][i]["byteOffset"] = 0.into();
            json["bufferViews"][i]["byteLength"] = n.clone();
        });
    };
    check_broken(overlap, code, "it overlaps other images");
}

#[test]
fn data_uris_hold_images_too() {
    let uri = format!("data:image/png;base64,{}", STANDARD.encode(png()));
    let bytes = textured_glb(&[], |json| {
        json["images"] = json!([{ "uri": uri }]);
        json["textures"] = json!([{ "source": 0 }]);
    });
    let Ingest { mesh, report, .. } = load("a.glb", &bytes).unwrap();
    assert_eq!(&*mesh.images[0].bytes, png());
    assert!(mesh.images[0].pixels.is_some() && report.notes.is_empty());
    assert_eq!(check_trip(&mesh)["images"][0], json!({ "bufferView": 3, "mimeType": "image/png" }));
}

/// The diffuse texture of specular-glossiness materials stands in where there is no other.
#[test]
fn specular_glossiness_gives_base_colours() {
    let glossy = json!({ "KHR_materials_pbrSpecularGlossiness": {
        "diffuseFactor": [0.5, 0.25, 1, 1], "diffuseTexture": { "index": 1 } } });
    let own = json!({ "baseColorTexture": { "index": 0 } });
    for (material, texture, color) in [
        (json!({ "extensions": glossy }), 1, [0.5, 0.25, 1.0, 1.0]),
        (json!({ "extensions": glossy, "pbrMetallicRoughness": {} }), 1, [0.5, 0.25, 1.0, 1.0]),
        (json!({ "extensions": glossy, "pbrMetallicRoughness": own }), 0, [1.0; 4]),
    ] {
        let bytes = textured_glb(&[png(), png()], |json| {
            json["materials"] = json!([material]);
            json["extensionsUsed"] = json!(["KHR_materials_pbrSpecularGlossiness"]);
        });
        let Ingest { mesh, report, .. } = load("a.glb", &bytes).unwrap();
        let found = &mesh.materials[0];
        assert_eq!((found.base_texture.unwrap().texture, found.base_color), (texture, color));
        let codes: Vec<_> = report.notes.iter().map(|n| n.code).collect();
        let others = (texture == 0).then_some("textures_not_evaluated");
        let expected: Vec<_> =
            others.into_iter().chain(["specular_glossiness_not_evaluated"]).collect();
        assert_eq!(codes, expected);
        check_trip(&mesh);
    }
}

/// What is given off: factor, strength and texture are read, the image is decoded, and what pictures do not show as it
/// is gets a note.
#[test]
fn emissive_colours_are_read() {
    let shifted = json!({ "KHR_texture_transform": { "offset": [0.5, 0] } });
    let strong = json!({ "KHR_materials_emissive_strength": { "emissiveStrength": 3 } });
    let unlit = json!({ "KHR_materials_unlit": {} });
    for (texture, extensions, light, codes) in [
        (json!({ "index": 1 }), strong, Some((0.75, Some(1))), &[][..]),
        (Value::Null, json!({}), Some((0.25, None)), &[]),
        (json!({ "index": 1 }), unlit, None, &["textures_not_evaluated"]),
        (
            json!({ "index": 1, "extensions": shifted }),
            json!({}),
            Some((0.25, Some(1))),
            &["emissive_texture_averaged"],
        ),
    ] {
        let bytes = textured_glb(&[png(), png()], |json| {
            json["materials"][0]["emissiveFactor"] = json!([0.25, 0, 1]);
            json["materials"][0]["emissiveTexture"] = texture;
            json["materials"][0]["extensions"] = extensions;
        });
        let Ingest { mesh, report, .. } = load("a.glb", &bytes).unwrap();
        let found = mesh.materials[0].emission();
        let red = found.map(|found| (found.factor[0], found.texture.map(|at| at.texture)));
        assert_eq!(red, light);
        let is_shown = light.is_some_and(|(_, texture)| texture == Some(1));
        assert_eq!(mesh.images[1].pixels.is_some(), is_shown);
        assert_eq!(report.notes.iter().map(|n| n.code).collect::<Vec<_>>(), codes);
        check_trip(&mesh);
    }
}

/// Materials of other origin are written from their fields.
#[test]
fn materials_without_source_are_written_from_fields() {
    let mut mesh = load("a.glb", &textured_glb(&[png()], |_| {})).unwrap().mesh;
    let transform = [[0.0, 2.0, 0.5], [-3.0, 0.0, 0.25]];
    mesh.materials[0] = Material {
        base_texture: Some(TextureUse { texture: 0, tex_coord: 0, transform }),
        ..Material::default()
    };
    let bytes = write_glb(&mesh).unwrap();
    let found = load("a.glb", &bytes).unwrap().mesh.materials[0].base_texture.unwrap();
    let pairs = found.transform.as_flattened().iter().zip(transform.as_flattened());
    assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
    assert_eq!(json_of(&bytes)["extensionsUsed"], json!(["KHR_texture_transform"]));
}

/// Sets of coordinates are numbered without gaps, and materials say so.
#[test]
fn sets_of_coordinates_are_renumbered() {
    let mut mesh = load("a.glb", &textured_glb(&[png()], |_| {})).unwrap().mesh;
    mesh.layers[0].semantic = crate::mesh::Semantic::TexCoord(3);
    mesh.materials[0].source = Some(json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0, "texCoord": 3 } },
        "normalTexture": { "index": 0, "texCoord": 1,
            "extensions": { "KHR_texture_transform": { "texCoord": 3 } } },
    }));
    let json = json_of(&write_glb(&mesh).unwrap());
    let material = &json["materials"][0];
    assert_eq!(material["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"], 0);
    let transform = &material["normalTexture"]["extensions"]["KHR_texture_transform"];
    assert_eq!(transform["texCoord"], 0);
}

/// File, images, base textures that are drawn.
const MODELS: [(&str, usize, usize); 6] = [
    ("barramundi_fish.glb", 1, 1),
    ("corset.glb", 2, 1),
    ("flight_helmet.glb", 15, 5),
    ("dutch_ship.glb", 9, 3),
    ("spot_cow.glb", 1, 1),
    ("house_scene.glb", 1, 1),
];

#[test]
fn models_keep_their_textures() {
    for (name, n_images, n_drawn) in MODELS {
        let Some(bytes) = model(name) else { continue };
        let mesh = load(name, &bytes).unwrap().mesh;
        let is_drawn = |m: &Material| {
            let texture = &mesh.textures[m.base_texture?.texture as usize];
            mesh.images[texture.image? as usize].pixels.as_ref()
        };
        let n_textured = mesh.materials.iter().filter(|m| m.base_texture.is_some()).count();
        assert_eq!(mesh.materials.iter().filter_map(is_drawn).count(), n_textured, "{name}");
        let drawn = mesh.images.iter().filter(|image| image.pixels.is_some()).count();
        assert_eq!((mesh.images.len(), drawn), (n_images, n_drawn), "{name}");
        let (json, written) = (json_of(&bytes), json_of(&write_glb(&mesh).unwrap()));
        assert_eq!(written["materials"], json["materials"], "{name}");
        let again = load(name, &write_glb(&mesh).unwrap()).unwrap().mesh;
        assert_eq!((again.textures, again.images), (mesh.textures, mesh.images), "{name}");
    }
}
