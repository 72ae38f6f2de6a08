//! What travels: one input texture to the device, one output buffer back, both grown as needed.

use super::{
    super::{device::Gpu, evaluator::RenderError},
    kernels::{Kernels, bind},
    pack::Word,
};

/// log2 of the input's width in words (`INPUT_WIDTH_BITS` in common.wgsl).
pub(super) const INPUT_WIDTH_BITS: u32 = 10;
/// Words in a row of the input.
const INPUT_WIDTH: usize = 1 << INPUT_WIDTH_BITS;
/// log2 of the width of the texels (`TEXELS_WIDTH_BITS` in common.wgsl).
pub(super) const TEXELS_WIDTH_BITS: u32 = 12;
/// Texels in a row.
const TEXELS_WIDTH: usize = 1 << TEXELS_WIDTH_BITS;
/// First size of the input, rows.
const FIRST_ROWS: u32 = 64;
/// First size of the output, bytes.
const FIRST_OUTPUT: u64 = 1 << 18;

/// Input, output, and the mappable copy of the output.
pub(super) struct Work {
    input: wgpu::Texture,
    texels: wgpu::TextureView,
    output: wgpu::Buffer,
    readback: wgpu::Buffer,
    bound: wgpu::BindGroup,
}

impl Work {
    /// With these texels.
    pub(super) fn new(gpu: &Gpu, kernels: &Kernels, texels: &[u32]) -> Result<Self, RenderError> {
        let texels = texel_texture(gpu, texels)?;
        let input = input_texture(gpu, FIRST_ROWS);
        let output = output_buffer(gpu, FIRST_OUTPUT);
        let readback = readback_buffer(gpu, FIRST_OUTPUT);
        let bound = bind_work(gpu, kernels, [&input_view(&input), &texels], &output);
        Ok(Self { input, texels, output, readback, bound })
    }

    /// The bind group of input and output.
    pub(super) fn bound(&self) -> &wgpu::BindGroup {
        &self.bound
    }

    /// Writes the words to the input, and makes room for `n_results` numbers of output.
    pub(super) fn write(
        &mut self,
        gpu: &Gpu,
        kernels: &Kernels,
        words: &mut Vec<Word>,
        n_results: usize,
    ) -> Result<(), RenderError> {
        words.resize(words.len().next_multiple_of(INPUT_WIDTH), [0; 4]);
        let n_rows = (words.len() / INPUT_WIDTH) as u32;
        self.reserve(gpu, kernels, n_rows, 4 * n_results as u64)?;
        if n_rows == 0 {
            return Ok(());
        }
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some((INPUT_WIDTH * size_of::<Word>()) as u32),
            rows_per_image: None,
        };
        let extent =
            wgpu::Extent3d { width: INPUT_WIDTH as u32, height: n_rows, depth_or_array_layers: 1 };
        let bytes = bytemuck::cast_slice(words);
        gpu.queue.write_texture(self.input.as_image_copy(), bytes, layout, extent);
        Ok(())
    }

    /// Whether the device binds so much input and so many numbers of output.
    pub(super) fn has_room(gpu: &Gpu, words: &[Word], n_results: usize) -> bool {
        let n_bytes = (n_results * size_of::<u32>()) as u64;
        words.len().div_ceil(INPUT_WIDTH) <= gpu.max_texture_side as usize
            && n_bytes <= gpu.max_binding
    }

    /// Makes room for so many rows of input and bytes of output.
    pub(super) fn reserve(
        &mut self,
        gpu: &Gpu,
        kernels: &Kernels,
        n_rows: u32,
        n_bytes: u64,
    ) -> Result<(), RenderError> {
        for (what, size, limit) in [
            ("input rows", u64::from(n_rows), u64::from(gpu.max_texture_side)),
            ("output bytes", n_bytes, gpu.max_binding),
        ] {
            if size > limit {
                let message = format!("{size} {what} are more than its {limit}");
                return Err(RenderError::Device(message));
            }
        }
        if n_rows <= self.input.height() && n_bytes <= self.output.size() {
            return Ok(());
        }
        if n_rows > self.input.height() {
            self.input = input_texture(gpu, n_rows.next_power_of_two().min(gpu.max_texture_side));
        }
        if n_bytes > self.output.size() {
            self.output = output_buffer(gpu, n_bytes.next_power_of_two().min(gpu.max_binding));
        }
        let textures = [&input_view(&self.input), &self.texels];
        self.bound = bind_work(gpu, kernels, textures, &self.output);
        Ok(())
    }

    /// Submits the recorded work, waits, and hands `take` the first `n_results` numbers of output
    /// and then the whole of `other`.
    pub(super) fn finish<T>(
        &mut self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
        n_results: usize,
        other: Option<&wgpu::Buffer>,
        take: impl FnOnce(&[u32]) -> T,
    ) -> Result<T, RenderError> {
        let results = 4 * n_results as u64;
        let size = results + other.map_or(0, wgpu::Buffer::size);
        if size > self.readback.size() {
            self.readback = readback_buffer(gpu, size.next_power_of_two());
        }
        let parts = [(&self.output, 0, results)];
        let other = other.map(|buffer| (buffer, results, buffer.size()));
        for (buffer, at, size) in parts.into_iter().chain(other).filter(|p| p.2 > 0) {
            encoder.copy_buffer_to_buffer(buffer, 0, &self.readback, at, Some(size));
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.read(&self.readback, size, |bytes| take(bytemuck::cast_slice(bytes)))
    }
}

fn input_texture(gpu: &Gpu, n_rows: u32) -> wgpu::Texture {
    let usage = wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_DST;
    let extent = (INPUT_WIDTH as u32, n_rows, 1);
    gpu.texture("input", extent, wgpu::TextureFormat::Rgba32Uint, usage)
}

fn input_view(input: &wgpu::Texture) -> wgpu::TextureView {
    input.create_view(&wgpu::TextureViewDescriptor::default())
}

/// The texels, row after row.
fn texel_texture(gpu: &Gpu, texels: &[u32]) -> Result<wgpu::TextureView, RenderError> {
    let n_rows = (texels.len().div_ceil(TEXELS_WIDTH) as u32).max(1);
    if n_rows > gpu.max_texture_side {
        let message = format!("{} texels do not fit one texture of it", texels.len());
        return Err(RenderError::Device(message));
    }
    let usage = wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_DST;
    let extent = (TEXELS_WIDTH as u32, n_rows, 1);
    let texture = gpu.texture("texels", extent, wgpu::TextureFormat::R32Uint, usage);
    gpu.check()?;
    let mut padded = texels.to_vec();
    padded.resize(TEXELS_WIDTH * n_rows as usize, 0);
    let layout = wgpu::TexelCopyBufferLayout {
        offset: 0,
        bytes_per_row: Some((TEXELS_WIDTH * size_of::<u32>()) as u32),
        rows_per_image: None,
    };
    let bytes = bytemuck::cast_slice(&padded);
    gpu.queue.write_texture(texture.as_image_copy(), bytes, layout, texture.size());
    Ok(texture.create_view(&wgpu::TextureViewDescriptor::default()))
}

fn output_buffer(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    gpu.buffer("output", size, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC)
}

fn readback_buffer(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    gpu.buffer("readback", size, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)
}

fn bind_work(
    gpu: &Gpu,
    kernels: &Kernels,
    [input, texels]: [&wgpu::TextureView; 2],
    output: &wgpu::Buffer,
) -> wgpu::BindGroup {
    let resources = [
        wgpu::BindingResource::TextureView(input),
        output.as_entire_binding(),
        wgpu::BindingResource::TextureView(texels),
    ];
    bind(gpu, &kernels.work, &resources)
}
