//! Polygons of OBJ and PLY: which triangles they are.
//!
//! The plane of a polygon is that of Newell's normal, about which its corners go round. Most polygons are fans from
//! their first corner. Where a triangle of the fan would be turned over, or flat, the polygon is split along
//! diagonals that lie inside: of a quad there is one other, of larger polygons ears are clipped, one after the
//! other. Where none is found (the outline crosses itself, or is nothing but a line), what is left is a fan.
//!
//! Invariants, whatever the corners are:
//! 1. n corners make n - 2 triangles, of indices below n;
//! 2. triangles go round as their polygon does;
//! 3. the work is at most quadratic, polygons of more than [`MAX_CORNERS`] corners are not clipped, and all polygons of
//!    a file together have [`LOOKS_OF_FILE`].

use glam::DVec3;

use super::soup::Notes;

/// Larger polygons are fans, whatever their shape.
const MAX_CORNERS: usize = 1000;
/// Corners that may be looked at while ears are sought, as a multiple of the square of their number.
const MAX_LOOKS: usize = 3;
/// The same for all polygons of a file, some seconds; honest files need far less.
const LOOKS_OF_FILE: usize = 100_000_000;

/// Splits the polygons of a file.
pub(super) struct Splitter {
    looks_left: usize,
}

impl Default for Splitter {
    fn default() -> Self {
        Self { looks_left: LOOKS_OF_FILE }
    }
}

impl Splitter {
    /// The triangles of a polygon, as indices into its corners.
    pub(super) fn triangulate(&mut self, corners: &[DVec3], notes: &mut Notes) -> Vec<[usize; 3]> {
        let n = corners.len();
        if n < 4 {
            return fan(n).collect();
        }
        let outline = Outline::of(corners);
        let is_turned = |triangle: [usize; 3]| outline.turn(triangle) > 0.0;
        if fan(n).all(is_turned) {
            return fan(n).collect();
        }
        if n == 4 {
            let other = [[0, 1, 3], [1, 2, 3]];
            return if other.into_iter().all(is_turned) { other.into() } else { fan(n).collect() };
        }
        if n > MAX_CORNERS || self.looks_left == 0 {
            let text = format!(
                "concave polygons of more than {MAX_CORNERS} corners, and those behind very many of fewer, are split \
                 from their first corner, which may turn triangles over: split them before"
            );
            notes.add("large_polygon_fanned", text);
            return fan(n).collect();
        }
        outline.clipped(&mut self.looks_left)
    }
}

/// The triangles that the first of `n` corners makes with all sides that it is not on.
fn fan(n: usize) -> impl Iterator<Item = [usize; 3]> {
    (2..n).map(|i| [0, i - 1, i])
}

/// The corners of a polygon and its normal, of length 1, or 0 where it has none.
struct Outline<'a> {
    corners: &'a [DVec3],
    normal: DVec3,
}

impl<'a> Outline<'a> {
    fn of(corners: &'a [DVec3]) -> Self {
        let first = corners.first().copied().unwrap_or_default();
        let sum: DVec3 =
            corners.windows(2).map(|side| (side[0] - first).cross(side[1] - first)).sum();
        Self { corners, normal: sum.normalize_or_zero() }
    }

    fn at(&self, corner: usize) -> DVec3 {
        self.corners.get(corner).copied().unwrap_or_default()
    }

    /// Twice the area of a triangle as seen along the normal: more than 0 where it is turned as the polygon is, less
    /// where it is turned over.
    fn turn(&self, triangle: [usize; 3]) -> f64 {
        let [a, b, c] = triangle.map(|corner| self.at(corner));
        self.normal.dot((b - a).cross(c - a))
    }

    /// Triangles by clipping ears. What is no ear may become one when others are gone.
    fn clipped(&self, looks_of_file: &mut usize) -> Vec<[usize; 3]> {
        let n = self.corners.len();
        let mut triangles = Vec::with_capacity(n.saturating_sub(2));
        let mut left: Vec<usize> = (0..n).collect();
        let mut looks_left = n.saturating_mul(n).saturating_mul(MAX_LOOKS);
        let (mut at, mut n_passed) = (0, 0);
        while left.len() > 3 && n_passed < left.len() && looks_left >= left.len() {
            looks_left -= left.len();
            *looks_of_file = looks_of_file.saturating_sub(left.len());
            at %= left.len();
            let corner = Corner::of(&left, at);
            if self.is_ear(&left, &corner) {
                triangles.push([corner.before, corner.own, corner.after]);
                left.remove(at);
                n_passed = 0;
                // The neighbours of an ear are the likeliest ones to have become ears.
                at = at.saturating_sub(1);
            } else {
                n_passed += 1;
                at += 1;
            }
        }
        triangles.extend(fan(left.len()).map(|triangle| triangle.map(|i| left[i])));
        triangles
    }

    /// Whether the triangle at a corner lies inside what is left of the polygon. Corners at the same place as one of
    /// its own, of bridges to holes, do not count; the diagonal must leave both of its ends inwards instead.
    fn is_ear(&self, left: &[usize], corner: &Corner) -> bool {
        let own = [corner.before, corner.own, corner.after];
        let is_turned = self.turn(own) > 0.0;
        if !is_turned {
            return false;
        }
        let (n, at) = (left.len(), corner.at);
        let [before, after] = [n - 1, 1].map(|step| Corner::of(left, (at + step) % n));
        if !self.is_inward(&before, corner.after) || !self.is_inward(&after, corner.before) {
            return false;
        }
        let places = own.map(|i| self.at(i));
        !left.iter().any(|i| !places.contains(&self.at(*i)) && self.holds(own, *i))
    }

    /// Whether a corner lies in a triangle or on its sides.
    fn holds(&self, [a, b, c]: [usize; 3], corner: usize) -> bool {
        [[a, b, corner], [b, c, corner], [c, a, corner]].into_iter().all(|t| self.turn(t) >= 0.0)
    }

    /// Whether the line from a corner to another one begins inside the polygon.
    fn is_inward(&self, from: &Corner, to: usize) -> bool {
        let Corner { before, own, after, .. } = *from;
        let (past_after, past_before) = (self.turn([own, after, to]), self.turn([own, to, before]));
        if self.turn([before, own, after]) > 0.0 {
            past_after >= 0.0 && past_before >= 0.0
        } else {
            past_after > 0.0 || past_before > 0.0
        }
    }
}

/// A corner among those that are left, and its neighbours.
struct Corner {
    /// Where it is in the list.
    at: usize,
    before: usize,
    own: usize,
    after: usize,
}

impl Corner {
    /// `at` is below the length of the list.
    fn of(left: &[usize], at: usize) -> Self {
        let n = left.len();
        let [before, own, after] = [n - 1, 0, 1].map(|step| left[(at + step) % n]);
        Self { at, before, own, after }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangulate(corners: &[DVec3], notes: &mut Notes) -> Vec<[usize; 3]> {
        Splitter::default().triangulate(corners, notes)
    }

    const L: [[f64; 2]; 6] = [[4., 0.], [4., 1.], [1., 1.], [1., 4.], [0., 4.], [0., 0.]];

    /// The corners of an outline, beginning with corner `first`, on a slanted plane far from the origin.
    fn placed(outline: &[[f64; 2]], first: usize) -> Vec<DVec3> {
        let place = |[x, y]: &[f64; 2]| DVec3::new(x + 1024.0, y - 512.0, x + 2.0 * y);
        outline.iter().cycle().skip(first).take(outline.len()).map(place).collect()
    }

    /// The areas of the triangles from every first corner, as seen from above, where the outline is as it was.
    fn areas(outline: &[[f64; 2]]) -> Vec<Vec<f64>> {
        let of = |first: usize| {
            let corners = placed(outline, first);
            let triangles = triangulate(&corners, &mut Notes::default());
            assert_eq!(triangles.len(), outline.len() - 2);
            let area = |t: &[usize; 3]| {
                let [a, b, c] = t.map(|i| corners[i].truncate());
                (b - a).perp_dot(c - a) / 2.0
            };
            triangles.iter().map(area).collect()
        };
        (0..outline.len()).map(of).collect()
    }

    /// Triangles cover the outline, which has that area, and none is smaller than `least`.
    #[track_caller]
    fn check(outline: &[[f64; 2]], area: f64, least: f64) {
        for (first, areas) in areas(outline).into_iter().enumerate() {
            assert!(areas.iter().all(|a| *a >= least), "from {first}: {areas:?}");
            let sum: f64 = areas.iter().sum();
            assert!((sum - area).abs() < 1e-9, "from {first}: {sum}, {areas:?}");
        }
    }

    #[test]
    fn concave_outlines_are_covered_once() {
        check(&L, 7.0, 0.1);
        let dart = [[0., 0.], [2., -1.], [1., 0.], [2., 1.]];
        check(&dart, 1.0, 0.1);
        let rim = [[3., 0.], [0., 3.], [-3., 0.], [0., -3.]];
        let inner = [[1., 1.], [-1., 1.], [-1., -1.], [1., -1.]];
        let star: Vec<[f64; 2]> = rim.into_iter().zip(inner).flat_map(|(a, b)| [a, b]).collect();
        check(&star, 12.0, 0.1);
        // A comb: from a bar, teeth that are narrower at their ends.
        let teeth = (0..20).rev().map(f64::from);
        let teeth =
            teeth.flat_map(|x| [[x + 1., 9.], [x + 0.75, 1.], [x + 0.25, 1.], [x + 0.25, 9.]]);
        let comb: Vec<[f64; 2]> = [[0., 0.], [20., 0.]].into_iter().chain(teeth).collect();
        let area: f64 = comb
            .iter()
            .zip(comb.iter().cycle().skip(1))
            .map(|(a, b)| a[0] * b[1] - b[0] * a[1])
            .sum();
        check(&comb, area / 2.0, 0.01);
    }

    /// A square with a square hole, to which a bridge leads.
    #[test]
    fn holes_stay_open() {
        let outer = [[0., 0.], [6., 0.], [6., 6.], [0., 6.], [0., 0.]];
        let hole = [[2., 2.], [2., 4.], [4., 4.], [4., 2.], [2., 2.]];
        check(&[outer, hole].concat(), 32.0, 0.1);
    }

    #[test]
    fn corners_on_a_line_or_at_one_place_turn_nothing_over() {
        let square =
            [[0., 0.], [1., 0.], [2., 0.], [2., 1.], [2., 2.], [1., 2.], [0., 2.], [0., 1.]];
        check(&square, 4.0, 0.1);
        check(&[[0., 0.], [1., 0.], [2., 0.], [1., 2.]], 2.0, 0.1);
        let [a, b, c, d, e, f] = L;
        // What repeats a corner has no area.
        check(&[a, b, b, c, c, c, d, e, f], 7.0, 0.0);
        let line = [[0., 0.], [1., 1.], [2., 2.], [3., 3.], [1., 1.]];
        check(&line, 0.0, 0.0);
    }

    #[test]
    fn convex_polygons_are_fans() {
        let pentagon = [[2., 0.], [1., 2.], [-1., 2.], [-2., 0.], [0., -2.]];
        for first in 0..5 {
            let triangles = triangulate(&placed(&pentagon, first), &mut Notes::default());
            assert_eq!(triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4]]);
        }
        let square = [DVec3::ZERO, DVec3::X, DVec3::X + DVec3::Y, DVec3::Y];
        let split = |corners: &[DVec3]| triangulate(corners, &mut Notes::default());
        assert_eq!(split(&square), [[0, 1, 2], [0, 2, 3]]);
        assert_eq!((split(&square[..3]), split(&square[..2])), (vec![[0, 1, 2]], vec![]));
    }

    /// Nothing is right about these, and nothing fails.
    #[test]
    fn outlines_without_sense_are_split_too() {
        let bow = [[0., 0.], [2., 2.], [2., 0.], [0., 2.]];
        let crossed = [[0., 0.], [4., 4.], [4., 0.], [0., 4.], [2., 9.], [2., -9.]];
        for outline in [&bow[..], &crossed[..]] {
            assert!(areas(outline).iter().all(|areas| areas.len() == outline.len() - 2));
        }
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            let corners: Vec<DVec3> = (0..6).map(|i| DVec3::new(f64::from(i), bad, bad)).collect();
            assert_eq!(triangulate(&corners, &mut Notes::default()).len(), 4);
        }
    }

    /// A zigzag of more corners than are clipped.
    #[test]
    fn the_work_is_bounded() {
        let zigzag = |n: u32| -> Vec<DVec3> {
            let there = (0..n).map(|i| DVec3::new(i.into(), f64::from(i % 2) * 9.0, 0.0));
            there.clone().chain(there.rev().map(|p| p + DVec3::Y)).collect()
        };
        for (n, n_notes) in [(500, 0), (501, 1)] {
            let mut notes = Notes::default();
            assert_eq!(triangulate(&zigzag(n), &mut notes).len(), 2 * n as usize - 2);
            let codes: Vec<_> = notes.into_vec().iter().map(|note| note.code).collect();
            assert_eq!(codes, vec!["large_polygon_fanned"; n_notes]);
        }
        // What others have used up is gone.
        let mut splitter = Splitter { looks_left: 1 };
        for n_notes in [0, 1, 1] {
            let mut notes = Notes::default();
            assert_eq!(splitter.triangulate(&placed(&L, 0), &mut notes).len(), 4);
            assert_eq!(notes.into_vec().len(), n_notes);
        }
    }
}
