//! The textures of a model as the pictures need them: luminances, no finer than pictures show.
//!
//! Colours are taken as they are encoded, without a transfer curve, as `image.rs` takes all others: base colour
//! texture times factor. Alpha is not looked at.

use std::sync::Arc;

use rayon::prelude::*;

use crate::{
    mesh::{Image, Material, Mesh, Pixels, TextureUse, Wrap},
    render::Texels,
};

use super::image::REC709;

/// Texels along a side of a texture, at most, for each pixel along a side of a picture: a model that fills the
/// picture then shows a texel in each of its pixels even where a quarter of the texture covers it.
const TEXELS_PER_PIXEL: u32 = 4;

/// See the module.
#[derive(Clone, Debug, Default)]
pub struct Palette {
    texels: Arc<Texels>,
    /// By material.
    paintings: Vec<Option<Painting>>,
}

/// What the triangles of a material are painted with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Painting {
    /// Number of the texture among the texels.
    pub map: u32,
    /// Set of texture coordinates.
    pub tex_coord: u32,
    /// From coordinates to places on the texture.
    transform: [[f32; 3]; 2],
}

impl Painting {
    /// Where a corner with these coordinates lies on the texture.
    pub fn place(&self, uv: &[f32]) -> [f32; 2] {
        let &[u, v, ..] = uv else { return [0.0; 2] };
        self.transform.map(|[a, b, c]| a * u + b * v + c)
    }
}

/// What a texture is made of: materials that agree in it share one.
#[derive(Clone, Copy, PartialEq)]
struct Recipe<'m> {
    image: &'m Image,
    wrap: [Wrap; 2],
    factor: [f32; 3],
}

impl Palette {
    /// Of a mesh that is shown in pictures of so many pixels a side.
    pub fn of(mesh: &Mesh, image_size: u32) -> Self {
        let mut recipes: Vec<Recipe<'_>> = Vec::new();
        let recipe_of = |m: &Material| {
            let texture = mesh.textures.get(m.base_texture?.texture as usize)?;
            let image = mesh.images.get(texture.image? as usize)?;
            image.pixels.as_ref()?;
            let [r, g, b, _] = m.base_color;
            Some(Recipe { image, wrap: texture.wrap, factor: [r, g, b] })
        };
        let mut paint = |m: &Material| {
            let (recipe, at) = (recipe_of(m)?, m.base_texture?);
            let known = recipes.iter().position(|r| *r == recipe);
            let map = known.unwrap_or(recipes.len());
            if known.is_none() {
                recipes.push(recipe);
            }
            Some(Painting {
                map: map as u32,
                tex_coord: at.tex_coord,
                transform: scaled(&at, recipe.wrap),
            })
        };
        let paintings = mesh.materials.iter().map(&mut paint).collect();
        let most = TEXELS_PER_PIXEL * image_size.next_power_of_two();
        let draw = |r: &Recipe<'_>| r.image.pixels.as_ref().map(|p| r.luminances(p, most));
        let drawn: Vec<_> = recipes.par_iter().map(draw).collect();
        let mut texels = Texels::default();
        for (recipe, (bits, luminances)) in recipes.iter().zip(drawn.into_iter().flatten()) {
            texels.add(bits, luminances, recipe.wrap.map(|w| w == Wrap::Clamp));
        }
        Self { texels: Arc::new(texels), paintings }
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

impl Recipe<'_> {
    /// Luminances, on sides that are powers of two and at most `most`, and the logarithms of these.
    fn luminances(&self, pixels: &Pixels, most: u32) -> ([u32; 2], Vec<u8>) {
        let (width, height) = (pixels.width as usize, pixels.height as usize);
        let weights: [f32; 3] = std::array::from_fn(|c| REC709[c] as f32 * self.factor[c]);
        let luminance = |p: &[u8; 4]| (0..3).map(|c| weights[c] * f32::from(p[c])).sum();
        let level: Vec<f32> = pixels.rgba.as_chunks::<4>().0.iter().map(luminance).collect();
        let side = |n: usize| n.next_power_of_two().min(most as usize);
        let across = resized(&level, (width, height), side(width));
        let down = resized(&transposed(&across, side(width)), (height, side(width)), side(height));
        let mut level = transposed(&down, side(height));
        let (mut bits, mut width) = ([side(width), side(height)].map(usize::ilog2), side(width));
        if self.wrap[0] == Wrap::Mirror {
            level = mirrored(&level, width);
            (bits[0], width) = (bits[0] + 1, 2 * width);
        }
        if self.wrap[1] == Wrap::Mirror {
            let below: Vec<f32> = level.rchunks_exact(width).flatten().copied().collect();
            level.extend(below);
            bits[1] += 1;
        }
        (bits, level.iter().map(|l| (l.clamp(0.0, 255.0) + 0.5) as u8).collect())
    }
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
