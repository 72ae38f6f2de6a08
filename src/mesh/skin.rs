//! What moves a vertex in a skin: up to four joints and the share of each.
//!
//! The values of a wedge in the layer [`Semantic::Skin`](super::Semantic) are four joints, then their shares. Joints are
//! numbered through all skins of the tree, so that wedges of different skins differ. Shares add up to 1 and descend;
//! joints with equal shares ascend, and those without a share are 0: equal skins have equal values. A vertex of a
//! part without a skin has nothing but zeros.
//!
//! A collapse fits the share of each joint as it fits any other attribute (`wedges.rs`); the four largest are
//! kept. Where all wedges of a vertex move alike they go on to: a seam of the texture does not tear when the model moves.

use smallvec::SmallVec;

use super::edit::Collapse;
use super::edit_mesh::EditMesh;
use super::model::{AttributeLayer, VertexId};
use super::wedges::Opinion;

/// Joints of a vertex that are kept.
pub const MAX_JOINTS: usize = 4;
/// Values of a wedge.
pub const WIDTH: usize = 2 * MAX_JOINTS;

/// The values for joints and their shares: the largest four, in order, brought to a sum of 1. What is not above 0, or
/// not finite, does not count; zeros where nothing does.
pub fn settled(shares: impl IntoIterator<Item = (u32, f64)>) -> [f32; WIDTH] {
    let mut sums: SmallVec<[(u32, f64); 8]> = SmallVec::new();
    for (joint, share) in shares.into_iter().filter(|(_, share)| *share > 0.0 && share.is_finite())
    {
        match sums.iter_mut().find(|(other, _)| *other == joint) {
            Some((_, sum)) => *sum += share,
            None => sums.push((joint, share)),
        }
    }
    sums.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    sums.truncate(MAX_JOINTS);
    let total: f64 = sums.iter().map(|(_, share)| share).sum();
    let mut values = [0.0; WIDTH];
    for (k, (joint, share)) in sums.into_iter().enumerate() {
        // Joints are counted in singles, exactly: readers allow fewer than 2^24.
        (values[k], values[MAX_JOINTS + k]) = (joint as f32, (share / total) as f32);
    }
    values
}

/// Joints and shares of a wedge, without those that have none.
pub fn shares(values: &[f32]) -> impl Iterator<Item = (u32, f64)> + '_ {
    let (joints, shares) = values.split_at(MAX_JOINTS.min(values.len()));
    let both = joints.iter().zip(shares).filter(|(_, share)| **share > 0.0);
    both.map(|(joint, share)| (*joint as u32, f64::from(*share)))
}

/// A mean of skins with the given weights.
pub(super) fn mean(skins: &[(f64, &[f32])]) -> [f32; WIDTH] {
    settled(skins.iter().flat_map(|(weight, values)| {
        shares(values).map(move |(joint, share)| (joint, weight * share))
    }))
}

/// The skin where a collapse leads to: what triangles say, each joint's share within the range that it has at their
/// corners; `ends` are the skins of the two vertices, and `t` says which is how near where no triangle says anything.
pub(super) fn fitted(
    layer: &AttributeLayer,
    plan: &Collapse,
    opinions: &[Opinion],
    ends: [&[f32]; 2],
    t: f64,
) -> [f32; WIDTH] {
    // A vertex that stays keeps its skin: so do the wedges that no removed triangle has.
    if plan.to == plan.keep_from {
        return mean(&[(1.0, ends[0])]);
    }
    if plan.to == plan.drop_from {
        return mean(&[(1.0, ends[1])]);
    }
    let corners = opinions.iter().flat_map(|o| o.wedges).flat_map(|w| shares(layer.get(w)));
    let mut joints: SmallVec<[u32; 16]> = corners.map(|(joint, _)| joint).collect();
    joints.sort_unstable();
    joints.dedup();
    let skin = settled(joints.into_iter().map(|joint| (joint, share(layer, opinions, joint))));
    if skin[MAX_JOINTS] > 0.0 { skin } else { mean(&[(1.0 - t, ends[0]), (t, ends[1])]) }
}

/// The share of a joint by what triangles say, within the range at their corners.
fn share(layer: &AttributeLayer, opinions: &[Opinion], joint: u32) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    let (mut low, mut high) = (f64::INFINITY, 0.0_f64);
    for opinion in opinions {
        let at_corners = opinion.wedges.map(|wedge| {
            shares(layer.get(wedge))
                .find(|(other, _)| *other == joint)
                .map_or(0.0, |(_, share)| share)
        });
        let said: f64 = opinion.shares.iter().zip(at_corners).map(|(a, b)| a * b).sum();
        sum += opinion.weight * said;
        total += opinion.weight;
        low = at_corners.into_iter().fold(low, f64::min);
        high = at_corners.into_iter().fold(high, f64::max);
    }
    (sum / total).max(low).min(high)
}

impl EditMesh {
    /// The skins of the ends of a collapse, where all wedges of each move alike.
    pub(super) fn whole_skin<'m>(
        &self,
        layer: &'m AttributeLayer,
        plan: &Collapse,
    ) -> Option<[&'m [f32]; 2]> {
        Some([self.skin_at(layer, plan.keep)?, self.skin_at(layer, plan.drop)?])
    }

    fn skin_at<'m>(&self, layer: &'m AttributeLayer, vertex: VertexId) -> Option<&'m [f32]> {
        let skin_in = |face| {
            let at = self.vertices_of(face).iter().position(|v| *v == vertex)?;
            Some(layer.get(self.wedges_of(face)[at]))
        };
        let mut skins = self.faces_around(vertex).iter().map(|face| skin_in(*face));
        let first = skins.next()??;
        skins.all(|skin| skin == Some(first)).then_some(first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skins_are_settled() {
        type Shares = &'static [(u32, f64)];
        let table: [(Shares, [f32; WIDTH]); 6] = [
            (&[], [0.0; 8]),
            (&[(3, 0.5)], [3.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
            // Equal shares go by joint; twice the same joint is once.
            (&[(7, 1.0), (2, 0.5), (2, 0.5)], [2.0, 7.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0]),
            // The fifth goes, the others grow.
            (
                &[(1, 0.1), (2, 0.2), (3, 0.2), (4, 0.3), (5, 0.3)],
                [4.0, 5.0, 2.0, 3.0, 0.3, 0.3, 0.2, 0.2],
            ),
            (
                &[(1, f64::NAN), (2, -1.0), (3, 0.0), (4, 2.0)],
                [4.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            ),
            (&[(1, f64::INFINITY)], [0.0; 8]),
        ];
        for (given, want) in table {
            assert_eq!(settled(given.iter().copied()), want, "{given:?}");
        }
    }

    #[test]
    fn a_mean_is_over_joints_and_not_over_places() {
        let (a, b) = (settled([(1, 0.75), (2, 0.25)]), settled([(2, 1.0)]));
        assert_eq!(mean(&[(0.5, &a), (0.5, &b)]), settled([(2, 0.625), (1, 0.375)]));
        assert_eq!(mean(&[(1.0, &a), (0.0, &b)]), a);
    }
}
