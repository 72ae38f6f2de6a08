//! Up to three independent linear constraints aᵀx = β, and the point they fix (sections 3.3, 3.4).
//!
//! A constraint is taken only if it is α-compatible with those before it: its plane makes an
//! angle of at least α = 1° with them. Which rows of an objective pass depends on the basis of
//! the free directions, so that basis is fixed: see [`Constraints::minimise`].

use glam::DVec3;

use super::quadratic::Quadratic;

/// cos² and sin² of α = 1°.
const COS2_ALPHA: f64 = 0.999_695_413_509_547_9;
const SIN2_ALPHA: f64 = 3.045_864_904_521_349_3e-4;

/// A row whose square is less than this times the square of the size it might have is rounding,
/// not direction. Exact zero is too weak a test: normals that cancel pass it and send vertices
/// far away.
pub(super) const MIN_ROW2: f64 = 1e-20;

/// Accepted constraints; `rows[..n]` are in use.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Constraints {
    rows: [DVec3; 3],
    right: [f64; 3],
    n: usize,
    /// |row 1|² from one row on.
    length2: f64,
    /// Row 1 × row 2 from two rows on.
    normal: DVec3,
    /// The determinant from three rows on.
    det: f64,
}

impl Constraints {
    /// Whether the point is fixed.
    #[inline]
    pub(super) fn is_full(&self) -> bool {
        self.n == 3
    }

    /// Adds aᵀx = β if it is α-compatible; `scale2` is what |a|² would be without cancellation.
    #[inline(always)]
    pub(super) fn add(&mut self, a: DVec3, beta: f64, scale2: f64) {
        let length2 = a.length_squared();
        if length2 <= MIN_ROW2 * scale2 {
            return;
        }
        match self.n {
            0 => self.length2 = length2,
            1 => {
                let dot = self.rows[0].dot(a);
                if dot * dot >= self.length2 * length2 * COS2_ALPHA {
                    return;
                }
                self.normal = self.rows[0].cross(a);
            }
            2 => {
                let det = self.normal.dot(a);
                if det * det <= self.normal.length_squared() * length2 * SIN2_ALPHA {
                    return;
                }
                self.det = det;
            }
            _ => return,
        }
        self.rows[self.n] = a;
        self.right[self.n] = beta;
        self.n += 1;
    }

    /// Adds what minimising `f` under the constraints so far still asks for: Q(Ax − b) = 0 with
    /// the rows of Q an orthogonal basis of the free directions (equation 4).
    #[inline(always)]
    pub(super) fn minimise(&mut self, f: &Quadratic) {
        let scale = f.a.trace();
        match self.n {
            0 => {
                for i in 0..3 {
                    self.add(f.a.row(i), f.b[i], scale * scale);
                }
            }
            1 => {
                let q1 = across(self.rows[0]);
                let q2 = self.rows[0].cross(q1);
                self.add_along(f, q1, scale);
                self.add_along(f, q2, scale);
            }
            2 => self.add_along(f, self.normal, scale),
            _ => {}
        }
    }

    #[inline(always)]
    fn add_along(&mut self, f: &Quadratic, q: DVec3, scale: f64) {
        self.add(f.a * q, f.b.dot(q), scale * scale * q.length_squared());
    }

    /// The point where three constraints meet.
    #[inline]
    pub(super) fn solve(&self) -> Option<DVec3> {
        let [a1, a2, a3] = self.rows;
        let [b1, b2, b3] = self.right;
        let x = (a2.cross(a3) * b1 + a3.cross(a1) * b2 + self.normal * b3) / self.det;
        (self.is_full() && x.is_finite()).then_some(x)
    }
}

/// A vector orthogonal to `a`: its smallest component dropped, the others turned by 90°.
#[inline]
fn across(a: DVec3) -> DVec3 {
    let size = a.abs();
    let is_x = size.x <= size.y && size.x <= size.z;
    let is_y = !is_x && size.y <= size.z;
    // As a product: which component is least cannot be predicted, so no branches.
    let axis = DVec3::new(is_x.into(), is_y.into(), (!is_x && !is_y).into());
    axis.cross(a)
}

#[cfg(test)]
mod tests {
    use super::super::quadratic::Symmetric;
    use super::*;

    #[test]
    fn three_planes_meet_in_a_point() {
        let mut c = Constraints::default();
        c.add(DVec3::X, 1.0, 1.0);
        c.add(DVec3::new(1.0, 1e-3, 0.0), 7.0, 1.0);
        assert_eq!(c.n, 1, "0.06 degrees from the first");
        c.add(DVec3::Y * 1e-11, 1.0, 1.0);
        assert_eq!(c.n, 1, "a row that is rounding");
        assert!(c.solve().is_none());
        c.add(DVec3::Y, 2.0, 1.0);
        c.add(DVec3::new(1.0, 1.0, 1e-3), 7.0, 1.0);
        assert_eq!(c.n, 2, "too close to the plane of the first two");
        c.add(DVec3::Z, 3.0, 1.0);
        assert_eq!(c.solve(), Some(DVec3::new(1.0, 2.0, 3.0)));
    }

    #[test]
    fn the_minimum_under_a_constraint() {
        // |x − p|² within the plane z = 0.
        let p = DVec3::new(1.0, -2.0, 5.0);
        let f = Quadratic { a: Symmetric::scaled_identity(2.0), b: p * 2.0, c: 0.0 };
        let mut c = Constraints::default();
        c.add(DVec3::Z * 3.0, 0.0, 3.0);
        c.minimise(&f);
        assert!(c.solve().unwrap().distance(DVec3::new(1.0, -2.0, 0.0)) < 1e-15);
        let mut free = Constraints::default();
        free.minimise(&f);
        assert!(free.solve().unwrap().distance(p) < 1e-15);
    }
}
