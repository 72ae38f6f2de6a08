//! Full rendering of a scene on the host: reference pictures, and the sorted fragments of the
//! current model. Slow but simple; the incremental paths are checked against it.

use rayon::prelude::*;

use super::{
    evaluator::Reference,
    lattice::{DEPTH_BITS, LUM_BITS, Setup},
    scene::Scene,
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
    Reference {
        pictures: (0..scene.n_views()).into_par_iter().map(|v| picture(scene, v)).collect(),
    }
}

/// The picture of one view: 8-bit luminance, row by row from the top.
pub fn picture(scene: &Scene, view: usize) -> Vec<u8> {
    let n = (scene.lattice.size * scene.lattice.size) as usize;
    let mut nearest = vec![(u32::MAX, u32::MAX); n];
    let mut lum = vec![scene.params.background; n];
    for_each_fragment(scene, view, &mut |i, j, f| {
        let pixel = (j * scene.lattice.size + i) as usize;
        let key = (u32::from(f.z), f.face);
        if key < nearest[pixel] {
            nearest[pixel] = key;
            lum[pixel] = f.lum;
        }
    });
    lum
}

/// Calls `on(i, j, fragment)` for every fragment of every triangle, triangles by ascending id.
pub fn for_each_fragment(scene: &Scene, view: usize, on: &mut impl FnMut(i32, i32, Fragment)) {
    let lattice = &scene.lattice;
    let cull = scene.culls_front(view);
    for (id, face) in scene.faces.iter().enumerate() {
        let Some(face) = face else { continue };
        let points = face.vertices.map(|v| scene.screen_points(v)[view]);
        // Most triangles of a dense model cover no pixel: shade only those that may.
        if lattice.setup(points, [0; 3], cull).is_none() {
            continue;
        }
        let lum = scene.face_luminance(view, face);
        let Some(s) = lattice.setup(points, lum, cull) else { continue };
        for_each_pixel(&s, |i, j| {
            on(i, j, fragment(&s, id as u32, i, j));
        });
    }
}

/// Calls `on(i, j)` for every pixel that a triangle covers, row by row.
pub fn for_each_pixel(s: &Setup, mut on: impl FnMut(i32, i32)) {
    for j in s.rect.y0..=s.rect.y1 {
        let row = s.rect.x0..=s.rect.x1;
        // Triangles are convex: what a row covers is one run.
        for i in row.skip_while(|i| !s.covers(*i, j)).take_while(|i| s.covers(*i, j)) {
            on(i, j);
        }
    }
}

/// What a triangle leaves in a pixel that it covers.
pub fn fragment(s: &Setup, face: u32, i: i32, j: i32) -> Fragment {
    Fragment { z: s.depth.at(i, j, DEPTH_BITS) as u16, lum: s.lum.at(i, j, LUM_BITS) as u8, face }
}

/// Sum over all pictures of the squared difference to the reference.
pub fn energy(reference: &Reference, pictures: &[Vec<u8>]) -> u64 {
    let square = |a: u8, b: u8| u64::from(a.abs_diff(b)).pow(2);
    reference
        .pictures
        .iter()
        .zip(pictures)
        .map(|(r, p)| r.iter().zip(p).map(|(a, b)| square(*a, *b)).sum::<u64>())
        .sum()
}
