//! Which triangle is seen in each pixel of a view, drawn with as little work as may be.
//!
//! Invariants:
//! 1. what is seen is the least (depth, triangle) of all that covers the pixel, in whatever order triangles
//!    are drawn;
//! 2. triangles that face away come last, and those behind everything in their rectangle are not drawn: of a
//!    closed surface that is nearly all of them.

use crate::intrinsics::by_processor;

use super::{
    lattice::{DEPTH_BITS, PixelRect, ScreenPoint, Setup},
    raster::{for_each_pixel, for_each_run},
    scene::{Scene, SceneFace},
    tiles::{BACKGROUND_Z, TileBounds},
};

/// No triangle: the background.
pub const NOTHING: u32 = u32::MAX;

/// See the module.
pub struct Nearest {
    size: usize,
    /// By pixel: the triangle seen there, or [`NOTHING`].
    pub ids: Vec<u32>,
    /// By pixel: how far away it is; `i32::MAX` where nothing is.
    pub depths: Vec<i32>,
}

impl Nearest {
    /// Draws one view.
    pub fn of(scene: &Scene, view: usize) -> Self {
        let size = scene.lattice.size as usize;
        let (ids, depths) = (vec![NOTHING; size * size], vec![i32::MAX; size * size]);
        let mut this = Self { size, ids, depths };
        let points = scene.screen_points_in(view);
        let at = |face: &SceneFace| face.vertices.map(|v| points[v as usize]);
        let texels = scene.texels.words();
        let setup = |id: u32, corners| {
            let face = scene.faces[id as usize].as_ref()?;
            let cull = scene.cull(view, &face.surface);
            let mut setup = scene.lattice.setup(corners, [0; 3], cull)?;
            if scene.has_holes(face) {
                setup.paint = scene.painted(view, face);
            }
            Some(setup)
        };
        let mut facing_away = Vec::new();
        for (id, face) in (0_u32..).zip(&scene.faces) {
            let Some(corners) = face.as_ref().map(at) else { continue };
            if is_front(corners) {
                this.draw(id, setup(id, corners), texels);
            } else {
                facing_away.push((id, corners));
            }
        }
        let bounds = this.bounds();
        for (id, corners) in facing_away {
            let nearest = corners.iter().map(|p| u32::from(p.z)).min().unwrap_or(0);
            let rect = rect(scene, corners);
            if !rect.is_empty() && !bounds.hides(&rect, nearest) {
                this.draw(id, setup(id, corners), texels);
            }
        }
        this
    }

    /// By triangle: whether it is seen in a pixel.
    pub fn faces_seen(&self, n_faces: usize) -> Vec<bool> {
        let mut is_seen = vec![false; n_faces];
        for id in self.ids.iter().filter(|id| **id != NOTHING) {
            is_seen[*id as usize] = true;
        }
        is_seen
    }

    fn draw(&mut self, id: u32, setup: Option<Setup>, texels: &[u32]) {
        match setup {
            Some(s) if s.paint.is_some() => self.draw_pierced(id, &s, texels),
            Some(s) => draw(&mut self.depths, &mut self.ids, self.size, id, &s),
            None => {}
        }
    }

    /// Draws a triangle with holes.
    fn draw_pierced(&mut self, id: u32, s: &Setup, texels: &[u32]) {
        for_each_pixel(s, |i, j| {
            let at = j as usize * self.size + i as usize;
            let z = s.depth.at(i, j, DEPTH_BITS);
            if (z, id) < (self.depths[at], self.ids[at]) && !s.is_hole(texels, i, j) {
                (self.depths[at], self.ids[at]) = (z, id);
            }
        });
    }

    /// The depth bounds of what is drawn so far.
    fn bounds(&self) -> TileBounds {
        let size = self.size as i32;
        let mut bounds = TileBounds::new(size);
        for tile in bounds.touched(&PixelRect { x0: 0, y0: 0, x1: size - 1, y1: size - 1 }) {
            let far = (tile.y0..=tile.y1).map(|j| {
                let start = (j * size + tile.x0) as usize;
                let row = &self.depths[start..][..(tile.x1 - tile.x0 + 1) as usize];
                row.iter().copied().max().unwrap_or(i32::MAX)
            });
            let far = far.max().unwrap_or(i32::MAX);
            bounds.set(&tile, (far as u32).min(BACKGROUND_Z));
        }
        bounds
    }
}

/// Corners that run counter-clockwise, in coordinates that run downwards.
fn is_front([a, b, c]: [ScreenPoint; 3]) -> bool {
    let by = |p: ScreenPoint| (i32::from(p.x) - i32::from(a.x), i32::from(p.y) - i32::from(a.y));
    let (b, c) = (by(b), by(c));
    b.0 * c.1 - c.0 * b.1 < 0
}

/// Pixels whose centres may be covered.
fn rect(scene: &Scene, corners: [ScreenPoint; 3]) -> PixelRect {
    let span = |v: [i16; 3]| (v[0].min(v[1]).min(v[2]).into(), v[0].max(v[1]).max(v[2]).into());
    scene.lattice.pixels_within(span(corners.map(|p| p.x)), span(corners.map(|p| p.y)))
}

by_processor! {
    /// Draws a triangle into pictures of depths and ids.
    fn draw(depths: &mut [i32], ids: &mut [u32], size: usize, id: u32, s: &Setup) -> () {
        avx2: draw_plain,
        plain: draw_plain,
    }
}

#[inline(always)]
fn draw_plain(depths: &mut [i32], ids: &mut [u32], size: usize, id: u32, s: &Setup) {
    for_each_run(s, |columns, j| {
        let start = j as usize * size;
        let run = start + columns.start as usize..start + columns.end as usize;
        let pixels = depths[run.clone()].iter_mut().zip(&mut ids[run]);
        for (i, (depth, seen)) in columns.zip(pixels) {
            let z = s.depth.at(i, j, DEPTH_BITS);
            // No branches: this loop is where the time goes.
            let is_nearer = (z < *depth) | ((z == *depth) & (id < *seen));
            *depth = if is_nearer { z } else { *depth };
            *seen = if is_nearer { id } else { *seen };
        }
    });
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;
    use crate::render::{contract, raster, view::BoundingSphere};

    /// The pictures show so much of the sphere that holds all triangles.
    fn check(faces: &[[DVec3; 3]], look: contract::Look, shown: f64) -> Result<(), TestCaseError> {
        let corners = (0..3 * faces.len() as u32).collect::<Vec<_>>();
        let ids = corners.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
        let mut sphere = BoundingSphere::of(faces.as_flattened().iter().copied());
        sphere.radius *= shown;
        let points = faces.as_flattened().to_vec();
        let scene = contract::scene_within(&sphere, points, ids, look);
        for view in 0..scene.n_views() {
            let nearest = Nearest::of(&scene, view);
            let size = scene.lattice.size;
            let mut least = vec![(i32::MAX, NOTHING); (size * size) as usize];
            raster::for_each_fragment(&scene, view, |_| true, &mut |i, j, f| {
                let slot = &mut least[(j * size + i) as usize];
                *slot = (*slot).min((i32::from(f.z), f.face));
            });
            let found: Vec<_> = nearest.depths.into_iter().zip(nearest.ids).collect();
            prop_assert_eq!(found, least);
        }
        Ok(())
    }

    fn triangle() -> impl Strategy<Value = [DVec3; 3]> {
        let corner = prop::array::uniform3(-0.5..0.5).prop_map(DVec3::from_array);
        prop::array::uniform3(corner)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        // Large triangles that face either way hide one another; doubled ones tie, with either side first. Some are
        // beside the picture.
        #[test]
        fn what_is_seen_is_the_least_of_all_fragments(
            faces in prop::collection::vec(triangle(), 1..40),
            look in prop::sample::select(vec![0, 1, 2, 4, 5, 6]),
            shown in prop::sample::select(vec![1.0, 0.6, 0.3]),
        ) {
            let turned = faces.iter().map(|[a, b, c]| [*a, *c, *b]);
            let all: Vec<_> = turned.chain(faces.iter().copied()).collect();
            check(&all, contract::LOOKS[look], shown)?;
        }
    }
}
