//! Tests of the off-line rasteriser.

use std::{convert::Infallible, sync::Arc};

use super::*;
use crate::{
    mesh::{AttributeLayer, Image, Material, Pixels, Texture},
    render::view::{BoundingSphere, ViewParams, camera},
};

fn front_view(sphere: &BoundingSphere) -> View {
    let params = ViewParams {
        directions: Vec::new(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 0.0,
    };
    camera(sphere, &params, DVec3::Z, 0.0)
}

/// A square that faces the viewer and fills the whole picture.
fn wall() -> Mesh {
    let corner = |x: f64, y: f64| DVec3::new(9.0 * x, 9.0 * y, 0.0);
    Mesh::from_parts(
        vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
        vec![[0, 1, 2], [0, 2, 3]],
    )
}

fn small() -> Look {
    Look { image_size: 16, ..Look::default() }
}

fn draw(mesh: &Mesh, look: &Look) -> Vec<[f32; 1]> {
    let unit = BoundingSphere { center: DVec3::ZERO, radius: 1.0 };
    let drawable = Drawable::luminance(mesh, look);
    let Ok(mut drawn) =
        pictures(&drawable, &[front_view(&unit)], look, &|_| Ok::<_, Infallible>(()));
    drawn.remove(0)
}

#[test]
fn a_wall_lit_from_the_front_is_white_on_both_sides() {
    let mut mesh = wall();
    for shading in [Shading::Flat, Shading::Smooth] {
        for _side in 0..2 {
            let look = Look { shading, ..small() };
            assert!(draw(&mesh, &look).iter().all(|p| (p[0] - 1.0).abs() < 1e-6));
            mesh.faces.iter_mut().for_each(|f| f.reverse());
        }
    }
}

#[test]
fn an_edge_through_a_pixel_is_anti_aliased() {
    // The wall's left half only: its border runs through the middle of the picture, moved a
    // quarter of a pixel to the right, so that column 8 is a quarter covered.
    let mut mesh = wall();
    let pixel = 2.0 / (16.0 * 3.0_f64.sqrt()) * 2.0;
    mesh.positions[1].x = pixel * 0.25;
    mesh.positions[2].x = pixel * 0.25;
    let row = &draw(&mesh, &small())[16 * 5..16 * 6];
    assert_eq!(row[7], [1.0]);
    assert!((row[8][0] - (0.25 + 0.75 * 0.5)).abs() < 1e-6, "{row:?}");
    assert_eq!(row[9], [0.5]);
}

#[test]
fn colours_are_base_times_vertex_colour() {
    let mut mesh = wall();
    mesh.materials = vec![Material { base_color: [0.5, 0.5, 0.5, 1.0], ..Material::default() }];
    mesh.face_wedges = mesh.faces.clone();
    mesh.layers = vec![AttributeLayer {
        semantic: Semantic::Color(0),
        width: 4,
        values: [0.0, 1.0, 0.0, 1.0].repeat(4),
    }];
    let look = Look { appearance: Appearance::Coloured, ..small() };
    assert!(draw(&mesh, &look).iter().all(|p| (p[0] - 0.5 * 0.7152).abs() < 1e-6));
    assert!(draw(&mesh, &small()).iter().all(|p| (p[0] - 1.0).abs() < 1e-6));
}

#[test]
fn backs_of_single_sided_materials_can_be_left_out() {
    for (double_sided, turned, expected) in
        [(false, false, 1.0), (false, true, 0.5), (true, true, 1.0), (true, false, 1.0)]
    {
        let mut mesh = wall();
        mesh.materials = vec![Material { double_sided, ..Material::default() }];
        if turned {
            mesh.faces.iter_mut().for_each(|face| face.swap(1, 2));
        }
        let look = Look { hides_back_faces: true, ..small() };
        assert!(draw(&mesh, &look).iter().all(|p| (p[0] - expected).abs() < 1e-6));
        assert!(draw(&mesh, &small()).iter().all(|p| (p[0] - 1.0).abs() < 1e-6));
    }
}

#[test]
fn what_is_transparent_shows_what_lies_behind() {
    for (source, alpha, expected) in [
        (r#"{"alphaMode": "MASK", "alphaCutoff": 0.4}"#, 0.3, 0.5),
        (r#"{"alphaMode": "MASK", "alphaCutoff": 0.4}"#, 0.5, 1.0),
        (r#"{"alphaMode": "BLEND"}"#, 0.5, 0.75),
        (r#"{"alphaMode": "BLEND"}"#, 0.0, 0.5),
        (r#"{"alphaMode": "OPAQUE"}"#, 0.5, 1.0),
    ] {
        let mut mesh = wall();
        let base_color = [1.0, 1.0, 1.0, alpha];
        let source = serde_json::from_str(source).unwrap();
        mesh.materials = vec![Material { base_color, source, ..Material::default() }];
        let look = Look { appearance: Appearance::Coloured, ..small() };
        let drawn = draw(&mesh, &look);
        assert!(drawn.iter().all(|p| (p[0] - expected).abs() < 1e-3), "{expected}: {:?}", drawn[0]);
    }
}

/// The same wall as `metric::palette`'s: what evaluators see, these pictures show.
#[test]
fn what_is_given_off_is_added_to_what_is_lit() {
    for (base, source, expected) in [
        (0.0, r#"{"emissiveFactor": [0.2, 0.2, 0.2]}"#, 0.2),
        (0.5, r#"{"emissiveFactor": [0.2, 0.2, 0.2]}"#, 0.7),
        (0.5, r#"{"emissiveFactor": [9, 9, 9]}"#, 1.0),
        (0.0, r#"{"emissiveFactor": [0, 0, 9]}"#, 0.0722),
        (0.5, r#"{"emissiveFactor": [0.2, 0.2, 0.2], "emissiveTexture": {"index": 0}}"#, 0.6),
        (0.5, r#"{"emissiveFactor": [0.2, 0.2, 0.2], "emissiveTexture": {"index": 1}}"#, 0.7),
        (0.5, r#"{"emissiveFactor": [0, 0, 0], "emissiveTexture": {"index": 0}}"#, 0.5),
    ] {
        let mut mesh = wall();
        let base_color = [base, base, base, 1.0];
        let source = serde_json::from_str(source).unwrap();
        mesh.materials = vec![Material { base_color, source, ..Material::default() }];
        let pixels = Pixels { width: 1, height: 1, rgba: vec![128, 128, 128, 255] };
        mesh.images = vec![Image { pixels: Some(Arc::new(pixels)), ..Image::default() }];
        mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
        let look = Look { appearance: Appearance::Coloured, ..small() };
        let drawn = draw(&mesh, &look);
        let is_so = |p: &[f32; 1]| (p[0] - expected).abs() < 5e-3;
        assert!(drawn.iter().all(is_so), "{expected}: {:?}", drawn[0]);
    }
}

#[test]
fn smooth_normals_join_at_equal_positions() {
    // Two triangles folded by a right angle along an edge that each has its own vertices for.
    let mesh = Mesh::from_parts(
        vec![
            DVec3::ZERO,
            DVec3::X,
            DVec3::Y,
            DVec3::new(-0.0, 0.0, 0.0),
            DVec3::Y,
            DVec3::new(0.0, 0.0, 1.0),
        ],
        vec![[0, 1, 2], [3, 4, 5]],
    );
    let normals = smooth_normals(&mesh, &area_normals(&mesh));
    assert_eq!(normals[0], normals[3]);
    assert!(normals[0].distance(DVec3::new(1.0, 0.0, 1.0).normalize_or_zero()) < 1e-12);
    assert_eq!(normals[1], DVec3::Z);
}

#[test]
fn stored_normals_take_the_place_of_derived_ones() {
    let mut mesh = Mesh::from_parts(vec![DVec3::ZERO, DVec3::X, DVec3::Y], vec![[0, 1, 2]]);
    mesh.face_wedges = vec![[0, 1, 2]];
    let values = vec![3.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0];
    mesh.layers = vec![AttributeLayer { semantic: Semantic::Normal, width: 3, values }];
    let smooth = Look { shading: Shading::Smooth, ..small() };
    let drawn = Drawable::luminance(&mesh, &smooth).with_stored_normals();
    assert_eq!(drawn.corner_normals, [[DVec3::X, DVec3::Y, DVec3::ZERO]]);
    let flat = Drawable::luminance(&mesh, &small()).with_stored_normals();
    assert!(flat.corner_normals.is_empty());
}

#[test]
fn an_empty_mesh_leaves_the_background() {
    assert!(draw(&Mesh::default(), &small()).iter().all(|p| p[0] == 0.5));
}
