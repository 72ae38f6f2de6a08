//! Textures of the off-line rasteriser: mip-mapped and filtered in floating point.
//!
//! A triangle is drawn from the two levels between which a texel is as wide as a sample at its middle; samples are
//! many to a pixel, so that what is left to filter, the pixel's box does.
//!
//! Where alpha says that a surface is not there, it is not drawn: sample by sample below a threshold, or at as large
//! a share of a pixel's samples as is transparent.
//!
//! Knows nothing of meshes.

use super::scan::Spot;
use crate::mesh::{Coverage, Pixels, Wrap};

/// A texture and its smaller versions, with `N` channels.
pub(super) struct Texture<const N: usize> {
    levels: Vec<Level<N>>,
    wrap: [Wrap; 2],
}

/// Where a textured surface is.
pub(super) struct Sieve {
    alpha: Texture<1>,
    coverage: Coverage,
}

/// A [`Sieve`] on a triangle.
pub(super) struct Holes<'t> {
    alpha: Filtered<'t, 1>,
    coverage: Coverage,
}

impl Sieve {
    /// Of an image and the factor of its alphas.
    pub(super) fn new(pixels: &Pixels, wrap: [Wrap; 2], factor: f32, coverage: Coverage) -> Self {
        let channel = |p: &[u8; 4]| [((f32::from(p[3]) * factor).clamp(0.0, 255.0) + 0.5) as u8];
        Self { alpha: Texture::of_texels(pixels, wrap, channel), coverage }
    }

    /// On a triangle with these coordinates at its corners.
    fn on(&self, uv: [[f32; 2]; 3], spots: &[Spot; 3]) -> Holes<'_> {
        Holes { alpha: self.alpha.filtered(uv, spots), coverage: self.coverage }
    }
}

impl Holes<'_> {
    /// Whether the surface is at some coordinates, which are seen in the sample at (x, y).
    pub(super) fn is_there(&self, uv: [f32; 2], (x, y): (usize, usize)) -> bool {
        // Of 4 × 4 samples as many as may be, whatever the share, and far from one another.
        const RANKS: [[u8; 4]; 4] = [[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]];
        let [alpha] = self.alpha.at(uv);
        match self.coverage {
            Coverage::Opaque => true,
            Coverage::Mask(least) => alpha >= least,
            Coverage::Blend => 16.0 * alpha > f32::from(RANKS[y % 4][x % 4]) + 0.5,
        }
    }
}

struct Level<const N: usize> {
    width: usize,
    height: usize,
    texels: Vec<[u8; N]>,
}

/// A texture on a triangle.
pub(super) struct Brush<'t, const N: usize> {
    /// Coordinates of the corners; the texture covers 0..1, downwards and to the right.
    pub(super) uv: [[f32; 2]; 3],
    /// Where it has some.
    pub(super) holes: Option<Holes<'t>>,
    colour: Filtered<'t, N>,
    glow: Option<Filtered<'t, N>>,
}

/// A texture as coarse as a triangle shows it.
struct Filtered<'t, const N: usize> {
    texture: &'t Texture<N>,
    /// The finer of two levels, and the share of the coarser.
    level: usize,
    share: f32,
}

impl<const N: usize> Texture<N> {
    /// Of an image; `encode` makes channels of red, green and blue, 0 to 1.
    pub(super) fn new(
        pixels: &Pixels,
        wrap: [Wrap; 2],
        encode: impl Fn([f32; 3]) -> [f32; N],
    ) -> Self {
        let texel = |p: &[u8; 4]| {
            let colour = encode([p[0], p[1], p[2]].map(|c| f32::from(c) / 255.0));
            colour.map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
        };
        Self::of_texels(pixels, wrap, texel)
    }

    fn of_texels(pixels: &Pixels, wrap: [Wrap; 2], texel: impl Fn(&[u8; 4]) -> [u8; N]) -> Self {
        let texels = pixels.rgba.as_chunks::<4>().0.iter().map(texel).collect();
        let (width, height) = (pixels.width as usize, pixels.height as usize);
        let mut levels = vec![Level { width, height, texels }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Self { levels, wrap }
    }

    /// Whether it is a single texel.
    pub(super) fn is_plain(&self) -> bool {
        self.levels.len() == 1
    }

    /// On a triangle with these coordinates at its corners.
    fn filtered(&self, uv: [[f32; 2]; 3], spots: &[Spot; 3]) -> Filtered<'_, N> {
        let rate = self.texels_per_sample(uv, spots);
        let depth = if rate > 1.0 { libm::log2(rate) } else { 0.0 };
        let depth = depth.min((self.levels.len() - 1) as f64);
        Filtered { texture: self, level: depth as usize, share: depth.fract() as f32 }
    }

    /// Texels of the finest level from a sample in the middle of a triangle to its neighbours, along the
    /// direction in which they are most.
    fn texels_per_sample(&self, uv: [[f32; 2]; 3], [a, b, c]: &[Spot; 3]) -> f64 {
        let area2 = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        let w = 3.0 / (a.inv_w + b.inv_w + c.inv_w);
        let size = [self.levels[0].width as f64, self.levels[0].height as f64];
        let spots = [a, b, c];
        // Changes of value / w, and of 1 / w, to the right and down.
        let slope = |value: [f64; 3]| {
            let over_w: [f64; 3] = std::array::from_fn(|k| value[k] * spots[k].inv_w);
            let (db, dc) = (over_w[1] - over_w[0], over_w[2] - over_w[0]);
            let dx = (db * (c.y - a.y) - dc * (b.y - a.y)) / area2;
            let dy = (dc * (b.x - a.x) - db * (c.x - a.x)) / area2;
            ([dx, dy], w * (over_w[0] + over_w[1] + over_w[2]) / 3.0)
        };
        let (of_weight, _) = slope([1.0; 3]);
        let mut squares = [0.0; 2];
        for axis in 0..2 {
            let (of_value, middle) = slope(uv.map(|c| f64::from(c[axis]) * size[axis]));
            for (k, square) in squares.iter_mut().enumerate() {
                *square += ((of_value[k] - middle * of_weight[k]) * w).powi(2);
            }
        }
        squares[0].max(squares[1]).sqrt()
    }

    /// Whole texels that a coordinate lies between, and the share of the second.
    fn between(&self, axis: usize, at: f32, size: usize) -> ([usize; 2], f32) {
        let x = at * size as f32 - 0.5;
        let low = x.floor();
        let place = |k: f32| -> usize {
            let (k, n) = (f64::from(k), size as f64);
            let around = |k: f64, n: f64| k - n * (k / n).floor();
            let inside = match self.wrap[axis] {
                Wrap::Clamp => k.clamp(0.0, n - 1.0),
                Wrap::Repeat => around(k, n),
                Wrap::Mirror => {
                    let twice = around(k, 2.0 * n);
                    if twice < n { twice } else { 2.0 * n - 1.0 - twice }
                }
            };
            (inside as usize).min(size - 1)
        };
        ([place(low), place(low + 1.0)], x - low)
    }

    fn bilinear(&self, level: usize, uv: [f32; 2]) -> [f32; N] {
        let level = &self.levels[level];
        let ([left, right], fx) = self.between(0, uv[0], level.width);
        let ([top, bottom], fy) = self.between(1, uv[1], level.height);
        let at = |x: usize, y: usize, c: usize| f32::from(level.texels[y * level.width + x][c]);
        std::array::from_fn(|c| {
            let upper = at(left, top, c) * (1.0 - fx) + at(right, top, c) * fx;
            let lower = at(left, bottom, c) * (1.0 - fx) + at(right, bottom, c) * fx;
            (upper * (1.0 - fy) + lower * fy) / 255.0
        })
    }
}

impl<const N: usize> Level<N> {
    /// Half as wide and high, each texel the mean of four; `None` of a single texel.
    fn halved(&self) -> Option<Self> {
        if self.texels.len() <= 1 {
            return None;
        }
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let at = |x: usize, y: usize, c: usize| {
            let (x, y) = (x.min(self.width - 1), y.min(self.height - 1));
            u32::from(self.texels[y * self.width + x][c])
        };
        let mean = |x: usize, y: usize, c: usize| {
            let (x, y) = (2 * x, 2 * y);
            ((at(x, y, c) + at(x + 1, y, c) + at(x, y + 1, c) + at(x + 1, y + 1, c) + 2) / 4) as u8
        };
        let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let texels = places.map(|(x, y)| std::array::from_fn(|c| mean(x, y, c))).collect();
        Some(Self { width, height, texels })
    }
}

impl<'t, const N: usize> Brush<'t, N> {
    /// A texture, where it has holes, and what it gives off, on a triangle with these coordinates at its corners.
    pub(super) fn new(
        colour: &'t Texture<N>,
        sieve: Option<&'t Sieve>,
        glow: Option<&'t Texture<N>>,
        (uv, spots): ([[f32; 2]; 3], &[Spot; 3]),
    ) -> Self {
        let holes = sieve.map(|sieve| sieve.on(uv, spots));
        let glow = glow.map(|glow| glow.filtered(uv, spots));
        Brush { uv, holes, colour: colour.filtered(uv, spots), glow }
    }

    /// The colour at some coordinates.
    pub(super) fn at(&self, uv: [f32; 2]) -> [f32; N] {
        self.colour.at(uv)
    }

    /// What is given off there, if something is.
    pub(super) fn glow(&self, uv: [f32; 2]) -> Option<[f32; N]> {
        self.glow.as_ref().map(|glow| glow.at(uv))
    }
}

impl<const N: usize> Filtered<'_, N> {
    fn at(&self, uv: [f32; 2]) -> [f32; N] {
        if !uv.iter().all(|c| c.is_finite()) {
            return [1.0; N];
        }
        let fine = self.texture.bilinear(self.level, uv);
        if self.share == 0.0 {
            return fine;
        }
        let coarse = self.texture.bilinear(self.level + 1, uv);
        std::array::from_fn(|c| fine[c] * (1.0 - self.share) + coarse[c] * self.share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(wrap: [Wrap; 2]) -> Texture<1> {
        // Four columns, from black to white, in two equal rows.
        let row: Vec<u8> = [0, 85, 170, 255].into_iter().flat_map(|g| [g, g, g, 255]).collect();
        let pixels = Pixels { width: 4, height: 2, rgba: row.repeat(2) };
        Texture::new(&pixels, wrap, |c| [c[1]])
    }

    #[test]
    fn coordinates_beyond_the_edges_are_wrapped() {
        let at = |wrap, u| texture([wrap, Wrap::Repeat]).bilinear(0, [u, 5.3])[0];
        let third = 1.0 / 3.0;
        for (wrap, u, expected) in [
            (Wrap::Repeat, 0.125, 0.0),
            (Wrap::Repeat, 0.25, 0.5 * third),
            (Wrap::Repeat, 1.375, third),
            (Wrap::Repeat, -0.125, 1.0),
            (Wrap::Repeat, 0.0, 0.5),
            (Wrap::Clamp, 0.0, 0.0),
            (Wrap::Clamp, 7.0, 1.0),
            (Wrap::Mirror, 1.125, 1.0),
            (Wrap::Mirror, -0.375, third),
        ] {
            assert!((at(wrap, u) - expected).abs() < 1e-5, "{wrap:?} {u}: {}", at(wrap, u));
        }
    }

    #[test]
    fn levels_halve_down_to_the_mean() {
        let texture = texture([Wrap::Repeat; 2]);
        let sizes: Vec<_> = texture.levels.iter().map(|l| (l.width, l.height)).collect();
        assert_eq!(sizes, [(4, 2), (2, 1), (1, 1)]);
        assert_eq!(texture.levels[2].texels, [[128]]);
    }

    #[test]
    fn a_texture_of_four_texels_a_sample_is_seen_at_its_second_level_but_one() {
        let spot = |x: f64, y: f64| Spot { x, y, z: 0.5, inv_w: 1.0 };
        let texture = texture([Wrap::Repeat; 2]);
        // The whole width on one sample; a row's height on each.
        let brush = texture.filtered(
            [[0.0, 0.0], [1.0, 0.0], [0.0, 0.5]],
            &[spot(0.0, 0.0), spot(1.0, 0.0), spot(0.0, 1.0)],
        );
        assert_eq!((brush.level, brush.share), (2, 0.0));
    }
}
