//! The integer raster: where floating point ends and exact arithmetic begins.
//!
//! Invariants (the specification that the WGSL kernels and the native twin share):
//! 1. the raster lattice is always 2^14 points across, guard band included, and the picture takes
//!    up at most its central half; a pixel is 2^`sub_bits` lattice steps wide (5 bits at 256²);
//! 2. edge functions are below 2^30 in size, so every sum fits an i32;
//! 3. a pixel is covered when its centre is inside, ties broken by the edge's direction, so that
//!    two triangles that share an edge never both cover a pixel and never leave one out;
//! 4. depth and luminance are affine in i32 arithmetic modulo 2^32 and clamped to the range of the
//!    three corners, so slivers stay exact;
//! 5. a triangle's [`Setup`] depends on its three corners in stored order and on nothing else: a
//!    triangle that an edit adds rasters to the same bits as in a full re-render.

use super::{paint::Painted, view::PicturePoint};

/// Width of the lattice, bits.
const LATTICE_BITS: u32 = 14;
/// Fraction bits of the depth plane.
pub const DEPTH_BITS: u32 = 14;
/// Fraction bits of the luminance plane.
pub const LUM_BITS: u32 = 16;

/// Geometry of the raster of one picture size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lattice {
    /// Pixels along each side.
    pub size: i32,
    /// log2 of the lattice steps in a pixel.
    pub sub_bits: u32,
    /// Lattice coordinate of the centre of pixel 0.
    pub first_center: i32,
}

/// A vertex in one picture: lattice coordinates and 16-bit depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct ScreenPoint {
    /// Lattice coordinate, rightwards.
    pub x: i16,
    /// Lattice coordinate, downwards.
    pub y: i16,
    /// 0 at the near end of the bounding sphere, 65,535 at the far end.
    pub z: u16,
    /// Always zero.
    pub pad: u16,
}

/// A rectangle of pixels, bounds inclusive; empty when `x0 > x1` or `y0 > y1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelRect {
    /// Leftmost column.
    pub x0: i32,
    /// Topmost row.
    pub y0: i32,
    /// Rightmost column.
    pub x1: i32,
    /// Bottom row.
    pub y1: i32,
}

/// A quantity that is affine over a triangle: `(at_origin + i dx + j dy) >> bits` at pixel (i, j),
/// modulo 2^32, clamped to `min..=max`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Plane {
    /// Value at pixel (0, 0), rounding included.
    pub at_origin: i32,
    /// Change from a pixel to its right neighbour.
    pub dx: i32,
    /// Change from a pixel to the one below.
    pub dy: i32,
    /// Least corner value.
    pub min: i32,
    /// Greatest corner value.
    pub max: i32,
}

/// An edge function: `at_origin + i dx + j dy >= 0` inside.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Edge {
    /// Value at pixel (0, 0), modulo 2^32, tie-break included.
    pub at_origin: i32,
    /// Change from a pixel to its right neighbour.
    pub dx: i32,
    /// Change from a pixel to the one below.
    pub dy: i32,
}

/// Which side of a surface is not drawn. A triangle turns its front to the viewer whose corners run
/// counter-clockwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cull {
    /// Both sides are drawn.
    Nothing,
    /// Fronts are not.
    Front,
    /// Backs are not.
    Back,
}

/// Everything needed to raster one triangle in one picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Setup {
    /// Pixels whose centres may be covered.
    pub rect: PixelRect,
    /// The three edges.
    pub edges: [Edge; 3],
    /// 16-bit depth.
    pub depth: Plane,
    /// 8-bit luminance.
    pub lum: Plane,
    /// Its texture.
    pub paint: Option<Painted>,
}

impl PixelRect {
    /// The empty rectangle.
    pub const EMPTY: Self = Self { x0: i32::MAX, y0: i32::MAX, x1: i32::MIN, y1: i32::MIN };

    /// Whether it holds no pixel.
    pub fn is_empty(&self) -> bool {
        self.x0 > self.x1 || self.y0 > self.y1
    }

    /// The smallest rectangle around both.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self {
            x0: self.x0.min(other.x0),
            y0: self.y0.min(other.y0),
            x1: self.x1.max(other.x1),
            y1: self.y1.max(other.y1),
        }
    }
}

impl Lattice {
    /// The lattice of a picture of `size`² pixels; `size` is 64 to 1024.
    pub fn new(size: u32) -> Self {
        let size = size as i32;
        let mut sub_bits = LATTICE_BITS;
        while (2 * size) << sub_bits > 1 << LATTICE_BITS {
            sub_bits -= 1;
        }
        let guard = ((1 << LATTICE_BITS) - (size << sub_bits)) / 2;
        Self { size, sub_bits, first_center: guard + (1 << (sub_bits - 1)) }
    }

    /// Rounds a projected point to the lattice, held inside the guard band.
    pub fn snap(&self, p: PicturePoint) -> ScreenPoint {
        let pixel = f64::from(1 << self.sub_bits);
        let origin = f64::from(self.first_center) - 0.5 * pixel;
        let extent = f64::from(self.size) * pixel;
        let top = f64::from((1 << LATTICE_BITS) - 1);
        let to_lattice = |v: f64| ((v * extent + origin).clamp(0.0, top) + 0.5) as i16;
        ScreenPoint {
            x: to_lattice(p.x),
            y: to_lattice(p.y),
            z: ((p.depth * 65535.0).clamp(0.0, 65535.0) + 0.5) as u16,
            pad: 0,
        }
    }

    /// Pixels with centres inside a box of lattice coordinates (bounds inclusive).
    #[inline(always)]
    pub fn pixels_within(&self, x: (i32, i32), y: (i32, i32)) -> PixelRect {
        let up = (1 << self.sub_bits) - 1;
        let first = |lo: i32| ((lo - self.first_center + up) >> self.sub_bits).max(0);
        let last = |hi: i32| ((hi - self.first_center) >> self.sub_bits).min(self.size - 1);
        PixelRect { x0: first(x.0), y0: first(y.0), x1: last(x.1), y1: last(y.1) }
    }

    /// Prepares a triangle; `None` when it covers no pixel centre for sure. `lum` are the
    /// luminances at the corners.
    #[inline(always)]
    pub fn setup(&self, p: [ScreenPoint; 3], lum: [u8; 3], cull: Cull) -> Option<Setup> {
        let x = p.map(|q| i32::from(q.x));
        let y = p.map(|q| i32::from(q.y));
        let z = p.map(|q| i32::from(q.z));
        let rect = self.pixels_within(span(x), span(y));
        // y runs downwards, so a counter-clockwise triangle has a negative area here.
        let area2 = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
        let flip = area2 < 0;
        let culled = if flip { Cull::Front } else { Cull::Back };
        if rect.is_empty() || area2 == 0 || cull == culled {
            return None;
        }
        let (b, c) = if flip { (2, 1) } else { (1, 2) };
        let corner = [(x[0], y[0]), (x[b], y[b]), (x[c], y[c])];
        let edges = [
            self.edge(corner[0], corner[1]),
            self.edge(corner[1], corner[2]),
            self.edge(corner[2], corner[0]),
        ];
        let depth = self.plane(x, y, z, area2, DEPTH_BITS);
        let l = lum.map(i32::from);
        let lum = if l[0] == l[1] && l[0] == l[2] {
            Plane { at_origin: l[0] << LUM_BITS, dx: 0, dy: 0, min: l[0], max: l[0] }
        } else {
            self.plane(x, y, l, area2, LUM_BITS)
        };
        Some(Setup { rect, edges, depth, lum, paint: None })
    }

    /// The plane through values at the corners of a triangle that has a [`Setup`].
    pub fn affine(&self, p: [ScreenPoint; 3], values: [i32; 3], bits: u32) -> Plane {
        let x = p.map(|q| i32::from(q.x));
        let y = p.map(|q| i32::from(q.y));
        let area2 = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
        self.plane(x, y, values, area2, bits)
    }

    /// The edge function of a → b, positive on the inner side.
    #[inline(always)]
    fn edge(&self, a: (i32, i32), b: (i32, i32)) -> Edge {
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let owns_ties = dy < 0 || (dy == 0 && dx > 0);
        let at = dx * (self.first_center - a.1) - dy * (self.first_center - a.0);
        Edge {
            at_origin: at - i32::from(!owns_ties),
            dx: -(dy << self.sub_bits),
            dy: dx << self.sub_bits,
        }
    }

    /// The plane through the corner values, anchored at the stored first corner.
    #[inline(always)]
    fn plane(&self, x: [i32; 3], y: [i32; 3], v: [i32; 3], area2: i32, bits: u32) -> Plane {
        let (v1, v2) = (i64::from(v[1] - v[0]), i64::from(v[2] - v[0]));
        let (x1, x2) = (i64::from(x[1] - x[0]), i64::from(x[2] - x[0]));
        let (y1, y2) = (i64::from(y[1] - y[0]), i64::from(y[2] - y[0]));
        // Numerators are exact integers below 2^33; one rounding each from here on.
        let per_area = f64::from(1_u32 << bits) / f64::from(area2);
        let gx = (v1 * y2 - v2 * y1) as f64 * per_area;
        let gy = (v2 * x1 - v1 * x2) as f64 * per_area;
        let origin_x = f64::from(self.first_center - x[0]);
        let origin_y = f64::from(self.first_center - y[0]);
        let base = (i64::from(v[0]) << bits) as f64 + f64::from(1_u32 << (bits - 1));
        let pixel = f64::from(1 << self.sub_bits);
        let (min, max) = span(v);
        Plane {
            at_origin: (base + gx * origin_x + gy * origin_y) as i64 as i32,
            dx: (gx * pixel) as i64 as i32,
            dy: (gy * pixel) as i64 as i32,
            min,
            max,
        }
    }
}

impl Plane {
    /// The value at pixel (i, j).
    #[inline(always)]
    pub fn at(&self, i: i32, j: i32, bits: u32) -> i32 {
        let v = self
            .at_origin
            .wrapping_add(self.dx.wrapping_mul(i))
            .wrapping_add(self.dy.wrapping_mul(j));
        (v >> bits).clamp(self.min, self.max)
    }
}

impl Edge {
    /// The value at pixel (i, j), >= 0 inside.
    #[inline(always)]
    pub fn at(&self, i: i32, j: i32) -> i32 {
        self.at_origin.wrapping_add(self.dx.wrapping_mul(i)).wrapping_add(self.dy.wrapping_mul(j))
    }
}

impl Setup {
    /// False only when no pixel of the rectangle is covered.
    #[inline]
    pub fn may_cover(&self, rect: &PixelRect) -> bool {
        let apart = self.rect.x0 > rect.x1
            || self.rect.x1 < rect.x0
            || self.rect.y0 > rect.y1
            || self.rect.y1 < rect.y0;
        !apart
            && self.edges.iter().all(|e| {
                let i = if e.dx > 0 { rect.x1 } else { rect.x0 };
                let j = if e.dy > 0 { rect.y1 } else { rect.y0 };
                e.at(i, j) >= 0
            })
    }

    /// The luminance at pixel (i, j), with what the texture has and gives off there.
    #[inline(always)]
    pub fn lum_at(&self, texels: &[u32], i: i32, j: i32) -> u8 {
        let lum = self.lum.at(i, j, LUM_BITS) as u32;
        self.paint.as_ref().map_or(lum, |p| p.shown(lum, texels, i, j)) as u8
    }

    /// Whether the texture has a hole at pixel (i, j).
    #[inline(always)]
    pub fn is_hole(&self, texels: &[u32], i: i32, j: i32) -> bool {
        self.paint.as_ref().is_some_and(|p| p.is_hole(texels, i, j))
    }

    /// Whether pixel (i, j) is covered.
    #[inline(always)]
    pub fn covers(&self, i: i32, j: i32) -> bool {
        (self.edges[0].at(i, j) | self.edges[1].at(i, j) | self.edges[2].at(i, j)) >= 0
    }
}

#[inline(always)]
fn span(v: [i32; 3]) -> (i32, i32) {
    (v[0].min(v[1]).min(v[2]), v[0].max(v[1]).max(v[2]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(x: i16, y: i16, z: u16) -> ScreenPoint {
        ScreenPoint { x, y, z, pad: 0 }
    }

    #[test]
    fn sizes_keep_the_picture_in_the_central_half() {
        for (size, sub_bits) in [(64, 7), (128, 6), (256, 5), (512, 4), (1024, 3), (200, 5)] {
            let l = Lattice::new(size);
            assert_eq!(l.sub_bits, sub_bits);
            let middle = l.snap(PicturePoint { x: 0.5, y: 0.5, depth: 0.5 });
            assert_eq!((middle.x, middle.y), (8192, 8192));
        }
    }

    proptest! {
        // A quad cut along its diagonal covers each of its pixels exactly once: no seam, no overlap.
        #[test]
        fn two_triangles_that_share_an_edge_tile(
            a in (4000_i16..12000, 4000_i16..12000), b in (4000_i16..12000, 4000_i16..12000),
            c in (4000_i16..12000, 4000_i16..12000),
        ) {
            let l = Lattice::new(64);
            // d mirrors c through the middle of a b: a parallelogram a c b d.
            let d = (a.0 + b.0 - c.0, a.1 + b.1 - c.1);
            prop_assume!((0..16384).contains(&d.0) && (0..16384).contains(&d.1));
            let tri = |p: [(i16, i16); 3]| l.setup(p.map(|q| at(q.0, q.1, 9)), [5; 3], Cull::Nothing);
            let halves = [[tri([a, b, c]), tri([b, a, d])], [tri([c, d, a]), tri([d, c, b])]];
            for j in 0..64 { for i in 0..64 {
                let count = |h: &[Option<Setup>; 2]| h.iter().flatten().filter(|s| s.covers(i, j)).count();
                prop_assert!(count(&halves[0]) <= 1);
                prop_assert_eq!(count(&halves[0]), count(&halves[1]));
            }}
        }

        // Corner order changes neither coverage nor, beyond one unit, depth; slivers stay in range.
        #[test]
        fn planes_stay_between_their_corners(
            p in prop::array::uniform3((0_i16..16384, 0_i16..16384, 0_u16..=65535)),
        ) {
            let l = Lattice::new(128);
            let q = p.map(|c| at(c.0, c.1, c.2));
            let (Some(s), Some(t)) = (l.setup(q, [0, 9, 255], Cull::Nothing),
                                      l.setup([q[1], q[2], q[0]], [9, 255, 0], Cull::Nothing)) else { return Ok(()) };
            for j in (s.rect.y0..=s.rect.y1).step_by(3) { for i in (s.rect.x0..=s.rect.x1).step_by(3) {
                prop_assert_eq!(s.covers(i, j), t.covers(i, j));
                let z = s.depth.at(i, j, DEPTH_BITS);
                prop_assert!(z >= s.depth.min && z <= s.depth.max);
            }}
        }
    }
}
