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

/// A row shorter than this times the size of its matrix is rounding, not direction. Exact zero
/// is too weak a test: cancelling normals pass it and send vertices far away.
const MIN_ROW: f64 = 1e-10;

/// Accepted constraints; `rows[..n]` are in use.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Constraints {
    rows: [DVec3; 3],
    right: [f64; 3],
    n: usize,
}

impl Constraints {
    /// Whether the point is fixed.
    #[inline]
    pub(super) fn is_full(&self) -> bool {
        self.n == 3
    }

    /// Adds aᵀx = β if it is α-compatible; `scale` is the size that |a| would have without
    /// cancellation.
    #[inline]
    pub(super) fn add(&mut self, a: DVec3, beta: f64, scale: f64) {
        let length2 = a.length_squared();
        let is_clear = length2 > MIN_ROW * MIN_ROW * scale * scale;
        if is_clear && self.is_compatible(a, length2) {
            self.rows[self.n] = a;
            self.right[self.n] = beta;
            self.n += 1;
        }
    }

    #[inline]
    fn is_compatible(&self, a: DVec3, length2: f64) -> bool {
        let [a1, a2, _] = self.rows;
        match self.n {
            0 => true,
            1 => {
                let dot = a1.dot(a);
                dot * dot < a1.length_squared() * length2 * COS2_ALPHA
            }
            2 => {
                let normal = a1.cross(a2);
                let det = normal.dot(a);
                det * det > normal.length_squared() * length2 * SIN2_ALPHA
            }
            _ => false,
        }
    }

    /// Adds what minimising `f` under the constraints so far still asks for: Q(Ax − b) = 0 with
    /// the rows of Q an orthogonal basis of the free directions (equation 4).
    #[inline]
    pub(super) fn minimise(&mut self, f: &Quadratic) {
        let scale = f.a.trace();
        let [a1, a2, _] = self.rows;
        match self.n {
            0 => {
                for i in 0..3 {
                    self.add(f.a.row(i), f.b[i], scale);
                }
            }
            1 => {
                let q1 = across(a1);
                self.add_along(f, q1, scale);
                self.add_along(f, a1.cross(q1), scale);
            }
            2 => self.add_along(f, a1.cross(a2), scale),
            _ => {}
        }
    }

    #[inline]
    fn add_along(&mut self, f: &Quadratic, q: DVec3, scale: f64) {
        self.add(f.a * q, f.b.dot(q), scale * q.length());
    }

    /// The point where three constraints meet.
    #[inline]
    pub(super) fn solve(&self) -> Option<DVec3> {
        let [a1, a2, a3] = self.rows;
        let normal = a1.cross(a2);
        let sum =
            a2.cross(a3) * self.right[0] + a3.cross(a1) * self.right[1] + normal * self.right[2];
        let x = sum / normal.dot(a3);
        (self.is_full() && x.is_finite()).then_some(x)
    }
}

/// A vector orthogonal to `a`: its smallest component dropped, the others turned by 90°.
#[inline]
fn across(a: DVec3) -> DVec3 {
    let size = a.abs();
    if size.x <= size.y && size.x <= size.z {
        DVec3::new(0.0, -a.z, a.y)
    } else if size.y <= size.z {
        DVec3::new(a.z, 0.0, -a.x)
    } else {
        DVec3::new(-a.y, a.x, 0.0)
    }
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
