//! The native twin: the evaluator's specification in Rust, fast enough to serve CPU nodes.
//!
//! One move in one view: bound the pixels it can touch; if everything there is nearer than the
//! move, stop (true of half the views: the surface's far side); raster the added triangles into a
//! small buffer; then compare the nearest fragment that stays with the nearest that comes, both
//! eight pixels at a time. A batch goes view by view, so that one view's fronts stay in cache while
//! every move is judged in it.

use rayon::prelude::*;

use super::{
    evaluator::{Evaluator, Reference, RenderError},
    fragments::FragmentLists,
    kernel,
    lattice::{PixelRect, Setup},
    moves::{Move, Projected},
    raster,
    scene::Scene,
};

/// The native evaluator.
pub struct Twin {
    views: Vec<ViewState>,
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
    pub fn new(scene: &Scene, reference: &Reference) -> Self {
        let view =
            |v| ViewState { lists: build_lists(scene, v, reference), scratch: Scratch::default() };
        let views: Vec<_> = (0..scene.n_views()).into_par_iter().map(view).collect();
        let pictures: Vec<_> = views.iter().map(|v| v.lists.picture()).collect();
        let energy = raster::energy(&scene.views, reference, &pictures);
        Self { views, energy, projected: Vec::new() }
    }

    /// Brings the moves of a batch into every picture.
    fn project(&mut self, scene: &Scene, moves: &[Move]) {
        self.projected.resize_with(moves.len().max(self.projected.len()), Projected::default);
        let projected = &mut self.projected[..moves.len()];
        projected.par_iter_mut().zip(moves).with_min_len(8).for_each(|(p, mv)| p.fill(scene, mv));
    }
}

fn build_lists(scene: &Scene, view: usize, reference: &Reference) -> FragmentLists {
    let size = scene.lattice.size;
    let shown = (&*reference.pictures[view], reference.weights_in(view));
    let mut lists = FragmentLists::new(size, scene.params.background, shown);
    raster::for_each_fragment(scene, view, |_| true, &mut |i, j, f| lists.insert(i, j, f));
    lists.refresh_tiles(&PixelRect { x0: 0, y0: 0, x1: size - 1, y1: size - 1 });
    lists
}

impl Evaluator for Twin {
    fn name(&self) -> String {
        "native".into()
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        self.project(scene, moves);
        let projected = &self.projected;
        let by_view: Vec<Vec<i64>> = (self.views.par_iter_mut().enumerate())
            .map(|(view, state)| {
                let delta = |(mv, p)| view_delta(scene, mv, p, view, state);
                moves.iter().zip(projected).map(delta).collect()
            })
            .collect();
        let of_move = |m: usize| {
            by_view.iter().zip(&scene.views).map(|(v, view)| i64::from(view.weight) * v[m]).sum()
        };
        Ok((0..moves.len()).map(of_move).collect())
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        scene.make_room(mv);
        self.project(scene, std::slice::from_ref(mv));
        let (projected, shown) = (&self.projected[0], &*scene);
        let delta = (self.views.par_iter_mut().enumerate().with_min_len(5))
            .map(|(view, state)| {
                let delta = view_delta(shown, mv, projected, view, state);
                update_view(shown, mv, projected, view, &mut state.lists);
                i64::from(shown.views[view].weight) * delta
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
    for &id in &mv.removed {
        let Some(face) = &scene.faces[id as usize] else { continue };
        let points = face.vertices.map(|v| scene.screen_points(v)[view]);
        // Where it was drawn does not depend on its luminance.
        let cull = scene.cull(view, &face.surface);
        if let Some(s) = scene.lattice.setup(points, [0; 3], cull) {
            raster::for_each_pixel(&s, |i, j| lists.remove(i, j, id));
        }
    }
    for (k, added) in mv.added.iter().enumerate() {
        if let Some(s) = projected.set_up(scene, mv, k, view) {
            let texels = scene.texels.words();
            raster::for_each_pixel(&s, |i, j| {
                if !s.is_hole(texels, i, j) {
                    lists.insert(i, j, raster::fragment(&s, texels, added.face, i, j));
                }
            });
        }
    }
    lists.refresh_tiles(&rect);
}

/// Working memory of a view.
#[derive(Default)]
struct Scratch {
    setups: Vec<(u32, Setup)>,
    kernel: kernel::Scratch,
}

/// The change of energy of one move in one view.
fn view_delta(
    scene: &Scene,
    mv: &Move,
    projected: &Projected,
    view: usize,
    state: &mut ViewState,
) -> i64 {
    let ViewState { lists, scratch } = state;
    let judged = judged(scene, mv, projected, view, lists, &mut scratch.setups);
    judged.map_or(0, |j| kernel::delta(&j, &mut scratch.kernel))
}

/// Sets up the triangles that come; `None` when the move cannot be seen in this view.
fn judged<'a>(
    scene: &'a Scene,
    mv: &'a Move,
    projected: &Projected,
    view: usize,
    lists: &'a FragmentLists,
    setups: &'a mut Vec<(u32, Setup)>,
) -> Option<kernel::Judged<'a>> {
    let (rect, nearest_z) = projected.extent(&scene.lattice, view);
    if rect.is_empty() || lists.bounds().hides(&rect, u32::from(nearest_z)) {
        return None;
    }
    setups.clear();
    for (k, added) in mv.added.iter().enumerate() {
        if let Some(setup) = projected.set_up(scene, mv, k, view) {
            setups.push((added.face, setup));
        }
    }
    // Ranks follow ids, so that the lesser id wins a tie in depth.
    setups.sort_unstable_by_key(|s| s.0);
    debug_assert!(setups.len() <= kernel::MAX_ADDED);
    let texels = scene.texels.words();
    Some(kernel::Judged { setups, texels, removed: &mv.removed, rect, lists })
}

#[cfg(test)]
mod tests {
    use super::super::contract;
    use super::*;

    /// The kernel that this machine uses, against the plain one, pixel kernels being the only part
    /// of the twin that has two versions.
    #[test]
    fn both_kernels_agree() {
        for look in contract::LOOKS {
            let scene = contract::scene(9, look);
            let mut twin = Twin::new(&scene, &contract::reference(&scene, look));
            let mut n_seen = 0;
            for k in 0..60 {
                let offset = glam::DVec3::new(0.05, -0.03, 0.01) * (k % 4) as f64;
                let Some(mv) = contract::random_move(&scene, (k * 31, k), offset) else { continue };
                twin.project(&scene, std::slice::from_ref(&mv));
                for (view, state) in twin.views.iter_mut().enumerate() {
                    let ViewState { lists, scratch } = state;
                    let projected = &twin.projected[0];
                    let Some(j) = judged(&scene, &mv, projected, view, lists, &mut scratch.setups)
                    else {
                        continue;
                    };
                    let plain = kernel::delta_plain(&j, &mut kernel::Scratch::default());
                    assert_eq!(kernel::delta(&j, &mut scratch.kernel), plain);
                    n_seen += u32::from(plain != 0);
                }
            }
            assert!(n_seen > 60, "only {n_seen} moves were seen");
        }
    }
}
