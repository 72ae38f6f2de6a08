//! The native twin: the evaluator's specification in Rust, fast enough to serve CPU nodes.
//!
//! One move in one view: bound the pixels it can touch; if everything there is nearer than the
//! move, stop (true of half the views: the surface's far side); raster the added triangles into a
//! small buffer, eight pixels at a time; then compare, pixel by pixel, the nearest fragment that
//! stays with the nearest that comes. A batch goes view by view, so that one view's fronts stay in
//! cache while every move is judged in it.

use rayon::prelude::*;

use super::{
    evaluator::{Evaluator, Reference, RenderError},
    fragments::{Cell, FragmentLists},
    lattice::{LUM_BITS, PixelRect, Setup},
    moves::{Move, Projected},
    raster,
    scene::Scene,
    simd,
};

/// The native evaluator.
pub struct Twin {
    views: Vec<ViewState>,
    reference: Reference,
    energy: u64,
    /// Moves of the last batch in every picture; kept for its memory.
    projected: Vec<Projected>,
}

/// One view and the working memory of whoever judges in it.
struct ViewState {
    lists: FragmentLists,
    scratch: Scratch,
}

impl Twin {
    /// Renders the scene and gets ready to judge moves.
    pub fn new(scene: &Scene, reference: Reference) -> Self {
        let view = |v| ViewState { lists: build_lists(scene, v), scratch: Scratch::default() };
        let views: Vec<_> = (0..scene.n_views()).into_par_iter().map(view).collect();
        let pictures: Vec<_> = views.iter().map(|v| v.lists.picture()).collect();
        let energy = raster::energy(&reference, &pictures);
        Self { views, reference, energy, projected: Vec::new() }
    }

    /// Brings the moves of a batch into every picture.
    fn project(&mut self, scene: &Scene, moves: &[Move]) {
        self.projected.resize_with(moves.len().max(self.projected.len()), Projected::default);
        let projected = &mut self.projected[..moves.len()];
        projected.par_iter_mut().zip(moves).with_min_len(8).for_each(|(p, mv)| p.fill(scene, mv));
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
        self.project(scene, moves);
        let (projected, reference) = (&self.projected, &self.reference);
        let by_view: Vec<Vec<i64>> = (self.views.par_iter_mut().enumerate())
            .map(|(view, state)| {
                let mut judge = Judge::new(scene, view, state, reference);
                moves.iter().zip(projected).map(|(mv, p)| judge.delta(mv, p)).collect()
            })
            .collect();
        Ok((0..moves.len()).map(|m| by_view.iter().map(|v| v[m]).sum()).collect())
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        let added_slots = mv.added.iter().map(|a| a.face as usize + 1).max().unwrap_or(0);
        if added_slots > scene.faces.len() {
            scene.faces.resize(added_slots, None);
        }
        self.project(scene, std::slice::from_ref(mv));
        let (projected, reference, shown) = (&self.projected[0], &self.reference, &*scene);
        let delta = (self.views.par_iter_mut().enumerate().with_min_len(5))
            .map(|(view, state)| {
                let delta = Judge::new(shown, view, state, reference).delta(mv, projected);
                update_view(shown, mv, projected, view, &mut state.lists);
                delta
            })
            .sum();
        self.energy = self.energy.saturating_add_signed(delta);
        scene.apply(mv);
        Ok(delta)
    }

    fn energy(&self) -> u64 {
        self.energy
    }

    fn picture(&mut self, _scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError> {
        Ok(self.views[view].lists.picture())
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
    let (size, cull) = (scene.lattice.size, scene.culls_front(view));
    for &id in &mv.removed {
        let Some(face) = &scene.faces[id as usize] else { continue };
        let points = face.vertices.map(|v| scene.screen_points(v)[view]);
        // Where it was drawn does not depend on its luminance.
        if let Some(s) = scene.lattice.setup(points, [0; 3], cull) {
            raster::for_each_pixel(&s, |i, j| lists.remove((j * size + i) as usize, id));
        }
    }
    for (k, added) in mv.added.iter().enumerate() {
        let points = projected.added_points(k, view);
        let lum = projected.added_luminance(scene, mv, k, view);
        if let Some(s) = scene.lattice.setup(points, lum, cull) {
            raster::for_each_pixel(&s, |i, j| {
                lists.insert((j * size + i) as usize, raster::fragment(&s, added.face, i, j));
            });
        }
    }
    lists.refresh_tiles(&rect);
}

/// Working memory of a view.
#[derive(Default)]
struct Scratch {
    setups: Vec<(u32, Setup)>,
    /// `z << 16 | rank` of the nearest added fragment of each pixel of the rectangle.
    nearest: Vec<u32>,
    /// Pixels that the move may change.
    touched: Vec<simd::Touched>,
    /// `marks[face] == serial` for the triangles of the current move that go.
    marks: Vec<u32>,
    serial: u32,
}

/// Judges moves in one view.
struct Judge<'a> {
    scene: &'a Scene,
    view: usize,
    lists: &'a FragmentLists,
    picture: &'a [u8],
    scratch: &'a mut Scratch,
}

impl<'a> Judge<'a> {
    fn new(
        scene: &'a Scene,
        view: usize,
        state: &'a mut ViewState,
        reference: &'a Reference,
    ) -> Self {
        let ViewState { lists, scratch } = state;
        scratch.marks.resize(scene.faces.len(), 0);
        Self { scene, view, lists, picture: &reference.pictures[view], scratch }
    }

    /// The change of energy of one move in this view.
    fn delta(&mut self, mv: &Move, projected: &Projected) -> i64 {
        let (scene, view) = (self.scene, self.view);
        let (rect, nearest_z) = projected.extent(&scene.lattice, view);
        if rect.is_empty() || self.lists.bounds().hides(&rect, u32::from(nearest_z)) {
            return 0;
        }
        let scratch = &mut *self.scratch;
        scratch.serial = scratch.serial.wrapping_add(1);
        for f in &mv.removed {
            scratch.marks[*f as usize] = scratch.serial;
        }
        scratch.setups.clear();
        for (k, added) in mv.added.iter().enumerate() {
            let points = projected.added_points(k, view);
            let lum = projected.added_luminance(scene, mv, k, view);
            if let Some(setup) = scene.lattice.setup(points, lum, scene.culls_front(view)) {
                scratch.setups.push((added.face, setup));
            }
        }
        // Ranks follow ids, so that the lesser id wins a tie in depth.
        scratch.setups.sort_unstable_by_key(|s| s.0);
        let going = mv.removed.iter().fold(0, |bits, f| bits | 1 << (f & 31));
        let coverage = simd::Coverage {
            setups: &scratch.setups,
            rect,
            fronts: self.lists.fronts(),
            size: scene.lattice.size,
            going,
        };
        simd::touched(&coverage, &mut scratch.nearest, &mut scratch.touched);
        self.resolve()
    }

    /// Compares what stays with what comes, pixel by pixel.
    fn resolve(&self) -> i64 {
        let (size, fronts) = (self.scene.lattice.size as u32, self.lists.fronts());
        let mut sum = 0_i64;
        for &(pixel, key) in &self.scratch.touched {
            let front = fronts[pixel as usize];
            let stays = self.stays(front.face);
            if stays && (key == u32::MAX || key >> 16 > front.z()) {
                continue;
            }
            let at = ((pixel % size) as i32, (pixel / size) as i32);
            let lum = self.new_luminance(front, stays, key, at, pixel as usize);
            let r = self.picture[pixel as usize];
            let square = |l: u8| (i32::from(l) - i32::from(r)).pow(2);
            sum += i64::from(square(lum) - square(front.lum()));
        }
        sum
    }

    /// The luminance of a pixel after the move.
    #[inline(always)]
    fn new_luminance(
        &self,
        front: Cell,
        stays: bool,
        key: u32,
        (i, j): (i32, i32),
        pixel: usize,
    ) -> u8 {
        let stay = if stays { front } else { self.lists.nearest_behind(pixel, |f| self.stays(f)) };
        if key != u32::MAX {
            let (face, setup) = &self.scratch.setups[(key & 0xffff) as usize];
            if (key >> 16, *face) < (stay.z(), stay.face) {
                return setup.lum.at(i, j, LUM_BITS) as u8;
            }
        }
        stay.lum()
    }

    /// Whether a triangle survives the move (the background does).
    #[inline(always)]
    fn stays(&self, face: u32) -> bool {
        self.scratch.marks.get(face as usize).is_none_or(|m| *m != self.scratch.serial)
    }
}
