//! Attribute values of new wedges.
//!
//! A split interpolates along the edge. A collapse fits: each triangle that a wedge belonged to says, by the affine
//! function of its corners' attributes, what the attributes are where the vertex now is (projected on its plane);
//! the new wedge has the mean of these, weighted by squared areas as volume optimization weights triangles. Where the
//! attributes are affine over the neighbourhood they stay so, wherever the vertex goes. Values do not leave the range
//! that they have at the corners of those triangles.

use glam::DVec3;
use smallvec::SmallVec;

use super::edit::{Collapse, RemovedFace};
use super::edit_mesh::EditMesh;
use super::model::{AttributeLayer, FaceId, Semantic, WedgeId};
use super::skin;

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
                if layer.semantic == Semantic::Skin {
                    values.extend(skin::mean(&[(1.0 - t, a), (t, b)]));
                    continue;
                }
                let start = values.len();
                values.extend(a.iter().zip(b).map(|(&a, &b)| lerp(a, b, t)));
                settle(&mut values[start..], layer, [a, b], t);
            }
        }
        values
    }

    /// Values of the wedges that a planned collapse appends, one for each pair; those that the corners in
    /// `rewedged` get. As [`Self::blend_wedges`] returns them.
    pub(super) fn fit_wedges(&self, plan: &Collapse, pairs: &[Pair]) -> Vec<f32> {
        let mut values = Vec::new();
        let t = edge_parameter(plan.keep_from, plan.drop_from, plan.to);
        let opinions_of =
            |k: usize| self.opinions(plan, pairs[k], WedgeId(plan.first_new_wedge.0 + k as u32));
        for (k, pair) in pairs.iter().enumerate() {
            if self.is_locked(plan.keep) && pair[0] != pair[1] {
                // What stays where it is stays as it is.
                values.extend(self.mesh.layers.iter().flat_map(|layer| layer.get(pair[0])));
                continue;
            }
            let opinions = opinions_of(k);
            for layer in &self.mesh.layers {
                let [a, b] = pair.map(|wedge| layer.get(wedge));
                let start = values.len();
                if layer.semantic == Semantic::Skin {
                    values.extend(match self.whole_skin(layer, plan) {
                        Some(ends) => {
                            let all: Vec<Opinion> =
                                (0..pairs.len()).flat_map(opinions_of).collect();
                            skin::fitted(layer, plan, &all, ends, t)
                        }
                        None => skin::fitted(layer, plan, &opinions, [a, b], t),
                    });
                } else if opinions.is_empty() {
                    values.extend(a.iter().zip(b).map(|(&a, &b)| lerp(a, b, t)));
                } else {
                    values.extend((0..layer.width).map(|at| fitted(&opinions, layer, at)));
                }
                settle(&mut values[start..], layer, [a, b], t);
            }
        }
        values
    }

    /// What the triangles of a pair say of the place that a collapse leads to; none of a triangle too thin to
    /// say anything.
    fn opinions(&self, plan: &Collapse, pair: Pair, new: WedgeId) -> SmallVec<[Opinion; 12]> {
        let ends = [plan.keep, plan.drop];
        let is_of_pair = |r: &&RemovedFace| {
            let of_end = |end| r.wedges[r.vertices.iter().position(|v| *v == end).unwrap_or(0)];
            ends.map(of_end) == pair
        };
        let removed = plan.removed.iter().filter(is_of_pair).map(|r| r.face);
        let kept = plan.rewedged.iter().filter(|r| r.to == new).map(|r| r.corner.face());
        let opinion = |face: FaceId| {
            let corners = self.vertices_of(face).map(|v| self.position(v));
            let (weight, shares) = shares_of(corners, plan.to)?;
            Some(Opinion { weight, shares, wedges: self.wedges_of(face) })
        };
        removed.chain(kept).filter_map(opinion).collect()
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

/// What a triangle says of a place: by which shares of its corners' attributes, and how much that counts.
pub(super) struct Opinion {
    pub(super) weight: f64,
    pub(super) shares: [f64; 3],
    pub(super) wedges: [WedgeId; 3],
}

/// Squared double area of a triangle, and the shares of its corners at the projection of `x` on its plane, which add
/// up to 1; `None` of a sliver.
fn shares_of([a, b, c]: [DVec3; 3], x: DVec3) -> Option<(f64, [f64; 3])> {
    /// Least height of a triangle, as a share of its longest side.
    const THIN: f64 = 1e-3;
    let normal = (b - a).cross(c - a);
    let weight = normal.length_squared();
    let longest =
        (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    if weight.is_nan() || weight <= (THIN * longest).powi(2) {
        return None;
    }
    let of_b = (x - a).cross(c - a).dot(normal) / weight;
    let of_c = (b - a).cross(x - a).dot(normal) / weight;
    Some((weight, [1.0 - of_b - of_c, of_b, of_c]))
}

/// The weighted mean of what triangles say of value `at` of a layer, within the range of their corners.
fn fitted(opinions: &[Opinion], layer: &AttributeLayer, at: usize) -> f32 {
    let (mut sum, mut total) = (0.0, 0.0);
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for opinion in opinions {
        let values = opinion.wedges.map(|w| layer.get(w)[at]);
        let said: f64 = (0..3).map(|k| opinion.shares[k] * f64::from(values[k])).sum();
        sum += opinion.weight * said;
        total += opinion.weight;
        low = values.iter().fold(low, |a, b| a.min(*b));
        high = values.iter().fold(high, |a, b| a.max(*b));
    }
    ((sum / total) as f32).max(low).min(high)
}

/// Brings a new value to what its meaning demands; `ends` are those of the pair it comes from.
fn settle(value: &mut [f32], layer: &AttributeLayer, [a, b]: [&[f32]; 2], t: f64) {
    match layer.semantic {
        Semantic::Normal => renormalise(value),
        Semantic::Tangent => settle_tangent(value, if t < 0.5 { a } else { b }),
        Semantic::TexCoord(_) | Semantic::Color(_) | Semantic::Skin | Semantic::Custom(_) => {}
    }
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
