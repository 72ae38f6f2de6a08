//! The off-line rasteriser: anti-aliased pictures of a mesh, for judging and for showing.
//!
//! It draws what Lindstrom & Turk 2000, section 4, describe: a z-buffer of n × n samples a pixel
//! (box filter), a grey background, one directional light a view, both sides of the surface lit
//! (the normal is turned to the viewer), ambient and diffuse reflection only. It shares no code
//! with the evaluator that drives the simplification, which it judges.
//!
//! Invariants:
//! 1. a picture is a function of mesh, view and parameters alone, not of threads;
//! 2. triangles are drawn as they are, in face order: nothing is merged, repaired or dropped;
//! 3. pixel values are floats from 0 to 1, never rounded to 8 bits.
//!
//! Knows nothing of differences, sheets or files.

use std::{collections::HashMap, ops::Range};

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    scan::{Band, Paint, Spot, doubled_area, rows_spanned},
    skin::{Skin, skin},
    texture::Brush,
};
use crate::{
    mesh::{Material, Mesh, Semantic, TextureUse, WedgeId},
    metric::{
        Metric,
        image::{luminance, srgb_from_linear},
    },
    render::view::{Projection, View},
};

/// How a triangle's shade varies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shading {
    /// One shade a triangle, from its geometric normal.
    #[default]
    Flat,
    /// Gouraud: a shade a corner, from the area-weighted normals of the triangles that meet at
    /// that position.
    Smooth,
}

/// What the surface is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Appearance {
    /// White all over, as in the papers.
    #[default]
    White,
    /// Material base colour × base colour texture × vertex colour, and emissive colours.
    Coloured,
}

/// Everything about a picture but the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Pixels along each side.
    pub image_size: usize,
    /// Samples along each side of a pixel.
    pub supersampling: usize,
    /// Flat or smooth.
    pub shading: Shading,
    /// White or coloured.
    pub appearance: Appearance,
    /// Ambient light, 0 to 1; diffuse is 1 − ambient.
    pub ambient: f64,
    /// Background grey, 0 to 1.
    pub background: f64,
    /// Back faces of single-sided materials are left out.
    pub hides_back_faces: bool,
    /// What differences are taken of.
    pub metric: Metric,
}

impl Default for Look {
    fn default() -> Self {
        Self {
            image_size: 512,
            supersampling: 4,
            shading: Shading::default(),
            appearance: Appearance::default(),
            ambient: 0.1,
            background: 0.5,
            hides_back_faces: false,
            metric: Metric::default(),
        }
    }
}

/// A mesh made ready for drawing: all that does not depend on the view. `N` is 1 for luminance
/// and 3 for red, green and blue.
pub struct Drawable<'m, const N: usize> {
    mesh: &'m Mesh,
    /// Unit normal of each triangle, zero where it has none.
    face_normals: Vec<DVec3>,
    /// Unit normal at each corner; empty unless the shading is smooth.
    corner_normals: Vec<[DVec3; 3]>,
    /// Colour of each corner; empty when the surface is white.
    corner_colours: Vec<[[f32; N]; 3]>,
    /// By material; empty when the surface is white.
    textures: Vec<Option<Skin<N>>>,
}

impl<'m> Drawable<'m, 1> {
    /// For pictures of linear luminance, which differences are taken of.
    pub fn luminance(mesh: &'m Mesh, look: &Look) -> Self {
        Self::new(mesh, look, |colour| [luminance(colour)], |texel| [luminance(texel)])
    }
}

impl<'m> Drawable<'m, 3> {
    /// For pictures of linear colours, which differences are taken of.
    pub fn channels(mesh: &'m Mesh, look: &Look) -> Self {
        Self::new(mesh, look, |colour| colour, |texel| texel)
    }

    /// For pictures to look at: surface colours are sRGB-encoded, then shaded, so that light and
    /// background are the same greys as in the luminance pictures. Textures are encoded already.
    pub fn display(mesh: &'m Mesh, look: &Look) -> Self {
        let encode = |colour: [f32; 3]| colour.map(|c| srgb_from_linear(f64::from(c)) as f32);
        Self::new(mesh, look, encode, |texel| texel)
    }
}

impl<'m, const N: usize> Drawable<'m, N> {
    fn new(
        mesh: &'m Mesh,
        look: &Look,
        encode: impl Fn([f32; 3]) -> [f32; N],
        encode_texel: impl Fn([f32; 3]) -> [f32; N] + Sync,
    ) -> Self {
        let area_normals = area_normals(mesh);
        let corner_normals = match look.shading {
            Shading::Flat => Vec::new(),
            Shading::Smooth => {
                let normals = smooth_normals(mesh, &area_normals);
                mesh.faces.iter().map(|f| f.map(|v| normals[v as usize])).collect()
            }
        };
        let (corner_colours, textures) = match look.appearance {
            Appearance::White => (Vec::new(), Vec::new()),
            Appearance::Coloured => {
                let skin = |m: &Material| skin(mesh, m, &encode_texel);
                let textures: Vec<_> = mesh.materials.par_iter().map(skin).collect();
                let colours = linear_colours(mesh, &textures);
                (colours.map(|corners| corners.map(&encode)).collect(), textures)
            }
        };
        let face_normals = area_normals.into_iter().map(DVec3::normalize_or_zero).collect();
        Self { mesh, face_normals, corner_normals, corner_colours, textures }
    }

    /// The same with the normals that the mesh has as an attribute, brought to unit length as in a
    /// glTF file. Changes nothing in flat shading, or where there are none.
    #[must_use]
    pub fn with_stored_normals(self) -> Self {
        let layer = self.mesh.layer(Semantic::Normal).filter(|layer| layer.width == 3);
        let Some(layer) = layer.filter(|_| !self.corner_normals.is_empty()) else { return self };
        let stored = |w: u32| match layer.get(WedgeId(w)) {
            &[x, y, z] => DVec3::new(x.into(), y.into(), z.into()).normalize_or_zero(),
            _ => DVec3::ZERO,
        };
        let corner_normals = self.mesh.face_wedges.iter().map(|f| f.map(stored)).collect();
        Self { corner_normals, ..self }
    }

    /// The texture of a triangle that is drawn there.
    fn brush(&self, face: usize, spots: &[Spot; 3]) -> Option<Brush<'_, N>> {
        let material = self.mesh.face_materials.get(face).copied().unwrap_or(0);
        let skin = self.textures.get(material as usize)?.as_ref()?;
        let uv = self.coordinates(face, &skin.at).or(skin.is_plain().then_some([[0.0; 2]; 3]))?;
        let Skin { texture, sieve, glow, .. } = skin;
        Some(Brush::new(texture, sieve.as_ref(), glow.as_ref(), (uv, spots)))
    }

    fn coordinates(&self, face: usize, at: &TextureUse) -> Option<[[f32; 2]; 3]> {
        let layer = self.mesh.layer(Semantic::TexCoord(at.tex_coord))?;
        Some(self.mesh.face_wedges.get(face)?.map(|w| match layer.get(WedgeId(w)) {
            &[u, v, ..] => at.transform.map(|[a, b, c]| a * u + b * v + c),
            _ => [0.0; 2],
        }))
    }

    /// Whether a triangle turns its back to the viewer and is meant to be seen from its front alone.
    fn is_hidden(&self, face: usize, corners: &[Spot; 3]) -> bool {
        // Rows run downwards: counter-clockwise is negative.
        doubled_area(corners) > 0.0 && self.material(face).is_some_and(|m| !m.double_sided)
    }

    /// Whether no light falls on a triangle; that of a white surface does.
    fn is_unlit(&self, face: usize) -> bool {
        !self.textures.is_empty() && self.material(face).is_some_and(|m| m.unlit)
    }

    fn material(&self, face: usize) -> Option<&Material> {
        let material = self.mesh.face_materials.get(face).copied().unwrap_or(0);
        self.mesh.materials.get(material as usize)
    }

    fn paints(&self, face: usize, view: &View, look: &Look) -> [Paint<N>; 3] {
        let corners = self.mesh.faces[face].map(|v| v as usize);
        let points = corners.map(|v| self.mesh.positions[v]);
        let normal = self.face_normals[face];
        let shade = |at: DVec3, shading_normal: DVec3| {
            let to_viewer = if view.sees_front(at, normal) { 1.0 } else { -1.0 };
            let lambert = (to_viewer * shading_normal.dot(view.to_light)).max(0.0);
            (look.ambient + (1.0 - look.ambient) * lambert) as f32
        };
        let shades = match self.corner_normals.get(face) {
            _ if self.is_unlit(face) => [1.0; 3],
            None => [shade((points[0] + points[1] + points[2]) / 3.0, normal); 3],
            Some(normals) => [0, 1, 2].map(|k| shade(points[k], normals[k])),
        };
        let colours = self.corner_colours.get(face).copied().unwrap_or([[1.0; N]; 3]);
        [0, 1, 2].map(|k| Paint { shade: shades[k], colour: colours[k] })
    }
}

/// Draws the mesh in each view, in parallel, one view at a time per thread: `image_size²` pixels
/// each, row after row from the top. `tick` hears from any thread that so large a share of the views begins; its
/// error ends the work.
pub fn pictures<const N: usize, E: Send>(
    drawable: &Drawable<'_, N>,
    views: &[View],
    look: &Look,
    tick: &(dyn Fn(f64) -> Result<(), E> + Sync),
) -> Result<Vec<Vec<[f32; N]>>, E> {
    let look = &Look {
        image_size: look.image_size.max(1),
        supersampling: look.supersampling.max(1),
        ..*look
    };
    let share = 1.0 / views.len() as f64;
    views.par_iter().map(|view| tick(share).map(|()| picture(drawable, view, look))).collect()
}

/// Pixel rows drawn at a time: half a megabyte of samples at 512² and 4 × 4.
const BAND_PIXELS: usize = 8;

fn picture<const N: usize>(drawable: &Drawable<'_, N>, view: &View, look: &Look) -> Vec<[f32; N]> {
    let side = look.image_size * look.supersampling;
    let spots: Vec<Spot> = drawable.mesh.positions.iter().map(|p| spot(view, *p, side)).collect();
    let rows_of_band = BAND_PIXELS * look.supersampling;
    let bins = Bins::new(&drawable.mesh.faces, &spots, side, rows_of_band);
    let mut pixels = Vec::with_capacity(look.image_size * look.image_size);
    let mut band = Band::new(side);
    for (index, faces) in bins.bands().enumerate() {
        let first = index * rows_of_band;
        band.clear(first..(first + rows_of_band).min(side), look.background as f32);
        for face in faces {
            let corners = drawable.mesh.faces[*face as usize].map(|v| spots[v as usize]);
            if look.hides_back_faces && drawable.is_hidden(*face as usize, &corners) {
                continue;
            }
            let brush = drawable.brush(*face as usize, &corners);
            band.draw(&corners, &drawable.paints(*face as usize, view, look), brush.as_ref());
        }
        box_filter(&band, look, &mut pixels);
    }
    pixels
}

fn spot(view: &View, point: DVec3, side: usize) -> Spot {
    let at = view.project(point);
    let inv_w = match view.projection {
        Projection::Perspective => 1.0 / (view.eye - point).dot(view.back),
        Projection::Orthographic => 1.0,
    };
    Spot { x: at.x * side as f64, y: at.y * side as f64, z: at.depth, inv_w }
}

/// The faces that each band of rows may show, in face order.
struct Bins {
    /// Where each band's faces start in `faces`, and where the last ends.
    starts: Vec<usize>,
    faces: Vec<u32>,
}

impl Bins {
    fn new(faces: &[[u32; 3]], spots: &[Spot], side: usize, rows_of_band: usize) -> Self {
        let bands_of = |corners: &[u32; 3]| {
            let rows = rows_spanned(&corners.map(|v| spots[v as usize]), side);
            rows.start / rows_of_band..rows.end.div_ceil(rows_of_band)
        };
        let bands: Vec<Range<usize>> = faces.iter().map(bands_of).collect();
        let mut starts = vec![0_usize; side.div_ceil(rows_of_band) + 1];
        bands.iter().flat_map(Clone::clone).for_each(|band| starts[band + 1] += 1);
        for band in 1..starts.len() {
            starts[band] += starts[band - 1];
        }
        let mut binned = vec![0_u32; starts.last().copied().unwrap_or(0)];
        let mut next = starts.clone();
        for (face, bands) in bands.into_iter().enumerate() {
            for band in bands {
                binned[next[band]] = face as u32;
                next[band] += 1;
            }
        }
        Self { starts, faces: binned }
    }

    fn bands(&self) -> impl Iterator<Item = &[u32]> {
        self.starts.windows(2).map(|at| &self.faces[at[0]..at[1]])
    }
}

/// Appends the band's pixels, each the mean of its samples.
fn box_filter<const N: usize>(band: &Band<N>, look: &Look, pixels: &mut Vec<[f32; N]>) {
    let n = look.supersampling;
    let scale = 1.0 / (n * n) as f32;
    let mut columns = vec![[0.0_f32; N]; band.side];
    for rows in band.values.chunks_exact(band.side * n) {
        columns.fill([0.0; N]);
        for row in rows.chunks_exact(band.side) {
            let sums = columns.as_flattened_mut().iter_mut();
            sums.zip(row.as_flattened()).for_each(|(sum, value)| *sum += value);
        }
        pixels.extend(columns.chunks_exact(n).map(|samples| {
            std::array::from_fn(|c| samples.iter().map(|sample| sample[c]).sum::<f32>() * scale)
        }));
    }
}

/// Normals of the triangles, twice their area long.
fn area_normals(mesh: &Mesh) -> Vec<DVec3> {
    let normal = |corners: &[u32; 3]| {
        let [a, b, c] = corners.map(|v| mesh.positions[v as usize]);
        (b - a).cross(c - a)
    };
    mesh.faces.iter().map(normal).collect()
}

/// Area-weighted unit normals; vertices at the same position share one, so that seams between
/// parts do not show.
fn smooth_normals(mesh: &Mesh, area_normals: &[DVec3]) -> Vec<DVec3> {
    let mut first_at: HashMap<[u64; 3], usize> = HashMap::with_capacity(mesh.positions.len());
    let shared: Vec<usize> = (mesh.positions.iter().enumerate())
        // Adding zero turns −0 into 0, which is the same position.
        .map(|(v, p)| *first_at.entry((*p + DVec3::ZERO).to_array().map(f64::to_bits)).or_insert(v))
        .collect();
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for (corners, normal) in mesh.faces.iter().zip(area_normals) {
        corners.iter().for_each(|v| sums[shared[*v as usize]] += *normal);
    }
    shared.into_iter().map(|v| sums[v].normalize_or_zero()).collect()
}

/// Linear RGB of every corner: base colour of the material × the first colour set. A texture has the factor in it.
fn linear_colours<const N: usize>(
    mesh: &Mesh,
    textures: &[Option<Skin<N>>],
) -> impl Iterator<Item = [[f32; 3]; 3]> {
    let layer = mesh.layer(Semantic::Color(0)).filter(|layer| layer.width >= 3);
    (0..mesh.faces.len()).map(move |face| {
        let material = mesh.face_materials.get(face).copied().unwrap_or(0) as usize;
        let is_textured = textures.get(material).is_some_and(Option::is_some);
        let material = mesh.materials.get(material).filter(|_| !is_textured);
        let base = material.map_or([1.0; 4], |m| m.base_color);
        [0, 1, 2].map(|k| {
            let vertex = layer.map_or([1.0; 3], |layer| {
                let at = mesh.face_wedges[face][k] as usize * layer.width;
                [0, 1, 2].map(|c| layer.values[at + c])
            });
            [0, 1, 2].map(|c| base[c] * vertex[c])
        })
    })
}

#[cfg(test)]
#[path = "raster_tests.rs"]
mod tests;
