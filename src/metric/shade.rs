//! How a triangle's luminance in one view depends on its corners, not rounded.

use glam::{DVec2, DVec3};

use crate::render::{Scene, SceneFace, Shading};

/// How a triangle is lit.
#[derive(Clone, Copy, Default)]
pub(super) struct Shade {
    /// Luminances of the corners.
    pub corners: [f64; 3],
    /// Flat: how the luminance changes with each corner's place. Smooth: how each corner's luminance
    /// changes with its normal.
    pub by: [DVec3; 3],
    /// How much of its albedo each corner shows.
    pub lights: [f64; 3],
    /// Shares of the corners at pixel (0, 0), and their changes to the right and down (only where corners
    /// differ or may come to differ, or a texture travels with them).
    pub shares: [[f64; 3]; 3],
}

impl Shade {
    /// Of a triangle whose vertices are drawn at these points; `has_shares`: shares are wanted in any case.
    pub fn of(
        scene: &Scene,
        view: usize,
        face: &SceneFace,
        (points, has_shares): (&[DVec2], bool),
    ) -> Self {
        let p = face.vertices.map(|v| scene.position(v));
        let area = (p[1] - p[0]).cross(p[2] - p[0]);
        let length = area.length();
        let normal = if length > 0.0 { area / length } else { DVec3::ZERO };
        match scene.params.shading {
            Shading::Flat => {
                let mut this = Self::flat(scene, view, face, p, (normal, length));
                if has_shares || face.surface.paint.is_some() || !this.is_even() {
                    this.share(face.vertices.map(|v| points[v as usize]));
                }
                this
            }
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
        let albedos = face.surface.albedo_in(v).map(f64::from);
        let albedo = albedos.iter().sum::<f64>() / 3.0;
        let centroid = (p[0] + p[1] + p[2]) / 3.0;
        let side = if v.sees_front(centroid, normal) { 1.0 } else { -1.0 };
        let cosine = side * normal.dot(v.to_light);
        if face.surface.is_unlit {
            return Self { corners: albedos, lights: [1.0; 3], ..Self::default() };
        }
        let lights = [ambient + (1.0 - ambient) * cosine.max(0.0); 3];
        let diffuse = albedo * (1.0 - ambient);
        let corners = albedos.map(|a| a * ambient + a * (1.0 - ambient) * cosine.max(0.0));
        if cosine <= 0.0 || length == 0.0 {
            return Self { corners, lights, ..Self::default() };
        }
        let by_area = side * diffuse / length * (v.to_light - normal * normal.dot(v.to_light));
        let (by1, by2) = ((p[2] - p[0]).cross(by_area), by_area.cross(p[1] - p[0]));
        Self { corners, lights, by: [-(by1 + by2), by1, by2], ..Self::default() }
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
            let albedo = f64::from(face.surface.albedo_in(v)[k]);
            if face.surface.is_unlit {
                (this.corners[k], this.lights[k]) = (albedo, 1.0);
                continue;
            }
            let side = if v.sees_front(place, normal) { 1.0 } else { -1.0 };
            let cosine = side * scene.normal(face.vertices[k]).dot(v.to_light);
            this.lights[k] = ambient + (1.0 - ambient) * cosine.max(0.0);
            this.corners[k] = albedo * this.lights[k];
            if cosine > 0.0 {
                this.by[k] = albedo * (1.0 - ambient) * side * v.to_light;
            }
        }
        this.share(face.vertices.map(|v| points[v as usize]));
        this
    }

    /// Whether the corners have one luminance.
    pub fn is_even(&self) -> bool {
        let [a, b, c] = self.corners;
        a == b && b == c
    }

    /// Finds the corners' shares.
    fn share(&mut self, q: [DVec2; 3]) {
        let area = (q[1] - q[0]).perp_dot(q[2] - q[0]);
        for k in 0..3 {
            let (a, b) = (q[(k + 1) % 3], q[(k + 2) % 3]);
            let middle = DVec2::splat(0.5);
            self.shares[0][k] = (a - middle).perp_dot(b - middle) / area;
            self.shares[1][k] = (a.y - b.y) / area;
            self.shares[2][k] = (b.x - a.x) / area;
        }
    }

    /// The corners' shares in a pixel, which add up to 1; outside the triangle some are negative.
    pub fn shares_at(&self, pixel: usize, size: usize) -> [f64; 3] {
        let (x, y) = ((pixel % size) as f64, (pixel / size) as f64);
        [0, 1, 2].map(|k| self.shares[0][k] + x * self.shares[1][k] + y * self.shares[2][k])
    }
}
