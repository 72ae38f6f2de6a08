//! Textured surfaces, in integers.
//!
//! A texture is a pyramid of luminances (or three, one a channel), each level half as wide and high as the one before.
//! The host chooses
//! the level of a triangle in a view, so that a texel is about a pixel wide there (a coarse picture must not
//! alias), and prepares what is affine in the picture ([`Painted`]); what remains for each pixel is one division
//! and one look at four neighbouring texels, in arithmetic that the native twin and the kernels share.
//!
//! Invariants:
//! 1. sides of a level are powers of two, so that a texture repeats by masking;
//! 2. a word of [`Texels`] holds a texel and its right, lower, and lower right neighbour: one look is enough;
//! 3. a triangle spans at most 2^9 texels of its level along each axis;
//! 4. what a triangle looks like in a pixel depends on its corners' places and coordinates, and on the view;
//! 5. a hole, where the texture's alpha says so, is no fragment: the triangle does not cover that pixel;
//! 6. what a surface gives off is added to the light that falls on it, as far as white.

use std::num::NonZeroU32;

use glam::DVec3;

use super::{
    lattice::{Lattice, Plane, ScreenPoint},
    view::View,
};

/// Fraction bits of the planes of [`Painted`].
pub const PAINT_BITS: u32 = 16;
/// Nearness of the nearest corner.
const NEAREST: f64 = 16_384.0;
/// Fraction bits of texel coordinates.
const TEXEL_BITS: u32 = 6;
/// The most that a triangle's coordinates may span.
const MAX_SPAN: f64 = 32_768.0;
/// A surface seen at so flat an angle counts as seen at this one: least cosine.
const LEAST_COSINE: f64 = 1.0 / 16.0;

/// The textures of a model.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Texels {
    words: Vec<u32>,
    maps: Vec<Map>,
}

/// One texture.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Map {
    levels: Vec<Level>,
    is_clamped: [bool; 2],
    /// Where it has holes; `None` where it has none.
    sieve: Option<Sieve>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Level {
    /// First word.
    at: u32,
    /// First word of the alphas, where the texture has holes.
    alpha_at: u32,
    /// First word of what is given off, where something is.
    glow_at: Option<NonZeroU32>,
    /// log2 of width and height.
    bits: [u32; 2],
}

/// Which alphas leave holes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sieve {
    /// Those below this one (0 to 255).
    Below(u8),
    /// As large a share of them as is transparent, spread evenly over the pixels.
    Dithered,
}

/// Where a texture is transparent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Alpha {
    /// As many as luminances.
    pub values: Vec<u8>,
    /// Which of them leave holes.
    pub sieve: Sieve,
}

/// A texture on a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paint {
    /// Number of the texture in [`Texels`]; views of further channels see the ones that follow.
    pub map: u32,
    /// Coordinates at each corner; the texture covers 0..1, downwards and to the right.
    pub uv: [[f32; 2]; 3],
}

/// What a texture adds to a [`Setup`](super::lattice::Setup).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Painted {
    /// How near the surface is, at most 2^14, and the shares of corners 1 and 2 in that: affine.
    pub planes: [Plane; 3],
    /// Texel coordinates at corner 0, in 64ths, half a texel to the upper left.
    pub from: [i32; 2],
    /// What is added to them on the way to corners 1 and 2.
    pub to: [[i32; 2]; 2],
    /// Bounds of texel coordinates where the texture does not repeat.
    pub range: [[i32; 2]; 2],
    /// First word of the level.
    pub at: u32,
    /// log2 of its width and height.
    pub bits: [u32; 2],
    /// Its holes.
    pub holes: Option<Holes>,
    /// First word of what it gives off, where something is.
    pub glow_at: Option<NonZeroU32>,
}

/// What a texture on a triangle does at a pixel when its coordinates change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaintSlope {
    /// What the pixel has of each corner.
    pub shares: [f64; 3],
    /// How the luminance there changes with the place on the texture, which is 1 wide and high.
    pub luminance: [f64; 2],
    /// The same of what is given off.
    pub glow: [f64; 2],
}

/// Where a level of a texture has holes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Holes {
    /// First word of the alphas.
    pub at: u32,
    /// The least alpha without a hole, 1 to 255; 0: that of [`dither`].
    pub least: u32,
}

impl Texels {
    /// Adds a texture of 2^`bits` texels, luminances row by row from the top; returns its number.
    /// Coordinates beyond its edges repeat, or are held at them along the axes that are clamped. `glow` is what it
    /// gives off, as many luminances.
    pub fn add(
        &mut self,
        bits: [u32; 2],
        luminances: Vec<u8>,
        is_clamped: [bool; 2],
        alpha: Option<Alpha>,
        mut glow: Option<Vec<u8>>,
    ) -> u32 {
        let sieve = alpha.as_ref().map(|a| a.sieve);
        let mut alphas = alpha.map(|a| a.values);
        let share = alphas.as_ref().zip(sieve).map(|(values, sieve)| share_left(values, sieve));
        let (mut levels, mut bits, mut level) = (Vec::new(), bits, luminances);
        loop {
            let at = self.words.len() as u32;
            self.append(&level, bits, is_clamped);
            let alpha_at = self.words.len() as u32;
            if let (Some(values), Some(sieve), Some(share)) = (&alphas, sieve, share) {
                self.append(&as_open(values, sieve, share), bits, is_clamped);
            }
            // Never the first of all words: those of the luminances come before.
            let glow_at = NonZeroU32::new(self.words.len() as u32).filter(|_| glow.is_some());
            if let Some(values) = &glow {
                self.append(values, bits, is_clamped);
            }
            levels.push(Level { at, alpha_at, glow_at, bits });
            if bits == [0, 0] {
                break;
            }
            alphas = alphas.map(|values| halved(&values, bits).0);
            glow = glow.map(|values| halved(&values, bits).0);
            (level, bits) = halved(&level, bits);
        }
        self.maps.push(Map { levels, is_clamped, sieve });
        self.maps.len() as u32 - 1
    }

    /// Whether a texture has holes.
    pub fn has_holes(&self, map: u32) -> bool {
        self.maps.get(map as usize).is_some_and(|map| map.sieve.is_some())
    }

    /// Whether a texture gives something off.
    pub fn has_glow(&self) -> bool {
        self.maps.iter().flat_map(|map| &map.levels).any(|level| level.glow_at.is_some())
    }

    /// Whether there are no textures.
    pub fn is_empty(&self) -> bool {
        self.maps.is_empty()
    }

    /// The words, level after level.
    pub fn words(&self) -> &[u32] {
        &self.words
    }

    fn append(&mut self, level: &[u8], bits: [u32; 2], is_clamped: [bool; 2]) {
        let size = bits.map(|b| 1_usize << b);
        let next = |k: usize, axis: usize| match k + 1 {
            end if end < size[axis] => end,
            _ if is_clamped[axis] => k,
            _ => 0,
        };
        for y in 0..size[1] {
            let (row, below) = (y * size[0], next(y, 1) * size[0]);
            self.words.extend((0..size[0]).map(|x| {
                let right = next(x, 0);
                let four = [row + x, row + right, below + x, below + right].map(|at| level[at]);
                u32::from_le_bytes(four)
            }));
        }
    }

    /// Prepares a texture on a triangle: `points` in the picture, `corners` in the model.
    pub fn painted(
        &self,
        lattice: &Lattice,
        view: &View,
        (points, corners): ([ScreenPoint; 3], [DVec3; 3]),
        paint: &Paint,
    ) -> Option<Painted> {
        let map = self.maps.get(paint.map as usize + usize::from(view.channel))?;
        let uv = paint.uv.map(|c| c.map(f64::from));
        let (level, place) = map.level_for(lattice, view, corners, uv);
        let distances = corners.map(|p| view.distance(p));
        let least = distances[0].min(distances[1]).min(distances[2]);
        let near = distances.map(|w| (NEAREST * least / w + 0.5) as i32);
        let planes = [near, [0, near[1], 0], [0, 0, near[2]]];
        let span = |k: usize, axis: usize| -> i32 {
            let by = place[k][axis] - place[0][axis];
            (by.clamp(-MAX_SPAN, MAX_SPAN) + 0.5).floor() as i32
        };
        let half = 1 << (TEXEL_BITS - 1);
        let last = |axis: usize| ((1 << level.bits[axis]) - 1) << TEXEL_BITS;
        let range = |axis: usize| {
            if map.is_clamped[axis] { [0, last(axis)] } else { [i32::MIN, i32::MAX] }
        };
        Some(Painted {
            planes: planes.map(|values| lattice.affine(points, values, PAINT_BITS)),
            from: [0, 1].map(|axis| (place[0][axis] + 0.5).floor() as i32 - half),
            to: [[span(1, 0), span(1, 1)], [span(2, 0), span(2, 1)]],
            range: [range(0), range(1)],
            at: level.at,
            bits: level.bits,
            holes: map.sieve.map(|sieve| Holes { at: level.alpha_at, least: sieve.least() }),
            glow_at: level.glow_at,
        })
    }
}

impl Sieve {
    /// See [`Holes::least`].
    fn least(self) -> u32 {
        match self {
            Self::Below(least) => u32::from(least.max(1)),
            Self::Dithered => 0,
        }
    }
}

/// How many alphas leave no hole, where a threshold decides.
fn share_left(alphas: &[u8], sieve: Sieve) -> f64 {
    let n = alphas.iter().filter(|a| u32::from(**a) >= sieve.least()).count();
    n as f64 / alphas.len().max(1) as f64
}

/// The alphas of a coarser level, scaled so that the same share of them as in the finest level leaves no hole:
/// the means of a fence would else be above the threshold everywhere, or nowhere (Castaño 2010).
fn as_open(alphas: &[u8], sieve: Sieve, share: f64) -> Vec<u8> {
    let Sieve::Below(least) = sieve else { return alphas.to_vec() };
    let n_left = (share * alphas.len() as f64 + 0.5) as usize;
    let mut sorted = alphas.to_vec();
    sorted.sort_unstable_by(|a, b| b.cmp(a));
    let Some(last) = n_left.checked_sub(1).map(|k| sorted[k]).filter(|last| *last > 0) else {
        return vec![0; alphas.len()];
    };
    let scale = |a: u8| (u32::from(a) * u32::from(least.max(1))).div_ceil(u32::from(last)).min(255);
    alphas.iter().map(|a| scale(*a) as u8).collect()
}

/// The least alpha that covers pixel (i, j) of a dithered surface: of every 8 × 8 pixels another one each, in the
/// order of Bayer 1973.
pub fn dither(i: i32, j: i32) -> u32 {
    let (x, y) = ((i ^ j) as u32, j as u32);
    let bit = |v: u32, from: u32, to: u32| (v >> from & 1) << to;
    let rank =
        bit(x, 0, 5) | bit(y, 0, 4) | bit(x, 1, 3) | bit(y, 1, 2) | bit(x, 2, 1) | bit(y, 2, 0);
    4 * rank + 2
}

impl Map {
    /// The level for a triangle in a view, and its corners' coordinates there in 64ths of a texel.
    fn level_for(
        &self,
        lattice: &Lattice,
        view: &View,
        corners: [DVec3; 3],
        uv: [[f64; 2]; 3],
    ) -> (Level, [[f64; 2]; 3]) {
        let finest = self.levels[0];
        let size = finest.bits.map(|b| f64::from(1_u32 << b));
        // Near the texture, so that what follows stays small: whole repetitions make no difference.
        let origin = [0, 1].map(|axis| uv[0][axis].floor());
        let mut place =
            uv.map(|c| [0, 1].map(|axis| self.settle(axis, c[axis], origin[axis]) * size[axis]));
        let mut rate = texels_per_unit(corners, place)
            * view.unit_per_pixel(corners, lattice.size, LEAST_COSINE);
        let fits = |place: &[[f64; 2]; 3]| {
            let most = MAX_SPAN / f64::from(1 << TEXEL_BITS);
            let span = |k: usize, axis: usize| (place[k][axis] - place[0][axis]).abs();
            (1..3).all(|k| span(k, 0) <= most && span(k, 1) <= most)
        };
        let mut level = 0;
        while level + 1 < self.levels.len() && (rate > std::f64::consts::SQRT_2 || !fits(&place)) {
            let by = [0, 1].map(|axis| if self.levels[level].bits[axis] > 0 { 0.5 } else { 1.0 });
            place = place.map(|c| [c[0] * by[0], c[1] * by[1]]);
            rate *= 0.5;
            level += 1;
        }
        let fine = f64::from(1 << TEXEL_BITS);
        (self.levels[level], place.map(|c| c.map(|x| x * fine)))
    }

    /// A coordinate near the texture.
    fn settle(&self, axis: usize, c: f64, origin: f64) -> f64 {
        const FAR: f64 = 1024.0;
        if self.is_clamped[axis] { c.clamp(-1.0, 2.0) } else { (c - origin).clamp(-FAR, FAR) }
    }
}

/// Texels for each unit of length, on average over all directions in the triangle: half the squared norm of the
/// map from places to coordinates is the mean square of that.
fn texels_per_unit(p: [DVec3; 3], place: [[f64; 2]; 3]) -> f64 {
    let (a, b) = (p[1] - p[0], p[2] - p[0]);
    let area2 = a.cross(b).length_squared();
    if area2 == 0.0 {
        return 0.0;
    }
    let norm = |axis: usize| {
        let (s, t) = (place[1][axis] - place[0][axis], place[2][axis] - place[0][axis]);
        b.length_squared() * s * s - 2.0 * a.dot(b) * s * t + a.length_squared() * t * t
    };
    (0.5 * (norm(0) + norm(1)).max(0.0) / area2).sqrt()
}

/// The next level: means of two by two.
fn halved(level: &[u8], bits: [u32; 2]) -> (Vec<u8>, [u32; 2]) {
    let smaller = bits.map(|b| b.saturating_sub(1));
    let (width, step) = (1_usize << bits[0], [0, 1].map(|axis| usize::from(bits[axis] > 0)));
    let mut out = Vec::with_capacity(1 << (smaller[0] + smaller[1]));
    for y in 0..1_usize << smaller[1] {
        for x in 0..1_usize << smaller[0] {
            let at = |dx: usize, dy: usize| {
                let (x, y) = ((x << step[0]) + dx * step[0], (y << step[1]) + dy * step[1]);
                u32::from(level[y * width + x])
            };
            out.push(((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) >> 2) as u8);
        }
    }
    (out, smaller)
}

impl Painted {
    /// The texture's luminance at pixel (i, j).
    #[inline]
    pub fn at(&self, words: &[u32], i: i32, j: i32) -> u32 {
        look_up(self.bits, words, self.at, self.place(i, j))
    }

    /// What it gives off at pixel (i, j).
    pub fn glow(&self, words: &[u32], i: i32, j: i32) -> u32 {
        let glow = |at: NonZeroU32| look_up(self.bits, words, at.get(), self.place(i, j));
        self.glow_at.map_or(0, glow)
    }

    /// A luminance seen through the texture at pixel (i, j), with what is given off there.
    #[inline]
    pub fn shown(&self, luminance: u32, words: &[u32], i: i32, j: i32) -> u32 {
        let place = self.place(i, j);
        let seen = modulated(luminance, look_up(self.bits, words, self.at, place));
        let with = |at: NonZeroU32| (seen + look_up(self.bits, words, at.get(), place)).min(255);
        self.glow_at.map_or(seen, with)
    }

    /// Whether there is a hole at pixel (i, j).
    #[inline]
    pub fn is_hole(&self, words: &[u32], i: i32, j: i32) -> bool {
        self.holes.is_some_and(|holes| {
            let least = if holes.least == 0 { dither(i, j) } else { holes.least };
            look_up(self.bits, words, holes.at, self.place(i, j)) < least
        })
    }

    /// How it changes at pixel (i, j) with the coordinates of its corners.
    pub fn slope(&self, words: &[u32], i: i32, j: i32) -> PaintSlope {
        let [one, two] = self.shares(i, j).map(|share| f64::from(share) / f64::from(1 << 15));
        let place = self.place(i, j);
        let slope = |first: u32| {
            let by = slope_at(self.bits, words, first, place);
            let is_held = |axis: usize| self.range[axis].contains(&place[axis]);
            [0, 1].map(|axis| if is_held(axis) { 0.0 } else { by[axis] })
        };
        PaintSlope {
            shares: [1.0 - one - two, one, two],
            luminance: slope(self.at),
            glow: self.glow_at.map_or([0.0; 2], |at| slope(at.get())),
        }
    }

    /// What pixel (i, j) has of corners 1 and 2, in 2^15ths.
    #[inline]
    fn shares(&self, i: i32, j: i32) -> [i32; 2] {
        let [near, one, two] = [0, 1, 2].map(|k| self.planes[k].at(i, j, PAINT_BITS) as u32);
        let per_near = (1 << 29) / near.max(1);
        [one, two].map(|share| (share.wrapping_mul(per_near) >> 14) as i32)
    }

    /// Texel coordinates at pixel (i, j), in 64ths.
    #[inline]
    fn place(&self, i: i32, j: i32) -> [i32; 2] {
        let shares = self.shares(i, j);
        [0, 1].map(|axis| {
            let by = shares[0]
                .wrapping_mul(self.to[0][axis])
                .wrapping_add(shares[1].wrapping_mul(self.to[1][axis]));
            let [low, high] = self.range[axis];
            self.from[axis].wrapping_add(by.wrapping_add(1 << 14) >> 15).clamp(low, high)
        })
    }
}

/// What lies at some coordinates, in 64ths of a texel, of a level of 2^`bits` texels that begins at a word.
#[inline]
fn look_up(bits: [u32; 2], words: &[u32], first: u32, [x, y]: [i32; 2]) -> u32 {
    let [a, b, c, d] = four_at(bits, words, first, [x, y]).map(u32::from);
    let (fx, fy) = ((x & 63) as u32, (y & 63) as u32);
    let (top, bottom) = (a * (64 - fx) + b * fx, c * (64 - fx) + d * fx);
    (top * (64 - fy) + bottom * fy + 2048) >> 12
}

/// The texels around some coordinates: left and right above, left and right below.
#[inline]
fn four_at(bits: [u32; 2], words: &[u32], first: u32, [x, y]: [i32; 2]) -> [u8; 4] {
    let mask = bits.map(|b| (1_i32 << b) - 1);
    let texel = ((y >> TEXEL_BITS & mask[1]) << bits[0]) + (x >> TEXEL_BITS & mask[0]);
    words.get(first as usize + texel as usize).copied().unwrap_or(u32::MAX).to_le_bytes()
}

/// How what [`look_up`] finds changes along the width and the height of the texture.
fn slope_at(bits: [u32; 2], words: &[u32], first: u32, [x, y]: [i32; 2]) -> [f64; 2] {
    let [a, b, c, d] = four_at(bits, words, first, [x, y]).map(f64::from);
    let [fx, fy] = [x, y].map(|place| f64::from(place & 63) / 64.0);
    let by_texel = [(b - a) * (1.0 - fy) + (d - c) * fy, (c - a) * (1.0 - fx) + (d - b) * fx];
    [0, 1].map(|axis| by_texel[axis] * f64::from(1_u32 << bits[axis]))
}

/// A luminance seen through a texture's: the product of two shares of 255, rounded.
#[inline]
pub fn modulated(luminance: u32, texel: u32) -> u32 {
    (luminance * texel * 257 + 32_768) >> 16
}

#[cfg(test)]
#[path = "paint_tests.rs"]
mod tests;
