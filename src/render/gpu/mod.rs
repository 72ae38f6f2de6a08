//! The device evaluator: the evaluator's specification as WGSL compute kernels.
//!
//! Invariants:
//! 1. the device sees integers only; every float is settled on the host, by the code that the
//!    native twin uses;
//! 2. results do not depend on the adapter, the batch, or the order in which its items run;
//! 3. `bounds` on the host mirrors the fronts on the device, so that moves that happen behind what
//!    is seen cost nothing but their projection;
//! 4. kernels notice when the driver ends their loops early (lavapipe does), and what they did is
//!    then done again in smaller parts: no driver's limit changes a result.
//!
//! One submission a batch: items sorted by area go up, a 32-bit sum for each comes back, the host
//! adds them up in 64 bits.

mod kernels;
mod lists;
mod pack;
mod work;

use std::{collections::BTreeSet, ops::Range};

use rayon::prelude::*;

use self::{
    kernels::{Kernel, Kernels, Params},
    lists::{Builder, Counters, Lists},
    pack::{BAND_CELLS, ITEM_WORDS, Item, Packed, Packer, Purpose, Word},
    work::Work,
};
use super::{
    device::{Gpu, SOFTWARE},
    evaluator::{Evaluator, Reference, RenderError},
    lattice::PixelRect,
    moves::Move,
    scene::Scene,
    tiles::TileBounds,
};

/// Moves of one submission.
const BATCH: usize = 512;
/// What is left of an item's cells when it has to be cut smaller.
const CUT_TO: u32 = 8;
/// log2 of the lanes that share an item where there are thousands of them: one for each cell.
const SHARED: u32 = BAND_CELLS.ilog2();

/// The device evaluator.
pub struct Device {
    gpu: Gpu,
    kernels: Kernels,
    work: Work,
    lists: Lists,
    bounds: Vec<TileBounds>,
    reference: Reference,
    energy: u64,
    /// Pixels along a side of a picture.
    size: usize,
    /// Cells of an item of a move that is made, at most: fewer where lists are long.
    make_cells: u32,
}

/// What became of a move that was made.
struct Made {
    /// The change of energy, if no driver stood in the way of finding it.
    delta: Option<i64>,
    used: Counters,
}

impl Device {
    /// Renders the scene on an open device and gets ready to judge moves. A processor computes an
    /// item in one lane, a GPU in many.
    pub(super) fn new(gpu: Gpu, scene: &Scene, reference: Reference) -> Result<Self, RenderError> {
        let lane_bits = if gpu.info.kind == SOFTWARE { 0 } else { SHARED };
        Self::with_lanes(gpu, scene, reference, lane_bits)
    }

    fn with_lanes(
        gpu: Gpu,
        scene: &Scene,
        reference: Reference,
        lane_bits: u32,
    ) -> Result<Self, RenderError> {
        let mut kernels = Kernels::new(&gpu, scene.texels.has_glow());
        let mut work = Work::new(&gpu, &kernels, scene.texels.words())?;
        let n_pool = (scene.n_pixels() / 32) as u32;
        let builder = Builder {
            gpu: &gpu,
            kernels: &mut kernels,
            work: &mut work,
            scene,
            reference: &reference,
            lane_bits,
        };
        let lists = builder.build(n_pool)?;
        kernels.prepare(&gpu, &[Kernel::Update, Kernel::Bounds, Kernel::Fronts])?;
        let size = scene.lattice.size;
        let bounds = vec![TileBounds::new(size); scene.n_views()];
        let (energy, size, make_cells) = (0, size as usize, BAND_CELLS);
        let mut device =
            Self { gpu, kernels, work, lists, bounds, reference, energy, size, make_cells };
        device.look_again(scene)?;
        Ok(device)
    }

    /// Finds the energy and the bounds anew from the lists.
    fn look_again(&mut self, scene: &Scene) -> Result<(), RenderError> {
        self.energy = 0;
        for view in 0..scene.n_views() {
            let fronts = self.fronts(view)?;
            self.energy += u64::from(scene.views[view].weight)
                * self.reference.difference(view, fronts.iter().map(|front| (front >> 8) as u8));
            self.refresh_bounds(view, &fronts);
        }
        Ok(())
    }

    /// A view's front fragments, row by row: z << 16 | luminance << 8 | reference.
    fn fronts(&mut self, view: usize) -> Result<Vec<u32>, RenderError> {
        let n_pixels = self.size * self.size;
        self.work.reserve(&self.gpu, &self.kernels, 0, 4 * n_pixels as u64)?;
        let mut encoder = encoder(&self.gpu);
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let n_items = n_pixels as u32;
            let params = Params { n_items, view: view as u32, ..self.lists.params };
            let bound = [&self.lists.bound_read, self.work.bound()];
            self.kernels.dispatch(&mut pass, Kernel::Fronts, &bound, &params);
        }
        self.work.finish(&self.gpu, encoder, n_pixels, None, <[u32]>::to_vec)
    }

    fn refresh_bounds(&mut self, view: usize, fronts: &[u32]) {
        let size = self.size;
        let bounds = &mut self.bounds[view];
        let last = size as i32 - 1;
        let tiles: Vec<_> =
            bounds.touched(&PixelRect { x0: 0, y0: 0, x1: last, y1: last }).collect();
        for tile in tiles {
            let rows = tile.y0 as usize..=tile.y1 as usize;
            let far = rows
                .flat_map(|y| &fronts[y * size + tile.x0 as usize..=y * size + tile.x1 as usize])
                .map(|front| front >> 16)
                .max();
            bounds.set(&tile, far.unwrap_or(u32::MAX));
        }
    }

    /// Packs moves for judging, in parallel; the order of the items means nothing.
    fn pack(&self, scene: &Scene, moves: &[Move], max_cells: u32) -> Packed {
        let pack = |packer: &mut Packer, (first, moves): (usize, &[Move])| {
            let mut out = Packed::default();
            for (owner, mv) in (first as u32..).zip(moves) {
                let what = (owner, mv);
                packer.pack(scene, &self.bounds, what, Purpose::Judge, &mut out);
            }
            out
        };
        const CHUNK: usize = 8;
        if moves.len() <= CHUNK {
            return pack(&mut Packer::new(max_cells), (0, moves));
        }
        let parts: Vec<Packed> = moves
            .par_chunks(CHUNK)
            .enumerate()
            .map_init(
                || Packer::new(max_cells),
                |packer, (k, chunk)| pack(packer, (k * CHUNK, chunk)),
            )
            .collect();
        let mut all = Packed::default();
        parts.iter().for_each(|part| all.append(part));
        all
    }

    /// Judges at most [`BATCH`] moves with one submission (or with more, where they are more than the device
    /// binds), in items of at most so many cells, and again in smaller ones those moves whose items the driver cut
    /// off.
    fn judge(
        &mut self,
        scene: &Scene,
        moves: &[Move],
        max_cells: u32,
    ) -> Result<Vec<i64>, RenderError> {
        let mut deltas = vec![0; moves.len()];
        let packed = self.pack(scene, moves, max_cells);
        if packed.items.is_empty() {
            return Ok(deltas);
        }
        let order = Order::of(&packed.items);
        self.kernels.prepare(&self.gpu, &order.kernels())?;
        let mut words = order.words(&packed);
        let n_results = self.n_results(order.items.len());
        if moves.len() > 1 && !Work::has_room(&self.gpu, &words, n_results) {
            let (first, second) = moves.split_at(moves.len() / 2);
            deltas = self.judge(scene, first, max_cells)?;
            deltas.extend(self.judge(scene, second, max_cells)?);
            return Ok(deltas);
        }
        self.work.write(&self.gpu, &self.kernels, &mut words, n_results)?;
        let mut encoder = encoder(&self.gpu);
        self.dispatch_judging(&mut encoder, &order);
        let mut cut_off = BTreeSet::new();
        let n_lanes = self.n_results(1);
        self.work.finish(&self.gpu, encoder, n_results, None, |sums| {
            for (k, sums) in order.items.iter().zip(sums.chunks(n_lanes)) {
                let item = &packed.items[*k as usize];
                let owner = item.owner as usize;
                match item.weighed(scene, sums) {
                    Some(delta) => deltas[owner] += delta,
                    None => _ = cut_off.insert(owner),
                }
            }
        })?;
        if cut_off.is_empty() {
            return Ok(deltas);
        }
        if max_cells == 1 {
            let text = "a move takes more steps than its driver allows; use the device `cpu`";
            return Err(RenderError::Device(text.into()));
        }
        let again: Vec<Move> = cut_off.iter().map(|owner| moves[*owner].clone()).collect();
        let found = self.judge(scene, &again, (max_cells / CUT_TO).max(1))?;
        for (owner, delta) in cut_off.into_iter().zip(found) {
            deltas[owner] = delta;
        }
        Ok(deltas)
    }

    /// Numbers of output of so many items.
    fn n_results(&self, n_items: usize) -> usize {
        n_items << self.lists.params.lane_bits
    }

    /// Adds the dispatches that judge the items, one for each kernel.
    fn dispatch_judging(&self, encoder: &mut wgpu::CommandEncoder, order: &Order) {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        for (kernel, items) in &order.runs {
            let params = Params {
                first_item: items.start as u32,
                n_items: items.len() as u32,
                output_at: self.n_results(items.start) as u32,
                ..self.lists.params
            };
            let bound = [&self.lists.bound_read, self.work.bound()];
            self.kernels.dispatch(&mut pass, *kernel, &bound, &params);
        }
    }

    /// Judges a move and brings the lists and depth bounds up to date with it, with one
    /// submission.
    fn make(&mut self, scene: &Scene, mv: &Move) -> Result<Made, RenderError> {
        let mut packer = Packer::new(self.make_cells);
        let mut packed = Packed::default();
        packer.pack(scene, &self.bounds, (0, mv), Purpose::Make, &mut packed);
        let order = Order::of(&packed.items);
        self.kernels.prepare(&self.gpu, &order.kernels())?;
        let tiles = self.touched_tiles(scene, &packer);
        let mut words = order.words(&packed);
        let tiles_at = words.len();
        words.extend(tiles.iter().map(|(view, t)| {
            let end = t.x1 as u32 | (t.y1 as u32) << 16;
            [t.x0 as u32, t.y0 as u32, end, *view as u32]
        }));
        let n_items = order.items.len();
        let (n_lanes, n_sums) = (self.n_results(1), self.n_results(n_items));
        let n_results = n_sums + tiles.len();
        self.work.write(&self.gpu, &self.kernels, &mut words, n_results)?;
        let mut encoder = encoder(&self.gpu);
        self.dispatch_judging(&mut encoder, &order);
        self.dispatch_update(&mut encoder, n_items, (tiles_at, tiles.len()));
        let bounds = &mut self.bounds;
        self.work.finish(&self.gpu, encoder, n_results, Some(&self.lists.counters), |words| {
            let (sums, rest) = words.split_at(n_sums);
            let (far, counters) = rest.split_at(tiles.len());
            for ((view, tile), far) in tiles.iter().zip(far) {
                bounds[*view].set(tile, *far);
            }
            let judged = order.items[..order.n_judged()].iter().zip(sums.chunks(n_lanes));
            let deltas = judged.map(|(k, sums)| packed.items[*k as usize].weighed(scene, sums));
            Made { delta: deltas.sum(), used: Counters::of(counters) }
        })
    }

    /// Adds the dispatches that update the lists and find the bounds of (place, number) tiles.
    fn dispatch_update(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        n_items: usize,
        (tiles_at, n_tiles): (usize, usize),
    ) {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let params = Params { n_items: n_items as u32, ..self.lists.params };
        let bound = [&self.lists.bound_write, self.work.bound()];
        self.kernels.dispatch(&mut pass, Kernel::Update, &bound, &params);
        let params = Params {
            first_item: tiles_at as u32,
            n_items: n_tiles as u32,
            output_at: self.n_results(n_items) as u32,
            ..self.lists.params
        };
        let bound = [&self.lists.bound_read, self.work.bound()];
        self.kernels.dispatch(&mut pass, Kernel::Bounds, &bound, &params);
    }

    /// The tiles that the packer's move touches, with their views.
    fn touched_tiles(&self, scene: &Scene, packer: &Packer) -> Vec<(usize, PixelRect)> {
        let mut tiles = Vec::new();
        for (view, bounds) in self.bounds.iter().enumerate() {
            let (rect, _) = packer.projected.extent(&scene.lattice, view);
            if !rect.is_empty() {
                tiles.extend(bounds.touched(&rect).map(|tile| (view, tile)));
            }
        }
        tiles
    }

    /// Builds the lists anew from the scene, with more room.
    fn rebuild(&mut self, scene: &Scene, used: &Counters) -> Result<(), RenderError> {
        let builder = Builder {
            gpu: &self.gpu,
            kernels: &mut self.kernels,
            work: &mut self.work,
            scene,
            reference: &self.reference,
            lane_bits: self.lists.params.lane_bits,
        };
        self.lists = builder.build(used.pool_used.saturating_mul(2))?;
        self.look_again(scene)
    }
}

impl Evaluator for Device {
    fn name(&self) -> String {
        self.gpu.info.name.clone()
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let mut deltas = Vec::with_capacity(moves.len());
        for batch in moves.chunks(BATCH) {
            deltas.extend(self.judge(scene, batch, BAND_CELLS)?);
        }
        Ok(deltas)
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        scene.make_room(mv);
        let Made { delta, used } = self.make(scene, mv)?;
        used.check_depth()?;
        scene.apply(mv);
        let is_cut_off = used.cut_off != 0 || delta.is_none();
        if is_cut_off {
            self.make_cells = (self.make_cells / CUT_TO).max(1);
        }
        let before = self.energy;
        if is_cut_off || used.pool_short != 0 {
            self.rebuild(scene, &used)?;
        } else {
            self.energy = before.saturating_add_signed(delta.unwrap_or(0));
        }
        Ok(delta.unwrap_or(self.energy as i64 - before as i64))
    }

    fn energy(&self) -> u64 {
        self.energy
    }

    fn picture(&mut self, _scene: &Scene, view: usize) -> Result<Vec<u8>, RenderError> {
        Ok(self.fronts(view)?.iter().map(|front| (front >> 8) as u8).collect())
    }
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
}

/// The order in which items run. Items of like area stand together, for they share a processor's
/// vector and take as long as the largest.
struct Order {
    /// Indices of the items: those to judge, then those that are hidden.
    items: Vec<u32>,
    /// Ranges of `items` that one dispatch judges.
    runs: Vec<(Kernel, Range<usize>)>,
}

impl Order {
    fn of(items: &[Item]) -> Self {
        let mut order: Vec<u32> = (0..items.len() as u32).collect();
        let kernel = |k: u32| {
            let item = &items[k as usize];
            let kernel = Kernel::judging(item.is_plain, item.added.1, item.removed.1);
            (item.is_hidden, kernel)
        };
        order.sort_unstable_by_key(|k| {
            let item = &items[*k as usize];
            (kernel(*k), item.is_folded, item.area())
        });
        let mut runs = Vec::new();
        let mut first = 0;
        for part in order.chunk_by(|a, b| kernel(*a) == kernel(*b)) {
            let (is_hidden, kernel) = kernel(part[0]);
            if !is_hidden {
                runs.push((kernel, first..first + part.len()));
            }
            first += part.len();
        }
        Self { items: order, runs }
    }

    /// The kernels that judge.
    fn kernels(&self) -> Vec<Kernel> {
        self.runs.iter().map(|run| run.0).collect()
    }

    /// Items to judge.
    fn n_judged(&self) -> usize {
        self.runs.last().map_or(0, |run| run.1.end)
    }

    /// The input: the items in this order, then their data.
    fn words(&self, packed: &Packed) -> Vec<Word> {
        let data_at = self.items.len() * ITEM_WORDS;
        let mut words = Vec::with_capacity(data_at + packed.data.len() + 1024);
        for k in &self.items {
            words.extend(packed.items[*k as usize].words(data_at as u32));
        }
        words.extend_from_slice(&packed.data);
        words
    }
}

#[cfg(test)]
mod stress;
#[cfg(test)]
mod tests;
