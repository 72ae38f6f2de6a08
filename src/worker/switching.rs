//! From how far away a level may stand in for the original.
//!
//! A level deviates from the original by some mean distance (symmetric, by points spread evenly over both
//! surfaces). The further away it is seen, the fewer pixels that is; once it is half a pixel, the two look
//! alike. Says nothing of colour or of single places that deviate by more than the mean.

use crate::{
    mesh::Mesh,
    metric::{
        bounding_sphere,
        surface::{Ruler, SurfaceParams},
    },
};

/// Height of the screen in pixels.
const SCREEN_HEIGHT: f64 = 1080.0;
/// Half of the vertical field of view, degrees.
const HALF_FOV_DEGREES: f64 = 30.0;
/// What the mean deviation may be, in pixels.
const PIXELS: f64 = 0.5;
/// Points on each surface.
const SAMPLES: u32 = 20_000;

/// Measures the levels of one original.
pub(super) struct Switching {
    ruler: Ruler,
    radius: f64,
}

impl Switching {
    /// Gets ready to measure.
    pub fn new(original: &Mesh) -> Self {
        let params = SurfaceParams { samples: SAMPLES, ..SurfaceParams::default() };
        Self { ruler: Ruler::new(original, params), radius: bounding_sphere(original).radius }
    }

    /// Mean distance between a level and the original, in radii of the original's bounding sphere. None
    /// where a mesh has no triangles or the original has no extent.
    pub fn deviation_radii(&self, level: &Mesh) -> Option<f64> {
        let deviation = self.ruler.mean(level)? / self.radius;
        deviation.is_finite().then_some(deviation)
    }

    /// Distance from the centre, in radii of the original's bounding sphere, from which on a level that
    /// deviates by so much may stand in.
    pub fn distance_radii(deviation_radii: f64) -> f64 {
        deviation_radii * radii_per_deviation()
    }

    /// How high the bounding sphere may be on a screen, in pixels, for a level to stand in for the
    /// original; infinite for the original itself.
    pub fn screen_size(deviation_radii: f64) -> f64 {
        // A pixel is 2 radii / height.
        2.0 * PIXELS / deviation_radii
    }
}

/// The share of the screen's height that the original's bounding sphere takes at a distance in its
/// radii, at most 1.
pub(super) fn screen_coverage(distance_radii: f64) -> f64 {
    (1.0 / (distance_radii * libm::tan(HALF_FOV_DEGREES.to_radians()))).min(1.0)
}

/// A pixel at distance D is 2 D tan(fov / 2) / height high.
fn radii_per_deviation() -> f64 {
    SCREEN_HEIGHT / (PIXELS * 2.0 * libm::tan(HALF_FOV_DEGREES.to_radians()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// A square of side 2 at a height.
    fn square(z: f64) -> Mesh {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let positions = corners.map(|[x, y]| DVec3::new(x, y, z)).to_vec();
        Mesh::from_parts(positions, vec![[0, 1, 2], [0, 2, 3]])
    }

    #[test]
    fn a_level_stands_in_from_where_it_is_off_by_half_a_pixel() {
        let switching = Switching::new(&square(0.0));
        let deviation = |z| switching.deviation_radii(&square(z)).unwrap();
        assert!(Switching::distance_radii(deviation(0.0)) < 1e-9);
        // Off by 0.01 everywhere, seen from `radii` x sqrt(2).
        let radii = Switching::distance_radii(deviation(0.01));
        let screen = 2.0 * radii * 2.0_f64.sqrt() / 3.0_f64.sqrt();
        assert!((0.01 / screen * 1080.0 - 0.5).abs() < 1e-6, "{radii}");
        // Seen from the front, the sphere is 2 sqrt(2) high.
        let height = Switching::screen_size(deviation(0.01));
        assert!((0.01 * height / (2.0 * 2.0_f64.sqrt()) - 0.5).abs() < 1e-6, "{height}");
        assert_eq!(switching.deviation_radii(&Mesh::from_parts(Vec::new(), Vec::new())), None);
    }
}
