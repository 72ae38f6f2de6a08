//! Scan conversion: which samples of a grid a triangle covers, and what is drawn there.
//!
//! Invariants:
//! 1. two triangles that share an edge cover no sample twice and leave none out along it, because
//!    both compute the edge from the same end with the same operations;
//! 2. a sample keeps the nearest fragment; among equally near ones, the first drawn;
//! 3. the depth of a fragment lies within the depths of its triangle's corners, slivers included.
//!
//! Knows nothing of meshes, cameras or light.

use std::ops::Range;

use super::texture::Brush;
use crate::intrinsics::by_processor;

/// A projected corner: `x` to the right and `y` down in samples, `z` growing away from the eye and
/// affine over the triangle's picture, `inv_w` the reciprocal of the distance along the view axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spot {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) z: f64,
    pub(super) inv_w: f64,
}

/// Shade and colour of a corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Paint<const N: usize> {
    pub(super) shade: f32,
    pub(super) colour: [f32; N],
}

impl<const N: usize> Paint<N> {
    /// What a pixel shows: lit, cut at full scale.
    fn lit(&self) -> [f32; N] {
        self.colour.map(|c| (c * self.shade).clamp(0.0, 1.0))
    }
}

/// A band of sample rows with its depth buffer; sample (0, 0) of the picture is at (0.5, 0.5).
///
/// A picture is drawn band after band because a band stays in the cache: small triangles touch
/// their samples in no order, and most of the time would be spent waiting for memory.
pub(super) struct Band<const N: usize> {
    /// Samples in a row, and rows in the whole picture.
    pub(super) side: usize,
    /// The rows of the picture that this band holds.
    pub(super) rows: Range<usize>,
    depth: Vec<f32>,
    pub(super) values: Vec<[f32; N]>,
}

impl<const N: usize> Band<N> {
    pub(super) fn new(side: usize) -> Self {
        Self { side, rows: 0..0, depth: Vec::new(), values: Vec::new() }
    }

    /// Moves to other rows and fills them with the background.
    pub(super) fn clear(&mut self, rows: Range<usize>, background: f32) {
        let n = rows.len() * self.side;
        self.rows = rows;
        self.depth.clear();
        self.depth.resize(n, f32::INFINITY);
        self.values.clear();
        self.values.resize(n, [background; N]);
    }

    /// Draws one triangle whose paint varies as it does on the surface (perspective-correct).
    pub(super) fn draw(
        &mut self,
        spots: &[Spot; 3],
        paints: &[Paint<N>; 3],
        brush: Option<&Brush<'_, N>>,
    ) {
        if brush.is_none() && paints[0] == paints[1] && paints[0] == paints[2] {
            self.draw_constant(spots, paints[0].lit());
        } else {
            self.draw_varying(spots, paints, brush);
        }
    }

    fn draw_constant(&mut self, spots: &[Spot; 3], value: [f32; N]) {
        let Some(depth) = DepthPlane::through(spots) else { return };
        let (side, first) = (self.side, self.rows.start);
        for_each_span(spots, side, self.rows.clone(), |row, columns| {
            let z = depth.along(row, columns.start);
            let at = (row - first) * side + columns.start..(row - first) * side + columns.end;
            fill(z, value, &mut self.depth[at.clone()], &mut self.values[at]);
        });
    }

    fn draw_varying(
        &mut self,
        spots: &[Spot; 3],
        paints: &[Paint<N>; 3],
        brush: Option<&Brush<'_, N>>,
    ) {
        let Some(depth) = DepthPlane::through(spots) else { return };
        // What is affine in the picture is value / w, not the value itself.
        let over_w = |value: [f32; 3]| {
            Plane::through(spots, [0, 1, 2].map(|k| f64::from(value[k]) * spots[k].inv_w))
        };
        let weight = over_w([1.0; 3]);
        let shade = over_w(paints.map(|p| p.shade));
        let colour: [Plane; N] = std::array::from_fn(|c| over_w(paints.map(|p| p.colour[c])));
        let uv = brush.map(|brush| [0, 1].map(|axis| over_w(brush.uv.map(|c| c[axis]))));
        let (side, first) = (self.side, self.rows.start);
        for_each_span(spots, side, self.rows.clone(), |row, columns| {
            let line = |plane: Plane| plane.along(row, columns.start);
            let (z, weight, shade) = (depth.along(row, columns.start), line(weight), line(shade));
            let (colour, uv) = (colour.map(line), uv.map(|uv| uv.map(line)));
            let at = (row - first) * side + columns.start..(row - first) * side + columns.end;
            let samples = self.depth[at.clone()].iter_mut().zip(&mut self.values[at]);
            for (i, (nearest, sample)) in (0_i32..).zip(samples) {
                let z = z.at(i);
                if z < *nearest {
                    let w = 1.0 / weight.at(i);
                    let (mut colour, mut glow) = (colour.map(|c| c.at(i) * w), None);
                    if let (Some(brush), Some(uv)) = (brush, uv) {
                        let uv = uv.map(|c| c.at(i) * w);
                        let sample = (columns.start + i as usize, row);
                        if brush.holes.as_ref().is_some_and(|h| !h.is_there(uv, sample)) {
                            continue;
                        }
                        let texel = brush.at(uv);
                        colour = std::array::from_fn(|c| colour[c] * texel[c]);
                        glow = brush.glow(uv);
                    }
                    *nearest = z;
                    *sample = Paint { shade: shade.at(i) * w, colour }.lit();
                    if let Some(glow) = glow {
                        *sample = std::array::from_fn(|c| (sample[c] + glow[c]).min(1.0));
                    }
                }
            }
        });
    }
}

by_processor! {
    /// Draws a run of samples that have the same value.
    fn fill<const N: usize>(depth: DepthLine, value: [f32; N], nearest: &mut [f32], samples: &mut [[f32; N]]) -> () {
        avx2: fill_plain,
        plain: fill_plain,
    }
}

#[inline(always)]
fn fill_plain<const N: usize>(
    depth: DepthLine,
    value: [f32; N],
    nearest: &mut [f32],
    samples: &mut [[f32; N]],
) {
    for (i, (nearest, sample)) in (0_i32..).zip(nearest.iter_mut().zip(samples)) {
        // No branches: this loop is where the time goes.
        let z = depth.at(i);
        let in_front = z < *nearest;
        *nearest = if in_front { z } else { *nearest };
        *sample = if in_front { value } else { *sample };
    }
}

/// A value that is affine over the picture.
#[derive(Clone, Copy)]
struct Plane {
    origin: f64,
    dx: f64,
    dy: f64,
}

impl Plane {
    /// Through three corners; all corners' values when the triangle has an area, which the caller
    /// has made sure of.
    fn through(spots: &[Spot; 3], values: [f64; 3]) -> Self {
        let [a, b, c] = spots;
        let inverse = 1.0 / doubled_area(spots);
        let (db, dc) = (values[1] - values[0], values[2] - values[0]);
        let dx = (db * (c.y - a.y) - dc * (b.y - a.y)) * inverse;
        let dy = (dc * (b.x - a.x) - db * (c.x - a.x)) * inverse;
        Self { origin: values[0] - dx * a.x - dy * a.y, dx, dy }
    }

    /// Along a row, from a column on.
    fn along(&self, row: usize, column: usize) -> Line {
        let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
        Line { start: (self.origin + self.dx * x + self.dy * y) as f32, step: self.dx as f32 }
    }
}

/// A value along a row of samples.
#[derive(Clone, Copy)]
struct Line {
    start: f32,
    step: f32,
}

impl Line {
    fn at(&self, i: i32) -> f32 {
        self.start + i as f32 * self.step
    }
}

struct DepthPlane {
    plane: Plane,
    nearest: f32,
    farthest: f32,
}

/// A depth along a row of samples, within its triangle's depths.
#[derive(Clone, Copy)]
struct DepthLine {
    line: Line,
    nearest: f32,
    farthest: f32,
}

impl DepthPlane {
    /// None for a triangle seen edge-on: it covers no sample.
    fn through(spots: &[Spot; 3]) -> Option<Self> {
        if doubled_area(spots) == 0.0 {
            return None;
        }
        let z = spots.map(|s| s.z);
        Some(Self {
            plane: Plane::through(spots, z),
            nearest: z[0].min(z[1]).min(z[2]) as f32,
            farthest: z[0].max(z[1]).max(z[2]) as f32,
        })
    }

    fn along(&self, row: usize, column: usize) -> DepthLine {
        let line = self.plane.along(row, column);
        DepthLine { line, nearest: self.nearest, farthest: self.farthest }
    }
}

impl DepthLine {
    fn at(&self, i: i32) -> f32 {
        // Comparisons instead of `clamp`, whose check of its bounds would stay in the loop.
        let z = self.line.at(i);
        let z = if z < self.nearest { self.nearest } else { z };
        if z > self.farthest { self.farthest } else { z }
    }
}

pub(super) fn doubled_area([a, b, c]: &[Spot; 3]) -> f64 {
    (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y)
}

/// The sample rows that the triangle's bounding box spans; empty if it holds no sample at all, which
/// spares most of the work on triangles smaller than a sample.
pub(super) fn rows_spanned([a, b, c]: &[Spot; 3], side: usize) -> Range<usize> {
    let span = |p: f64, q: f64, r: f64| {
        first_sample(p.min(q).min(r), side)..first_sample(p.max(q).max(r), side)
    };
    let columns = span(a.x, b.x, c.x);
    if columns.is_empty() { 0..0 } else { span(a.y, b.y, c.y) }
}

/// The first sample at or after a coordinate, kept within 0..=side. A coordinate on a sample may
/// go either way, but the same way whichever triangle asks, which is all that invariant 1 needs.
fn first_sample(coordinate: f64, side: usize) -> usize {
    // Adding 2^52 rounds to whole numbers and leaves them in the low bits: far cheaper than a call
    // of `ceil` and a checked conversion.
    const ROUND: f64 = (1_u64 << 52) as f64;
    let limit = side as f64;
    let within = if coordinate > 0.0 { coordinate } else { 0.0 };
    let within = if within < limit { within } else { limit };
    (within + ROUND).to_bits() as u32 as usize
}

/// Calls `draw(row, columns)` for every one of the given rows in which the triangle covers samples.
fn for_each_span(
    spots: &[Spot; 3],
    side: usize,
    rows: Range<usize>,
    mut draw: impl FnMut(usize, Range<usize>),
) {
    let [mut top, mut middle, mut bottom] = *spots;
    let swap_if_below = |a: &mut Spot, b: &mut Spot| {
        if (b.y, b.x) < (a.y, a.x) {
            std::mem::swap(a, b);
        }
    };
    swap_if_below(&mut top, &mut middle);
    swap_if_below(&mut middle, &mut bottom);
    swap_if_below(&mut top, &mut middle);
    let long = Edge::new(&top, &bottom);
    for short in [Edge::new(&top, &middle), Edge::new(&middle, &bottom)] {
        let first = first_sample(short.top, side).max(rows.start);
        for row in first..first_sample(short.bottom, side).min(rows.end) {
            let y = row as f64 + 0.5;
            let (a, b) = (long.x_at(y), short.x_at(y));
            let columns = first_sample(a.min(b), side)..first_sample(a.max(b), side);
            if !columns.is_empty() {
                draw(row, columns);
            }
        }
    }
}

/// An edge, always described from its upper end.
struct Edge {
    x: f64,
    top: f64,
    bottom: f64,
    slope: f64,
}

impl Edge {
    fn new(top: &Spot, bottom: &Spot) -> Self {
        // A level edge spans no row, so its infinite slope is never used.
        let slope = (bottom.x - top.x) / (bottom.y - top.y);
        Self { x: top.x, top: top.y, bottom: bottom.y, slope }
    }

    fn x_at(&self, y: f64) -> f64 {
        self.x + (y - self.top) * self.slope
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn spot(x: f64, y: f64, z: f64) -> Spot {
        Spot { x, y, z, inv_w: 1.0 }
    }

    fn white(shade: f32) -> [Paint<1>; 3] {
        [Paint { shade, colour: [1.0] }; 3]
    }

    #[test]
    fn a_right_triangle_covers_half_its_square() {
        let mut band = Band::<1>::new(8);
        band.clear(0..band.side, 0.0);
        band.draw(
            &[spot(0.0, 0.0, 0.5), spot(8.0, 0.0, 0.5), spot(0.0, 8.0, 0.5)],
            &white(1.0),
            None,
        );
        // Samples on the hypotenuse belong to one of the two triangles of the square, not to both.
        let lower = band.values.iter().filter(|v| v[0] == 1.0).count();
        band.clear(0..band.side, 0.0);
        band.draw(
            &[spot(8.0, 0.0, 0.5), spot(8.0, 8.0, 0.5), spot(0.0, 8.0, 0.5)],
            &white(1.0),
            None,
        );
        assert_eq!(lower + band.values.iter().filter(|v| v[0] == 1.0).count(), 64);
    }

    #[test]
    fn the_nearest_fragment_stays_and_the_first_of_equals() {
        let all = |z| [spot(-9.0, -9.0, z), spot(30.0, -9.0, z), spot(-9.0, 30.0, z)];
        let mut band = Band::<1>::new(4);
        band.clear(0..band.side, 0.5);
        for (z, shade) in [(0.5, 0.1), (0.25, 0.2), (0.75, 0.3), (0.25, 0.4)] {
            band.draw(&all(z), &white(shade), None);
        }
        assert!(band.values.iter().all(|v| v[0] == 0.2));
    }

    #[test]
    fn shades_are_interpolated_in_space_not_in_the_picture() {
        // The right end is three times as far away, so the middle of the picture lies at a quarter
        // of the way on the surface.
        let far = |x, y| Spot { x, y, z: 0.9, inv_w: 1.0 / 3.0 };
        let triangle = [spot(0.0, -0.5, 0.1), spot(0.0, 1.5, 0.1), far(201.0, 0.5)];
        let paint = |shade| Paint { shade, colour: [1.0] };
        let mut band = Band::<1>::new(256);
        band.clear(0..band.side, 0.0);
        band.draw(&triangle, &[paint(0.0), paint(0.0), paint(1.0)], None);
        assert!((band.values[100][0] - 0.25).abs() < 1e-3, "{:?}", band.values[100]);
    }

    proptest! {
        // A fan round an inner point covers each sample of a convex polygon exactly once.
        #[test]
        fn a_fan_covers_every_sample_exactly_once(
            center in (10.0..22.0_f64, 10.0..22.0_f64),
            radii in prop::collection::vec(1.0..9.0_f64, 3..9),
        ) {
            let n = radii.len();
            let rim = |k: usize| {
                let turn = std::f64::consts::TAU * (k % n) as f64 / n as f64;
                spot(center.0 + radii[k % n] * turn.cos(), center.1 + radii[k % n] * turn.sin(), 0.5)
            };
            let middle = spot(center.0, center.1, 0.5);
            let mut hits = vec![0_u32; 32 * 32];
            for k in 0..n {
                for_each_span(&[middle, rim(k), rim(k + 1)], 32, 0..32, |row, columns| {
                    columns.for_each(|x| hits[row * 32 + x] += 1);
                });
            }
            prop_assert!(hits.iter().all(|h| *h <= 1));
            // Every sample within the smallest radius' inscribed circle is hit.
            let inner = radii.iter().fold(9.0_f64, |a, r| a.min(*r))
                * (std::f64::consts::PI / n as f64).cos();
            for (i, hit) in hits.iter().enumerate() {
                let (x, y) = ((i % 32) as f64 + 0.5 - center.0, (i / 32) as f64 + 0.5 - center.1);
                if x.hypot(y) < inner - 1e-9 {
                    prop_assert_eq!(*hit, 1);
                }
            }
        }
    }
}
