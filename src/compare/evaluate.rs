//! How much a simplified mesh looks like its original: the papers' off-line evaluation.
//!
//! Invariants:
//! 1. the cameras are those of the original's bounding sphere, for both meshes;
//! 2. no picture here was seen by the simplification: 24 views against its 20 or fewer, and a
//!    rasteriser of its own;
//! 3. sums over views run in view order, so a result does not depend on threads.
//!
//! Source: Lindstrom & Turk 2000, section 4; views, light and material as restated there.

use std::{convert::Infallible, fmt::Write};

use serde::{Deserialize, Serialize};

use super::raster::{Appearance, Drawable, Look, Shading, pictures};
use crate::{
    mesh::Mesh,
    metric::{
        Metric, bounding_sphere,
        image::{d2_percent, mean_square_difference, mean_weighed_difference},
        masking,
        surface::{SurfaceDistance, SurfaceParams, try_surface_distance},
    },
    render::{
        FULL_WEIGHT,
        view::{Projection, View, ViewParams, cameras, directions},
    },
};

/// What to compare, and how closely.
#[derive(Clone, Debug, PartialEq)]
pub struct Params {
    /// Size, shading, material and light of the pictures.
    pub look: Look,
    /// Full field of view, degrees.
    pub fov_degrees: f64,
    /// Angle between the directions to the eye and to the light, degrees.
    pub light_degrees: f64,
    /// In smooth shading, draw the simplified mesh with the normals that it brings.
    pub stored_normals: bool,
    /// Also measure the distance between the surfaces.
    pub surface: Option<SurfaceParams>,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            look: Look::default(),
            fov_degrees: 60.0,
            light_degrees: 10.0,
            stored_normals: false,
            surface: None,
        }
    }
}

/// The result of a comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// Triangles of the original.
    pub triangles_original: usize,
    /// Triangles of the simplified mesh.
    pub triangles_simplified: usize,
    /// RMS difference over all pixels (and channels) of all views, as far as the metric sees it, percent of full
    /// scale.
    pub d2_percent: f64,
    /// The same on a 0 to 255 scale.
    pub d2_255: f64,
    /// RMS difference of each view, percent of full scale.
    pub per_view: Vec<f64>,
    /// Flat or smooth.
    pub shading: Shading,
    /// White or coloured.
    pub appearance: Appearance,
    /// What differences were taken of.
    #[serde(default)]
    pub metric: Metric,
    /// Pixels along each side.
    pub image_size: usize,
    /// Samples along each side of a pixel.
    pub supersampling: usize,
    /// Distance between the surfaces, if it was asked for and both have triangles.
    pub metro: Option<SurfaceDistance>,
}

/// What is worked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The pictures that d2 is taken of.
    Pictures,
    /// The distance between the surfaces.
    Distance,
    /// The contact sheet.
    Sheet,
}

impl Part {
    /// The name that is shown.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pictures => "pictures",
            Self::Distance => "distance",
            Self::Sheet => "sheet",
        }
    }
}

/// Hears from any thread that so large a share of a part begins; its error ends the work.
pub type Tick<'t, E> = &'t (dyn Fn(Part, f64) -> Result<(), E> + Sync);

/// Hears nothing, ends nothing.
pub(super) const NEVER_ENDS: Tick<'static, Infallible> = &|_, _| Ok(());

/// An original with its pictures, to compare any number of meshes with.
pub struct Reference<'m> {
    original: &'m Mesh,
    params: Params,
    views: Vec<View>,
    pictures: Vec<Vec<f32>>,
    /// How much each pixel counts, where not all count the same.
    weights: Vec<Vec<u8>>,
}

impl<'m> Reference<'m> {
    /// Draws the original in all 24 views; the pictures take `24 · image_size² · 4` bytes for each channel.
    pub fn new(original: &'m Mesh, params: &Params) -> Self {
        let Ok(reference) = Self::try_new(original, params, NEVER_ENDS);
        reference
    }

    /// [`Self::new`], which may be ended: half of [`Part::Pictures`].
    pub fn try_new<E: Send>(
        original: &'m Mesh,
        params: &Params,
        tick: Tick<'_, E>,
    ) -> Result<Self, E> {
        let views = cameras(
            &bounding_sphere(original),
            &ViewParams {
                directions: directions(24).unwrap_or_default(),
                ..view_params(params.fov_degrees, params.light_degrees)
            },
        );
        let pictures = drawn(original, &views, (&params.look, false), tick)?;
        let weights = match params.look.metric {
            Metric::Luminance | Metric::Rgb => Vec::new(),
            Metric::Perceptual => pictures.iter().map(|p| weights(p, &params.look)).collect(),
        };
        Ok(Self { original, params: params.clone(), views, pictures, weights })
    }

    /// Compares one mesh with the original.
    pub fn compare(&self, simplified: &Mesh) -> Comparison {
        let Ok(comparison) = self.try_compare(simplified, NEVER_ENDS);
        comparison
    }

    /// [`Self::compare`], which may be ended: the other half of [`Part::Pictures`], and [`Part::Distance`].
    pub fn try_compare<E: Send>(
        &self,
        simplified: &Mesh,
        tick: Tick<'_, E>,
    ) -> Result<Comparison, E> {
        let look = &self.params.look;
        let drawn = drawn(simplified, &self.views, (look, self.params.stored_normals), tick)?;
        let mean_square =
            |(view, (a, b)): (usize, (&Vec<f32>, &Vec<f32>))| match self.weights.get(view) {
                None => mean_square_difference(a, b),
                Some(weights) => mean_weighed_difference(a, b, (weights, FULL_WEIGHT)),
            };
        let mean_squares: Vec<f64> =
            self.pictures.iter().zip(&drawn).enumerate().map(mean_square).collect();
        let d2 = d2_percent(&mean_squares);
        let of_distance = |share: f64| tick(Part::Distance, share);
        let metro = match &self.params.surface {
            Some(surface) => {
                try_surface_distance(self.original, simplified, surface, &of_distance)?
            }
            None => None,
        };
        Ok(Comparison {
            triangles_original: self.original.faces.len(),
            triangles_simplified: simplified.faces.len(),
            d2_percent: d2,
            d2_255: d2 * 2.55,
            per_view: mean_squares.iter().map(|m| d2_percent(&[*m])).collect(),
            shading: look.shading,
            appearance: look.appearance,
            metric: look.metric,
            image_size: look.image_size,
            supersampling: look.supersampling,
            metro,
        })
    }
}

/// Pictures of a mesh, pixel after pixel and channel after channel of each: half of [`Part::Pictures`].
fn drawn<E: Send>(
    mesh: &Mesh,
    views: &[View],
    (look, stored_normals): (&Look, bool),
    tick: Tick<'_, E>,
) -> Result<Vec<Vec<f32>>, E> {
    match look.metric {
        Metric::Luminance | Metric::Perceptual => {
            drawn_channels(Drawable::luminance(mesh, look), views, (look, stored_normals), tick)
        }
        Metric::Rgb => {
            drawn_channels(Drawable::channels(mesh, look), views, (look, stored_normals), tick)
        }
    }
}

/// How much the pixels of a picture count.
fn weights(picture: &[f32], look: &Look) -> Vec<u8> {
    let bytes: Vec<u8> = picture.iter().map(|lum| (lum * 255.0 + 0.5) as u8).collect();
    masking::weights(&bytes, look.image_size)
}

fn drawn_channels<const N: usize, E: Send>(
    mut drawable: Drawable<'_, N>,
    views: &[View],
    (look, stored_normals): (&Look, bool),
    tick: Tick<'_, E>,
) -> Result<Vec<Vec<f32>>, E> {
    if stored_normals {
        drawable = drawable.with_stored_normals();
    }
    let half = |share: f64| tick(Part::Pictures, share / 2.0);
    let pictures = pictures(&drawable, views, look, &half)?;
    Ok(pictures.into_iter().map(Vec::into_flattened).collect())
}

/// Compares one mesh with its original.
pub fn compare(original: &Mesh, simplified: &Mesh, params: &Params) -> Comparison {
    Reference::new(original, params).compare(simplified)
}

/// The comparison in words, a few lines for a terminal.
pub fn report_text(comparison: &Comparison) -> String {
    let c = comparison;
    let kept = 100.0 * c.triangles_simplified as f64 / c.triangles_original.max(1) as f64;
    let (least, most) = (c.per_view.iter())
        .fold((f64::INFINITY, 0.0_f64), |(least, most), v| (least.min(*v), most.max(*v)));
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "triangles  {} -> {} ({kept:.2} %)",
        c.triangles_original, c.triangles_simplified
    );
    let _ = writeln!(
        text,
        "image      d2 = {:.4} % of full scale ({:.4} of 255), {} views from {least:.3} to {most:.3} %",
        c.d2_percent,
        c.d2_255,
        c.per_view.len(),
    );
    let (shading, appearance) = (lower(c.shading), lower(c.appearance));
    let _ = writeln!(
        text,
        "           {size} x {size} pixels, {n} x {n} samples each, {shading} shading, {appearance}{by}",
        size = c.image_size,
        n = c.supersampling,
        by = match c.metric {
            Metric::Luminance => "",
            Metric::Rgb => ", by red, green and blue",
            Metric::Perceptual => ", by visible luminance",
        },
    );
    if let Some(m) = &c.metro {
        let _ = writeln!(
            text,
            "surface    mean {:.5} %, RMS {:.5} %, maximum {:.4} % of the bounding box's diagonal",
            m.mean, m.rms, m.max
        );
    }
    text
}

/// The comparison in one sentence, for a log.
pub fn summary(comparison: &Comparison) -> String {
    let c = comparison;
    let n_views = c.per_view.len();
    let mut text = format!(
        "d2 is {:.4} % of full scale ({:.4} of 255) over {n_views} views",
        c.d2_percent, c.d2_255
    );
    if let Some(m) = &c.metro {
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            ", the surfaces are {:.5} % of the bounding box's diagonal apart on average and {:.4} % at most",
            m.mean, m.max
        );
    }
    text
}

/// One comparison, or a list of them, as files and standard output have it.
pub fn json<T: Serialize>(comparisons: &T) -> serde_json::Result<String> {
    serde_json::to_string_pretty(comparisons).map(|json| json + "\n")
}

/// Camera parameters without directions.
pub(super) fn view_params(fov_degrees: f64, light_degrees: f64) -> ViewParams {
    let projection = Projection::Perspective;
    ViewParams { directions: Vec::new(), fov_degrees, projection, light_degrees }
}

fn lower(name: impl std::fmt::Debug) -> String {
    format!("{name:?}").to_lowercase()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn octahedron(radius: f64) -> Mesh {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z];
        let faces = vec![
            [0, 1, 2],
            [1, 3, 2],
            [3, 4, 2],
            [4, 0, 2],
            [1, 0, 5],
            [3, 1, 5],
            [4, 3, 5],
            [0, 4, 5],
        ];
        Mesh::from_parts(axes.iter().map(|a| *a * radius).collect(), faces)
    }

    fn small() -> Params {
        Params { look: Look { image_size: 32, ..Look::default() }, ..Params::default() }
    }

    #[test]
    fn a_mesh_looks_exactly_like_itself_and_unlike_a_smaller_one() {
        let original = octahedron(1.0);
        let same = compare(&original, &original, &small());
        assert_eq!(same.d2_percent, 0.0);
        assert_eq!(same.per_view, vec![0.0; 24]);
        let reference = Reference::new(&original, &small());
        let near = reference.compare(&octahedron(0.95)).d2_percent;
        let far = reference.compare(&octahedron(0.7)).d2_percent;
        assert!(0.5 < near && near < far, "{near} {far}");
    }

    #[test]
    fn the_cameras_do_not_care_for_size_or_place() {
        let moved = |mesh: Mesh| Mesh {
            positions: mesh.positions.iter().map(|p| *p * 1000.0 + DVec3::splat(5e3)).collect(),
            ..mesh
        };
        let here = compare(&octahedron(1.0), &octahedron(0.9), &small());
        let there = compare(&moved(octahedron(1.0)), &moved(octahedron(0.9)), &small());
        assert!((here.d2_percent - there.d2_percent).abs() < 1e-3 * here.d2_percent);
    }

    #[test]
    fn nothing_at_all_is_compared_with_the_background() {
        let gone = compare(&octahedron(1.0), &Mesh::default(), &small());
        assert!(gone.d2_percent > 10.0 && gone.metro.is_none());
    }

    #[test]
    fn the_report_names_both_scales() {
        let params = Params { surface: Some(SurfaceParams::default()), ..small() };
        let text = report_text(&compare(&octahedron(1.0), &octahedron(0.9), &params));
        for part in ["8 -> 8 (100.00 %)", "of full scale", "of 255", "24 views", "flat", "mean"] {
            assert!(text.contains(part), "{part} in {text}");
        }
    }
}
