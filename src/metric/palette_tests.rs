//! Tests of the textures that pictures show.

use std::sync::Arc;

use glam::DVec3;
use serde_json::{Value, json};

use super::Palette;
use crate::{
    mesh::{AttributeLayer, Image, Material, Mesh, Pixels, Semantic, Texture, TextureUse},
    metric::{Metric, Pictures, bounding_sphere, is_white, reference_pictures},
    render::{
        RenderParams, Shading,
        view::{Projection, ViewParams, cameras},
    },
};

/// A square that faces the viewer, of one material.
fn wall(source: Value, alpha: f32) -> Mesh {
    let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
    let mut mesh = Mesh::from_parts(
        vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
        vec![[0, 1, 2], [0, 2, 3]],
    );
    let base_color = [1.0, 1.0, 1.0, alpha];
    mesh.materials = vec![Material { base_color, source: Some(source), ..Material::default() }];
    mesh
}

/// A mesh from the front, lit from there; the background is black.
fn picture(mesh: &Mesh, hides_back_faces: bool) -> Vec<u8> {
    let params = RenderParams {
        image_size: 128,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 0,
        interior_views: 0,
        hides_back_faces,
    };
    let view_params = ViewParams {
        directions: vec![DVec3::Z],
        fov_degrees: 60.0,
        projection: Projection::Orthographic,
        light_degrees: 0.0,
    };
    let views = cameras(&bounding_sphere(mesh), &view_params);
    reference_pictures(mesh, &Pictures::of(mesh, params, views)).pictures.remove(0)
}

/// The share of the wall's pixels that it covers.
fn share_seen(mesh: &Mesh) -> f64 {
    share_seen_where(mesh, false)
}

fn share_seen_where(mesh: &Mesh, hides_back_faces: bool) -> f64 {
    let seen = |mesh: &Mesh| {
        let picture = picture(mesh, hides_back_faces);
        picture.into_iter().filter(|lum| *lum > 0).count() as f64
    };
    seen(mesh) / seen(&wall(Value::Null, 1.0))
}

#[test]
fn alpha_says_how_much_of_a_surface_is_there() {
    let (mask, blend) =
        (json!({ "alphaMode": "MASK", "alphaCutoff": 0.4 }), json!({ "alphaMode": "BLEND" }));
    for (source, alpha, expected) in [
        (json!({ "alphaMode": "OPAQUE" }), 0.0, 1.0),
        (mask.clone(), 0.41, 1.0),
        (mask, 0.39, 0.0),
        (json!({ "alphaMode": "MASK" }), 0.49, 0.0),
        (blend.clone(), 0.25, 0.25),
        (blend.clone(), 0.0, 0.0),
        (blend, 1.0, 1.0),
    ] {
        let found = share_seen(&wall(source.clone(), alpha));
        assert!((found - expected).abs() < 0.01, "{source} {alpha}: {found}");
    }
    assert!(is_white(&wall(Value::Null, 0.5)));
    assert!(!is_white(&wall(json!({ "alphaMode": "BLEND" }), 0.5)));
}

#[test]
fn backs_of_single_sided_materials_can_be_hidden() {
    for (double_sided, is_turned, hides, expected) in [
        (false, true, true, 0.0),
        (false, true, false, 1.0),
        (false, false, true, 1.0),
        (true, true, true, 1.0),
    ] {
        let mut mesh = wall(Value::Null, 1.0);
        mesh.materials[0].double_sided = double_sided;
        if is_turned {
            mesh.faces.iter_mut().for_each(|face| face.swap(1, 2));
        }
        assert_eq!(share_seen_where(&mesh, hides), expected, "{double_sided} {is_turned} {hides}");
    }
}

/// Seen from so far that several texels fall into a pixel, a fence of thin bars covers as much as from near by.
#[test]
fn masks_keep_their_share_at_coarse_levels() {
    let side = 2048;
    let bar = |x: u32, y: u32| u8::from((x / 3 + y / 5).is_multiple_of(4)) * 255;
    let texel = |k: u32| [255, 255, 255, bar(k % side, k / side)];
    let rgba = (0..side * side).flat_map(texel).collect();
    let mut mesh = wall(json!({ "alphaMode": "MASK" }), 1.0);
    mesh.images = vec![Image {
        pixels: Some(Arc::new(Pixels { width: side, height: side, rgba })),
        ..Image::default()
    }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let transform = [[0.5, 0.0, 0.5], [0.0, 0.5, 0.5]];
    mesh.materials[0].base_texture = Some(TextureUse { texture: 0, tex_coord: 0, transform });
    lay_coordinates(&mut mesh);
    let found = share_seen(&mesh);
    assert!((found - 0.25).abs() < 0.04, "{found}");
}

/// Texture coordinates that are the places on the wall, in two sets.
fn lay_coordinates(mesh: &mut Mesh) {
    mesh.face_wedges = mesh.faces.clone();
    let values: Vec<f32> = mesh.positions.iter().flat_map(|p| [p.x as f32, p.y as f32]).collect();
    let layer = |set| AttributeLayer {
        semantic: Semantic::TexCoord(set),
        width: 2,
        values: values.clone(),
    };
    mesh.layers = vec![layer(0), layer(1)];
}

/// A wall with a base texture, grey, and an image that is black on the left and white on the right.
fn glowing_wall(base_color: [f32; 4], is_textured: bool, source: Value) -> Mesh {
    let mut mesh = wall(source, 1.0);
    lay_coordinates(&mut mesh);
    let image = |width: u32, rgba: Vec<u8>| Image {
        pixels: Some(Arc::new(Pixels { width, height: 1, rgba })),
        ..Image::default()
    };
    mesh.images = vec![image(1, vec![51, 51, 51, 255]), image(8, [[0; 16], [255; 16]].concat())];
    let texture = |image| Texture { image, ..Texture::default() };
    mesh.textures = [Some(0), Some(1), None].map(texture).into();
    let at = TextureUse { texture: 0, tex_coord: 0, transform: FROM_PLACES };
    mesh.materials[0].base_color = base_color;
    mesh.materials[0].base_texture = is_textured.then_some(at);
    mesh
}

/// From places on the wall, -1 to 1, to the texture.
const FROM_PLACES: [[f32; 3]; 2] = [[0.5, 0.0, 0.5], [0.0, 0.5, 0.5]];

#[test]
fn what_is_given_off_is_added_to_what_is_lit() {
    let transform =
        json!({ "KHR_texture_transform": { "offset": [0.5, 0.5], "scale": [0.5, 0.5] } });
    let textured =
        |tex_coord: u32| json!({ "index": 1, "texCoord": tex_coord, "extensions": transform });
    let strong = |strength: f64| json!({ "KHR_materials_emissive_strength": { "emissiveStrength": strength } });
    let source = |factor: [f64; 3], texture: Value, strength: f64| json!({ "emissiveFactor": factor, "emissiveTexture": texture, "extensions": strong(strength) });
    let (black, half, grey) = ([0.0, 0.0, 0.0, 1.0], [0.5, 0.5, 0.5, 1.0], [0.2; 3]);
    for (base_color, is_textured, source, [left, right]) in [
        // A factor alone, its strength, and no more than white; each channel up to full scale.
        (black, false, source(grey, Value::Null, 1.0), [51, 51]),
        (black, false, source(grey, Value::Null, 2.0), [102, 102]),
        (half, false, source(grey, Value::Null, 1.0), [179, 179]),
        (half, false, source(grey, Value::Null, 99.0), [255, 255]),
        (black, false, source([0.0, 0.0, 1.0], Value::Null, 99.0), [18, 18]),
        (half, true, source(grey, Value::Null, 1.0), [77, 77]),
        // A texture where the base texture is, or without one.
        (black, false, source([1.0; 3], textured(0), 1.0), [0, 255]),
        (half, true, source(grey, textured(0), 1.0), [26, 77]),
        (half, true, source(grey, textured(0), 2.0), [26, 128]),
        // Elsewhere than the base texture: its mean. Where there is none, it lies where it will.
        (half, true, source(grey, textured(1), 1.0), [51, 51]),
        (black, false, source(grey, textured(1), 1.0), [0, 51]),
        // Its coordinates are not there: its mean. Its image is not there: nothing. There is none: the factor.
        (black, false, source(grey, textured(2), 1.0), [26, 26]),
        (half, false, source(grey, json!({ "index": 2 }), 1.0), [128, 128]),
        (half, false, source(grey, json!({ "index": 7 }), 1.0), [179, 179]),
    ] {
        let mesh = glowing_wall(base_color, is_textured, source.clone());
        let picture = picture(&mesh, false);
        // A single camera is rolled by half a turn: what is on the right of the picture is on the wall's left.
        let seen = [78, 50].map(|i| picture[64 * 128 + i]);
        let is_near = seen.iter().zip([left, right]).all(|(a, b)| a.abs_diff(b) <= 1);
        assert!(
            is_near,
            "{seen:?}, not {:?}: {source} {base_color:?} {is_textured}",
            [left, right]
        );
        assert!(!is_white(&mesh), "{source}");
    }
}

#[test]
fn unlit_materials_give_nothing_off_and_black_textures_cost_nothing() {
    let mut mesh = glowing_wall([0.5; 4], false, json!({ "emissiveFactor": [1, 1, 1] }));
    mesh.materials[0].unlit = true;
    assert!(picture(&mesh, false).contains(&128) && !picture(&mesh, false).contains(&255));
    assert!(Palette::of(&mesh, 128, Metric::Luminance).is_empty());
    let source = json!({ "emissiveFactor": [1, 1, 1], "emissiveTexture": { "index": 1 } });
    let mut mesh = glowing_wall([0.5; 4], false, source);
    assert!(Palette::of(&mesh, 128, Metric::Luminance).texels().has_glow());
    mesh.images[1].pixels = Some(Arc::new(Pixels { width: 1, height: 1, rgba: vec![0; 4] }));
    assert!(!Palette::of(&mesh, 128, Metric::Luminance).texels().has_glow());
}

#[test]
fn materials_that_differ_in_what_they_give_off_share_no_texture() {
    let mut mesh = glowing_wall([0.5; 4], true, json!({ "emissiveFactor": [1, 1, 1] }));
    let first = mesh.materials[0].clone();
    let other = |source: Value| Material { source: Some(source), ..first.clone() };
    mesh.materials.extend([
        other(json!({ "emissiveFactor": [1, 1, 1], "name": "the same" })),
        other(json!({ "emissiveFactor": [1, 1, 0] })),
        other(Value::Null),
    ]);
    let palette = Palette::of(&mesh, 128, Metric::Luminance);
    let maps: Vec<_> = (0..4).map(|k| palette.painting(k).unwrap().map).collect();
    assert_eq!(maps, [0, 0, 1, 2]);
}
