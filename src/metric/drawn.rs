//! One view of a scene, drawn so that it can be differentiated: which triangle is seen in each
//! pixel, and how its luminance there depends on its corners.
//!
//! Invariants:
//! 1. what is seen where is what the evaluators see: the same lattice, the same ties;
//! 2. luminances are not rounded, so that they have derivatives.

use glam::{DVec2, DVec3};

use crate::render::{
    Scene, SceneFace, Shading, for_each_pixel,
    lattice::DEPTH_BITS,
    view::{Projection, View},
};

use super::slopes::{Slope, Slopes};

/// No triangle: the background.
const NOTHING: u64 = u64::MAX;

/// See the module.
pub struct Drawn<'s> {
    scene: &'s Scene,
    view: usize,
    size: usize,
    /// Where each vertex slot is drawn, in pixels from the upper left corner.
    points: Vec<DVec2>,
    /// Depth and triangle, or [`NOTHING`].
    keys: Vec<u64>,
    /// By triangle.
    shades: Vec<Shade>,
}

/// How a triangle is lit.
#[derive(Clone, Copy, Default)]
struct Shade {
    /// Luminances of the corners.
    corners: [f64; 3],
    /// Flat: how the luminance changes with each corner's place. Smooth: how each corner's luminance
    /// changes with its normal.
    by: [DVec3; 3],
    /// Shares of the corners at pixel (0, 0), and their changes to the right and down (smooth only).
    shares: [[f64; 3]; 3],
}

/// What a triangle's pixels add up to.
#[derive(Clone, Copy, Default)]
struct Seen {
    n: f64,
    /// Luminance too much.
    off: f64,
    /// The same, weighted by the corners' shares; and the sums of the squares of these.
    off_by_share: [f64; 3],
    squares: [f64; 3],
}

impl<'s> Drawn<'s> {
    /// Draws one view.
    pub fn new(scene: &'s Scene, view: usize) -> Self {
        let size = scene.lattice.size as usize;
        let mut keys = vec![NOTHING; size * size];
        let mut shades = vec![Shade::default(); scene.faces.len()];
        let points_on_picture: Vec<DVec2> =
            (0..scene.n_vertex_slots() as u32).map(|v| on_picture(scene, view, v)).collect();
        for (id, face) in scene.faces.iter().enumerate() {
            let Some(face) = face else { continue };
            let points = face.vertices.map(|v| scene.screen_points(v)[view]);
            let Some(s) = scene.lattice.setup(points, [0; 3], scene.culls_front(view)) else {
                continue;
            };
            let mut is_seen = false;
            for_each_pixel(&s, |i, j| {
                let slot = &mut keys[j as usize * size + i as usize];
                let key = (s.depth.at(i, j, DEPTH_BITS) as u64) << 32 | id as u64;
                is_seen |= key < *slot;
                *slot = (*slot).min(key);
            });
            if is_seen {
                shades[id] = Shade::of(scene, view, face, &points_on_picture);
            }
        }
        Self { scene, view, size, points: points_on_picture, keys, shades }
    }

    /// Adds energy and slopes.
    pub fn differentiate(&self, reference: &[u8], sum: &mut Slopes) {
        let motions: Vec<[DVec3; 2]> = (0..sum.places.len() as u32)
            .map(|v| motion(&self.scene.views[self.view], self.scene.position(v), self.size as f64))
            .collect();
        self.inside(reference, &motions, sum);
        for j in 0..self.size {
            for i in 0..self.size {
                let at = j * self.size + i;
                if i + 1 < self.size && differ(self.keys[at], self.keys[at + 1]) {
                    self.across(reference, [at, at + 1], Axis::X, &motions, &mut sum.places);
                }
                if j + 1 < self.size && differ(self.keys[at], self.keys[at + self.size]) {
                    self.across(
                        reference,
                        [at, at + self.size],
                        Axis::Y,
                        &motions,
                        &mut sum.places,
                    );
                }
            }
        }
    }

    /// Adds what changes inside triangles.
    fn inside(&self, reference: &[u8], motions: &[[DVec3; 2]], sum: &mut Slopes) {
        let mut seen = vec![Seen::default(); self.shades.len()];
        for (pixel, r) in reference.iter().enumerate() {
            let off = self.luminance(pixel) - f64::from(*r);
            sum.energy += off * off;
            if self.keys[pixel] == NOTHING {
                continue;
            }
            let face = (self.keys[pixel] as u32) as usize;
            let seen = &mut seen[face];
            seen.n += 1.0;
            seen.off += off;
            if self.scene.params.shading == Shading::Smooth {
                let shares = self.shades[face].shares_at(pixel, self.size);
                for (k, share) in shares.into_iter().enumerate() {
                    seen.off_by_share[k] += off * share;
                    seen.squares[k] += share * share;
                }
            }
        }
        for ((face, shade), seen) in self.scene.faces.iter().zip(&self.shades).zip(seen) {
            let Some(face) = face.filter(|_| seen.n > 0.0) else { continue };
            match self.scene.params.shading {
                Shading::Flat => {
                    for (v, by) in face.vertices.iter().zip(shade.by) {
                        sum.places[*v as usize].add(2.0 * seen.off, 2.0 * seen.n, by);
                    }
                }
                Shading::Smooth => smooth_inside(&face, shade, &seen, motions, sum),
            }
        }
    }

    /// The luminance of a pixel.
    fn luminance(&self, pixel: usize) -> f64 {
        self.luminance_of(self.keys[pixel], pixel)
    }

    /// The luminance of a triangle in a pixel, in which another may be seen.
    fn luminance_of(&self, key: u64, pixel: usize) -> f64 {
        if key == NOTHING {
            return f64::from(self.scene.params.background);
        }
        let shade = &self.shades[(key as u32) as usize];
        match self.scene.params.shading {
            Shading::Flat => shade.corners[0],
            Shading::Smooth => {
                let shares = shade.shares_at(pixel, self.size);
                let sum: f64 = (0..3).map(|k| shares[k] * shade.corners[k]).sum();
                let [a, b, c] = shade.corners;
                sum.max(a.min(b).min(c)).min(a.max(b).max(c))
            }
        }
    }

    /// Adds what changes where two neighbouring pixels show different triangles.
    fn across(
        &self,
        reference: &[u8],
        pixels: [usize; 2],
        axis: Axis,
        motions: &[[DVec3; 2]],
        places: &mut [Slope],
    ) {
        let Some(edge) = self.edge_between(pixels, axis) else { return };
        // Both at the edge: smooth surfaces do not jump where two triangles meet.
        let at_edge = |key| 0.5 * pixels.iter().map(|p| self.luminance_of(key, *p)).sum::<f64>();
        let lum = pixels.map(|p| at_edge(self.keys[p]));
        let square = |l: f64, p: usize| (l - f64::from(reference[p])).powi(2);
        // As the edge moves on, the first pixel's triangle gains ground from the second's.
        let change = |p: &usize| square(lum[0], *p) - square(lum[1], *p);
        let slope = 0.5 * pixels.iter().map(change).sum::<f64>();
        let bend = 2.0 * (lum[0] - lum[1]).powi(2);
        for (v, share) in edge.ends.into_iter().zip([1.0 - edge.at, edge.at]) {
            let [dx, dy] = motions[v as usize];
            let along = match axis {
                Axis::X => dx - edge.slant * dy,
                Axis::Y => dy - edge.slant * dx,
            };
            places[v as usize].add(slope, bend, share * along);
        }
    }

    /// The edge that separates two neighbouring pixels: of the nearer triangle first.
    fn edge_between(&self, pixels: [usize; 2], axis: Axis) -> Option<Crossing> {
        let mut keys = pixels.map(|p| self.keys[p]);
        keys.sort_unstable();
        let (x, y) = (pixels[0] % self.size, pixels[0] / self.size);
        let from = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        let of = |key: u64| {
            let face = self.scene.faces[(key as u32) as usize]?;
            let corners = face.vertices.map(|v| (v, self.points[v as usize]));
            (0..3).find_map(|k| crossing(corners[k], corners[(k + 1) % 3], from, axis))
        };
        keys.into_iter().filter(|k| *k != NOTHING).find_map(of)
    }
}

/// Adds what changes inside a triangle with interpolated luminance.
fn smooth_inside(
    face: &SceneFace,
    shade: &Shade,
    seen: &Seen,
    motions: &[[DVec3; 2]],
    sum: &mut Slopes,
) {
    let gradient =
        |axis: usize| -> f64 { (0..3).map(|k| shade.shares[axis][k] * shade.corners[k]).sum() };
    let (right, down) = (gradient(1), gradient(2));
    for (k, v) in face.vertices.iter().enumerate() {
        let v = *v as usize;
        let (slope, bend) = (2.0 * seen.off_by_share[k], 2.0 * seen.squares[k]);
        sum.normals[v].add(slope, bend, shade.by[k]);
        // Luminances travel with the corners.
        let [dx, dy] = motions[v];
        sum.places[v].add(slope, bend, -(right * dx + down * dy));
    }
}

fn differ(a: u64, b: u64) -> bool {
    a as u32 != b as u32
}

/// Where a vertex is drawn, in pixels from the upper left corner.
fn on_picture(scene: &Scene, view: usize, v: u32) -> DVec2 {
    let (p, lattice) = (scene.screen_points(v)[view], &scene.lattice);
    let step = f64::from(1 << lattice.sub_bits);
    let pixel = |c: i16| f64::from(i32::from(c) - lattice.first_center) / step + 0.5;
    DVec2::new(pixel(p.x), pixel(p.y))
}

/// The direction from a pixel to its neighbour.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Axis {
    X,
    Y,
}

/// Where an edge runs between two pixels.
struct Crossing {
    ends: [u32; 2],
    /// Share of the way from the first end to the second.
    at: f64,
    /// Change along the axis for each pixel across it.
    slant: f64,
}

/// Whether an edge runs between the centres of a pixel and of its neighbour, and rather across the
/// line between them than along it: the other half of the edges is found along the other axis.
fn crossing(a: (u32, DVec2), b: (u32, DVec2), from: DVec2, axis: Axis) -> Option<Crossing> {
    let turned = |p: DVec2| if axis == Axis::X { p } else { DVec2::new(p.y, p.x) };
    let (p, q, from) = (turned(a.1), turned(b.1), turned(from));
    let by = q - p;
    let is_other = by.x.abs() > by.y.abs() || (axis == Axis::Y && by.x.abs() == by.y.abs());
    if by.y == 0.0 || is_other {
        return None;
    }
    let at = (from.y - p.y) / by.y;
    let x = p.x + at * by.x;
    let is_between = (0.0..=1.0).contains(&at) && (from.x..=from.x + 1.0).contains(&x);
    is_between.then(|| Crossing { ends: [a.0, b.0], at, slant: by.x / by.y })
}

/// How a point's picture moves, in pixels to the right and down, with its place.
fn motion(view: &View, p: DVec3, size: f64) -> [DVec3; 2] {
    let at = view.project(p);
    // To the right, the distance along the view axis stays the same.
    let scale = view.project(p + view.right).x - at.x;
    let away = match view.projection {
        Projection::Perspective => view.back / -(p - view.eye).dot(view.back),
        Projection::Orthographic => DVec3::ZERO,
    };
    let (dx, dy) =
        (scale * view.right + (at.x - 0.5) * away, (at.y - 0.5) * away - scale * view.up);
    [size * dx, size * dy]
}

impl Shade {
    fn of(scene: &Scene, view: usize, face: &SceneFace, points: &[DVec2]) -> Self {
        let p = face.vertices.map(|v| scene.position(v));
        let area = (p[1] - p[0]).cross(p[2] - p[0]);
        let length = area.length();
        let normal = if length > 0.0 { area / length } else { DVec3::ZERO };
        match scene.params.shading {
            Shading::Flat => Self::flat(scene, view, face, p, (normal, length)),
            Shading::Smooth => Self::smooth(scene, view, face, (p, normal), points),
        }
    }

    fn flat(
        scene: &Scene,
        view: usize,
        face: &SceneFace,
        p: [DVec3; 3],
        (normal, length): (DVec3, f64),
    ) -> Self {
        let v = &scene.views[view];
        let ambient = scene.params.ambient;
        let albedo = face.albedo.iter().map(|a| f64::from(*a)).sum::<f64>() / 3.0;
        let centroid = (p[0] + p[1] + p[2]) / 3.0;
        let side = if v.sees_front(centroid, normal) { 1.0 } else { -1.0 };
        let cosine = side * normal.dot(v.to_light);
        let diffuse = albedo * (1.0 - ambient);
        let corners = [albedo * ambient + diffuse * cosine.max(0.0); 3];
        if cosine <= 0.0 || length == 0.0 {
            return Self { corners, ..Self::default() };
        }
        let by_area = side * diffuse / length * (v.to_light - normal * normal.dot(v.to_light));
        let (by1, by2) = ((p[2] - p[0]).cross(by_area), by_area.cross(p[1] - p[0]));
        Self { corners, by: [-(by1 + by2), by1, by2], ..Self::default() }
    }

    fn smooth(
        scene: &Scene,
        view: usize,
        face: &SceneFace,
        (p, normal): ([DVec3; 3], DVec3),
        points: &[DVec2],
    ) -> Self {
        let v = &scene.views[view];
        let ambient = scene.params.ambient;
        let mut this = Self::default();
        for (k, place) in p.into_iter().enumerate() {
            let albedo = f64::from(face.albedo[k]);
            let side = if v.sees_front(place, normal) { 1.0 } else { -1.0 };
            let cosine = side * scene.normal(face.vertices[k]).dot(v.to_light);
            this.corners[k] = albedo * (ambient + (1.0 - ambient) * cosine.max(0.0));
            if cosine > 0.0 {
                this.by[k] = albedo * (1.0 - ambient) * side * v.to_light;
            }
        }
        let q = face.vertices.map(|v| points[v as usize]);
        let area = (q[1] - q[0]).perp_dot(q[2] - q[0]);
        for k in 0..3 {
            let (a, b) = (q[(k + 1) % 3], q[(k + 2) % 3]);
            let middle = DVec2::splat(0.5);
            this.shares[0][k] = (a - middle).perp_dot(b - middle) / area;
            this.shares[1][k] = (a.y - b.y) / area;
            this.shares[2][k] = (b.x - a.x) / area;
        }
        this
    }

    /// The corners' shares in a pixel, which add up to 1; outside the triangle some are negative.
    fn shares_at(&self, pixel: usize, size: usize) -> [f64; 3] {
        let (x, y) = ((pixel % size) as f64, (pixel / size) as f64);
        [0, 1, 2].map(|k| self.shares[0][k] + x * self.shares[1][k] + y * self.shares[2][k])
    }
}
