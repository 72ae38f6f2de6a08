//! The textures of a model as the pictures need them: luminances, or a texture each of red, green and blue, no finer
//! than pictures show.
//!
//! Colours are taken as they are encoded, without a transfer curve, as `image.rs` takes all others: base colour
//! texture times factor. Where a material is masked, alpha below its threshold leaves holes; where it is blended, as
//! large a share of the pixels, evenly spread: what lies behind shows through without an order.

use std::sync::Arc;

use rayon::prelude::*;

use crate::{
    mesh::{Coverage, Image, Material, Mesh, Pixels, TextureUse, Wrap},
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
}

/// What a texture is made of: materials that agree in it share one.
#[derive(Clone, Copy, PartialEq)]
struct Recipe<'m> {
    /// `None` for a single texel.
    image: Option<&'m Image>,
    wrap: [Wrap; 2],
    factor: [f32; 4],
    sieve: Option<Sieve>,
}

impl Palette {
    /// Of a mesh that is shown in pictures of so many pixels a side, by a metric.
    pub fn of(mesh: &Mesh, image_size: u32, metric: Metric) -> Self {
        let mut recipes: Vec<Recipe<'_>> = Vec::new();
        let mut paint = |m: &Material| {
            let recipe = Recipe::of(mesh, m)?;
            let at = m.base_texture.filter(|_| recipe.image.is_some());
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
            for (bits, values, alpha) in channels {
                texels.add(bits, values, recipe.wrap.map(|w| w == Wrap::Clamp), alpha);
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

impl<'m> Recipe<'m> {
    /// Of a material that needs one: it has a texture that was read, or lets something through.
    fn of(mesh: &'m Mesh, m: &Material) -> Option<Self> {
        let texture = m.base_texture.and_then(|at| mesh.textures.get(at.texture as usize));
        let image = texture.and_then(|t| mesh.images.get(t.image? as usize));
        let image = image.filter(|image| image.pixels.is_some());
        let sieve = match m.coverage() {
            Coverage::Opaque => None,
            Coverage::Mask(least) => {
                Some(Sieve::Below((least.clamp(0.0, 1.0) * 255.0).ceil() as u8))
            }
            Coverage::Blend => Some(Sieve::Dithered),
        };
        let wrap = texture.filter(|_| image.is_some()).map_or([Wrap::Repeat; 2], |t| t.wrap);
        let this = Self { image, wrap, factor: m.base_color, sieve };
        // What is opaque everywhere needs no second look at each pixel.
        let sieve = sieve.filter(|sieve| this.is_pierced(*sieve));
        (image.is_some() || sieve.is_some()).then_some(Self { sieve, ..this })
    }

    fn pixels(&self) -> Option<&'m Pixels> {
        self.image?.pixels.as_deref()
    }

    fn is_pierced(&self, sieve: Sieve) -> bool {
        let least = if let Sieve::Below(least) = sieve { least } else { 255 };
        let alpha = |p: &[u8; 4]| to_byte(f32::from(p[3]) * self.factor[3]);
        let texels = self.pixels().map_or(std::slice::from_ref(&WHITE), |p| p.rgba.as_chunks().0);
        texels.iter().any(|p| alpha(p) < least)
    }

    /// A channel, which has so much of red, green and blue, and alphas, on sides that are powers of two and at most
    /// `most`, and the logarithms of these.
    fn drawn(&self, most: u32, weights: &[f64; 3]) -> ([u32; 2], Vec<u8>, Option<Alpha>) {
        let [r, g, b] = std::array::from_fn(|c| weights[c] as f32 * self.factor[c]);
        let (bits, luminances) = self.channel([r, g, b, 0.0], most);
        let alpha = self.sieve.map(|sieve| {
            let (_, values) = self.channel([0.0, 0.0, 0.0, self.factor[3]], most);
            Alpha { values, sieve }
        });
        (bits, luminances, alpha)
    }

    /// A weighted sum of the image's channels.
    fn channel(&self, weights: [f32; 4], most: u32) -> ([u32; 2], Vec<u8>) {
        let (width, height) =
            self.pixels().map_or((1, 1), |p| (p.width as usize, p.height as usize));
        let sum = |p: &[u8; 4]| (0..4).map(|c| weights[c] * f32::from(p[c])).sum();
        let texels = self.pixels().map_or(std::slice::from_ref(&WHITE), |p| p.rgba.as_chunks().0);
        let level: Vec<f32> = texels.iter().map(sum).collect();
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
        (bits, level.into_iter().map(to_byte).collect())
    }
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
mod tests {
    use std::sync::Arc;

    use glam::DVec3;
    use serde_json::{Value, json};

    use crate::{
        mesh::{Image, Material, Mesh, Pixels, Texture, TextureUse},
        metric::{Pictures, bounding_sphere, is_white, reference_pictures},
        render::{
            RenderParams, Shading,
            view::{Projection, ViewParams, cameras},
        },
    };

    /// A square that faces the viewer, of one material.
    fn wall(source: Value, alpha: f32) -> Mesh {
        let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let mut mesh = Mesh::from_parts(
            vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
            vec![[0, 1, 2], [0, 2, 3]],
        );
        let base_color = [1.0, 1.0, 1.0, alpha];
        mesh.materials = vec![Material { base_color, source: Some(source), ..Material::default() }];
        mesh
    }

    /// The share of the wall's pixels that it covers; the background is black.
    fn share_seen(mesh: &Mesh) -> f64 {
        share_seen_where(mesh, false)
    }

    fn share_seen_where(mesh: &Mesh, hides_back_faces: bool) -> f64 {
        let params = RenderParams {
            image_size: 128,
            shading: Shading::Flat,
            ambient: 0.1,
            background: 0,
            interior_views: 0,
            hides_back_faces,
        };
        let view_params = ViewParams {
            directions: vec![DVec3::Z],
            fov_degrees: 60.0,
            projection: Projection::Orthographic,
            light_degrees: 0.0,
        };
        let views = cameras(&bounding_sphere(mesh), &view_params);
        let seen = |mesh: &Mesh| {
            let pictures = Pictures::of(mesh, params.clone(), views.clone());
            let picture = reference_pictures(mesh, &pictures).pictures.remove(0);
            picture.into_iter().filter(|lum| *lum > 0).count() as f64
        };
        seen(mesh) / seen(&wall(Value::Null, 1.0))
    }

    #[test]
    fn alpha_says_how_much_of_a_surface_is_there() {
        let (mask, blend) =
            (json!({ "alphaMode": "MASK", "alphaCutoff": 0.4 }), json!({ "alphaMode": "BLEND" }));
        for (source, alpha, expected) in [
            (json!({ "alphaMode": "OPAQUE" }), 0.0, 1.0),
            (mask.clone(), 0.41, 1.0),
            (mask, 0.39, 0.0),
            (json!({ "alphaMode": "MASK" }), 0.49, 0.0),
            (blend.clone(), 0.25, 0.25),
            (blend.clone(), 0.0, 0.0),
            (blend, 1.0, 1.0),
        ] {
            let found = share_seen(&wall(source.clone(), alpha));
            assert!((found - expected).abs() < 0.01, "{source} {alpha}: {found}");
        }
        assert!(is_white(&wall(Value::Null, 0.5)));
        assert!(!is_white(&wall(json!({ "alphaMode": "BLEND" }), 0.5)));
    }

    #[test]
    fn backs_of_single_sided_materials_can_be_hidden() {
        for (double_sided, is_turned, hides, expected) in [
            (false, true, true, 0.0),
            (false, true, false, 1.0),
            (false, false, true, 1.0),
            (true, true, true, 1.0),
        ] {
            let mut mesh = wall(Value::Null, 1.0);
            mesh.materials[0].double_sided = double_sided;
            if is_turned {
                mesh.faces.iter_mut().for_each(|face| face.swap(1, 2));
            }
            assert_eq!(
                share_seen_where(&mesh, hides),
                expected,
                "{double_sided} {is_turned} {hides}"
            );
        }
    }

    /// Seen from so far that several texels fall into a pixel, a fence of thin bars covers as much as from near by.
    #[test]
    fn masks_keep_their_share_at_coarse_levels() {
        let side = 2048;
        let bar = |x: u32, y: u32| u8::from((x / 3 + y / 5).is_multiple_of(4)) * 255;
        let texel = |k: u32| [255, 255, 255, bar(k % side, k / side)];
        let rgba = (0..side * side).flat_map(texel).collect();
        let mut mesh = wall(json!({ "alphaMode": "MASK" }), 1.0);
        mesh.images = vec![Image {
            pixels: Some(Arc::new(Pixels { width: side, height: side, rgba })),
            ..Image::default()
        }];
        mesh.textures = vec![Texture { image: Some(0), ..Texture::default() }];
        let transform = [[0.5, 0.0, 0.5], [0.0, 0.5, 0.5]];
        mesh.materials[0].base_texture = Some(TextureUse { texture: 0, tex_coord: 0, transform });
        mesh.face_wedges = mesh.faces.clone();
        let values = mesh.positions.iter().flat_map(|p| [p.x as f32, p.y as f32]).collect();
        mesh.layers = vec![crate::mesh::AttributeLayer {
            semantic: crate::mesh::Semantic::TexCoord(0),
            width: 2,
            values,
        }];
        let found = share_seen(&mesh);
        assert!((found - 0.25).abs() < 0.04, "{found}");
    }
}
