//! A bounding volume hierarchy over triangles: the distance from a point to the nearest of them.
//!
//! Invariants:
//! 1. the left child of an inner node follows it, the right child's index is stored;
//! 2. a node's box holds the boxes of its children; a leaf's box holds its triangles;
//! 3. the split is at the median, so the depth is the logarithm of the number of triangles.
//!
//! Knows nothing of sampling or percentages.

use glam::DVec3;
use smallvec::SmallVec;

const LEAF_SIZE: usize = 4;

/// One corner after the other, model space.
pub(super) type Triangle = [DVec3; 3];

/// Triangles in an order of its own, and the tree over them.
pub(super) struct Bvh {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
}

/// What a query found: the squared distance, and which triangle (an index of this tree's own, fit
/// as a hint for the next query).
#[derive(Clone, Copy, Debug)]
pub(super) struct Nearest {
    pub(super) distance2: f64,
    pub(super) triangle: usize,
}

struct Node {
    low: DVec3,
    high: DVec3,
    /// First triangle of a leaf, or index of the right child.
    at: u32,
    /// Triangles of a leaf; 0 for an inner node.
    count: u32,
}

impl Bvh {
    /// Builds the tree. At least one triangle is needed for a query to have an answer.
    pub(super) fn new(mut triangles: Vec<Triangle>) -> Self {
        let mut nodes = Vec::with_capacity(triangles.len() / 2 + 1);
        if !triangles.is_empty() {
            build(&mut nodes, &mut triangles, 0);
        }
        Self { nodes, triangles }
    }

    /// The nearest triangle; `hint` (any triangle, best one that is near) only saves time.
    pub(super) fn nearest(&self, point: DVec3, hint: usize) -> Nearest {
        let start = self.triangles.get(hint).map(|t| distance_squared(point, t));
        let mut best = Nearest { distance2: start.unwrap_or(f64::INFINITY), triangle: hint };
        let mut open: SmallVec<[(f64, usize); 64]> = SmallVec::new();
        if let Some(root) = self.nodes.first() {
            open.push((root.distance_squared(point), 0));
        }
        while let Some((distance2, index)) = open.pop() {
            if distance2 >= best.distance2 {
                continue;
            }
            let node = &self.nodes[index];
            if node.count > 0 {
                self.search_leaf(point, node, &mut best);
                continue;
            }
            let (left, right) = (index + 1, node.at as usize);
            let near = (self.nodes[left].distance_squared(point), left);
            let far = (self.nodes[right].distance_squared(point), right);
            // The nearer child is looked at first: it is pushed last.
            let (near, far) = if far.0 < near.0 { (far, near) } else { (near, far) };
            open.push(far);
            open.push(near);
        }
        best
    }

    fn search_leaf(&self, point: DVec3, leaf: &Node, best: &mut Nearest) {
        for triangle in leaf.at as usize..(leaf.at + leaf.count) as usize {
            let distance2 = distance_squared(point, &self.triangles[triangle]);
            if distance2 < best.distance2 {
                *best = Nearest { distance2, triangle };
            }
        }
    }
}

impl Node {
    fn distance_squared(&self, point: DVec3) -> f64 {
        point.distance_squared(point.clamp(self.low, self.high))
    }
}

fn build(nodes: &mut Vec<Node>, triangles: &mut [Triangle], first: usize) {
    let (low, high) = bounds(triangles.iter().flatten().copied());
    let index = nodes.len();
    nodes.push(Node { low, high, at: first as u32, count: triangles.len() as u32 });
    if triangles.len() <= LEAF_SIZE {
        return;
    }
    let center = |t: &Triangle| t[0] + t[1] + t[2];
    let (center_low, center_high) = bounds(triangles.iter().map(center));
    let axis = (center_high - center_low).max_position();
    let middle = triangles.len() / 2;
    triangles.select_nth_unstable_by(middle, |a, b| center(a)[axis].total_cmp(&center(b)[axis]));
    let (left, right) = triangles.split_at_mut(middle);
    build(nodes, left, first);
    nodes[index].at = nodes.len() as u32;
    nodes[index].count = 0;
    build(nodes, right, first + middle);
}

/// The box round some points; inverted when there are none.
pub(super) fn bounds(points: impl Iterator<Item = DVec3>) -> (DVec3, DVec3) {
    let nothing = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    points.fold(nothing, |(low, high), p| (low.min(p), high.max(p)))
}

/// Squared distance from a point to a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
pub(super) fn distance_squared(point: DVec3, [a, b, c]: &Triangle) -> f64 {
    let (ab, ac) = (*b - *a, *c - *a);
    let ap = point - *a;
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return ap.length_squared();
    }
    let bp = point - *b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return bp.length_squared();
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return (ap - ab * quotient(d1, d1 - d3)).length_squared();
    }
    let cp = point - *c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return cp.length_squared();
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return (ap - ac * quotient(d2, d2 - d6)).length_squared();
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return (bp - (*c - *b) * quotient(d4 - d3, (d4 - d3) + (d5 - d6))).length_squared();
    }
    // Inside. Rounding may bring a needle here, so the weights are held within the triangle.
    let v = quotient(vb, va + vb + vc);
    let w = quotient(vc, va + vb + vc).min(1.0 - v);
    (ap - ab * v - ac * w).length_squared()
}

/// A share of a whole, 0 to 1; 0 of nothing.
fn quotient(part: f64, whole: f64) -> f64 {
    if whole == 0.0 { 0.0 } else { (part / whole).clamp(0.0, 1.0) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn point() -> impl Strategy<Value = DVec3> {
        [-1.0..1.0_f64, -1.0..1.0_f64, -1.0..1.0_f64].prop_map(DVec3::from_array)
    }

    /// Distance by brute force: the best of a fine grid of points on the triangle.
    fn sampled_distance(p: DVec3, [a, b, c]: &Triangle) -> f64 {
        let n = 200;
        let grid = (0..=n).flat_map(|i| (0..=n - i).map(move |j| (i, j)));
        grid.map(|(i, j)| {
            let (v, w) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
            p.distance(*a + (*b - *a) * v + (*c - *a) * w)
        })
        .fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn all_seven_regions_of_a_triangle() {
        let t = [DVec3::ZERO, DVec3::X * 4.0, DVec3::Y * 4.0];
        let cases = [
            (DVec3::new(1.0, 1.0, 3.0), 9.0),
            (DVec3::new(-3.0, -4.0, 0.0), 25.0),
            (DVec3::new(6.0, -1.0, 0.0), 5.0),
            (DVec3::new(-1.0, 6.0, 0.0), 5.0),
            (DVec3::new(2.0, -2.0, 1.0), 5.0),
            (DVec3::new(-2.0, 2.0, 1.0), 5.0),
            (DVec3::new(4.0, 4.0, 0.0), 8.0),
        ];
        for (p, expected) in cases {
            assert!((distance_squared(p, &t) - expected).abs() < 1e-12, "{p}");
        }
    }

    #[test]
    fn degenerate_triangles_are_segments_and_points() {
        let segment = [DVec3::ZERO, DVec3::X, DVec3::X * 2.0];
        assert!((distance_squared(DVec3::new(1.5, 2.0, 0.0), &segment) - 4.0).abs() < 1e-12);
        assert!((distance_squared(DVec3::new(5.0, 0.0, 0.0), &segment) - 9.0).abs() < 1e-12);
        assert_eq!(distance_squared(DVec3::X, &[DVec3::ZERO; 3]), 1.0);
    }

    #[test]
    fn no_triangles_are_infinitely_far() {
        assert_eq!(Bvh::new(Vec::new()).nearest(DVec3::ZERO, 0).distance2, f64::INFINITY);
    }

    proptest! {
        #[test]
        fn distance_agrees_with_a_sampled_triangle(p in point(), t in [point(), point(), point()]) {
            let exact = distance_squared(p, &t).sqrt();
            let sampled = sampled_distance(p, &t);
            prop_assert!(exact <= sampled + 1e-12 && sampled - exact < 0.02);
        }

        #[test]
        fn the_tree_finds_what_a_scan_finds(
            triangles in prop::collection::vec([point(), point(), point()], 1..60),
            p in point(),
            hint in 0_usize..80,
        ) {
            let scan = triangles.iter().map(|t| distance_squared(p, t)).fold(f64::INFINITY, f64::min);
            prop_assert_eq!(Bvh::new(triangles).nearest(p, hint).distance2, scan);
        }
    }
}
