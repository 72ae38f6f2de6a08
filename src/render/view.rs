//! Cameras: bounding sphere, view directions, projection and light of every picture.
//!
//! Invariants:
//! 1. the bounding sphere lies in front of every eye, so no vertex of the original is clipped;
//! 2. the same cameras serve the original and every simplified mesh;
//! 3. all trigonometry is `libm`'s (one implementation on every platform) and happens here, once.
//!
//! Knows nothing of rasters or lattices.

use glam::DVec3;

/// A sphere that holds every vertex of the original, model space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundingSphere {
    /// Centre.
    pub center: DVec3,
    /// Radius, > 0.
    pub radius: f64,
}

/// How eye rays run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Projection {
    /// All rays meet in the eye.
    #[default]
    Perspective,
    /// All rays are parallel to the viewing direction.
    Orthographic,
}

/// Parameters of a set of cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewParams {
    /// Directions from the centre to each eye (any length but 0).
    pub directions: Vec<DVec3>,
    /// Full field of view, degrees (perspective).
    pub fov_degrees: f64,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Angle between the direction to the eye and the direction to the light, degrees.
    pub light_degrees: f64,
}

/// One camera and its light, model space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Position of the eye.
    pub eye: DVec3,
    /// Unit vector to the right of the picture.
    pub right: DVec3,
    /// Unit vector to the top of the picture.
    pub up: DVec3,
    /// Unit vector from the centre to the eye.
    pub back: DVec3,
    /// Unit vector towards the light (directional).
    pub to_light: DVec3,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// How often its picture counts in energies.
    pub weight: u32,
    /// Which channel of the surfaces' colours it shows: 0 where that is luminance, else red, green, blue (0 to 2).
    pub channel: u8,
    /// Half-pictures per unit of x/w (perspective) or of x (orthographic).
    focal: f64,
    /// Distance from the eye to the nearest and the farthest point of the sphere.
    near: f64,
    far: f64,
}

/// A point in a picture: `x`, `y` in 0..1 from the upper left corner, `depth` in 0..1 from the
/// near to the far end of the bounding sphere, affine over every triangle's picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PicturePoint {
    /// From the left edge (0) to the right edge (1).
    pub x: f64,
    /// From the top edge (0) to the bottom edge (1).
    pub y: f64,
    /// From near (0) to far (1).
    pub depth: f64,
}

impl View {
    /// Projects a model-space point.
    pub fn project(&self, p: DVec3) -> PicturePoint {
        let from_eye = p - self.eye;
        let (x, y) = (from_eye.dot(self.right), from_eye.dot(self.up));
        // Points behind the near end (a placement that overshot the sphere) are held in front of
        // the eye, so that the quotient below stays finite.
        let w = (-from_eye.dot(self.back)).max(self.near * 0.05);
        let (scale, depth) = match self.projection {
            Projection::Perspective => {
                (self.focal / w, (1.0 / self.near - 1.0 / w) / (1.0 / self.near - 1.0 / self.far))
            }
            Projection::Orthographic => (self.focal, (w - self.near) / (self.far - self.near)),
        };
        PicturePoint { x: 0.5 + 0.5 * x * scale, y: 0.5 - 0.5 * y * scale, depth }
    }

    /// The same camera, which shows another channel.
    #[must_use]
    pub fn in_channel(self, channel: u8) -> Self {
        Self { channel, ..self }
    }

    /// How far a point lies in front of the eye along the viewing direction, for the perspective of what is
    /// seen; the same for all points where there is none.
    pub fn distance(&self, p: DVec3) -> f64 {
        match self.projection {
            Projection::Perspective => (self.eye - p).dot(self.back).max(self.near * 0.05),
            Projection::Orthographic => 1.0,
        }
    }

    /// Length on a triangle for each pixel of a picture of `size` pixels a side: the mean of its least and its
    /// greatest, which the angle at which it is seen stretches, but not beyond a least cosine.
    pub fn unit_per_pixel(&self, p: [DVec3; 3], size: i32, least_cosine: f64) -> f64 {
        let center = (p[0] + p[1] + p[2]) / 3.0;
        let normal = (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero();
        let to_eye = match self.projection {
            Projection::Perspective => (self.eye - center).normalize_or_zero(),
            Projection::Orthographic => self.back,
        };
        let stretched = 1.0 / normal.dot(to_eye).abs().max(least_cosine);
        2.0 * self.distance(center) / (self.focal * f64::from(size)) * stretched.sqrt()
    }

    /// Whether a surface element at `p` with the given normal (any length) turns its front to the
    /// viewer.
    pub fn sees_front(&self, p: DVec3, normal: DVec3) -> bool {
        match self.projection {
            Projection::Perspective => normal.dot(self.eye - p) >= 0.0,
            Projection::Orthographic => normal.dot(self.back) >= 0.0,
        }
    }
}

/// The cameras of a view set round the sphere: distance r / sin(fov / 2) (Lindstrom & Turk 2000,
/// section 4), roll angles evenly spread so that pixel rows never line up with the model's axes.
pub fn cameras(sphere: &BoundingSphere, params: &ViewParams) -> Vec<View> {
    let n = params.directions.len();
    (0..n).map(|k| camera(sphere, params, params.directions[k], roll_turns(k, n))).collect()
}

/// Roll of view `k` of `n`, in turns; a stride coprime to `n` keeps neighbours apart.
fn roll_turns(k: usize, n: usize) -> f64 {
    let stride = [7, 5, 3, 1].into_iter().find(|s| !n.is_multiple_of(*s)).unwrap_or(1);
    ((k * stride % n) as f64 + 0.5) / n as f64
}

/// One upright-or-rolled camera that looks at the sphere's centre from `direction`.
pub fn camera(
    sphere: &BoundingSphere,
    params: &ViewParams,
    direction: DVec3,
    roll_turns: f64,
) -> View {
    let back = direction.normalize_or_zero();
    let reference = if back.y.abs() > 0.999 { DVec3::Z } else { DVec3::Y };
    let level_right = reference.cross(back).normalize_or_zero();
    let level_up = back.cross(level_right);
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * roll_turns);
    let (right, up) = (level_right * cos + level_up * sin, level_up * cos - level_right * sin);

    let half_fov = (params.fov_degrees * 0.5).to_radians();
    let distance = match params.projection {
        Projection::Perspective => sphere.radius / libm::sin(half_fov),
        Projection::Orthographic => 2.0 * sphere.radius,
    };
    let focal = match params.projection {
        Projection::Perspective => 1.0 / libm::tan(half_fov),
        Projection::Orthographic => 1.0 / sphere.radius,
    };
    // The light stands at the viewer's upper left.
    let (light_sin, light_cos) = libm::sincos(params.light_degrees.to_radians());
    let side = (up - right) * std::f64::consts::FRAC_1_SQRT_2;
    View {
        eye: sphere.center + back * distance,
        right,
        up,
        back,
        to_light: back * light_cos + side * light_sin,
        projection: params.projection,
        weight: 1,
        channel: 0,
        focal,
        near: distance - sphere.radius,
        far: distance + sphere.radius,
    }
}

/// The directions of a built-in view set: vertices of the tetrahedron (4), octahedron (6),
/// cube (8), icosahedron (12), dodecahedron (20) or small rhombicuboctahedron (24).
pub fn directions(n_views: u32) -> Option<Vec<DVec3>> {
    let phi = f64::midpoint(1.0, 5.0_f64.sqrt());
    let set = match n_views {
        4 => vec![
            DVec3::new(1.0, 1.0, 1.0),
            DVec3::new(1.0, -1.0, -1.0),
            DVec3::new(-1.0, 1.0, -1.0),
            DVec3::new(-1.0, -1.0, 1.0),
        ],
        6 => cyclic(DVec3::new(1.0, 0.0, 0.0)),
        8 => signs(DVec3::ONE),
        12 => cyclic(DVec3::new(0.0, 1.0, phi)),
        20 => [signs(DVec3::ONE), cyclic(DVec3::new(0.0, 1.0 / phi, phi))].concat(),
        24 => cyclic(DVec3::new(1.0 + 2.0_f64.sqrt(), 1.0, 1.0)),
        _ => return None,
    };
    Some(set.into_iter().map(DVec3::normalize_or_zero).collect())
}

/// Every choice of signs of the non-zero coordinates.
fn signs(v: DVec3) -> Vec<DVec3> {
    let both = |x: f64| if x == 0.0 { vec![0.0] } else { vec![x, -x] };
    let mut out = Vec::new();
    for x in both(v.x) {
        for y in both(v.y) {
            for z in both(v.z) {
                out.push(DVec3::new(x, y, z));
            }
        }
    }
    out
}

/// Every choice of signs of the three cyclic permutations.
fn cyclic(v: DVec3) -> Vec<DVec3> {
    [v, DVec3::new(v.z, v.x, v.y), DVec3::new(v.y, v.z, v.x)].into_iter().flat_map(signs).collect()
}

impl BoundingSphere {
    /// The minimum bounding sphere of the points (Welzl 1991, move to front), a hair enlarged so
    /// that every point is inside. A point set without extent gets radius 1.
    pub fn of(points: impl IntoIterator<Item = DVec3>) -> Self {
        let mut points: Vec<DVec3> = points.into_iter().collect();
        let origin = far_center(&points);
        points.iter_mut().for_each(|p| *p -= origin);
        let ball = minimum_ball(&points);
        let center = origin + ball.center;
        if ball.radius2 <= 0.0 {
            return Self { center, radius: 1.0 };
        }
        // What the sum loses.
        let lost = (center - origin - ball.center).length();
        Self { center, radius: ball.radius2.sqrt() * (1.0 + 1e-12) + lost }
    }
}

/// Where rounding would hide how points that are far from the origin lie to each other, the centre of their bounds;
/// elsewhere the origin.
fn far_center(points: &[DVec3]) -> DVec3 {
    let first = points.first().copied().unwrap_or(DVec3::ZERO);
    let (low, high) = points.iter().fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let is_far = low.abs().max(high.abs()).max_element() > FAR * (high - low).max_element();
    if is_far { low.midpoint(high) } else { DVec3::ZERO }
}

/// Farthest-point passes: the support set grows by the worst offender until none is left. Each pass solves a tiny exact
/// problem, so a million points cost a few linear scans.
fn minimum_ball(points: &[DVec3]) -> Ball {
    let mut ball = Ball { center: DVec3::ZERO, radius2: -1.0 };
    let mut support: Vec<DVec3> = Vec::new();
    for _ in 0..200 {
        let Some(worst) = farthest(points, &ball) else { return ball };
        support.push(worst);
        if support.len() > MAX_SUPPORT {
            break;
        }
        ball = welzl(&mut support.clone(), &mut Vec::new());
        support.retain(|p| p.distance_squared(ball.center) >= ball.radius2 * (1.0 - 1e-9));
    }
    // All but minimal, if rounding keeps the passes from an end.
    let worst = farthest(points, &ball);
    worst.map_or(ball, |p| Ball { radius2: p.distance_squared(ball.center), ..ball })
}

/// Points are far from the origin when they are so many times the size of their bounds away.
const FAR: f64 = 1024.0;
/// Points on the sphere, beyond which a pass takes too long.
const MAX_SUPPORT: usize = 32;

#[derive(Clone, Copy)]
struct Ball {
    center: DVec3,
    radius2: f64,
}

/// The point farthest outside the ball, if any is.
fn farthest(points: &[DVec3], ball: &Ball) -> Option<DVec3> {
    let mut worst = (ball.radius2 + ball.radius2.abs() * 1e-12, None);
    for &p in points {
        let d2 = p.distance_squared(ball.center);
        if d2 > worst.0 {
            worst = (d2, Some(p));
        }
    }
    if ball.radius2 < 0.0 { points.first().copied() } else { worst.1 }
}

/// Welzl's recursion on a handful of points.
fn welzl(points: &mut Vec<DVec3>, support: &mut Vec<DVec3>) -> Ball {
    if points.is_empty() || support.len() == 4 {
        return circumball(support);
    }
    let Some(p) = points.pop() else { return circumball(support) };
    let ball = welzl(points, support);
    let ball = if p.distance_squared(ball.center) <= ball.radius2 * (1.0 + 1e-12) {
        ball
    } else {
        support.push(p);
        let with = welzl(points, support);
        support.pop();
        with
    };
    points.push(p);
    ball
}

/// The smallest sphere through up to four points.
fn circumball(support: &[DVec3]) -> Ball {
    let Some((&origin, rest)) = support.split_first() else {
        return Ball { center: DVec3::ZERO, radius2: -1.0 };
    };
    let d: Vec<DVec3> = rest.iter().map(|p| *p - origin).collect();
    let offset = match d.as_slice() {
        [] => DVec3::ZERO,
        [a] => *a * 0.5,
        [a, b] => {
            let n = a.cross(*b);
            let n2 = n.length_squared();
            if n2 == 0.0 {
                let longer = if a.length_squared() > b.length_squared() { a } else { b };
                *longer * 0.5
            } else {
                (n.cross(*a) * b.length_squared() + b.cross(n) * a.length_squared()) / (2.0 * n2)
            }
        }
        [a, b, c, ..] => {
            let det = a.dot(b.cross(*c));
            if det == 0.0 {
                return circumball(&support[..3]);
            }
            (b.cross(*c) * a.length_squared()
                + c.cross(*a) * b.length_squared()
                + a.cross(*b) * c.length_squared())
                / (2.0 * det)
        }
    };
    Ball { center: origin + offset, radius2: offset.length_squared() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn view_sets_have_their_size_and_are_centred() {
        for n in [4, 6, 8, 12, 20, 24] {
            let set = directions(n).unwrap();
            assert_eq!(set.len(), n as usize);
            assert!(set.iter().sum::<DVec3>().length() < 1e-9);
            assert!(set.iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
            for (i, a) in set.iter().enumerate() {
                assert!(set[..i].iter().all(|b| a.distance(*b) > 0.3));
            }
        }
        assert!(directions(5).is_none());
    }

    #[test]
    fn bounding_sphere_of_a_box_and_of_degenerate_sets() {
        // The eight corners of a box: the sphere through all of them.
        let corners = signs(DVec3::new(1.0, 2.0, 3.0));
        let s = BoundingSphere::of(corners.iter().map(|c| *c + DVec3::X));
        assert!((s.center - DVec3::X).length() < 1e-9);
        assert!((s.radius - 14.0_f64.sqrt()).abs() < 1e-9);
        assert_eq!(BoundingSphere::of([DVec3::ONE; 5]).radius, 1.0);
        let line = BoundingSphere::of((0..10).map(|i| DVec3::X * i as f64));
        assert!((line.radius - 4.5).abs() < 1e-9);
    }

    /// As scans are whose coordinates are those of a map; singles would be half a metre apart.
    #[test]
    fn bounding_sphere_far_from_the_origin() {
        let points: Vec<DVec3> = (0..2000)
            .map(|i| directions(24).unwrap()[i % 24] * (0.9 + 0.1 * libm::sin(i as f64)))
            .collect();
        let near = BoundingSphere::of(points.iter().copied());
        for offset in [1e3, 4.5e6, 1e8, 1e12] {
            let offset = DVec3::new(offset, 0.3 * offset, -7.0);
            let moved: Vec<DVec3> = points.iter().map(|p| *p + offset).collect();
            let far = BoundingSphere::of(moved.iter().copied());
            let step = 1e-15 * offset.length();
            assert!((far.radius - near.radius).abs() < 1e-9 + 10.0 * step, "{offset}: {far:?}");
            let outermost = moved.iter().map(|p| p.distance(far.center)).fold(0.0, f64::max);
            assert!(outermost <= far.radius, "{offset}");
        }
    }

    #[test]
    fn the_sphere_fills_the_picture_and_the_depth_range() {
        let sphere = BoundingSphere { center: DVec3::new(1.0, 2.0, 3.0), radius: 5.0 };
        for projection in [Projection::Perspective, Projection::Orthographic] {
            let params = ViewParams {
                directions: directions(20).unwrap(),
                fov_degrees: 60.0,
                projection,
                light_degrees: 10.0,
            };
            for v in cameras(&sphere, &params) {
                let c = v.project(sphere.center);
                assert!((c.x - 0.5).abs() < 1e-12 && (c.y - 0.5).abs() < 1e-12);
                let near = v.project(sphere.center + v.back * 5.0);
                let far = v.project(sphere.center - v.back * 5.0);
                assert!(near.depth.abs() < 1e-12 && (far.depth - 1.0).abs() < 1e-12);
                for dir in directions(24).unwrap() {
                    let p = v.project(sphere.center + dir * 5.0);
                    assert!((-1e-9..=1.0 + 1e-9).contains(&p.x), "{p:?}");
                }
            }
        }
    }
}
