//! The fragment lists on the device: where they lie, and how they are built.
//!
//! Invariants:
//! 1. the first four fragments of each pixel lie in two textures of one layer a view (`near` holds
//!    the first two, and the reference luminance), the rest in a pool of chained nodes;
//! 2. no fragment is lost: kernels count what they had no room for, and the lists are then built
//!    anew from the scene with more room, or an error says that the adapter has none.

use std::ops::Range;

use super::super::{
    device::Gpu,
    evaluator::{Reference, RenderError},
    scene::Scene,
};
use super::{
    encoder,
    kernels::{Kernel, Kernels, Params, bind},
    pack::{TRIANGLE_WORDS, Word, paint_words, triangle},
    work::Work,
};

/// Bytes of a pool node or a stack node.
const NODE_SIZE: u64 = 16;
/// Pixels that one invocation visits of one triangle while building, about.
const BAND_PIXELS: u32 = 4096;
/// Triangles of one submission while building.
const BUILD_CHUNK: usize = 1 << 15;

/// The lists of all views.
pub(super) struct Lists {
    /// What every dispatch on these lists is told.
    pub(super) params: Params,
    pub(super) counters: wgpu::Buffer,
    pub(super) bound_read: wgpu::BindGroup,
    pub(super) bound_write: wgpu::BindGroup,
}

/// What the kernels counted; mirrors `Counters` in lists.wgsl.
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Counters {
    /// Nodes of the pool that were asked for.
    pub(super) pool_used: u32,
    /// Building: nodes of the stacks that were asked for.
    pub(super) nodes_used: u32,
    /// Not 0 when the pool had too few.
    pub(super) pool_short: u32,
    /// Not 0 when a list is longer than kernels can follow.
    pub(super) too_deep: u32,
    /// Not 0 when the driver ended loops early.
    pub(super) cut_off: u32,
    /// Building: not 0 when stacks are left to sort.
    pub(super) unsorted: u32,
}

/// Offset of [`Counters::nodes_used`] in the buffer.
const NODES_USED_AT: u64 = 4;
/// Offset of [`Counters::unsorted`].
const UNSORTED_AT: u64 = 20;

impl Counters {
    /// From the numbers that came back.
    pub(super) fn of(words: &[u32]) -> Self {
        match *words {
            [pool_used, nodes_used, pool_short, too_deep, cut_off, unsorted, ..] => {
                Self { pool_used, nodes_used, pool_short, too_deep, cut_off, unsorted }
            }
            _ => Self::default(),
        }
    }

    /// Fails when a pixel has more fragments than the kernels can follow.
    pub(super) fn check_depth(&self) -> Result<(), RenderError> {
        if self.too_deep == 0 {
            return Ok(());
        }
        let text = "a pixel has more than 4,096 triangles behind it; use the device `cpu`";
        Err(RenderError::Device(text.into()))
    }
}

/// The longest list, fragments (`MAX_DEPTH` in lists.wgsl, and the number in the message above).
#[cfg(test)]
pub(super) const MAX_DEPTH: u32 = 4096;

/// What the lists are built with and from.
pub(super) struct Builder<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a mut Kernels,
    pub(super) work: &'a mut Work,
    pub(super) scene: &'a Scene,
    pub(super) reference: &'a Reference,
    /// log2 of the lanes that share an item.
    pub(super) lane_bits: u32,
}

impl Builder<'_> {
    /// Builds the lists with room for `n_pool` fragments beyond the first four of each pixel, or
    /// more if it takes more.
    pub(super) fn build(mut self, n_pool: u32) -> Result<Lists, RenderError> {
        self.kernels.prepare(self.gpu, &[Kernel::Clear, Kernel::Append, Kernel::Sort])?;
        let mut n_pool = n_pool;
        let mut stacks = Stacks::new(self.gpu, self.kernels, self.scene, self.n_pixels())?;
        loop {
            let mut lists = Lists::new(self.gpu, self.kernels, self.scene, n_pool)?;
            lists.params.lane_bits = self.lane_bits;
            let mut used = Counters::default();
            let mut view = 0;
            while view < self.scene.n_views() {
                self.clear_view(&lists, view)?;
                used = self.build_view(&lists, &stacks, view)?;
                used.check_depth()?;
                if used.cut_off != 0 {
                    let text = "its driver ended loops early; use the device `cpu`";
                    return Err(RenderError::Device(text.into()));
                }
                if used.nodes_used > stacks.n_nodes {
                    let n_nodes = used.nodes_used;
                    stacks = Stacks::new(self.gpu, self.kernels, self.scene, n_nodes)?;
                } else {
                    view += 1;
                }
            }
            if used.pool_short == 0 {
                return Ok(lists);
            }
            n_pool = used.pool_used.saturating_add(used.pool_used / 2);
        }
    }

    /// Pixels of a view.
    fn n_pixels(&self) -> u32 {
        self.scene.lattice.size.unsigned_abs().pow(2)
    }

    /// Empties a view's lists and enters its reference picture and the weights of its pixels.
    fn clear_view(&mut self, lists: &Lists, view: usize) -> Result<(), RenderError> {
        let picture = &self.reference.pictures[view];
        let mut words = picture_words(picture);
        match self.reference.weights_in(view) {
            Some(weights) => words.extend(picture_words(weights)),
            None => words.extend(picture_words(&vec![1; picture.len()])),
        }
        self.work.write(self.gpu, self.kernels, &mut words, 0)?;
        let mut encoder = encoder(self.gpu);
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let n_items = self.n_pixels();
            let params = Params { n_items, view: view as u32, ..lists.params };
            let bound = [&lists.bound_write, self.work.bound()];
            self.kernels.dispatch(&mut pass, Kernel::Clear, &bound, &params);
        }
        self.gpu.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Rasters every triangle into a view's (empty) lists.
    fn build_view(
        &mut self,
        lists: &Lists,
        stacks: &Stacks,
        view: usize,
    ) -> Result<Counters, RenderError> {
        let base = Params { view: view as u32, n_nodes: stacks.n_nodes, ..lists.params };
        let mut commands = encoder(self.gpu);
        commands.clear_buffer(&stacks.tops, 0, None);
        commands.clear_buffer(&lists.counters, NODES_USED_AT, Some(4));
        for first in (0..self.scene.faces.len()).step_by(BUILD_CHUNK) {
            let last = (first + BUILD_CHUNK).min(self.scene.faces.len());
            let (mut words, n_items) = pack_faces(self.scene, view, first..last);
            self.work.write(self.gpu, self.kernels, &mut words, 0)?;
            self.dispatch(
                &mut commands,
                Kernel::Append,
                &Params { n_items, ..base },
                lists,
                stacks,
            );
            // The input is written anew for the next chunk, so this one must be under way first.
            self.gpu.queue.submit([std::mem::replace(&mut commands, encoder(self.gpu)).finish()]);
        }
        self.sort(commands, lists, stacks, &Params { n_items: self.n_pixels(), ..base })
    }

    /// Sorts the stacks into the lists, in as many dispatches as it takes.
    fn sort(
        &mut self,
        mut commands: wgpu::CommandEncoder,
        lists: &Lists,
        stacks: &Stacks,
        params: &Params,
    ) -> Result<Counters, RenderError> {
        loop {
            commands.clear_buffer(&lists.counters, UNSORTED_AT, Some(4));
            self.dispatch(&mut commands, Kernel::Sort, params, lists, stacks);
            let counters = Some(&lists.counters);
            let used = self.work.finish(self.gpu, commands, 0, counters, Counters::of)?;
            if used.unsorted == 0 || used.too_deep != 0 {
                return Ok(used);
            }
            commands = encoder(self.gpu);
        }
    }

    fn dispatch(
        &self,
        commands: &mut wgpu::CommandEncoder,
        kernel: Kernel,
        params: &Params,
        lists: &Lists,
        stacks: &Stacks,
    ) {
        let mut pass = commands.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        let bound = [&lists.bound_write, self.work.bound(), &stacks.bound];
        self.kernels.dispatch(&mut pass, kernel, &bound, params);
    }
}

impl Lists {
    fn new(gpu: &Gpu, kernels: &Kernels, scene: &Scene, n_pool: u32) -> Result<Self, RenderError> {
        if u64::from(n_pool) * NODE_SIZE > gpu.max_binding {
            let message = "the model is too deep for its buffers; use another device".into();
            return Err(RenderError::Device(message));
        }
        let side = scene.lattice.size.unsigned_abs();
        let extent = (side, side, scene.n_views() as u32);
        let usage = wgpu::TextureUsages::STORAGE_BINDING;
        let texture = |label, format| gpu.texture(label, extent, format, usage);
        let near = array_view(&texture("near", wgpu::TextureFormat::Rgba32Uint));
        let deep = array_view(&texture("deep", wgpu::TextureFormat::Rgba32Uint));
        let heads = array_view(&texture("heads", wgpu::TextureFormat::R32Uint));
        let storage = wgpu::BufferUsages::STORAGE;
        let pool = gpu.buffer("pool", u64::from(n_pool) * NODE_SIZE, storage);
        let counters = gpu.buffer(
            "counters",
            size_of::<Counters>() as u64,
            storage | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
        );
        gpu.check()?;
        let textures = [&near, &deep, &heads].map(wgpu::BindingResource::TextureView);
        let buffers = [&pool, &counters].map(wgpu::Buffer::as_entire_binding);
        let resources = [&textures[..], &buffers[..]].concat();
        let bound_read = bind(gpu, &kernels.lists_read, &resources[..4]);
        let bound_write = bind(gpu, &kernels.lists_write, &resources);
        let params = Params {
            size: scene.lattice.size,
            first_center: scene.lattice.first_center,
            sub_bits: scene.lattice.sub_bits,
            background: 0xffff << 16 | u32::from(scene.params.background) << 8,
            n_pool,
            ..Params::default()
        };
        Ok(Self { params, counters, bound_read, bound_write })
    }
}

fn array_view(texture: &wgpu::Texture) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        ..wgpu::TextureViewDescriptor::default()
    })
}

/// The unsorted per-pixel stacks that one view's lists are built from.
struct Stacks {
    tops: wgpu::Buffer,
    n_nodes: u32,
    bound: wgpu::BindGroup,
}

impl Stacks {
    fn new(gpu: &Gpu, kernels: &Kernels, scene: &Scene, n_nodes: u32) -> Result<Self, RenderError> {
        if u64::from(n_nodes) * NODE_SIZE > gpu.max_binding {
            let message = format!("{n_nodes} fragments in one view do not fit its buffers");
            return Err(RenderError::Device(message));
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let n_pixels = u64::from(scene.lattice.size.unsigned_abs()).pow(2);
        let tops = gpu.buffer("stack tops", 4 * n_pixels, usage);
        let nodes = gpu.buffer("stack nodes", u64::from(n_nodes) * NODE_SIZE, usage);
        let resources = [tops.as_entire_binding(), nodes.as_entire_binding()];
        let bound = bind(gpu, &kernels.stacks, &resources);
        Ok(Self { tops, n_nodes, bound })
    }
}

/// Bands of rows (triangle's place, first row, last row, 0), how many, and the packed triangles of
/// some faces behind them.
fn pack_faces(scene: &Scene, view: usize, faces: Range<usize>) -> (Vec<Word>, u32) {
    let (mut bands, mut triangles): (Vec<Word>, Vec<Word>) = (Vec::new(), Vec::new());
    for id in faces {
        let Some(face) = &scene.faces[id] else { continue };
        let points = face.vertices.map(|v| scene.screen_points(v)[view]);
        // Most triangles of a dense model cover no pixel: shade only those that may.
        let cull = scene.cull(view, &face.surface);
        if scene.lattice.setup(points, [0; 3], cull).is_none() {
            continue;
        }
        let Some(setup) = scene.set_up(view, face) else { continue };
        let at = triangles.len() as u32;
        let (mut words, _) = triangle(points, &setup, id as u32);
        if let Some(paint) = &setup.paint {
            words[2][3] = TRIANGLE_WORDS as u32;
            triangles.extend(words);
            triangles.extend(paint_words(paint));
        } else {
            triangles.extend(words);
        }
        let width = (setup.rect.x1 - setup.rect.x0 + 1) as u32;
        let rows = (BAND_PIXELS / width).max(1);
        let (first, last) = (setup.rect.y0 as u32, setup.rect.y1 as u32);
        bands.extend(
            (first..=last).step_by(rows as usize).map(|y| [at, y, (y + rows - 1).min(last), 0]),
        );
    }
    let n_bands = bands.len() as u32;
    bands.iter_mut().for_each(|band| band[0] += n_bands);
    bands.append(&mut triangles);
    (bands, n_bands)
}

/// A picture, sixteen luminances a word.
fn picture_words(picture: &[u8]) -> Vec<Word> {
    let number = |b: &[u8], k: usize| -> u32 {
        (0..4).map(|n| u32::from(b.get(4 * k + n).copied().unwrap_or(0)) << (8 * n)).sum()
    };
    picture.chunks(size_of::<Word>()).map(|b| std::array::from_fn(|k| number(b, k))).collect()
}
