//! Which corners share an unknown, within which bounds, and what a scene shows of other values.

use glam::DVec3;

use super::{
    Attributes, Palette, Pictures, Unknown, bounding_sphere, channels::Metric, scene_of_edit_mesh,
    slopes_tests::painted,
};
use crate::{
    mesh::{AttributeLayer, EditMesh, Mesh, Semantic, VertexId, shapes},
    render::{
        RenderParams, Shading,
        view::{Projection, ViewParams, cameras, directions},
    },
};

fn attributes(mesh: &EditMesh) -> Attributes {
    Attributes::of(mesh, &Palette::of(mesh.mesh(), 64, Metric::Luminance).into())
}

/// Two squares beside one another, one unit wide and folded up at x = 1; wedges 6 and 7 are vertices 1 and 4 as the
/// right one has them, whose normals differ. Coordinates are places, those of wedge 7 but for `off`.
fn squares(off: f32) -> EditMesh {
    let positions: Vec<DVec3> =
        (0..6).map(|i| DVec3::new(f64::from(i % 3), f64::from(i / 3), 0.0)).collect();
    let mesh = Mesh::from_parts(positions, vec![[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]);
    let mut mesh = painted(mesh);
    mesh.face_wedges = vec![[0, 1, 4], [0, 4, 3], [6, 2, 5], [6, 5, 7]];
    let uvs = [0, 1, 2, 3, 4, 5, 1, 4].into_iter().flat_map(|i| [(i % 3) as f32, (i / 3) as f32]);
    let mut values: Vec<f32> = uvs.collect();
    values[14] += off;
    let normals = (0..24).map(|k| k as f32).collect();
    mesh.layers = vec![
        AttributeLayer { semantic: Semantic::Normal, width: 3, values: normals },
        AttributeLayer { semantic: Semantic::TexCoord(0), width: 2, values },
    ];
    EditMesh::new(mesh).unwrap()
}

#[test]
fn what_is_the_same_on_the_texture_is_one_unknown_and_a_seam_has_two() {
    let of_vertex = |all: &Attributes, v: u32| -> Vec<Unknown> {
        all.coordinates().iter().filter(|u| u.vertex == VertexId(v)).copied().collect()
    };
    let whole = attributes(&squares(0.0));
    assert_eq!((whole.coordinates().len(), whole.colours().len()), (6, 0));
    assert_eq!(of_vertex(&whole, 4)[0].bounds, [DVec3::ZERO, DVec3::new(2.0, 1.0, 0.0)]);
    let seamed = attributes(&squares(0.5));
    assert_eq!(seamed.coordinates().len(), 7);
    let [left, right] = of_vertex(&seamed, 4)[..] else { panic!("{seamed:?}") };
    assert_eq!((left.at, right.at), (DVec3::new(1.0, 1.0, 0.0), DVec3::new(1.5, 1.0, 0.0)));
    assert_eq!(left.bounds, [DVec3::ZERO, DVec3::new(1.0, 1.0, 0.0)]);
    assert_eq!(right.bounds, [DVec3::new(1.0, 0.0, 0.0), DVec3::new(2.0, 1.0, 0.0)]);
    // Two triangles to the left, each with sides of 1 and √2. To the right is one, with sides of √1.25 and .5.
    assert!((left.reach - f64::midpoint(1.0, 2.0_f64.sqrt())).abs() < 1e-12);
    assert!((right.reach - f64::midpoint(1.25_f64.sqrt(), 0.5)).abs() < 1e-12);
}

#[test]
fn without_textures_or_colours_nothing_is_unknown() {
    assert!(attributes(&EditMesh::new(shapes::octahedron()).unwrap()).is_empty());
    let mut plain = painted(shapes::octahedron());
    plain.materials[0].base_texture = None;
    assert!(attributes(&EditMesh::new(plain).unwrap()).is_empty());
}

#[test]
fn colours_beyond_white_do_not_go_further_and_luminance_keeps_hues() {
    let mut mesh = shapes::octahedron();
    mesh.face_wedges.clone_from(&mesh.faces);
    let mut values = vec![0.5; 24];
    (values[0], values[5]) = (1.5, 0.25);
    values[8..11].fill(0.0);
    mesh.layers = vec![AttributeLayer { semantic: Semantic::Color(0), width: 4, values }];
    let mesh = EditMesh::new(mesh).unwrap();
    let of = |metric| Attributes::of(&mesh, &Palette::of(mesh.mesh(), 64, metric).into());
    let found = of(Metric::Rgb);
    assert_eq!(found.colours().len(), 6);
    assert_eq!(found.colours()[0].bounds, [DVec3::ZERO, DVec3::new(1.5, 1.0, 1.0)]);
    assert_eq!(found.colours()[5].bounds, [DVec3::ZERO, DVec3::ONE]);
    assert!(found.colours().iter().all(|u| u.way.is_none()));
    // Where luminance is all that is seen, hues stay: .5 .25 .5 can be twice that; black gets grey.
    let found = of(Metric::Luminance);
    let check = |i: usize, way: [f64; 3], bounds: [[f64; 3]; 2]| {
        let found = &found.colours()[i];
        let all = [found.way.unwrap(), found.bounds[0], found.bounds[1]];
        let wanted = [DVec3::from(way).normalize_or_zero(), bounds[0].into(), bounds[1].into()];
        assert!(all.iter().zip(wanted).all(|(a, b)| a.abs_diff_eq(b, 1e-12)), "{found:?}");
    };
    check(0, [3.0, 1.0, 1.0], [[0.0; 3], [1.5, 0.5, 0.5]]);
    check(1, [2.0, 1.0, 2.0], [[0.0; 3], [1.0, 0.5, 1.0]]);
    check(2, [1.0; 3], [[0.0; 3], [1.0; 3]]);
}

#[test]
fn triangles_that_turn_over_go_back() {
    let all = attributes(&squares(0.0));
    let start: Vec<DVec3> = all.coordinates().iter().map(|u| u.at).collect();
    let mut to = start.clone();
    // Across the diagonal from 0 to 4; vertex 2 moves within its triangle.
    to[3] = DVec3::new(0.9, 0.1, 0.0);
    to[2] = DVec3::new(1.9, 0.2, 0.0);
    all.unfold(&mut to);
    let wanted = |i: usize| if i == 2 { DVec3::new(1.9, 0.2, 0.0) } else { start[i] };
    assert_eq!(to, (0..6).map(wanted).collect::<Vec<_>>());
}

/// A scene in which values are exchanged is the scene of the mesh that has them.
#[test]
fn a_scene_is_dressed_as_the_mesh_will_be() {
    let mut mesh = painted(shapes::torus(9, 7, 0.0));
    let values = (0..4 * mesh.positions.len()).map(|k| (k % 7) as f32 / 7.0).collect();
    mesh.layers.push(AttributeLayer { semantic: Semantic::Color(0), width: 4, values });
    let view_params = ViewParams {
        directions: directions(4).unwrap(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 10.0,
    };
    let params = RenderParams {
        image_size: 64,
        shading: Shading::Flat,
        ambient: 0.1,
        background: 128,
        interior_views: 0,
        hides_back_faces: false,
    };
    for metric in [Metric::Luminance, Metric::Rgb] {
        let views = cameras(&bounding_sphere(&mesh), &view_params);
        let pictures = Pictures::by_metric(&mesh, params.clone(), views, metric);
        let mut edited = EditMesh::new(mesh.clone()).unwrap();
        let all = Attributes::of(&edited, &pictures.palette);
        let mut scene = scene_of_edit_mesh(&edited, &pictures);
        let moved = |unknowns: &[Unknown]| -> Vec<DVec3> {
            unknowns.iter().map(|u| (u.at * 0.9 + 0.02).as_vec3().as_dvec3()).collect()
        };
        let (uvs, rgbs) = (moved(all.coordinates()), moved(all.colours()));
        all.dress(&mut scene, &uvs, &rgbs);
        let uvs = all.coordinates().iter().zip(&uvs).map(|(u, at)| (u.corner, at.as_vec3()));
        let uvs: Vec<_> = uvs.map(|(corner, at)| (corner, [at.x, at.y])).collect();
        let rgbs = all.colours().iter().zip(&rgbs).map(|(u, at)| (u.corner, at.as_vec3()));
        let rgbs: Vec<_> = rgbs.map(|(corner, at)| (corner, at.to_array())).collect();
        edited.revalue_shared(Semantic::TexCoord(0), &uvs).unwrap();
        edited.revalue_shared(Semantic::Color(0), &rgbs).unwrap();
        assert!(scene.faces == scene_of_edit_mesh(&edited, &pictures).faces, "{metric:?}");
    }
}
