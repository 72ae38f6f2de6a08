//! Slopes against differences: what the energy does on the way from one place to another is the sum of
//! the slopes along the way. (At one place alone the energy in pixels is a staircase.)

use std::sync::Arc;

use glam::DVec3;
use serde_json::json;

use super::{
    Attributes, Metric, Pictures, Slopes, Unknown, ViewSet, bounding_sphere, scene_of_edit_mesh,
    scene_with_normals, slopes, with_vertex_normals,
};
use crate::{
    mesh::{
        AttributeLayer, EditMesh, Image, Material, Mesh, Pixels, Semantic, Texture, TextureUse,
        VertexId, shapes,
    },
    render::{
        self, RenderParams, Scene, Shading,
        view::{Projection, ViewParams, cameras, directions},
    },
};

/// The same mesh, dark on one side and bright on the other.
fn coloured(mut mesh: Mesh) -> Mesh {
    if mesh.layers.is_empty() {
        mesh.face_wedges.clone_from(&mesh.faces);
    }
    let mut values = vec![0.0; 4 * mesh.positions.len()];
    for (vertices, wedges) in mesh.faces.iter().zip(&mesh.face_wedges) {
        for (v, w) in vertices.iter().zip(wedges) {
            let bright = 0.5 + 0.4 * libm::sin(3.0 * mesh.positions[*v as usize].x) as f32;
            values[4 * *w as usize..][..4].copy_from_slice(&[bright, bright, bright, 1.0]);
        }
    }
    mesh.layers.push(AttributeLayer { semantic: Semantic::Color(0), width: 4, values });
    mesh
}

/// The same mesh, grey, with light that it gives off in waves along x.
fn glowing(mut mesh: Mesh) -> Mesh {
    mesh.face_wedges.clone_from(&mesh.faces);
    let values = mesh.positions.iter().flat_map(|p| [0.3 * p.x as f32 + 0.5, 0.5]).collect();
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    let texel = |k: u32| [(100.0 + 60.0 * libm::sin(f64::from(k) / 5.0)) as u8; 4];
    let rgba = (0..64).flat_map(texel).collect();
    let pixels = Some(Arc::new(Pixels { width: 64, height: 1, rgba }));
    mesh.images = vec![Image { pixels, ..Image::default() }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let source = json!({ "emissiveFactor": [1, 1, 1], "emissiveTexture": { "index": 0 } });
    let base_color = [0.3, 0.3, 0.3, 1.0];
    mesh.materials = vec![Material { base_color, source: Some(source), ..Material::default() }];
    mesh
}

/// The same mesh with a texture of waves along x and along y.
pub(super) fn painted(mut mesh: Mesh) -> Mesh {
    mesh.face_wedges.clone_from(&mesh.faces);
    let place = |p: &DVec3| [0.3 * p.x as f32 + 0.5, 0.3 * p.y as f32 + 0.5];
    let values = mesh.positions.iter().flat_map(place).collect();
    mesh.layers = vec![AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values }];
    let wave = |k: u32| libm::sin(f64::from(k) / 5.0);
    let texel = |k: u32| [(128.0 + 60.0 * (wave(k % 64) + wave(k / 64))) as u8; 4];
    let rgba = (0..64 * 64).flat_map(texel).collect();
    let pixels = Some(Arc::new(Pixels { width: 64, height: 64, rgba }));
    mesh.images = vec![Image { pixels, ..Image::default() }];
    mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
    let transform = [[1.5, 0.2, -0.3], [-0.1, 1.2, 0.1]];
    let at = TextureUse { texture: 0, tex_coord: 0, transform };
    mesh.materials = vec![Material { base_texture: Some(at), ..Material::default() }];
    mesh
}

/// A torus in a few views, and a coarser one that stands for it.
fn stage(shading: Shading, projection: Projection) -> (ViewSet, Mesh) {
    stage_of(shapes::torus(40, 24, 0.0), shading, projection)
}

fn stage_of(original: Mesh, shading: Shading, projection: Projection) -> (ViewSet, Mesh) {
    stage_by(original, (shading, projection), Metric::Luminance)
}

fn stage_by(
    original: Mesh,
    (shading, projection): (Shading, Projection),
    metric: Metric,
) -> (ViewSet, Mesh) {
    let view_params = ViewParams {
        directions: directions(6).unwrap(),
        fov_degrees: 60.0,
        projection,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 256,
        shading,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    let sphere = bounding_sphere(&original);
    let mut views = cameras(&sphere, &view_params);
    views[2].weight = 5;
    let pictures = Pictures::by_metric(&original, params, views, metric);
    let set = ViewSet::turned(&original, &pictures, sphere.center, 1);
    (set, with_vertex_normals(shapes::torus(9, 7, 0.0)))
}

/// The pixels count more and more from left to right.
fn weighed(mut set: ViewSet) -> ViewSet {
    let row = (0..256).map(|x| 1 + (x / 16) as u8).collect::<Vec<_>>();
    set.reference.weights = vec![row.repeat(256); set.reference.pictures.len()];
    set
}

/// Steps of the way that is walked.
const N_STEPS: usize = 32;

/// Walks vertex by vertex in some direction and compares. `move_to` changes a scene, `slope` picks what
/// it should have changed.
fn check(
    (set, scene): (&ViewSet, &Scene),
    has_own_normals: bool,
    reach: f64,
    move_to: &dyn Fn(&mut Scene, u32, DVec3),
    slope: &dyn Fn(&Slopes, usize) -> DVec3,
) {
    let find = |scene: &Scene| slopes(scene, &set.reference, has_own_normals, None);
    compare((scene, &find), reach, move_to, slope);
}

fn compare(
    (scene, find): (&Scene, &dyn Fn(&Scene) -> Slopes),
    reach: f64,
    move_to: &dyn Fn(&mut Scene, u32, DVec3),
    slope: &dyn Fn(&Slopes, usize) -> DVec3,
) {
    let (mut found, mut wanted) = (Vec::new(), Vec::new());
    for v in [3_u32, 17, 44] {
        for direction in DVec3::AXES {
            let at = |t: f64| {
                let mut scene = scene.clone();
                move_to(&mut scene, v, direction * (reach * t));
                find(&scene)
            };
            wanted.push(at(1.0).energy - at(-1.0).energy);
            let step = 2.0 / N_STEPS as f64;
            let along = |k| slope(&at(-1.0 + (k as f64 + 0.5) * step), v as usize).dot(direction);
            found.push((0..N_STEPS).map(along).sum::<f64>() * step * reach);
        }
    }
    let size = |all: &[f64]| all.iter().map(|x| x * x).sum::<f64>().sqrt();
    let off: Vec<f64> = found.iter().zip(&wanted).map(|(a, b)| a - b).collect();
    let share = size(&off) / size(&wanted);
    assert!(share < 0.12, "{share}: {found:.0?} for {wanted:.0?}");
}

fn move_place(scene: &mut Scene, v: u32, by: DVec3) {
    let places: Vec<DVec3> =
        (0..scene.n_vertex_slots() as u32).map(|w| scene.position(w)).collect();
    let views = scene.views.clone();
    let moved = places.iter().enumerate().map(|(w, p)| if w == v as usize { *p + by } else { *p });
    scene.redraw(&views, moved.collect(), true);
}

#[test]
fn places_of_flat_triangles() {
    for projection in [Projection::Perspective, Projection::Orthographic] {
        let (set, mesh) = stage(Shading::Flat, projection);
        let scene = scene_of_edit_mesh(&EditMesh::new(mesh).unwrap(), &set.pictures);
        check((&set, &scene), false, 0.05, &move_place, &|s, v| s.places[v].gradient);
    }
}

#[test]
fn places_where_pixels_have_weights() {
    let (set, mesh) = stage(Shading::Flat, Projection::Perspective);
    let set = weighed(set);
    let scene = scene_of_edit_mesh(&EditMesh::new(mesh).unwrap(), &set.pictures);
    check((&set, &scene), false, 0.05, &move_place, &|s, v| s.places[v].gradient);
}

/// Colours travel with the corners, and are lit as the triangle is.
#[test]
fn places_of_flat_triangles_with_colours() {
    let original = coloured(shapes::torus(40, 24, 0.0));
    let (set, mesh) = stage_of(original, Shading::Flat, Projection::Perspective);
    let scene = scene_of_edit_mesh(&EditMesh::new(coloured(mesh)).unwrap(), &set.pictures);
    check((&set, &scene), false, 0.05, &move_place, &|s, v| s.places[v].gradient);
}

/// What is given off travels with the corners too.
#[test]
fn places_of_triangles_that_glow() {
    let original = glowing(shapes::torus(40, 24, 0.0));
    let (set, _) = stage_of(original, Shading::Flat, Projection::Perspective);
    let mesh = EditMesh::new(glowing(shapes::torus(9, 7, 0.0))).unwrap();
    let scene = scene_of_edit_mesh(&mesh, &set.pictures);
    check((&set, &scene), false, 0.05, &move_place, &|s, v| s.places[v].gradient);
}

#[test]
fn the_energy_is_that_of_the_pictures() {
    let plain: fn(Mesh) -> Mesh = |mesh| mesh;
    for (dressed, shading) in [
        (plain, Shading::Flat),
        (coloured, Shading::Flat),
        (plain, Shading::Smooth),
        (coloured, Shading::Smooth),
        (glowing, Shading::Flat),
    ] {
        let original = dressed(shapes::torus(40, 24, 0.0));
        let (set, mesh) = stage_of(original, shading, Projection::Perspective);
        let scene = scene_of_edit_mesh(&EditMesh::new(dressed(mesh)).unwrap(), &set.pictures);
        let drawn = render::reference(&scene).pictures;
        for set in [set.clone(), weighed(set)] {
            let wanted = render::energy(&set.pictures.views, &set.reference, &drawn) as f64;
            let found = slopes(&scene, &set.reference, false, None).energy;
            // Luminances of the pictures are rounded.
            assert!((found / wanted - 1.0).abs() < 0.01, "{shading:?}: {found} {wanted}");
        }
    }
}

#[test]
fn places_of_smooth_triangles_turn_the_normals_around() {
    let (set, mesh) = stage(Shading::Smooth, Projection::Perspective);
    let scene = scene_of_edit_mesh(&EditMesh::new(mesh).unwrap(), &set.pictures);
    check((&set, &scene), false, 0.05, &move_place, &|s, v| s.places[v].gradient);
}

#[test]
fn normals_of_their_own() {
    let (set, mesh) = stage(Shading::Smooth, Projection::Perspective);
    let scene = scene_with_normals(&EditMesh::new(mesh).unwrap(), &set.pictures);
    let turn = |scene: &mut Scene, v: u32, by: DVec3| {
        let all: Vec<DVec3> = (0..scene.n_vertex_slots() as u32).map(|w| scene.normal(w)).collect();
        let turned = |(w, n): (usize, DVec3)| if w == v as usize { n + by } else { n };
        scene.turn_normals(all.into_iter().enumerate().map(turned));
    };
    check((&set, &scene), true, 0.2, &turn, &|s, v| s.normals[v].gradient);
}

/// The values of some unknowns, the first of which are those of the vertices.
fn values(unknowns: &[Unknown]) -> Vec<DVec3> {
    unknowns.iter().map(|u| u.at).collect()
}

#[test]
fn texture_coordinates() {
    let painted: fn(Mesh) -> Mesh = painted;
    for (dressed, shading) in
        [(painted, Shading::Flat), (painted, Shading::Smooth), (glowing, Shading::Flat)]
    {
        let original = dressed(shapes::torus(40, 24, 0.0));
        let (set, _) = stage_of(original, shading, Projection::Perspective);
        let mesh = EditMesh::new(dressed(shapes::torus(9, 7, 0.0))).unwrap();
        let scene = scene_of_edit_mesh(&mesh, &set.pictures);
        let attributes = Attributes::of(&mesh, &set.pictures.palette);
        let find = |scene: &Scene| slopes(scene, &set.reference, false, Some(&attributes));
        let shift = |scene: &mut Scene, v: u32, by: DVec3| {
            let mut coordinates = values(attributes.coordinates());
            coordinates[v as usize] += by.with_z(0.0);
            attributes.dress(scene, &coordinates, &[]);
        };
        compare((&scene, &find), 0.04, &shift, &|s, v| s.coordinates[v].gradient);
        assert_eq!(find(&scene).energy, slopes(&scene, &set.reference, false, None).energy);
    }
}

#[test]
fn colours() {
    for (metric, shading) in [
        (Metric::Luminance, Shading::Flat),
        (Metric::Luminance, Shading::Smooth),
        (Metric::Rgb, Shading::Flat),
    ] {
        let original = coloured(shapes::torus(40, 24, 0.0));
        let (set, mesh) = stage_by(original, (shading, Projection::Perspective), metric);
        let mut mesh = coloured(mesh);
        mesh.materials = vec![Material { base_color: [0.9, 0.8, 0.7, 1.0], ..Material::default() }];
        let mesh = EditMesh::new(mesh).unwrap();
        let scene = scene_of_edit_mesh(&mesh, &set.pictures);
        let attributes = Attributes::of(&mesh, &set.pictures.palette);
        let find = |scene: &Scene| slopes(scene, &set.reference, false, Some(&attributes));
        let stain = |scene: &mut Scene, v: u32, by: DVec3| {
            let mut colours = values(attributes.colours());
            colours[v as usize] += by;
            attributes.dress(scene, &[], &colours);
        };
        compare((&scene, &find), 0.08, &stain, &|s, v| s.colours[v].gradient);
    }
}

#[test]
fn bends_are_those_of_a_bowl_and_unseen_vertices_have_none() {
    let (set, mesh) = stage(Shading::Flat, Projection::Perspective);
    let mesh = EditMesh::new(mesh).unwrap();
    let found = slopes(&scene_of_edit_mesh(&mesh, &set.pictures), &set.reference, false, None);
    assert!(found.energy > 0.0 && found.normals.is_empty());
    for (v, slope) in found.places.iter().enumerate() {
        assert!(mesh.is_used(VertexId(v as u32)));
        for axis in DVec3::AXES {
            assert!((slope.bend * axis).dot(axis) >= 0.0, "{v}: {slope:?}");
        }
    }
}
