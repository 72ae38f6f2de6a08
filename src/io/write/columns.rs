//! How values of vertices become bytes: as singles, or as integers (KHR_mesh_quantization).

use glam::{DMat4, DVec3};
use serde_json::{Value, json};

use crate::mesh::{Mesh, Semantic};

/// A component of an accessor, and how a value becomes one.
pub(super) struct Number {
    pub(super) component: u32,
    pub(super) normalized: bool,
    put: fn(f32, &mut Vec<u8>),
}

pub(super) static FLOAT: Number = Number {
    component: 5_126,
    normalized: false,
    put: |v, out| out.extend_from_slice(&v.to_le_bytes()),
};
/// Places on a [`Grid`].
pub(super) static STEPS: Number =
    Number { component: 5_123, normalized: false, put: |v, out| put_u16(v, out) };
/// 0 to 1 in 16 bits.
static SHARE: Number =
    Number { component: 5_123, normalized: true, put: |v, out| put_u16(v * 65_535.0, out) };
/// Joints of small skins, and of others.
static SMALL: Number =
    Number { component: 5_121, normalized: false, put: |v, out| out.push(v as u8) };
static LARGE: Number =
    Number { component: 5_123, normalized: false, put: |v, out| put_u16(v, out) };
/// −1 to 1 in 8 bits.
static DIRECTION: Number = Number {
    component: 5_120,
    normalized: true,
    put: |v, out| out.push((v * 127.0).round() as i8 as u8),
};

fn put_u16(v: f32, out: &mut Vec<u8>) {
    out.extend_from_slice(&(v.round() as u16).to_le_bytes());
}

/// What holds joints below `n`.
pub(super) fn joints(n: usize) -> &'static Number {
    if n <= 256 { &SMALL } else { &LARGE }
}

/// What holds the shares of joints.
pub(super) fn shares(is_quantized: bool) -> &'static Number {
    if is_quantized { &SHARE } else { &FLOAT }
}

/// What holds quantized values of a layer. Texture coordinates beyond 0..=1 stay singles, and so do
/// values of unknown meaning.
pub(super) fn quantized(semantic: Semantic, values: &[f32]) -> &'static Number {
    match semantic {
        Semantic::Normal | Semantic::Tangent => &DIRECTION,
        Semantic::Color(_) => &SHARE,
        Semantic::TexCoord(_) if values.iter().all(|v| (0.0..=1.0).contains(v)) => &SHARE,
        Semantic::TexCoord(_) | Semantic::Skin | Semantic::Custom(_) => &FLOAT,
    }
}

/// The bytes of records of `width` values, each padded to a multiple of four, and their stride.
pub(super) fn column(values: &[f32], width: usize, number: &Number) -> (Vec<u8>, usize) {
    let mut bytes = Vec::new();
    for record in values.chunks_exact(width) {
        record.iter().for_each(|v| (number.put)(*v, &mut bytes));
        bytes.resize(bytes.len().next_multiple_of(4), 0);
    }
    let stride = bytes.len() / (values.len() / width).max(1);
    (bytes, stride)
}

/// 65,536 places along the longest side of the vertices' bounds, as many to the unit along the
/// others. One grid for the whole file: what coincides goes on to coincide. Or, without steps, an origin for what is so
/// far from that of the model that singles are too coarse there.
pub(super) struct Grid {
    low: [f32; 3],
    step: f32,
    has_steps: bool,
}

/// Models are far from the origin when they are so many times their size away: singles leave them 14 bits of 24.
const FAR: f64 = 1024.0;

fn bounds(meshes: &[&Mesh]) -> (DVec3, DVec3) {
    let mut points = meshes.iter().flat_map(|mesh| &mesh.positions);
    let first = points.next().copied().unwrap_or(DVec3::ZERO);
    points.fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)))
}

impl Grid {
    /// Covers all vertices.
    pub(super) fn of(meshes: &[&Mesh]) -> Self {
        let (low, high) = bounds(meshes);
        let low = low.to_array().map(at_most);
        let extent = (high - DVec3::from_array(low.map(f64::from))).max_element();
        let step = if extent > 0.0 { -at_most(-extent / 65_535.0) } else { 1.0 };
        Self { low, step: step.max(f32::MIN_POSITIVE), has_steps: true }
    }

    /// An origin near the vertices, where they are far from their own.
    pub(super) fn near(meshes: &[&Mesh]) -> Option<Self> {
        let (low, high) = bounds(meshes);
        let is_far = low.abs().max(high.abs()).max_element() > FAR * (high - low).max_element();
        let low = low.midpoint(high).to_array().map(|x| x as f32);
        is_far.then_some(Self { low, step: 1.0, has_steps: false })
    }

    /// What is in the file for a position: the steps to the nearest place, or what is left from the origin.
    pub(super) fn steps(&self, p: DVec3) -> [f32; 3] {
        let low = DVec3::from_array(self.low.map(f64::from));
        if !self.has_steps {
            return (p - low).as_vec3().to_array();
        }
        let steps = ((p - low) / f64::from(self.step)).round();
        steps.clamp(DVec3::ZERO, DVec3::splat(65_535.0)).as_vec3().to_array()
    }

    /// A matrix that begins in the model's space, column by column, after the steps were brought there.
    pub(super) fn put_before(&self, matrix: &[f64; 16]) -> [f64; 16] {
        let low = DVec3::from_array(self.low.map(f64::from));
        let world_from_grid =
            DMat4::from_translation(low) * DMat4::from_scale(DVec3::splat(f64::from(self.step)));
        (DMat4::from_cols_array(matrix) * world_from_grid).to_cols_array()
    }

    /// Brings steps back into the model's space.
    pub(super) fn put_transform(&self, node: &mut Value) {
        node["translation"] = json!(self.low);
        if self.has_steps {
            node["scale"] = json!([self.step, self.step, self.step]);
        }
    }
}

/// The largest single that is not above `x`.
fn at_most(x: f64) -> f32 {
    let nearest = x as f32;
    if f64::from(nearest) > x { nearest.next_down() } else { nearest }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Far from the origin, where singles are coarse; and a point alone.
    #[test]
    fn places_are_within_half_a_step() {
        for (low, size) in [(-1.0, 2.0), (1e6, 1.0), (0.1, 1e-6), (-3.0, 0.0), (0.0, 1e-44)] {
            let points = (0..=50).map(|i| low + size * f64::from(i) / 50.0);
            let positions: Vec<_> = points.map(|x| DVec3::new(x, low, x / 3.0)).collect();
            let grid = Grid::of(&[&Mesh::from_parts(positions.clone(), Vec::new())]);
            for p in positions {
                let steps = DVec3::from_array(grid.steps(p).map(f64::from));
                let back =
                    DVec3::from_array(grid.low.map(f64::from)) + steps * f64::from(grid.step);
                let off = (back - p).abs().max_element() / f64::from(grid.step);
                assert!(off <= 0.5 + 1e-6, "{low} {size}: {off} steps");
                assert!(steps.fract() == DVec3::ZERO);
            }
        }
    }

    #[test]
    fn records_are_padded_to_four_bytes() {
        for (number, width, bytes) in [
            (&DIRECTION, 3, &[0, 127, 129, 0][..]),
            (&SHARE, 3, &[0, 0, 255, 255, 0, 0, 0, 0]),
            (&STEPS, 2, &[0, 0, 1, 0]),
            (&FLOAT, 1, &[0; 4]),
        ] {
            let (found, stride) = column(&[0.0, 1.0, -1.0][..width], width, number);
            assert_eq!((&*found, stride), (bytes, bytes.len()));
        }
        let uv = Semantic::TexCoord(0);
        assert!(quantized(uv, &[0.0, 1.0]).normalized && !quantized(uv, &[0.0, 1.1]).normalized);
    }
}
