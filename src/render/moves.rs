//! A candidate edit as the evaluators see it: triangles out, triangles in, vertices moved.

use glam::DVec3;
use smallvec::SmallVec;

use super::{
    lattice::{Lattice, PixelRect, ScreenPoint, Setup},
    scene::{FaceShape, Scene, Shading, Surface},
};

/// A triangle that an edit adds. It takes the id of one that the edit removes (or a new one), so
/// that ties in depth fall as they would in a full re-render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AddedFace {
    /// Its id.
    pub face: u32,
    /// Vertex slots in corner order; slots listed in [`Move::moved`] stand at their new places.
    pub vertices: [u32; 3],
    /// Its material.
    pub surface: Surface,
}

/// A candidate edit. A triangle that merely changes shape is both removed and added.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Move {
    /// Ids of the triangles that go.
    pub removed: SmallVec<[u32; 16]>,
    /// Triangles that come.
    pub added: SmallVec<[AddedFace; 16]>,
    /// New places of vertices, model space.
    pub moved: SmallVec<[(u32, DVec3); 1]>,
    /// New unit normals of vertices (smooth shading only; empty when flat).
    pub normals: SmallVec<[(u32, DVec3); 0]>,
}

/// A move brought into every picture: the part of an evaluation that is done once, not per view.
#[derive(Clone, Debug, Default)]
pub struct Projected {
    /// `n_views` screen points for each distinct vertex of the removed and added triangles.
    points: Vec<ScreenPoint>,
    /// The distinct vertices: slot, and whether an added triangle uses it at its new place.
    vertices: Vec<(u32, bool)>,
    /// For each added triangle: its corners as indices into `vertices`.
    corners: Vec<[u8; 3]>,
    /// For each added triangle: centroid and normal.
    shapes: Vec<FaceShape>,
    /// For each added triangle: corner positions.
    places: Vec<[DVec3; 3]>,
    /// For each added triangle: corner normals (smooth shading only).
    normals: Vec<[DVec3; 3]>,
    n_views: usize,
}

/// The most distinct vertices of one move.
pub const MAX_MOVE_VERTICES: usize = 255;

impl Projected {
    /// Projects `mv`, reusing the buffers of `self`.
    pub fn fill(&mut self, scene: &Scene, mv: &Move) {
        self.points.clear();
        self.vertices.clear();
        self.corners.clear();
        self.shapes.clear();
        self.places.clear();
        self.normals.clear();
        self.n_views = scene.n_views();
        for a in &mv.added {
            let corner = a.vertices.map(|v| self.vertex(v, true));
            self.corners.push(corner);
        }
        for f in &mv.removed {
            if let Some(face) = &scene.faces[*f as usize] {
                for v in face.vertices {
                    let moves = mv.moved.iter().any(|m| m.0 == v);
                    // A vertex at rest stands for the old and the new triangles alike.
                    self.vertex(v, !moves);
                }
            }
        }
        for i in 0..self.vertices.len() {
            let (slot, new) = self.vertices[i];
            match mv.moved.iter().find(|m| new && m.0 == slot) {
                Some((_, p)) => self.points.extend(scene.project(*p)),
                None => self.points.extend_from_slice(scene.screen_points(slot)),
            }
        }
        self.shade(scene, mv);
    }

    fn shade(&mut self, scene: &Scene, mv: &Move) {
        let place = |v: u32| match mv.moved.iter().find(|m| m.0 == v) {
            Some((_, p)) => *p,
            None => scene.position(v),
        };
        let normal = |v: u32| match mv.normals.iter().find(|m| m.0 == v) {
            Some((_, n)) => *n,
            None => scene.normal(v),
        };
        for a in &mv.added {
            let p = a.vertices.map(place);
            self.shapes.push(FaceShape::new(p));
            self.places.push(p);
            if scene.params.shading == Shading::Smooth {
                self.normals.push(a.vertices.map(normal));
            }
        }
    }

    /// Index of a vertex in `vertices`, entering it when it is new.
    fn vertex(&mut self, slot: u32, new: bool) -> u8 {
        let at = self.vertices.iter().position(|v| *v == (slot, new)).unwrap_or_else(|| {
            self.vertices.push((slot, new));
            self.vertices.len() - 1
        });
        at.min(MAX_MOVE_VERTICES) as u8
    }

    /// The screen point of distinct vertex `k`.
    #[inline(always)]
    fn point(&self, k: usize, view: usize) -> ScreenPoint {
        self.points[k * self.n_views + view]
    }

    /// The pixels that the move can touch in a view, and the least depth of its triangles there.
    #[inline(always)]
    pub fn extent(&self, lattice: &Lattice, view: usize) -> (PixelRect, u16) {
        let (mut x, mut y, mut z) = ((i32::MAX, i32::MIN), (i32::MAX, i32::MIN), u16::MAX);
        for k in 0..self.vertices.len() {
            let p = self.point(k, view);
            x = (x.0.min(i32::from(p.x)), x.1.max(i32::from(p.x)));
            y = (y.0.min(i32::from(p.y)), y.1.max(i32::from(p.y)));
            z = z.min(p.z);
        }
        if self.vertices.is_empty() {
            return (PixelRect::EMPTY, z);
        }
        (lattice.pixels_within(x, y), z)
    }

    /// Screen points of added triangle `k`.
    #[inline(always)]
    pub fn added_points(&self, k: usize, view: usize) -> [ScreenPoint; 3] {
        self.corners[k].map(|c| self.point(usize::from(c), view))
    }

    /// Prepares added triangle `k`; `None` when it covers no pixel for sure.
    #[inline(always)]
    pub fn set_up(&self, scene: &Scene, mv: &Move, k: usize, view: usize) -> Option<Setup> {
        let points = self.added_points(k, view);
        let surface = &mv.added[k].surface;
        let albedo = surface.albedo_in(&scene.views[view]);
        let lum =
            if surface.is_unlit { albedo } else { self.added_luminance(scene, albedo, k, view) };
        let mut setup = scene.lattice.setup(points, lum, scene.cull(view, surface))?;
        if let Some(paint) = &surface.paint {
            let shown = (points, self.places[k]);
            setup.paint = scene.texels.painted(&scene.lattice, &scene.views[view], shown, paint);
        }
        Some(setup)
    }

    /// Corner luminances of added triangle `k`.
    #[inline(always)]
    fn added_luminance(&self, scene: &Scene, albedo: [u8; 3], k: usize, view: usize) -> [u8; 3] {
        match self.normals.get(k) {
            None => scene.flat_luminance(view, &self.shapes[k], albedo),
            Some(n) => scene.smooth_luminance(view, &self.shapes[k], self.places[k], *n, albedo),
        }
    }
}
