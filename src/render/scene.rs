//! The model as the evaluators see it: triangles, their corners in every picture, and the light.
//!
//! Everything in floating point happens here, on the host, in f64 with + − × ÷ √ only; what leaves
//! is integers ([`ScreenPoint`]s and 8-bit luminances). The native twin and the device share this
//! code, so they cannot differ in it.

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use super::{
    lattice::{Cull, Lattice, ScreenPoint, Setup},
    moves::Move,
    paint::{Paint, Painted, Texels},
    view::View,
};

/// Surface shading.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shading {
    /// One normal a triangle.
    #[default]
    Flat,
    /// Area-weighted vertex normals, luminance interpolated (Gouraud).
    Smooth,
}

/// How pictures are drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderParams {
    /// Pixels along each side, 64 to 1024.
    pub image_size: u32,
    /// Flat or smooth.
    pub shading: Shading,
    /// Ambient light, 0 to 1; diffuse is the rest.
    pub ambient: f64,
    /// Background luminance, 0 to 255.
    pub background: u8,
    /// The first so many views cull front faces and so see the interior.
    pub interior_views: usize,
    /// The other views cull back faces of single-sided surfaces.
    pub hides_back_faces: bool,
}

/// What a triangle's light falls on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Albedo at each corner, by channel (see [`View::channel`]).
    pub albedo: [[u8; 3]; 3],
    /// A texture, which multiplies the albedo.
    pub paint: Option<Paint>,
    /// As bright from everywhere: no light falls on it.
    pub is_unlit: bool,
    /// Meant to be seen from its front alone.
    pub is_single_sided: bool,
}

impl Surface {
    /// The same everywhere.
    pub const WHITE: Self =
        Self { albedo: [[255; 3]; 3], paint: None, is_unlit: false, is_single_sided: false };

    /// Albedo at each corner, as a view sees it.
    #[inline(always)]
    pub fn albedo_in(&self, view: &View) -> [u8; 3] {
        self.albedo.map(|corner| corner[usize::from(view.channel)])
    }

    /// Takes corner `from` of another surface as corner `k`.
    pub fn set_corner(&mut self, k: usize, other: &Self, from: usize) {
        self.albedo[k] = other.albedo[from];
        if let (Some(own), Some(other)) = (&mut self.paint, &other.paint) {
            own.uv[k] = other.uv[from];
        }
    }
}

/// One triangle of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneFace {
    /// Vertex slots, in the mesh's corner order.
    pub vertices: [u32; 3],
    /// Its material.
    pub surface: Surface,
}

/// The current model in every picture.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Drawing parameters.
    pub params: RenderParams,
    /// Cameras.
    pub views: Vec<View>,
    /// The raster.
    pub lattice: Lattice,
    /// What triangles are painted with.
    pub texels: Arc<Texels>,
    /// Triangles by id; `None` where an edit removed one.
    pub faces: Vec<Option<SceneFace>>,
    /// Vertex positions by slot, model space.
    positions: Vec<DVec3>,
    /// Unit vertex normals by slot; empty when shading is flat.
    normals: Vec<DVec3>,
    /// Screen points, `n_views` for each vertex slot.
    screen: Vec<ScreenPoint>,
}

impl Scene {
    /// A scene of the given triangles. `positions` are by vertex slot.
    pub fn new(
        params: RenderParams,
        views: Vec<View>,
        texels: Arc<Texels>,
        positions: Vec<DVec3>,
        faces: Vec<Option<SceneFace>>,
    ) -> Self {
        let lattice = Lattice::new(params.image_size);
        let screen = positions
            .par_iter()
            .flat_map_iter(|p| views.iter().map(move |v| lattice.snap(v.project(*p))))
            .collect();
        let normals = match params.shading {
            Shading::Flat => Vec::new(),
            Shading::Smooth => vertex_normals(&positions, &faces),
        };
        Self { params, views, lattice, texels, faces, positions, normals, screen }
    }

    /// Number of pictures.
    pub fn n_views(&self) -> usize {
        self.views.len()
    }

    /// Pixels in all pictures.
    pub fn n_pixels(&self) -> u64 {
        u64::from(self.params.image_size).pow(2) * self.n_views() as u64
    }

    /// Pixels in all pictures, as often as they count.
    pub fn n_counted_pixels(&self) -> u64 {
        let n_weights: u64 = self.views.iter().map(|view| u64::from(view.weight)).sum();
        u64::from(self.params.image_size).pow(2) * n_weights
    }

    /// Number of vertex slots.
    pub fn n_vertex_slots(&self) -> usize {
        self.positions.len()
    }

    /// Position of a vertex slot, model space.
    pub fn position(&self, vertex: u32) -> DVec3 {
        self.positions[vertex as usize]
    }

    /// The screen points of a vertex slot, one a view.
    pub fn screen_points(&self, vertex: u32) -> &[ScreenPoint] {
        let n = self.n_views();
        &self.screen[vertex as usize * n..][..n]
    }

    /// The screen points of all vertex slots in one view, beside one another: in the scene a vertex's points of all
    /// views are, far from its neighbours'.
    pub fn screen_points_in(&self, view: usize) -> Vec<ScreenPoint> {
        (0..self.n_vertex_slots() as u32).map(|v| self.screen_points(v)[view]).collect()
    }

    /// Screen points of a position that is not (yet) a vertex, one a view.
    pub fn project(&self, p: DVec3) -> impl Iterator<Item = ScreenPoint> + '_ {
        self.views.iter().map(move |v| self.lattice.snap(v.project(p)))
    }

    /// Which side of a surface this view does not draw.
    #[inline]
    pub fn cull(&self, view: usize, surface: &Surface) -> Cull {
        if view < self.params.interior_views {
            Cull::Front
        } else if self.params.hides_back_faces && surface.is_single_sided {
            Cull::Back
        } else {
            Cull::Nothing
        }
    }

    /// Prepares a triangle that is in the scene; `None` when it covers no pixel for sure.
    pub fn set_up(&self, view: usize, face: &SceneFace) -> Option<Setup> {
        let points = face.vertices.map(|v| self.screen_points(v)[view]);
        let lum = self.face_luminance(view, face);
        let mut setup = self.lattice.setup(points, lum, self.cull(view, &face.surface))?;
        setup.paint = self.painted(view, face);
        Some(setup)
    }

    /// Whether the texture on a triangle has holes.
    pub fn has_holes(&self, face: &SceneFace) -> bool {
        face.surface.paint.is_some_and(|paint| self.texels.has_holes(paint.map))
    }

    /// The texture on a triangle that is in the scene and has an area in this view.
    pub fn painted(&self, view: usize, face: &SceneFace) -> Option<Painted> {
        let paint = face.surface.paint.as_ref()?;
        let points = face.vertices.map(|v| self.screen_points(v)[view]);
        let corners = face.vertices.map(|v| self.positions[v as usize]);
        self.texels.painted(&self.lattice, &self.views[view], (points, corners), paint)
    }

    /// Luminances at the corners of a triangle that is in the scene.
    pub fn face_luminance(&self, view: usize, face: &SceneFace) -> [u8; 3] {
        let albedo = face.surface.albedo_in(&self.views[view]);
        if face.surface.is_unlit {
            return albedo;
        }
        let p = face.vertices.map(|v| self.positions[v as usize]);
        let shape = FaceShape::new(p);
        match self.params.shading {
            Shading::Flat => self.flat_luminance(view, &shape, albedo),
            Shading::Smooth => {
                let n = face.vertices.map(|v| self.normals[v as usize]);
                self.smooth_luminance(view, &shape, p, n, albedo)
            }
        }
    }

    /// One luminance for the whole triangle (times the albedo of each corner).
    #[inline]
    pub fn flat_luminance(&self, view: usize, shape: &FaceShape, albedo: [u8; 3]) -> [u8; 3] {
        let v = &self.views[view];
        let side = if v.sees_front(shape.centroid, shape.unit_normal) { 1.0 } else { -1.0 };
        let shade = self.shade(side * shape.unit_normal.dot(v.to_light));
        albedo.map(|a| to_u8(shade * f64::from(a)))
    }

    /// Gouraud luminances: both sides are lit, the side that faces the viewer is the triangle's.
    #[inline]
    pub fn smooth_luminance(
        &self,
        view: usize,
        shape: &FaceShape,
        corners: [DVec3; 3],
        normals: [DVec3; 3],
        albedo: [u8; 3],
    ) -> [u8; 3] {
        let v = &self.views[view];
        std::array::from_fn(|k| {
            let side = if v.sees_front(corners[k], shape.unit_normal) { 1.0 } else { -1.0 };
            to_u8(self.shade(side * normals[k].dot(v.to_light)) * f64::from(albedo[k]))
        })
    }

    /// Unit normal of a vertex slot (smooth shading only).
    pub fn normal(&self, vertex: u32) -> DVec3 {
        self.normals.get(vertex as usize).copied().unwrap_or(DVec3::ZERO)
    }

    /// Ambient plus diffuse, 0 to 1.
    #[inline]
    fn shade(&self, cosine: f64) -> f64 {
        self.params.ambient + (1.0 - self.params.ambient) * cosine.max(0.0)
    }

    /// The same triangles with their vertices at other places, in other views. Smooth shading:
    /// normals follow the triangles if `derives_normals`, or stay as they are.
    pub fn redraw(&mut self, views: &[View], positions: Vec<DVec3>, derives_normals: bool) {
        self.views = views.to_vec();
        self.positions = positions;
        let snap = |p: &DVec3| self.project(*p).collect::<Vec<_>>();
        self.screen = self.positions.par_iter().flat_map_iter(snap).collect();
        if self.params.shading == Shading::Smooth && derives_normals {
            self.normals = vertex_normals(&self.positions, &self.faces);
        }
    }

    /// Other normals, by vertex slot from the first on; those that are not given stay.
    pub fn turn_normals(&mut self, normals: impl Iterator<Item = DVec3>) {
        self.normals.iter_mut().zip(normals).for_each(|(old, new)| *old = new);
    }

    /// Slots for the triangles that a move brings.
    pub(super) fn make_room(&mut self, mv: &Move) {
        let n_slots = mv.added.iter().map(|a| a.face as usize + 1).max().unwrap_or(0);
        if n_slots > self.faces.len() {
            self.faces.resize(n_slots, None);
        }
    }

    /// Applies an edit to the triangles, positions and screen points.
    pub fn apply(&mut self, mv: &Move) {
        self.make_room(mv);
        for f in &mv.removed {
            self.faces[*f as usize] = None;
        }
        for a in &mv.added {
            self.faces[a.face as usize] =
                Some(SceneFace { vertices: a.vertices, surface: a.surface });
        }
        let n = self.n_views();
        for (vertex, p) in &mv.moved {
            let slot = *vertex as usize;
            if slot >= self.positions.len() {
                self.positions.resize(slot + 1, DVec3::ZERO);
                self.screen.resize((slot + 1) * n, ScreenPoint::default());
            }
            self.positions[slot] = *p;
            for view in 0..n {
                self.screen[slot * n + view] = self.lattice.snap(self.views[view].project(*p));
            }
        }
        for (vertex, normal) in &mv.normals {
            let slot = *vertex as usize;
            if slot >= self.normals.len() {
                self.normals.resize(slot + 1, DVec3::ZERO);
            }
            self.normals[slot] = *normal;
        }
    }
}

/// What flat shading needs of a triangle, model space.
#[derive(Clone, Copy, Debug, Default)]
pub struct FaceShape {
    /// Mean of the corners.
    pub centroid: DVec3,
    /// Unit normal, zero for a degenerate triangle.
    pub unit_normal: DVec3,
}

impl FaceShape {
    /// Of the triangle with these corners.
    pub fn new(p: [DVec3; 3]) -> Self {
        Self {
            centroid: (p[0] + p[1] + p[2]) / 3.0,
            unit_normal: (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero(),
        }
    }
}

/// Rounds 0..=255 to the nearest integer.
#[inline]
fn to_u8(v: f64) -> u8 {
    (v.clamp(0.0, 255.0) + 0.5) as u8
}

/// Area-weighted unit vertex normals.
fn vertex_normals(positions: &[DVec3], faces: &[Option<SceneFace>]) -> Vec<DVec3> {
    let mut sums = vec![DVec3::ZERO; positions.len()];
    for face in faces.iter().flatten() {
        let p = face.vertices.map(|v| positions[v as usize]);
        let area = (p[1] - p[0]).cross(p[2] - p[0]);
        for v in face.vertices {
            sums[v as usize] += area;
        }
    }
    sums.into_iter().map(DVec3::normalize_or_zero).collect()
}
