//! Quadratic objectives in three unknowns: f(x) = ½ xᵀAx − bᵀx + ½c (equation 3).

use std::ops::{Add, AddAssign, Mul, Sub};

use glam::DVec3;

/// A symmetric 3 × 3 matrix by its diagonal and the entries (yz, xz, xy) off it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Symmetric {
    pub(super) diagonal: DVec3,
    pub(super) off: DVec3,
}

impl Symmetric {
    /// The identity times `s`.
    pub(super) fn scaled_identity(s: f64) -> Self {
        Self { diagonal: DVec3::splat(s), off: DVec3::ZERO }
    }

    /// v vᵀ.
    #[inline]
    pub(super) fn outer(v: DVec3) -> Self {
        Self { diagonal: v * v, off: DVec3::new(v.y * v.z, v.x * v.z, v.x * v.y) }
    }

    /// The sum of the diagonal.
    #[inline]
    pub(super) fn trace(self) -> f64 {
        self.diagonal.element_sum()
    }

    /// Row (and column) `i`.
    #[inline]
    pub(super) fn row(self, i: usize) -> DVec3 {
        let Self { diagonal: d, off: o } = self;
        [DVec3::new(d.x, o.z, o.y), DVec3::new(o.z, d.y, o.x), DVec3::new(o.y, o.x, d.z)][i]
    }
}

impl Mul<DVec3> for Symmetric {
    type Output = DVec3;
    #[inline]
    fn mul(self, v: DVec3) -> DVec3 {
        let Self { diagonal: d, off: o } = self;
        DVec3::new(
            d.x * v.x + o.z * v.y + o.y * v.z,
            o.z * v.x + d.y * v.y + o.x * v.z,
            o.y * v.x + o.x * v.y + d.z * v.z,
        )
    }
}

impl Mul<f64> for Symmetric {
    type Output = Self;
    #[inline]
    fn mul(self, s: f64) -> Self {
        Self { diagonal: self.diagonal * s, off: self.off * s }
    }
}

impl Add for Symmetric {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        Self { diagonal: self.diagonal + other.diagonal, off: self.off + other.off }
    }
}

impl Sub for Symmetric {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        Self { diagonal: self.diagonal - other.diagonal, off: self.off - other.off }
    }
}

impl AddAssign for Symmetric {
    #[inline]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// f(x) = ½ xᵀAx − bᵀx + ½c.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Quadratic {
    pub(super) a: Symmetric,
    pub(super) b: DVec3,
    pub(super) c: f64,
}

impl Quadratic {
    /// f(x), not below zero: all objectives are sums of squares, less is rounding.
    #[inline]
    pub(super) fn value(&self, x: DVec3) -> f64 {
        (0.5 * (x.dot(self.a * x) + self.c) - self.b.dot(x)).max(0.0)
    }
}

impl Mul<f64> for Quadratic {
    type Output = Self;
    #[inline]
    fn mul(self, s: f64) -> Self {
        Self { a: self.a * s, b: self.b * s, c: self.c * s }
    }
}

impl Add for Quadratic {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        Self { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }
}
