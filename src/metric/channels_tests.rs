use glam::DVec3;

use super::{Metric, Pictures, bounding_sphere, is_grey, reference_pictures};
use crate::{
    mesh::{AttributeLayer, Material, Mesh, Semantic, shapes},
    render::{
        RenderParams, Shading, energy,
        view::{Projection, ViewParams, cameras, directions},
    },
};

fn pictures(mesh: &Mesh, metric: Metric) -> Pictures {
    let view_params = ViewParams {
        directions: directions(6).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 64,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 128,
        interior_views: 2,
        hides_back_faces: false,
    };
    let mut views = cameras(&bounding_sphere(mesh), &view_params);
    views[1].weight = 3;
    Pictures::by_metric(mesh, params, views, metric)
}

/// A ball whose triangles have one of two colours, as materials or as colours of vertices.
fn ball(colours: [[f32; 3]; 2], border: f64, is_vertices: bool) -> Mesh {
    let mut mesh = shapes::sphere(3);
    let side = |p: DVec3| usize::from(p.x > border);
    if is_vertices {
        let colour = |p: &DVec3| colours[side(*p)];
        let values = mesh.positions.iter().flat_map(colour).collect();
        mesh.face_wedges = mesh.faces.clone();
        mesh.layers.push(AttributeLayer { semantic: Semantic::Color(0), width: 3, values });
        return mesh;
    }
    let center = |f: &[u32; 3]| f.iter().map(|v| mesh.positions[*v as usize]).sum::<DVec3>() / 3.0;
    mesh.face_materials = mesh.faces.iter().map(|f| side(center(f)) as u32).collect();
    let material =
        |[r, g, b]: [f32; 3]| Material { base_color: [r, g, b, 1.0], ..Material::default() };
    mesh.materials = colours.map(material).to_vec();
    mesh
}

fn difference(a: &Mesh, b: &Mesh, metric: Metric) -> u64 {
    let pictures = pictures(a, metric);
    let other = Pictures { palette: self::pictures(b, metric).palette, ..pictures.clone() };
    let (a, b) = (reference_pictures(a, &pictures), reference_pictures(b, &other));
    energy(&pictures.views, &a, &b.pictures)
}

/// Red and green of the same luminance.
const EVEN: [[f32; 3]; 2] = [[1.0, 0.0, 0.0], [0.0, 0.2126 / 0.7152, 0.0]];

#[test]
fn colours_of_one_luminance_differ_by_rgb_alone() {
    for is_vertices in [false, true] {
        let [a, b] = [0.0, 0.3].map(|border| ball(EVEN, border, is_vertices));
        assert_eq!(difference(&a, &b, Metric::Luminance), 0, "{is_vertices}");
        assert!(difference(&a, &b, Metric::Rgb) > 0, "{is_vertices}");
        assert_eq!(difference(&a, &a, Metric::Rgb), 0, "{is_vertices}");
        assert!(!is_grey(&a));
    }
}

#[test]
fn the_channels_of_greys_are_as_their_luminance() {
    for is_vertices in [false, true] {
        let greys = [[0.25; 3], [0.75; 3]];
        let [a, b] = [0.0, 0.3].map(|border| ball(greys, border, is_vertices));
        assert!(is_grey(&a));
        let luminance = difference(&a, &b, Metric::Luminance);
        assert!(luminance > 0 && difference(&a, &b, Metric::Rgb) == 3 * luminance);
    }
}

#[test]
fn a_camera_takes_a_picture_of_each_channel() {
    let mesh = ball(EVEN, 0.0, false);
    let (one, three) = (pictures(&mesh, Metric::Luminance), pictures(&mesh, Metric::Rgb));
    assert_eq!((one.views.len(), one.params.interior_views), (6, 2));
    assert_eq!((three.views.len(), three.params.interior_views), (18, 6));
    for (k, view) in three.views.iter().enumerate() {
        assert_eq!(*view, one.views[k / 3].in_channel((k % 3) as u8));
    }
    // The backs of the first two cameras' pictures, and nothing blue anywhere.
    let drawn = reference_pictures(&mesh, &three).pictures;
    assert!(drawn.iter().skip(2).step_by(3).all(|p| p.iter().all(|c| [0, 128].contains(c))));
}
