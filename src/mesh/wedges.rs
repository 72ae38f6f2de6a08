//! Attribute values of new wedges: interpolation along an edge.

use glam::DVec3;
use smallvec::SmallVec;

use super::edit_mesh::EditMesh;
use super::model::{Semantic, WedgeId};

/// Two wedges that become one.
pub(super) type Pair = [WedgeId; 2];

/// The parameter of `x` projected on the edge from `a` to `b`, clamped to 0..=1.
pub(super) fn edge_parameter(a: DVec3, b: DVec3, x: DVec3) -> f64 {
    let edge = b - a;
    let t = (x - a).dot(edge) / edge.length_squared();
    if t.is_finite() { t.clamp(0.0, 1.0) } else { 0.5 }
}

impl EditMesh {
    /// Values of one new wedge per pair, each interpolated at `t` from first to second: wedge
    /// after wedge, all layers of a wedge in layer order.
    pub(super) fn blend_wedges(&self, pairs: &[Pair], t: f64) -> Vec<f32> {
        let mut values = Vec::new();
        for pair in pairs {
            for layer in &self.mesh.layers {
                let [a, b] = pair.map(|wedge| layer.get(wedge));
                let start = values.len();
                values.extend(a.iter().zip(b).map(|(&a, &b)| lerp(a, b, t)));
                let blended = &mut values[start..];
                match layer.semantic {
                    Semantic::Normal => renormalise(blended),
                    Semantic::Tangent => settle_tangent(blended, if t < 0.5 { a } else { b }),
                    Semantic::TexCoord(_) | Semantic::Color(_) | Semantic::Custom(_) => {}
                }
            }
        }
        values
    }

    /// The id that the next appended wedge will get.
    pub(super) fn next_wedge(&self) -> WedgeId {
        WedgeId(self.mesh.n_wedges() as u32)
    }

    /// Appends wedges given as [`Self::blend_wedges`] returns them.
    pub(super) fn append_wedges(&mut self, values: &[f32]) {
        let mut rest = values;
        while !rest.is_empty() {
            for layer in &mut self.mesh.layers {
                let (head, tail) = rest.split_at(layer.width.min(rest.len()));
                layer.values.extend_from_slice(head);
                rest = tail;
            }
        }
    }

    /// Removes all wedges from `first` on.
    pub(super) fn truncate_wedges(&mut self, first: WedgeId) {
        for layer in &mut self.mesh.layers {
            layer.values.truncate(first.index() * layer.width);
        }
    }
}

/// The wedge that replaces `wedge` when `pairs` merge into wedges numbered from `first`; when
/// several pairs name it, the first one counts.
pub(super) fn replacement(pairs: &[Pair], first: WedgeId, wedge: WedgeId) -> Option<WedgeId> {
    let at = pairs.iter().position(|pair| pair.contains(&wedge))?;
    Some(WedgeId(first.0 + at as u32))
}

/// Adds a pair unless it is there; returns its position.
pub(super) fn add_pair(pairs: &mut SmallVec<[Pair; 2]>, pair: Pair) -> usize {
    pairs.iter().position(|&p| p == pair).unwrap_or_else(|| {
        pairs.push(pair);
        pairs.len() - 1
    })
}

fn lerp(a: f32, b: f32, t: f64) -> f32 {
    (f64::from(a) * (1.0 - t) + f64::from(b) * t) as f32
}

/// Scales to unit length what is not zero.
fn renormalise(vector: &mut [f32]) {
    let length = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
    if length > 0.0 && length.is_finite() {
        for x in vector {
            *x = (f64::from(*x) / length) as f32;
        }
    }
}

/// A tangent's direction has unit length; its handedness (the last value) is never blended.
fn settle_tangent(tangent: &mut [f32], nearest: &[f32]) {
    let Some((handedness, direction)) = tangent.split_last_mut() else { return };
    renormalise(direction);
    if let Some(&sign) = nearest.last() {
        *handedness = sign;
    }
}
