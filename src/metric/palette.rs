//! The textures of a model as the pictures need them: luminances, or a texture each of red, green and blue, no finer
//! than pictures show.
//!
//! Colours are taken as they are encoded, without a transfer curve, as `image.rs` takes all others: base colour
//! texture times factor; and what is given off, emissive texture times factor, each channel up to full scale. Where a
//! material is masked, alpha below its threshold leaves holes; where it is blended, as large a share of the pixels,
//! evenly spread: what lies behind shows through without an order.

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    mesh::{Coverage, Image, Material, Mesh, TextureUse, Wrap},
    render::{Alpha, Sieve, Texels},
};

use super::channels::Metric;

/// Texels along a side of a texture, at most, for each pixel along a side of a picture: a model that fills the
/// picture then shows a texel in each of its pixels even where a quarter of the texture covers it.
const TEXELS_PER_PIXEL: u32 = 4;

/// See the module.
#[derive(Clone, Debug, Default)]
pub struct Palette {
    texels: Arc<Texels>,
    /// By material.
    paintings: Vec<Option<Painting>>,
    /// By which it is seen.
    metric: Metric,
}

/// What the triangles of a material are painted with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Painting {
    /// Number of the texture among the texels.
    pub map: u32,
    /// Set of texture coordinates; `None` where it is the same everywhere.
    pub tex_coord: Option<u32>,
    /// From coordinates to places on the texture.
    transform: [[f32; 3]; 2],
}

impl Painting {
    /// Where a corner with these coordinates lies on the texture.
    pub fn place(&self, uv: &[f32]) -> [f32; 2] {
        let &[u, v, ..] = uv else { return [0.0; 2] };
        self.transform.map(|[a, b, c]| a * u + b * v + c)
    }

    /// How the place changes with the coordinates, rightwards and downwards.
    pub fn turns(&self) -> [DVec3; 2] {
        self.transform.map(|[a, b, _]| DVec3::new(a.into(), b.into(), 0.0))
    }
}

/// What a texture is made of: materials that agree in it share one.
#[derive(Clone, Copy, PartialEq)]
struct Recipe<'m> {
    /// `None` for a single texel.
    image: Option<&'m Image>,
    wrap: [Wrap; 2],
    factor: [f32; 4],
    sieve: Option<Sieve>,
    /// What is given off.
    glow: Option<Shine<'m>>,
}

/// A factor times an image, or the same everywhere.
#[derive(Clone, Copy, PartialEq)]
struct Shine<'m> {
    image: Option<&'m Image>,
    factor: [f32; 3],
}

impl Palette {
    /// Of a mesh that is shown in pictures of so many pixels a side, by a metric.
    pub fn of(mesh: &Mesh, image_size: u32, metric: Metric) -> Self {
        let mut recipes: Vec<Recipe<'_>> = Vec::new();
        let mut paint = |m: &Material| {
            let (recipe, at) = Recipe::of(mesh, m)?;
            let known = recipes.iter().position(|r| *r == recipe);
            let map = known.unwrap_or(recipes.len());
            if known.is_none() {
                recipes.push(recipe);
            }
            Some(Painting {
                map: (map * metric.n_channels()) as u32,
                tex_coord: at.map(|at| at.tex_coord),
                transform: at.map_or(TextureUse::IDENTITY, |at| scaled(&at, recipe.wrap)),
            })
        };
        let paintings = mesh.materials.iter().map(&mut paint).collect();
        let most = TEXELS_PER_PIXEL * image_size.next_power_of_two();
        let draw = |r: &Recipe<'_>| metric.weights().iter().map(|w| r.drawn(most, w)).collect();
        let drawn: Vec<Vec<_>> = recipes.par_iter().map(draw).collect();
        let mut texels = Texels::default();
        for (recipe, channels) in recipes.iter().zip(drawn) {
            for Drawn { bits, values, alpha, glow } in channels {
                texels.add(bits, values, recipe.wrap.map(|w| w == Wrap::Clamp), alpha, glow);
            }
        }
        Self { texels: Arc::new(texels), paintings, metric }
    }

    /// What is seen of colours.
    pub(super) fn metric(&self) -> Metric {
        self.metric
    }

    /// The textures.
    pub fn texels(&self) -> &Arc<Texels> {
        &self.texels
    }

    /// Whether nothing is textured.
    pub fn is_empty(&self) -> bool {
        self.paintings.iter().all(Option::is_none)
    }

    /// What a material is painted with.
    pub(super) fn painting(&self, material: u32) -> Option<&Painting> {
        self.paintings.get(material as usize)?.as_ref()
    }
}

/// Coordinates of a texture that is stored with its mirror image count half.
fn scaled(at: &TextureUse, wrap: [Wrap; 2]) -> [[f32; 3]; 2] {
    let half = |axis: usize| if wrap[axis] == Wrap::Mirror { 0.5 } else { 1.0 };
    [0, 1].map(|axis| at.transform[axis].map(|x| x * half(axis)))
}

/// What takes the place of an image that is not there.
const WHITE: [u8; 4] = [255; 4];

/// A texture, on sides that are powers of two.
struct Drawn {
    /// The logarithms of these.
    bits: [u32; 2],
    values: Vec<u8>,
    alpha: Option<Alpha>,
    glow: Option<Vec<u8>>,
}

impl<'m> Recipe<'m> {
    /// Of a material that needs one, and where it lies: it has a texture that was read, gives something off, or lets
    /// something through.
    fn of(mesh: &'m Mesh, m: &Material) -> Option<(Self, Option<TextureUse>)> {
        let texture = m.base_texture.and_then(|at| mesh.textures.get(at.texture as usize));
        let image = texture.and_then(|t| mesh.images.get(t.image? as usize));
        let image = image.filter(|image| image.pixels.is_some());
        let glow = mesh.glow_of(m);
        let glowing = glow.and_then(|glow| glow.texture);
        let sieve = match m.coverage() {
            Coverage::Opaque => None,
            Coverage::Mask(least) => {
                Some(Sieve::Below((least.clamp(0.0, 1.0) * 255.0).ceil() as u8))
            }
            Coverage::Blend => Some(Sieve::Dithered),
        };
        let base =
            m.base_texture.zip(texture).filter(|_| image.is_some()).map(|(at, t)| (at, t.wrap));
        let place = base.or(glowing.map(|glowing| (glowing.at, glowing.wrap)));
        let wrap = place.map_or([Wrap::Repeat; 2], |(_, wrap)| wrap);
        let glow = glow.map(|glow| Shine { image: glowing.map(|g| g.image), factor: glow.factor });
        let this = Self { image, wrap, factor: m.base_color, sieve, glow };
        // What is opaque everywhere needs no second look at each pixel.
        let sieve = sieve.filter(|sieve| this.is_pierced(*sieve));
        let is_needed = image.is_some() || sieve.is_some() || glow.is_some();
        is_needed.then_some((Self { sieve, ..this }, place.map(|(at, _)| at)))
    }

    fn is_pierced(&self, sieve: Sieve) -> bool {
        let least = if let Sieve::Below(least) = sieve { least } else { 255 };
        let alpha = |p: &[u8; 4]| to_byte(f32::from(p[3]) * self.factor[3]);
        texels(self.image).iter().any(|p| alpha(p) < least)
    }

    /// A channel, which has so much of red, green and blue; alphas; and what is given off in that channel. On sides of
    /// at most `most`.
    fn drawn(&self, most: u32, weights: &[f64; 3]) -> Drawn {
        let [r, g, b] = std::array::from_fn(|c| weights[c] as f32 * self.factor[c]);
        let base = |weights: [f32; 4]| {
            let sum = |p: &[u8; 4]| (0..4).map(|c| weights[c] * f32::from(p[c])).sum();
            self.channel(self.image, sum, most)
        };
        let (bits, values) = base([r, g, b, 0.0]);
        let alpha = self.sieve.map(|sieve| {
            let (_, values) = base([0.0, 0.0, 0.0, self.factor[3]]);
            Alpha { values, sieve }
        });
        let glow = self.glow.map(|glow| {
            let channel = |p: &[u8; 4], c: usize| (glow.factor[c] * f32::from(p[c])).min(255.0);
            let sum = |p: &[u8; 4]| (0..3).map(|c| weights[c] as f32 * channel(p, c)).sum();
            self.channel(glow.image, sum, most).1
        });
        // What is black everywhere needs no second look either.
        let glow = glow.filter(|glow| glow.iter().any(|lum| *lum > 0));
        Drawn { bits, values, alpha, glow }
    }

    /// Sides that hold both images, at most `most`.
    fn sides(&self, most: u32) -> [usize; 2] {
        let images = [self.image, self.glow.and_then(|glow| glow.image)].map(size);
        let side = |n: usize| n.next_power_of_two().min(most as usize);
        [side(images[0].0.max(images[1].0)), side(images[0].1.max(images[1].1))]
    }

    /// A value of each of an image's texels, and the logarithms of the sides.
    fn channel(
        &self,
        image: Option<&Image>,
        value: impl Fn(&[u8; 4]) -> f32,
        most: u32,
    ) -> ([u32; 2], Vec<u8>) {
        let ((width, height), [across, down]) = (size(image), self.sides(most));
        let level: Vec<f32> = texels(image).iter().map(value).collect();
        let level = resized(&level, (width, height), across);
        let level = resized(&transposed(&level, across), (height, across), down);
        let mut level = transposed(&level, down);
        let (mut bits, mut width) = ([across, down].map(usize::ilog2), across);
        if self.wrap[0] == Wrap::Mirror {
            level = mirrored(&level, width);
            (bits[0], width) = (bits[0] + 1, 2 * width);
        }
        if self.wrap[1] == Wrap::Mirror {
            let below: Vec<f32> = level.rchunks_exact(width).flatten().copied().collect();
            level.extend(below);
            bits[1] += 1;
        }
        (bits, level.into_iter().map(to_byte).collect())
    }
}

/// Red, green, blue and alpha of an image; a single white texel where there is none.
fn texels(image: Option<&Image>) -> &[[u8; 4]] {
    let pixels = image.and_then(|image| image.pixels.as_deref());
    pixels.map_or(std::slice::from_ref(&WHITE), |pixels| pixels.rgba.as_chunks().0)
}

/// Width and height of [`texels`].
fn size(image: Option<&Image>) -> (usize, usize) {
    let pixels = image.and_then(|image| image.pixels.as_deref());
    pixels.map_or((1, 1), |pixels| (pixels.width as usize, pixels.height as usize))
}

fn to_byte(value: f32) -> u8 {
    (value.clamp(0.0, 255.0) + 0.5) as u8
}

/// Rows of another length: each value is the mean over its part of the row.
fn resized(values: &[f32], (width, height): (usize, usize), to: usize) -> Vec<f32> {
    if width == to {
        return values.to_vec();
    }
    let mut out = Vec::with_capacity(to * height);
    let scale = width as f32 / to as f32;
    for row in values.chunks_exact(width) {
        out.extend((0..to).map(|k| {
            let (from, end) = (k as f32 * scale, (k + 1) as f32 * scale);
            let share = |i: usize| (end.min((i + 1) as f32) - from.max(i as f32)).max(0.0);
            let part = from as usize..(end.ceil() as usize).min(width);
            part.map(|i| row[i] * share(i)).sum::<f32>() / scale
        }));
    }
    out
}

fn transposed(values: &[f32], width: usize) -> Vec<f32> {
    let height = values.len() / width.max(1);
    (0..width).flat_map(|x| (0..height).map(move |y| values[y * width + x])).collect()
}

/// Every row followed by its mirror image.
fn mirrored(values: &[f32], width: usize) -> Vec<f32> {
    let rows = values.chunks_exact(width);
    rows.flat_map(|row| row.iter().chain(row.iter().rev())).copied().collect()
}

#[cfg(test)]
#[path = "palette_tests.rs"]
mod tests;
