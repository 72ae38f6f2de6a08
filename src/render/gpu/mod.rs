//! The device evaluator: the evaluator's specification as WGSL compute kernels.
//!
//! Invariants:
//! 1. the device sees integers only; every float is settled on the host, by the code that the
//!    native twin uses;
//! 2. results do not depend on the adapter, the batch, or the order in which its items run;
//! 3. `bounds` on the host mirrors the fronts on the device, so that moves that happen behind what
//!    is seen cost nothing but their projection.
//!
//! One submission a batch: items sorted by area go up, a 32-bit sum for each comes back, the host
//! adds them up in 64 bits.

mod kernels;
mod lists;
mod pack;
mod work;

use std::ops::Range;

use rayon::prelude::*;

use self::{
    kernels::{Kernel, Kernels, Params},
    lists::{Counters, Geometry, Group},
    pack::{ITEM_WORDS, Item, Packed, Packer, Purpose, Word},
    work::Work,
};
use super::{
    device::Gpu,
    evaluator::{Evaluator, Reference, RenderError},
    lattice::PixelRect,
    moves::Move,
    scene::Scene,
    tiles::TileBounds,
};

/// Moves of one submission.
const BATCH: usize = 512;

/// The device evaluator.
pub struct Device {
    gpu: Gpu,
    kernels: Kernels,
    work: Work,
    geometry: Geometry,
    groups: Vec<Group>,
    bounds: Vec<TileBounds>,
    reference: Reference,
    energy: u64,
}

impl Device {
    /// Renders the scene on an open device and gets ready to judge moves.
    pub(super) fn new(gpu: Gpu, scene: &Scene, reference: Reference) -> Result<Self, RenderError> {
        let mut kernels = Kernels::new(&gpu);
        let mut work = Work::new(&gpu, &kernels);
        let geometry = Geometry::new(&gpu, scene)?;
        let mut groups = Vec::new();
        for views in geometry.groups() {
            let n_pool = geometry.view_pixels() / 8 * views.len() as u32;
            let what = (&geometry, views, n_pool);
            groups.push(lists::build(&gpu, &mut kernels, &mut work, what, (scene, &reference))?);
        }
        kernels.prepare(&gpu, &[Kernel::Evaluate, Kernel::Update, Kernel::Bounds])?;
        let bounds = vec![TileBounds::new(geometry.size as i32); geometry.n_views];
        let mut device =
            Self { gpu, kernels, work, geometry, groups, bounds, reference, energy: 0 };
        for view in 0..device.geometry.n_views {
            let fronts = device.fronts(view)?;
            device.energy += squared_difference(&device.reference.pictures[view], &fronts);
            device.refresh_bounds(view, &fronts);
        }
        Ok(device)
    }

    /// A view's front fragments, row by row: z << 16 | luminance << 8 | reference.
    fn fronts(&mut self, view: usize) -> Result<Vec<u32>, RenderError> {
        let group = &self.groups[self.geometry.group_of(view) as usize];
        let fronts = [group.fronts(&self.geometry, view)];
        let encoder = encoder(&self.gpu);
        let (size, stride) = (self.geometry.size as usize, self.geometry.row_stride as usize);
        self.work.finish(&self.gpu, encoder, 0, &fronts, |words| {
            words.chunks(stride).flat_map(|row| &row[..size]).copied().collect()
        })
    }

    fn refresh_bounds(&mut self, view: usize, fronts: &[u32]) {
        let size = self.geometry.size as usize;
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
    fn pack(&self, scene: &Scene, moves: &[Move]) -> Packed {
        let pack = |packer: &mut Packer, (first, moves): (usize, &[Move])| {
            let mut out = Packed::default();
            for (owner, mv) in (first as u32..).zip(moves) {
                let what = (owner, mv);
                packer.pack(scene, &self.geometry, &self.bounds, what, Purpose::Judge, &mut out);
            }
            out
        };
        const CHUNK: usize = 8;
        if moves.len() <= CHUNK {
            return pack(&mut Packer::default(), (0, moves));
        }
        let parts: Vec<Packed> = moves
            .par_chunks(CHUNK)
            .enumerate()
            .map_init(Packer::default, |packer, (k, chunk)| pack(packer, (k * CHUNK, chunk)))
            .collect();
        let mut all = Packed::default();
        parts.iter().for_each(|part| all.append(part));
        all
    }

    /// Judges at most [`BATCH`] moves with one submission.
    fn judge(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let mut deltas = vec![0; moves.len()];
        let packed = self.pack(scene, moves);
        if packed.items.is_empty() {
            return Ok(deltas);
        }
        let (order, runs) = arrange(&packed.items);
        let data_at = (order.len() * ITEM_WORDS) as u32;
        let items: Vec<Word> =
            order.iter().flat_map(|k| packed.items[*k as usize].words(data_at)).collect();
        self.work.write(&self.gpu, &self.kernels, &[&items, &packed.data], order.len())?;
        let mut encoder = encoder(&self.gpu);
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            for run in &runs {
                self.dispatch_evaluate(&mut pass, &packed.items[order[run.start] as usize], run);
            }
        }
        self.work.finish(&self.gpu, encoder, order.len(), &[], |sums| {
            for (k, sum) in order.iter().zip(sums) {
                let owner = packed.items[*k as usize].owner;
                deltas[owner as usize] += i64::from(*sum as i32);
            }
        })?;
        Ok(deltas)
    }

    /// Adds the dispatch of a run of items of the same group.
    fn dispatch_evaluate(&self, pass: &mut wgpu::ComputePass<'_>, item: &Item, run: &Range<usize>) {
        let group = &self.groups[item.group as usize];
        let params = Params {
            first_item: run.start as u32,
            n_items: run.len() as u32,
            output_at: run.start as u32,
            ..group.params
        };
        let bound = [&group.bound_read, self.work.bound()];
        self.kernels.dispatch(pass, Kernel::Evaluate, &bound, &params);
    }

    /// Brings the lists up to date with a move. Returns what the kernels counted, by group, and
    /// sets the depth bounds.
    fn update(&mut self, scene: &Scene, mv: &Move) -> Result<Vec<Counters>, RenderError> {
        let mut packer = Packer::default();
        let mut packed = Packed::default();
        let what = (0, mv);
        packer.pack(scene, &self.geometry, &self.bounds, what, Purpose::Make, &mut packed);
        let (order, runs) = arrange(&packed.items);
        let tiles = self.touched_tiles(scene, &packer);
        let data_at = order.len() * ITEM_WORDS;
        let items: Vec<Word> =
            order.iter().flat_map(|k| packed.items[*k as usize].words(data_at as u32)).collect();
        let tile_words: Vec<Word> = tiles.iter().map(|(_, tile)| Self::tile_word(tile)).collect();
        let parts: [&[Word]; 3] = [&items, &packed.data, &tile_words];
        self.work.write(&self.gpu, &self.kernels, &parts, tiles.len())?;
        let mut encoder = encoder(&self.gpu);
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            for run in &runs {
                let group = &self.groups[packed.items[order[run.start] as usize].group as usize];
                let params = Params {
                    first_item: run.start as u32,
                    n_items: run.len() as u32,
                    ..group.params
                };
                let bound = [&group.bound_write, self.work.bound()];
                self.kernels.dispatch(&mut pass, Kernel::Update, &bound, &params);
            }
            self.dispatch_bounds(&mut pass, &tiles, (data_at + packed.data.len()) as u32);
        }
        let counters: Vec<_> = self.groups.iter().map(|g| (&g.counters, 0, 16)).collect();
        let bounds = &mut self.bounds;
        self.work.finish(&self.gpu, encoder, tiles.len(), &counters, |words| {
            let (far, counters) = words.split_at(tiles.len());
            for ((view, tile), far) in tiles.iter().zip(far) {
                bounds[*view].set(&tile.rect, *far);
            }
            bytemuck::cast_slice(counters).to_vec()
        })
    }

    /// The tiles that the packer's move touches, by view and so by group.
    fn touched_tiles(&self, scene: &Scene, packer: &Packer) -> Vec<(usize, Tile)> {
        let mut tiles = Vec::new();
        for (view, bounds) in self.bounds.iter().enumerate() {
            let (rect, _) = packer.projected.extent(&scene.lattice, view);
            if !rect.is_empty() {
                tiles.extend(bounds.touched(&rect).map(|rect| {
                    let first = self.geometry.address(view, rect.x0 as u32, rect.y0 as u32);
                    (view, Tile { first, rect })
                }));
            }
        }
        tiles
    }

    fn tile_word(tile: &Tile) -> Word {
        let r = &tile.rect;
        [tile.first, (r.x1 - r.x0 + 1) as u32, (r.y1 - r.y0 + 1) as u32, 0]
    }

    fn dispatch_bounds(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        tiles: &[(usize, Tile)],
        tiles_at: u32,
    ) {
        let mut first = 0;
        for part in
            tiles.chunk_by(|a, b| self.geometry.group_of(a.0) == self.geometry.group_of(b.0))
        {
            let group = &self.groups[self.geometry.group_of(part[0].0) as usize];
            let params = Params {
                first_item: tiles_at + first,
                n_items: part.len() as u32,
                output_at: first,
                ..group.params
            };
            let bound = [&group.bound_read, self.work.bound()];
            self.kernels.dispatch(pass, Kernel::Bounds, &bound, &params);
            first += part.len() as u32;
        }
    }

    /// Builds the lists of groups whose pool ran short from the scene, with more room.
    fn rebuild(&mut self, scene: &Scene, counters: &[Counters]) -> Result<(), RenderError> {
        for (k, used) in counters.iter().enumerate() {
            if used.pool_short == 0 {
                continue;
            }
            let old = &self.groups[k];
            let n_pool = (2 * old.n_pool()).max(used.pool_used);
            let what = (&self.geometry, old.views.clone(), n_pool);
            let with = (scene, &self.reference);
            let group = lists::build(&self.gpu, &mut self.kernels, &mut self.work, what, with)?;
            let views = group.views.clone();
            self.groups[k] = group;
            for view in views {
                let fronts = self.fronts(view)?;
                self.refresh_bounds(view, &fronts);
            }
        }
        Ok(())
    }
}

/// A tile of a view: its first pixel's address, its pixels.
struct Tile {
    first: u32,
    rect: PixelRect,
}

impl Evaluator for Device {
    fn name(&self) -> String {
        self.gpu.info.name.clone()
    }

    fn evaluate(&mut self, scene: &Scene, moves: &[Move]) -> Result<Vec<i64>, RenderError> {
        let mut deltas = Vec::with_capacity(moves.len());
        for batch in moves.chunks(BATCH) {
            deltas.extend(self.judge(scene, batch)?);
        }
        Ok(deltas)
    }

    fn commit(&mut self, scene: &mut Scene, mv: &Move) -> Result<i64, RenderError> {
        let n_slots = mv.added.iter().map(|a| a.face as usize + 1).max().unwrap_or(0);
        if n_slots > scene.faces.len() {
            scene.faces.resize(n_slots, None);
        }
        let delta = self.judge(scene, std::slice::from_ref(mv))?[0];
        let counters = self.update(scene, mv)?;
        for used in &counters {
            used.check_depth()?;
        }
        scene.apply(mv);
        self.rebuild(scene, &counters)?;
        self.energy = self.energy.saturating_add_signed(delta);
        Ok(delta)
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

/// The order in which items run, and the runs of items of the same group. Items of like area stand
/// together, for they share a processor's vector and take as long as the largest.
fn arrange(items: &[Item]) -> (Vec<u32>, Vec<Range<usize>>) {
    let mut order: Vec<u32> = (0..items.len() as u32).collect();
    let rank = |k: u32| {
        let item = &items[k as usize];
        (item.group, item.added.1, item.n_cells())
    };
    order.sort_unstable_by_key(|k| rank(*k));
    let mut runs = Vec::new();
    let mut first = 0;
    for run in order.chunk_by(|a, b| items[*a as usize].group == items[*b as usize].group) {
        runs.push(first..first + run.len());
        first += run.len();
    }
    (order, runs)
}

fn squared_difference(reference: &[u8], fronts: &[u32]) -> u64 {
    reference
        .iter()
        .zip(fronts)
        .map(|(r, front)| u64::from(r.abs_diff((front >> 8) as u8)).pow(2))
        .sum()
}

#[cfg(test)]
mod tests;
