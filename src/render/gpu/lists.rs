//! The fragment lists of a group of views on the device: where they lie, and how they are built.
//!
//! Invariants:
//! 1. no binding exceeds the adapter's limit: views are split into groups, each with its buffers;
//! 2. no fragment is lost: kernels count what they had no room for, and the lists are then built
//!    anew from the scene with more room, or an error says that the adapter has none.

use std::ops::Range;

use super::super::{
    device::Gpu,
    evaluator::{Reference, RenderError},
    scene::Scene,
};
use super::{
    kernels::{Kernel, Kernels, Params, bind},
    pack::{TRIANGLE_WORDS, Word, triangle},
    work::Work,
};

/// Fragments of a pixel that lie in layers (`N_LAYERS` in common.wgsl); the rest are chained.
pub(super) const N_LAYERS: u32 = 4;
/// Pixels / 4 of a work item, at most (`BAND_QUADS` in evaluate.wgsl).
pub(super) const BAND_CELLS: u32 = 64;
/// Bytes of `Counters` in lists.wgsl.
const COUNTERS_SIZE: u64 = 16;
/// Bytes of a stack node.
const NODE_SIZE: u64 = 16;
/// Pixels that one invocation visits of one triangle while building, about.
const BAND_PIXELS: u32 = 4096;
/// Triangles of one submission while building.
const BUILD_CHUNK: usize = 1 << 15;

/// Where pixels lie in the buffers.
#[derive(Clone, Debug)]
pub(super) struct Geometry {
    pub(super) n_views: usize,
    pub(super) size: u32,
    /// Pixels from one row to the next: the size, rounded up to whole vectors.
    pub(super) row_stride: u32,
    pub(super) views_per_group: usize,
    /// Pixels / 4 of a work item, at most.
    pub(super) band_cells: u32,
}

impl Geometry {
    pub(super) fn new(gpu: &Gpu, scene: &Scene) -> Result<Self, RenderError> {
        let size = scene.lattice.size as u32;
        let row_stride = size.next_multiple_of(4);
        let view_bytes = u64::from(size * row_stride * N_LAYERS) * 4;
        // Half as much again for the pool.
        let views_per_group = (gpu.max_binding * 2 / (view_bytes * 3)) as usize;
        if views_per_group == 0 {
            let message = format!("pictures of {size}² pixels do not fit its buffers");
            return Err(RenderError::Device(message));
        }
        let n_views = scene.n_views();
        let views_per_group = views_per_group.min(n_views.max(1));
        Ok(Self { n_views, size, row_stride, views_per_group, band_cells: BAND_CELLS })
    }

    /// Pixels of a view, padding included.
    pub(super) fn view_pixels(&self) -> u32 {
        self.row_stride * self.size
    }

    /// The group that a view belongs to.
    pub(super) fn group_of(&self, view: usize) -> u32 {
        (view / self.views_per_group) as u32
    }

    /// Address of a pixel's front within its group.
    pub(super) fn address(&self, view: usize, x: u32, y: u32) -> u32 {
        (view % self.views_per_group) as u32 * self.view_pixels() + y * self.row_stride + x
    }

    /// The views of each group.
    pub(super) fn groups(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        (0..self.n_views)
            .step_by(self.views_per_group)
            .map(|first| first..(first + self.views_per_group).min(self.n_views))
    }
}

/// The lists of a few views.
pub(super) struct Group {
    pub(super) views: Range<usize>,
    /// What every dispatch on these lists is told.
    pub(super) params: Params,
    pub(super) depth_lum: wgpu::Buffer,
    pub(super) counters: wgpu::Buffer,
    pub(super) bound_read: wgpu::BindGroup,
    pub(super) bound_write: wgpu::BindGroup,
}

/// What the kernels counted; mirrors `Counters` in lists.wgsl.
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Counters {
    pub(super) pool_used: u32,
    pub(super) nodes_used: u32,
    pub(super) pool_short: u32,
    pub(super) too_deep: u32,
}

impl Counters {
    /// Fails when a pixel has more fragments than the kernels can follow.
    pub(super) fn check_depth(&self) -> Result<(), RenderError> {
        if self.too_deep == 0 {
            return Ok(());
        }
        Err(RenderError::Device("a pixel has more than 60,000 triangles behind it".into()))
    }
}

/// Builds the lists of some views from the scene, with room for `n_pool` fragments beyond the
/// layers, or more if it takes more.
pub(super) fn build(
    gpu: &Gpu,
    kernels: &mut Kernels,
    work: &mut Work,
    (geometry, views, n_pool): (&Geometry, Range<usize>, u32),
    (scene, reference): (&Scene, &Reference),
) -> Result<Group, RenderError> {
    kernels.prepare(gpu, &[Kernel::Clear, Kernel::Append, Kernel::Sort])?;
    let mut n_pool = n_pool;
    let mut stacks = Stacks::new(gpu, kernels, geometry, geometry.view_pixels())?;
    loop {
        let group = Group::new(gpu, kernels, geometry, scene, views.clone(), n_pool)?;
        let mut used = Counters::default();
        let mut view = views.start;
        while view < views.end {
            group.clear_view(gpu, kernels, work, (geometry, view), reference)?;
            used = group.build_view(gpu, kernels, work, (geometry, view), (scene, &stacks))?;
            used.check_depth()?;
            if used.nodes_used > stacks.n_nodes {
                stacks = Stacks::new(gpu, kernels, geometry, used.nodes_used)?;
                continue;
            }
            view += 1;
        }
        if used.pool_short == 0 {
            return Ok(group);
        }
        n_pool = used.pool_used.saturating_add(used.pool_used / 2);
    }
}

impl Group {
    fn new(
        gpu: &Gpu,
        kernels: &Kernels,
        geometry: &Geometry,
        scene: &Scene,
        views: Range<usize>,
        n_pool: u32,
    ) -> Result<Self, RenderError> {
        let n_pixels = geometry.view_pixels() * views.len() as u32;
        let n_addresses = u64::from(n_pixels) * u64::from(N_LAYERS) + u64::from(n_pool);
        if n_addresses * 4 > gpu.max_binding {
            let message = "the model is too deep for its buffers; use another device".into();
            return Err(RenderError::Device(message));
        }
        let storage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_SRC
            | wgpu::BufferUsages::COPY_DST;
        let faces = gpu.buffer("faces", n_addresses * 4, storage);
        let depth_lum = gpu.buffer("depth and luminance", n_addresses * 4, storage);
        let links = gpu.buffer("links", u64::from(n_pixels + n_pool) * 4, storage);
        let counters = gpu.buffer("counters", COUNTERS_SIZE, storage);
        let read = [&faces, &depth_lum, &links];
        let bound_read = bind(gpu, &kernels.lists_read, &read);
        let write = [&faces, &depth_lum, &links, &counters];
        let bound_write = bind(gpu, &kernels.lists_write, &write);
        let params = Params {
            row_stride: geometry.row_stride,
            n_pixels,
            n_addresses: n_addresses as u32,
            size: geometry.size as i32,
            first_center: scene.lattice.first_center,
            sub_bits: scene.lattice.sub_bits,
            background: 0xffff << 16 | u32::from(scene.params.background) << 8,
            ..Params::default()
        };
        Ok(Self { views, params, depth_lum, counters, bound_read, bound_write })
    }

    /// Fragments of the pool.
    pub(super) fn n_pool(&self) -> u32 {
        self.params.n_addresses - N_LAYERS * self.params.n_pixels
    }

    /// Where a view's front fragments lie in `depth_lum`: (buffer, first byte, bytes).
    pub(super) fn fronts(&self, geometry: &Geometry, view: usize) -> (&wgpu::Buffer, u64, u64) {
        let at = u64::from(geometry.address(view, 0, 0)) * 4;
        (&self.depth_lum, at, u64::from(geometry.view_pixels()) * 4)
    }

    /// Empties a view's lists and enters its reference picture.
    fn clear_view(
        &self,
        gpu: &Gpu,
        kernels: &Kernels,
        work: &mut Work,
        (geometry, view): (&Geometry, usize),
        reference: &Reference,
    ) -> Result<(), RenderError> {
        let words = padded_picture(geometry, &reference.pictures[view]);
        work.write(gpu, kernels, &[&words], 0)?;
        let mut encoder =
            gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let params = Params {
                n_items: geometry.view_pixels(),
                first_pixel: geometry.address(view, 0, 0),
                ..self.params
            };
            kernels.dispatch(&mut pass, Kernel::Clear, &[&self.bound_write, work.bound()], &params);
        }
        gpu.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Rasters every triangle into a view's (empty) lists.
    fn build_view(
        &self,
        gpu: &Gpu,
        kernels: &Kernels,
        work: &mut Work,
        (geometry, view): (&Geometry, usize),
        (scene, stacks): (&Scene, &Stacks),
    ) -> Result<Counters, RenderError> {
        let begin =
            || gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let base = Params {
            first_pixel: geometry.address(view, 0, 0),
            n_nodes: stacks.n_nodes,
            ..self.params
        };
        let mut encoder = begin();
        encoder.clear_buffer(&stacks.heads, 0, None);
        encoder.clear_buffer(&self.counters, 4, Some(4));
        for first in (0..scene.faces.len()).step_by(BUILD_CHUNK) {
            let last = (first + BUILD_CHUNK).min(scene.faces.len());
            let (bands, triangles) = pack_faces(scene, view, first..last);
            let shift = bands.len() as u32;
            let bands: Vec<Word> = bands.iter().map(|b| [b[0] + shift, b[1], b[2], 0]).collect();
            work.write(gpu, kernels, &[&bands, &triangles], 0)?;
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                let params = Params { n_items: shift, ..base };
                let groups = [&self.bound_write, work.bound(), &stacks.bound];
                kernels.dispatch(&mut pass, Kernel::Append, &groups, &params);
            }
            // The input is written anew for the next chunk, so this one must be under way first.
            gpu.queue.submit([std::mem::replace(&mut encoder, begin()).finish()]);
        }
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let params = Params { n_items: geometry.view_pixels(), ..base };
            let groups = [&self.bound_write, work.bound(), &stacks.bound];
            kernels.dispatch(&mut pass, Kernel::Sort, &groups, &params);
        }
        let counters = [(&self.counters, 0, COUNTERS_SIZE)];
        work.finish(gpu, encoder, 0, &counters, |words| {
            *bytemuck::from_bytes(bytemuck::cast_slice(words))
        })
    }
}

/// The unsorted per-pixel stacks that one view's lists are built from.
struct Stacks {
    heads: wgpu::Buffer,
    n_nodes: u32,
    bound: wgpu::BindGroup,
}

impl Stacks {
    fn new(
        gpu: &Gpu,
        kernels: &Kernels,
        geometry: &Geometry,
        n_nodes: u32,
    ) -> Result<Self, RenderError> {
        if u64::from(n_nodes) * NODE_SIZE > gpu.max_binding {
            let message = format!("{n_nodes} fragments in one view do not fit its buffers");
            return Err(RenderError::Device(message));
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let heads = gpu.buffer("stack heads", u64::from(geometry.view_pixels()) * 4, usage);
        let nodes = gpu.buffer("stack nodes", u64::from(n_nodes) * NODE_SIZE, usage);
        let bound = bind(gpu, &kernels.stacks, &[&heads, &nodes]);
        Ok(Self { heads, n_nodes, bound })
    }
}

/// Bands of rows (triangle's place, first row, last row) and packed triangles of some faces.
fn pack_faces(scene: &Scene, view: usize, faces: Range<usize>) -> (Vec<Word>, Vec<Word>) {
    let (mut bands, mut triangles) = (Vec::new(), Vec::new());
    let cull = scene.culls_front(view);
    for id in faces {
        let Some(face) = &scene.faces[id] else { continue };
        let points = face.vertices.map(|v| scene.screen_points(v)[view]);
        // Most triangles of a dense model cover no pixel: shade only those that may.
        if scene.lattice.setup(points, [0; 3], cull).is_none() {
            continue;
        }
        let lum = scene.face_luminance(view, face);
        let Some(setup) = scene.lattice.setup(points, lum, cull) else { continue };
        let at = triangles.len() as u32;
        triangles
            .extend_from_slice(&triangle(points, &setup, id as u32) as &[Word; TRIANGLE_WORDS]);
        let width = (setup.rect.x1 - setup.rect.x0 + 1) as u32;
        let rows = (BAND_PIXELS / width).max(1);
        let (first, last) = (setup.rect.y0 as u32, setup.rect.y1 as u32);
        bands.extend(
            (first..=last).step_by(rows as usize).map(|y| [at, y, (y + rows - 1).min(last), 0]),
        );
    }
    (bands, triangles)
}

/// A picture with its rows padded to whole vectors, four luminances a word.
fn padded_picture(geometry: &Geometry, picture: &[u8]) -> Vec<Word> {
    let mut bytes =
        vec![0_u8; (geometry.view_pixels() as usize).next_multiple_of(size_of::<Word>())];
    let (size, stride) = (geometry.size as usize, geometry.row_stride as usize);
    for (row, from) in bytes.chunks_mut(stride).zip(picture.chunks(size)) {
        row[..from.len()].copy_from_slice(from);
    }
    bytes
        .chunks_exact(size_of::<Word>())
        .map(|w| std::array::from_fn(|k| u32::from_le_bytes(std::array::from_fn(|b| w[4 * k + b]))))
        .collect()
}
