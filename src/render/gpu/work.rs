//! What travels: one input buffer to the device, one output buffer back, both grown as needed.

use super::{
    super::{device::Gpu, evaluator::RenderError},
    kernels::{Kernels, bind},
    pack::Word,
};

/// Input, output, and the mappable copy of the output.
pub(super) struct Work {
    input: wgpu::Buffer,
    output: wgpu::Buffer,
    readback: wgpu::Buffer,
    bound: wgpu::BindGroup,
}

/// First size of each buffer, bytes.
const FIRST_SIZE: u64 = 1 << 20;

impl Work {
    pub(super) fn new(gpu: &Gpu, kernels: &Kernels) -> Self {
        let input = input_buffer(gpu, FIRST_SIZE);
        let output = output_buffer(gpu, FIRST_SIZE);
        let readback = readback_buffer(gpu, FIRST_SIZE);
        let bound = bind(gpu, &kernels.work, &[&input, &output]);
        Self { input, output, readback, bound }
    }

    /// The bind group of input and output.
    pub(super) fn bound(&self) -> &wgpu::BindGroup {
        &self.bound
    }

    /// Writes the parts, one after the other, to the input, and makes room for `n_results` words of
    /// output.
    pub(super) fn write(
        &mut self,
        gpu: &Gpu,
        kernels: &Kernels,
        parts: &[&[Word]],
        n_results: usize,
    ) -> Result<(), RenderError> {
        let sizes: Vec<u64> = parts.iter().map(|p| size_of_val(*p) as u64).collect();
        let (input, output) = (sizes.iter().sum(), 4 * n_results as u64);
        for (what, size) in [("input", input), ("output", output)] {
            if size > gpu.max_binding {
                let (adapter, limit) = (&gpu.info.name, gpu.max_binding);
                let message = format!("{what} of {size} bytes is over {adapter}'s {limit}");
                return Err(RenderError::Device(message));
            }
        }
        if input > self.input.size() || output > self.output.size() {
            self.input = input_buffer(gpu, grown(self.input.size(), input, gpu));
            self.output = output_buffer(gpu, grown(self.output.size(), output, gpu));
            self.bound = bind(gpu, &kernels.work, &[&self.input, &self.output]);
        }
        let mut at = 0;
        for (part, size) in parts.iter().zip(&sizes) {
            if *size > 0 {
                gpu.queue.write_buffer(&self.input, at, bytemuck::cast_slice(part));
            }
            at += size;
        }
        Ok(())
    }

    /// Submits the recorded work, waits, and hands `take` the first `n_results` words of output and
    /// then those of each of the `others`: (buffer, first byte, bytes).
    pub(super) fn finish<T>(
        &mut self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
        n_results: usize,
        others: &[(&wgpu::Buffer, u64, u64)],
        take: impl FnOnce(&[u32]) -> T,
    ) -> Result<T, RenderError> {
        let results = 4 * n_results as u64;
        let size = results + others.iter().map(|o| o.2).sum::<u64>();
        if size > self.readback.size() {
            self.readback = readback_buffer(gpu, size.next_power_of_two());
        }
        let mut at = 0;
        for (buffer, from, size) in [(&self.output, 0, results)].iter().chain(others) {
            if *size > 0 {
                encoder.copy_buffer_to_buffer(buffer, *from, &self.readback, at, Some(*size));
            }
            at += size;
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.read(&self.readback, size, |bytes| take(bytemuck::cast_slice(bytes)))
    }
}

fn grown(old: u64, needed: u64, gpu: &Gpu) -> u64 {
    if needed <= old { old } else { needed.next_power_of_two().min(gpu.max_binding) }
}

fn input_buffer(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    gpu.buffer("input", size, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST)
}

fn output_buffer(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    gpu.buffer("output", size, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC)
}

fn readback_buffer(gpu: &Gpu, size: u64) -> wgpu::Buffer {
    gpu.buffer("readback", size, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)
}
