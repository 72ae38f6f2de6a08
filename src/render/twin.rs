//! The native twin: the evaluator's specification in Rust, fast enough to serve CPU nodes.
//!
//! One move in one view: bound the pixels it can touch; if everything there is nearer than the
//! move, stop (true of half the views: the surface's far side); raster the added triangles into a
//! small buffer, eight pixels at a time; then compare, pixel by pixel, the nearest fragment that
//! stays with the nearest that comes.

use rayon::prelude::*;

use super::{
    evaluator::{Evaluator, Reference, RenderError},
    fragments::FragmentLists,
    lattice::{DEPTH_BITS, LUM_BITS, PixelRect, Setup},
    moves::{Move, Projected},
    raster::{self, Fragment},
    scene::Scene,
    simd,
};

/// The native evaluator.
pub struct Twin {
    views: Vec<FragmentLists>,
    reference: Reference,
    energy: u64,
    n_face_slots: usize,
    size: i32,
}

impl Twin {
    /// Renders the scene and gets ready to judge moves.
    pub fn new(scene: &Scene, reference: Reference) -> Self {
        let views: Vec<_> =
            (0..scene.n_views()).into_par_iter().map(|v| build_lists(scene, v)).collect();
        let pictures: Vec<_> = views.iter().map(FragmentLists::picture).collect();
        let energy = raster::energy(&reference, &pictures);
        Self { views, reference, energy, n_face_slots: scene.faces.len(), size: scene.lattice.size }
    }
}

/// An id above every triangle's, for the background: slots are 32-bit, this one is never used.
const NO_FACE: u32 = u32::MAX - 1;

fn build_lists(scene: &Scene, view: usize) -> FragmentLists {
    let size = scene.lattice.size;
    let mut lists = FragmentLists::new(size, scene.params.background, NO_FACE);
    raster::for_each_fragment(scene, view, &mut |pixel, f| lists.insert(pixel, f));
    lists.refresh_tiles(&PixelRect { x0: 0, y0: 0, x1: size - 1, y1: size - 1 });
    lists
}

impl Evaluator for Twin {
    fn name(&self) -> String {
        "native".into()
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let slots = self.n_face_slots;
        let this = &*self;
        if moves.len() < 3 {
            let mut scratch = Scratch::new(slots);
            return Ok(moves.iter().map(|mv| this.delta(scene, mv, &mut scratch)).collect());
        }
        Ok(moves
            .par_iter()
            .with_min_len(2)
            .map_init(|| Scratch::new(slots), |scratch, mv| this.delta(scene, mv, scratch))
            .collect())
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        let added_slots = mv.added.iter().map(|a| a.face as usize + 1).max().unwrap_or(0);
        if added_slots > scene.faces.len() {
            scene.faces.resize(added_slots, None);
        }
        self.n_face_slots = scene.faces.len();
        let mut scratch = Scratch::new(self.n_face_slots);
        let delta = self.delta(scene, mv, &mut scratch);
        let projected = &scratch.projected;
        self.views.par_iter_mut().enumerate().for_each(|(view, lists)| {
            update_view(scene, mv, projected, view, lists);
        });
        self.energy = self.energy.saturating_add_signed(delta);
        scene.apply(mv);
        Ok(delta)
    }

    fn energy(&self) -> u64 {
        self.energy
    }

    fn picture(&mut self, _scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError> {
        Ok(self.views[view].picture())
    }
}

/// Replaces the fragments of the removed triangles by those of the added ones.
fn update_view(
    scene: &Scene,
    mv: &Move,
    projected: &Projected,
    view: usize,
    lists: &mut FragmentLists,
) {
    let (rect, _) = projected.extent(&scene.lattice, view);
    if rect.is_empty() {
        return;
    }
    let size = scene.lattice.size;
    for j in rect.y0..=rect.y1 {
        for i in rect.x0..=rect.x1 {
            lists.retain((j * size + i) as usize, |f| !mv.removed.contains(&f));
        }
    }
    for (k, added) in mv.added.iter().enumerate() {
        let points = projected.added_points(k, view);
        let lum = projected.added_luminance(scene, mv, k, view);
        let Some(s) = scene.lattice.setup(points, lum, scene.culls_front(view)) else { continue };
        for j in s.rect.y0..=s.rect.y1 {
            for i in s.rect.x0..=s.rect.x1 {
                if s.covers(i, j) {
                    let z = s.depth.at(i, j, DEPTH_BITS) as u16;
                    let lum = s.lum.at(i, j, LUM_BITS) as u8;
                    lists.insert((j * size + i) as usize, Fragment { z, lum, face: added.face });
                }
            }
        }
    }
    lists.refresh_tiles(&rect);
}

/// Working memory of one thread.
struct Scratch {
    projected: Projected,
    setups: Vec<(u32, Setup)>,
    /// `z << 16 | rank` of the nearest added fragment of each pixel of the rectangle.
    nearest: Vec<u32>,
    /// `marks[face] == serial` for the triangles of the current move that go.
    marks: Vec<u32>,
    serial: u32,
}

impl Scratch {
    fn new(n_face_slots: usize) -> Self {
        Self {
            projected: Projected::default(),
            setups: Vec::new(),
            nearest: Vec::new(),
            marks: vec![0; n_face_slots],
            serial: 0,
        }
    }
}

impl Twin {
    /// The change of energy of one move, all views.
    fn delta(&self, scene: &Scene, mv: &Move, scratch: &mut Scratch) -> i64 {
        scratch.projected.fill(scene, mv);
        scratch.serial += 1;
        for f in &mv.removed {
            scratch.marks[*f as usize] = scratch.serial;
        }
        (0..self.views.len()).map(|v| self.delta_in_view(scene, mv, v, scratch)).sum()
    }

    fn delta_in_view(&self, scene: &Scene, mv: &Move, view: usize, scratch: &mut Scratch) -> i64 {
        let lists = &self.views[view];
        let (rect, nearest_z) = scratch.projected.extent(&scene.lattice, view);
        if rect.is_empty() || lists.bounds().hides(&rect, u32::from(nearest_z)) {
            return 0;
        }
        let cull = scene.culls_front(view);
        scratch.setups.clear();
        for (k, added) in mv.added.iter().enumerate() {
            let points = scratch.projected.added_points(k, view);
            let lum = scratch.projected.added_luminance(scene, mv, k, view);
            if let Some(setup) = scene.lattice.setup(points, lum, cull) {
                scratch.setups.push((added.face, setup));
            }
        }
        // Ranks follow ids, so that the lesser id wins a tie in depth.
        scratch.setups.sort_unstable_by_key(|s| s.0);
        let stride = simd::raster(&scratch.setups, &rect, &mut scratch.nearest);
        self.resolve(view, &rect, stride, scratch)
    }

    /// Compares what stays with what comes, pixel by pixel.
    fn resolve(&self, view: usize, rect: &PixelRect, stride: usize, scratch: &Scratch) -> i64 {
        let lists = &self.views[view];
        let picture = &self.reference.pictures[view];
        let size = self.size;
        let (marks, serial) = (&scratch.marks, scratch.serial);
        let stays = |face: u32| marks.get(face as usize).is_none_or(|m| *m != serial);
        let mut sum = 0_i64;
        for j in rect.y0..=rect.y1 {
            let fronts = lists.row(j, rect.x0, rect.x1);
            let reference = &picture[(j * size + rect.x0) as usize..=(j * size + rect.x1) as usize];
            let coming = &scratch.nearest[(j - rect.y0) as usize * stride..][..fronts.len()];
            for (i, ((front, &r), &key)) in fronts.iter().zip(reference).zip(coming).enumerate() {
                let front_stays = stays(front.face);
                if front_stays && key >> 16 > front.z() || front_stays && key == u32::MAX {
                    continue;
                }
                let stay = lists.nearest(*front, stays);
                let mut lum = stay.lum();
                if key != u32::MAX {
                    let (face, setup) = &scratch.setups[(key & 0xffff) as usize];
                    if (key >> 16, *face) < (stay.z(), stay.face) {
                        lum = setup.lum.at(rect.x0 + i as i32, j, LUM_BITS) as u8;
                    }
                }
                let square = |l: u8| i64::from((i32::from(l) - i32::from(r)).pow(2));
                sum += square(lum) - square(front.lum());
            }
        }
        sum
    }
}
