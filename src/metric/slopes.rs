//! How the pictures' energy changes with every vertex at once: slope and bend, from one drawing of
//! each picture.
//!
//! The energy in pixels is a staircase; this is the slope of the smooth function beneath it, as if
//! every pixel were the mean over its area. It has two parts. *Inside* a triangle, luminance changes
//! with normals, and with the corners it is interpolated between. *Across* an edge in a picture,
//! pixels change from one triangle's luminance to another's as the edge moves (Li et al. 2018,
//! section 3; edges are sought between neighbouring pixels as in Laine et al. 2020, section 3.6).
//! Bends are those of Gauss and Newton: never negative, a matrix for each vertex.
//!
//! Invariants:
//! 1. sums over views, as often as each counts, run in view order, so the result does not depend on threads;
//! 2. nothing is judged here: whether a step along a slope helps, the pictures must tell.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use crate::render::{Reference, Scene, Shading};

use super::{attributes::Attributes, drawn::Drawn, shown::Shown};

/// Slope and bend of the energy at a vertex.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slope {
    /// First derivative.
    pub gradient: DVec3,
    /// Second derivative (Gauss–Newton).
    pub bend: DMat3,
}

impl Slope {
    /// Of an energy that does not change.
    pub const FLAT: Self = Self { gradient: DVec3::ZERO, bend: DMat3::ZERO };

    /// Adds residuals that change by `by`: `slope` is the energy's derivative by them, `bend` its
    /// second one.
    pub(super) fn add(&mut self, slope: f64, bend: f64, by: DVec3) {
        self.gradient += slope * by;
        self.bend += outer(bend * by, by);
    }

    /// What is left of it where only steps along a direction of length 1 are taken.
    #[must_use]
    pub fn along(&self, way: DVec3) -> Self {
        let bend = way.dot(self.bend * way);
        Self { gradient: way * way.dot(self.gradient), bend: outer(bend * way, way) }
    }
}

/// What changes as a corner takes a texture along in the picture, or moves on it: slopes along two axes, and their
/// squares and product.
#[derive(Clone, Copy, Default)]
pub(super) struct Drag {
    slope: DVec2,
    squares: DVec2,
    product: f64,
}

impl Drag {
    /// Adds a pixel that counts `weight` times, whose luminance is too much by `off`, and grows by `by` for each unit of
    /// motion the other way.
    pub(super) fn add(&mut self, weight: f64, off: f64, by: DVec2) {
        self.slope += 2.0 * weight * off * by;
        self.squares += 2.0 * weight * by * by;
        self.product += 2.0 * weight * by.x * by.y;
    }

    /// `dx` and `dy` are how the corner moves along the axes.
    pub(super) fn add_to(&self, at: &mut Slope, [dx, dy]: [DVec3; 2]) {
        at.gradient -= self.slope.x * dx + self.slope.y * dy;
        at.bend += outer(self.squares.x * dx + self.product * dy, dx);
        at.bend += outer(self.product * dx + self.squares.y * dy, dy);
    }
}

/// The energy of a scene and how it changes.
#[derive(Clone, Debug, PartialEq)]
pub struct Slopes {
    /// Sum of squared luminance differences, of luminances that were not rounded.
    pub energy: f64,
    /// By vertex slot: by the place.
    pub places: Vec<Slope>,
    /// By vertex slot: by the normal; empty unless surfaces are smooth and normals their own.
    pub normals: Vec<Slope>,
    /// By unknown texture coordinate of the [`Attributes`]; the third number is nothing.
    pub coordinates: Vec<Slope>,
    /// By unknown vertex colour of these.
    pub colours: Vec<Slope>,
    /// By triangle: its part of the energy, the background's left out.
    pub faces: Vec<f64>,
}

impl Slopes {
    fn all(&self) -> [&Vec<Slope>; 4] {
        [&self.places, &self.normals, &self.coordinates, &self.colours]
    }

    fn all_mut(&mut self) -> [&mut Vec<Slope>; 4] {
        [&mut self.places, &mut self.normals, &mut self.coordinates, &mut self.colours]
    }
}

/// The energy of a scene against pictures of the original, and its slopes at every vertex, and by those `attributes`
/// that the scene shows.
pub fn slopes(
    scene: &Scene,
    reference: &Reference,
    has_own_normals: bool,
    attributes: Option<&Attributes>,
) -> Slopes {
    let n_slots = scene.faces.iter().flatten().flat_map(|f| f.vertices).max();
    let n_slots = n_slots.map_or(0, |v| v as usize + 1);
    let n_normals = if scene.params.shading == Shading::Smooth { n_slots } else { 0 };
    let mut sum = Slopes {
        energy: 0.0,
        places: vec![Slope::FLAT; n_slots],
        normals: vec![Slope::FLAT; n_normals],
        coordinates: vec![Slope::FLAT; attributes.map_or(0, |a| a.coordinates().len())],
        colours: vec![Slope::FLAT; attributes.map_or(0, |a| a.colours().len())],
        faces: vec![0.0; scene.faces.len()],
    };
    let of_view = |view: usize| {
        let mut part = sum.clone();
        let drawn = Drawn::new(scene, view, attributes);
        drawn.differentiate(Shown::of(reference, view), &mut part);
        part
    };
    let parts: Vec<Slopes> = (0..scene.n_views()).into_par_iter().map(of_view).collect();
    for (part, view) in parts.into_iter().zip(&scene.views) {
        let weight = f64::from(view.weight);
        sum.energy += weight * part.energy;
        sum.faces.iter_mut().zip(&part.faces).for_each(|(total, one)| *total += weight * one);
        for (total, one) in
            sum.all_mut().into_iter().flatten().zip(part.all().into_iter().flatten())
        {
            total.gradient += weight * one.gradient;
            total.bend += weight * one.bend;
        }
    }
    if !has_own_normals {
        derive(scene, &mut sum);
        sum.normals.clear();
    }
    sum
}

/// Turns slopes by area-weighted normals into slopes by the places of the vertices around.
fn derive(scene: &Scene, sum: &mut Slopes) {
    let mut areas = vec![DVec3::ZERO; sum.normals.len()];
    let corners = |face: [u32; 3]| face.map(|v| scene.position(v));
    for face in scene.faces.iter().flatten().filter(|_| !sum.normals.is_empty()) {
        let [p0, p1, p2] = corners(face.vertices);
        let area = (p1 - p0).cross(p2 - p0);
        face.vertices.iter().for_each(|v| areas[*v as usize] += area);
    }
    for face in scene.faces.iter().flatten().filter(|_| !sum.normals.is_empty()) {
        let p = corners(face.vertices);
        for v in face.vertices {
            let length = areas[v as usize].length();
            if length == 0.0 {
                continue;
            }
            let normal = areas[v as usize] / length;
            let across = (DMat3::IDENTITY - outer(normal, normal)) * (1.0 / length);
            let (by, bend) =
                (across * sum.normals[v as usize].gradient, sum.normals[v as usize].bend);
            let bend = across * bend * across;
            for k in 0..3 {
                // The area changes by (opposite side) × (motion of the corner).
                let turn = crossing_with(p[(k + 2) % 3] - p[(k + 1) % 3]);
                let place = &mut sum.places[face.vertices[k] as usize];
                place.gradient += turn.transpose() * by;
                place.bend += turn.transpose() * bend * turn;
            }
        }
    }
}

/// The matrix of `x ↦ a × x`.
fn crossing_with(a: DVec3) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(0.0, a.z, -a.y),
        DVec3::new(-a.z, 0.0, a.x),
        DVec3::new(a.y, -a.x, 0.0),
    )
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}
