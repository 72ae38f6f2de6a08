//! Full rendering of a scene on the host: reference pictures, and the sorted fragments of the
//! current model. Slow but simple; the incremental paths are checked against it.

use std::{
    ops::Range,
    sync::atomic::{AtomicBool, Ordering},
};

use rayon::prelude::*;

use super::{
    evaluator::Reference,
    lattice::{DEPTH_BITS, PixelRect, Setup},
    nearest::{NOTHING, Nearest},
    scene::{Scene, SceneFace},
    view::View,
};

/// One fragment: what a triangle leaves in a pixel it covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fragment {
    /// 16-bit depth.
    pub z: u16,
    /// 8-bit luminance.
    pub lum: u8,
    /// Triangle.
    pub face: u32,
}

/// Renders the nearest surface in every view.
pub fn reference(scene: &Scene) -> Reference {
    reference_and_seen(scene).0
}

/// Likewise; and of each triangle, whether it is the nearest in some pixel of some view.
pub fn reference_and_seen(scene: &Scene) -> (Reference, Vec<bool>) {
    let seen: Vec<AtomicBool> = scene.faces.iter().map(|_| AtomicBool::new(false)).collect();
    let draw = |view: usize| {
        let nearest = Nearest::of(scene, view);
        let ids = nearest.ids.iter().filter(|id| **id != NOTHING);
        ids.for_each(|id| seen[*id as usize].store(true, Ordering::Relaxed));
        shade(scene, view, &nearest)
    };
    let pictures = (0..scene.n_views()).into_par_iter().map(draw).collect();
    (Reference::plain(pictures), seen.into_iter().map(AtomicBool::into_inner).collect())
}

/// The picture of one view: 8-bit luminance, row by row from the top.
pub fn picture(scene: &Scene, view: usize) -> Vec<u8> {
    shade(scene, view, &Nearest::of(scene, view))
}

fn shade(scene: &Scene, view: usize, nearest: &Nearest) -> Vec<u8> {
    // Most triangles of a dense model are not seen: shade only those that are.
    let is_seen = nearest.faces_seen(scene.faces.len());
    let ids = &nearest.ids;
    let mut lum = vec![scene.params.background; ids.len()];
    for_each_fragment(scene, view, |id| is_seen[id as usize], &mut |i, j, f| {
        let at = (j * scene.lattice.size + i) as usize;
        if ids[at] == f.face {
            lum[at] = f.lum;
        }
    });
    lum
}

/// Calls `on(i, j, fragment)` for every fragment of the triangles that are `wanted`, these by
/// ascending id.
pub fn for_each_fragment(
    scene: &Scene,
    view: usize,
    wanted: impl Fn(u32) -> bool,
    on: &mut impl FnMut(i32, i32, Fragment),
) {
    // Most triangles of a dense model cover no pixel: shade only those that may.
    for_each_setup(scene, view, wanted, |id, face, _| {
        let texels = scene.texels.words();
        let s = scene.set_up(view, face);
        if let Some(s) = &s {
            for_each_pixel(s, |i, j| {
                if !s.is_hole(texels, i, j) {
                    on(i, j, fragment(s, texels, id, i, j));
                }
            });
        }
    });
}

/// Calls `on(id, triangle, setup)` for every triangle that is `wanted` and may cover a pixel, by
/// ascending id. The setups know no luminance.
pub(super) fn for_each_setup(
    scene: &Scene,
    view: usize,
    wanted: impl Fn(u32) -> bool,
    mut on: impl FnMut(u32, &SceneFace, &Setup),
) {
    let points = scene.screen_points_in(view);
    for (id, face) in (0_u32..).zip(&scene.faces).filter(|(id, _)| wanted(*id)) {
        let Some(face) = face else { continue };
        let (corners, cull) =
            (face.vertices.map(|v| points[v as usize]), scene.cull(view, &face.surface));
        if let Some(s) = scene.lattice.setup(corners, [0; 3], cull) {
            on(id, face, &s);
        }
    }
}

/// Calls `on(i, j)` for every pixel that a triangle covers, row by row.
#[inline]
pub fn for_each_pixel(s: &Setup, mut on: impl FnMut(i32, i32)) {
    for_each_run(s, |row, j| row.for_each(|i| on(i, j)));
}

/// Calls `on(columns, j)` for every row in which a triangle covers pixels. Triangles are convex: what a
/// row covers is one run.
#[inline(always)]
pub(super) fn for_each_run(s: &Setup, mut on: impl FnMut(Range<i32>, i32)) {
    let PixelRect { x0, y0, x1, y1 } = s.rect;
    for j in y0..=y1 {
        let [mut a, mut b, mut c] = s.edges.map(|e| e.at(x0, j));
        let [da, db, dc] = s.edges.map(|e| e.dx);
        let mut i = x0;
        let mut go_while = |is_outside: bool| {
            while i <= x1 && ((a | b | c) < 0) == is_outside {
                (a, b, c) = (a.wrapping_add(da), b.wrapping_add(db), c.wrapping_add(dc));
                i = i.wrapping_add(1);
            }
            i
        };
        let run = go_while(true)..go_while(false);
        if !run.is_empty() {
            on(run, j);
        }
    }
}

/// What a triangle leaves in a pixel that it covers.
pub fn fragment(s: &Setup, texels: &[u32], face: u32, i: i32, j: i32) -> Fragment {
    Fragment { z: s.depth.at(i, j, DEPTH_BITS) as u16, lum: s.lum_at(texels, i, j), face }
}

/// Sum over all pictures of the squared difference to the reference, each as often as its view and its
/// pixel count.
pub fn energy(views: &[View], reference: &Reference, pictures: &[Vec<u8>]) -> u64 {
    let of_view = |(k, (view, picture)): (usize, (&View, &Vec<u8>))| {
        u64::from(view.weight) * reference.difference(k, picture.iter().copied())
    };
    views.iter().zip(pictures).enumerate().map(of_view).sum()
}
