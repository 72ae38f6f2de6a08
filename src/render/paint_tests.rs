//! Tests of textured surfaces.

use super::*;
use crate::render::view::{BoundingSphere, Projection, ViewParams, camera};

/// 64 × 64 texels that grow brighter to the right: texel x has 4 x.
fn ramp(is_clamped: bool) -> Texels {
    let mut texels = Texels::default();
    let row: Vec<u8> = (0..64).map(|x| 4 * x).collect();
    texels.add([6, 6], row.repeat(64), [is_clamped; 2], None, None);
    texels
}

/// A floor that is seen at a flat angle, its far end three times as far away as its near end: what each pixel
/// shows is where its ray meets the floor, not where it lies between the corners.
#[test]
fn perspective_is_that_of_rays() {
    let sphere = BoundingSphere { center: DVec3::ZERO, radius: 1.0 };
    let params = ViewParams {
        directions: Vec::new(),
        fov_degrees: 60.0,
        projection: Projection::Perspective,
        light_degrees: 0.0,
    };
    let view = camera(&sphere, &params, DVec3::new(0.0, 0.5, 1.0), 0.0);
    let lattice = Lattice::new(256);
    // Texture coordinate u runs from the far end to the near one.
    let corners =
        [DVec3::new(-0.6, 0.0, -0.8), DVec3::new(0.6, 0.0, -0.8), DVec3::new(0.0, 0.0, 0.8)];
    let paint = Paint { map: 0, uv: [[0.1, 0.0], [0.1, 0.0], [0.9, 0.0]] };
    let points = corners.map(|p| lattice.snap(view.project(p)));
    let texels = ramp(true);
    let painted = texels.painted(&lattice, &view, (points, corners), &paint).unwrap();
    let (mut n, mut affine_error) = (0, 0.0_f64);
    for step in 1..40 {
        let z = -0.8 + 1.6 * f64::from(step) / 40.0;
        let at = view.project(DVec3::new(0.0, 0.0, z));
        let (i, j) = ((at.x * 256.0) as i32, (at.y * 256.0) as i32);
        // Where the ray through the pixel's centre meets the floor.
        let (x, y) = ((f64::from(i) + 0.5) / 128.0 - 1.0, 1.0 - (f64::from(j) + 0.5) / 128.0);
        let slope = libm::tan(30.0_f64.to_radians());
        let ray = -view.back + slope * (x * view.right + y * view.up);
        let hit = view.eye - ray * (view.eye.y / ray.y);
        let u = 0.1 + 0.8 * (hit.z + 0.8) / 1.6;
        let expected = 4.0 * (64.0 * u - 0.5);
        let found = f64::from(painted.at(texels.words(), i, j));
        assert!((found - expected).abs() < 3.0, "{found}, not {expected} at z = {z}");
        let ends = [corners[0], corners[2]].map(|p| view.project(p).y);
        let affine = 0.1 + 0.8 * (at.y - ends[0]) / (ends[1] - ends[0]);
        affine_error = affine_error.max((256.0 * (affine - u)).abs());
        n += 1;
    }
    assert!(n == 39 && affine_error > 20.0, "the test would not notice: {affine_error}");
}

#[test]
fn levels_are_means_and_words_hold_neighbours() {
    let texels = ramp(false);
    let at = |level: &Level, x: u32, y: u32| {
        texels.words[(level.at + (y << level.bits[0]) + x) as usize].to_le_bytes()
    };
    let levels = &texels.maps[0].levels;
    assert_eq!(levels.len(), 7);
    assert_eq!(at(&levels[0], 3, 9), [12, 16, 12, 16]);
    assert_eq!(at(&levels[0], 63, 63), [252, 0, 252, 0], "it repeats");
    assert_eq!(at(&levels[1], 1, 0), [10, 18, 10, 18]);
    assert_eq!(at(&levels[6], 0, 0), [126; 4]);
    let edge = ramp(true);
    assert_eq!(edge.words[63].to_le_bytes(), [252; 4], "it is held");
}

/// A coarse picture of a fine texture shows its mean, not whatever texel lies under a pixel's centre.
#[test]
fn far_textures_are_seen_at_coarse_levels() {
    let mut texels = Texels::default();
    let checks = (0..256 * 256).map(|k| if (k / 256 + k) % 2 == 0 { 0 } else { 255 }).collect();
    texels.add([8, 8], checks, [false; 2], None, None);
    let lattice = Lattice::new(64);
    let sphere = BoundingSphere { center: DVec3::ZERO, radius: 1.0 };
    let params = ViewParams {
        directions: Vec::new(),
        fov_degrees: 60.0,
        projection: Projection::Orthographic,
        light_degrees: 0.0,
    };
    let view = camera(&sphere, &params, DVec3::Z, 0.0);
    let corners =
        [DVec3::new(-0.7, -0.7, 0.0), DVec3::new(0.7, -0.7, 0.0), DVec3::new(0.0, 0.7, 0.0)];
    let points = corners.map(|p| lattice.snap(view.project(p)));
    let paint = Paint { map: 0, uv: [[0.0, 1.0], [1.0, 1.0], [0.5, 0.0]] };
    let painted = texels.painted(&lattice, &view, (points, corners), &paint).unwrap();
    assert!(painted.bits[0] < 7, "256 texels on 45 pixels: {:?}", painted.bits);
    assert!((20..44).all(|i| painted.at(texels.words(), i, 40) == 128));
}
