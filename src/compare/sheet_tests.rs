//! Tests of contact sheets.

use super::*;

/// A tetrahedron with one corner on top.
fn tetrahedron(height: f64) -> Mesh {
    Mesh::from_parts(
        vec![
            DVec3::new(-1.0, 0.0, -1.0),
            DVec3::new(1.0, 0.0, -1.0),
            DVec3::new(0.0, 0.0, 1.0),
            DVec3::new(0.0, height, 0.0),
        ],
        vec![[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]],
    )
}

fn small() -> SheetParams {
    let look = Look { image_size: 64, ..Look::default() };
    SheetParams { look, tile: 48, ..SheetParams::default() }
}

fn size(png: &[u8]) -> (u32, u32) {
    let read = image::load_from_memory(png).unwrap();
    (read.width(), read.height())
}

#[test]
fn sheets_have_a_column_for_each_mesh_and_a_row_for_each_view() {
    let (a, b) = (tetrahedron(2.0), tetrahedron(1.5));
    let (frame_x, frame_y) = (2 * 28 - 10, 2 * 28 - 10 + 74 + 58);
    assert_eq!(size(&sheet(&a, &b, &small())), (3 * 58 + frame_x, 5 * 58 + frame_y));
    let multi = sheet_multi(&a, &[&b, &b, &a], &small());
    assert_eq!(size(&multi), (4 * 58 + frame_x, 10 * 58 + frame_y));
}

#[test]
fn the_difference_of_equal_meshes_is_black() {
    let mesh = tetrahedron(2.0);
    let portraits = Portraits::new(&mesh, &mesh, &small());
    let (tile, caption) = portraits.difference(&portraits, 0, &small());
    assert!(tile.iter().all(|p| *p == [0, 0, 0]));
    assert_eq!(caption, "d2 0.00 %");
    let taller = Portraits::new(&mesh, &tetrahedron(1.5), &small());
    let (tile, _) = taller.difference(&portraits, 0, &small());
    assert!(tile.iter().any(|p| p[0] > 100));
}

#[test]
fn simplified_meshes_show_the_normals_of_their_files_where_these_are_asked_for() {
    use crate::{
        compare::raster::Shading,
        mesh::{AttributeLayer, Semantic},
    };
    let mut mesh = tetrahedron(2.0);
    mesh.face_wedges.clone_from(&mesh.faces);
    let values = [0.0, 0.0, 1.0].repeat(mesh.positions.len());
    mesh.layers = vec![AttributeLayer { semantic: Semantic::Normal, width: 3, values }];
    for (shading, shows) in [(Shading::Smooth, true), (Shading::Flat, false)] {
        let look = Look { shading, ..small().look };
        let plain = SheetParams { look, ..small() };
        let asked = plain.clone().with_stored_normals(true);
        assert_eq!(sheet(&mesh, &mesh, &plain) != sheet(&mesh, &mesh, &asked), shows);
        // The original is drawn as ever.
        let [one, other] = [&plain, &asked.of_original()].map(|p| Portraits::new(&mesh, &mesh, p));
        assert!(one.luminance == other.luminance);
    }
}

#[test]
fn the_chosen_axis_points_to_the_top() {
    let mesh = tetrahedron(2.0);
    for up in [Axis::X, Axis::Y, Axis::Z] {
        let params = SheetParams { up, views: all_round_views(up), ..small() };
        for view in sheet_cameras(&mesh, &params) {
            let center = bounding_sphere(&mesh).center;
            let (low, high) = (view.project(center), view.project(center + axes(up).0 * 0.1));
            assert!((high.x - low.x).abs() < 1e-9 && high.y < low.y, "{view:?}");
        }
    }
}

#[test]
fn heat_runs_from_black_through_red_and_yellow_to_white_ever_lighter() {
    assert_eq!((heat(0.0), heat(1.0)), ([0; 3], [255; 3]));
    assert!(matches!(heat(0.4), [180..=255, 0, 0]), "{:?}", heat(0.4));
    assert!(matches!(heat(0.9), [255, 180..=255, 0]), "{:?}", heat(0.9));
    let sums: Vec<u32> =
        (0..=50).map(|i| heat(f64::from(i) / 50.0).map(u32::from).iter().sum()).collect();
    assert!(sums.is_sorted());
}

#[test]
fn numbers_are_grouped() {
    assert_eq!([7, 1_000, 69_451, 1_234_567].map(thousands), ["7", "1,000", "69,451", "1,234,567"]);
}
