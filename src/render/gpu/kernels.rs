//! The compute kernels: their WGSL text, their pipelines, and the parameters of a dispatch.
//!
//! Pipelines are compiled when first used: a job that never meets a kernel does not wait for it.

use super::super::{device::Gpu, evaluator::RenderError};

/// Invocations of a workgroup (`WORKGROUP` in common.wgsl).
pub(super) const WORKGROUP: u32 = 64;
/// The most workgroups along one axis of a dispatch.
const MAX_GROUPS: u32 = 65_535;

/// The parameters of a dispatch; mirrors `Params` in common.wgsl (a test compares the offsets).
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Params {
    /// Index of the first item in the input.
    pub(super) first_item: u32,
    /// Number of items.
    pub(super) n_items: u32,
    /// Where the first item's result goes in the output.
    pub(super) output_at: u32,
    /// Pixels from one row to the next.
    pub(super) row_stride: u32,
    /// Pixels of the group of views.
    pub(super) n_pixels: u32,
    /// Fragment addresses, layers and pool.
    pub(super) n_addresses: u32,
    /// Pixels along a side of a picture.
    pub(super) size: i32,
    /// Lattice coordinate of the first pixel's centre.
    pub(super) first_center: i32,
    /// log2 of the lattice steps in a pixel.
    pub(super) sub_bits: u32,
    /// The background as a fragment.
    pub(super) background: u32,
    /// Building: first pixel of the view.
    pub(super) first_pixel: u32,
    /// Building: nodes of the stacks.
    pub(super) n_nodes: u32,
}

/// A kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kernel {
    /// Empty lists, enter the reference.
    Clear,
    /// Triangles to stacks.
    Append,
    /// Stacks to lists.
    Sort,
    /// Judge moves.
    Evaluate,
    /// Make a move.
    Update,
    /// Depth bounds of tiles.
    Bounds,
}

/// How a kernel uses the fragment lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    Read,
    Write,
    Build,
}

/// Name of the entry point, use of the lists, and text of each kernel.
const KERNELS: [(Kernel, &str, Access, &[&str]); 6] = {
    const COMMON: &str = include_str!("../shaders/common.wgsl");
    const LISTS: &str = include_str!("../shaders/lists.wgsl");
    const ITEM: &str = include_str!("../shaders/item.wgsl");
    [
        (
            Kernel::Clear,
            "clear",
            Access::Write,
            &[COMMON, LISTS, include_str!("../shaders/clear.wgsl")],
        ),
        (
            Kernel::Append,
            "append",
            Access::Build,
            &[COMMON, LISTS, include_str!("../shaders/append.wgsl")],
        ),
        (
            Kernel::Sort,
            "sort",
            Access::Build,
            &[COMMON, LISTS, include_str!("../shaders/sort.wgsl")],
        ),
        (
            Kernel::Evaluate,
            "evaluate",
            Access::Read,
            &[COMMON, ITEM, include_str!("../shaders/evaluate.wgsl")],
        ),
        (
            Kernel::Update,
            "update",
            Access::Write,
            &[COMMON, LISTS, ITEM, include_str!("../shaders/update.wgsl")],
        ),
        (Kernel::Bounds, "bounds", Access::Read, &[COMMON, include_str!("../shaders/bounds.wgsl")]),
    ]
};

/// Layouts of the bind groups, and the pipelines made so far.
pub(super) struct Kernels {
    /// Group 0 for kernels that only read the lists.
    pub(super) lists_read: wgpu::BindGroupLayout,
    /// Group 0 for kernels that change them.
    pub(super) lists_write: wgpu::BindGroupLayout,
    /// Group 1: input and output.
    pub(super) work: wgpu::BindGroupLayout,
    /// Group 2: the stacks that lists are built from.
    pub(super) stacks: wgpu::BindGroupLayout,
    pipelines: [Option<wgpu::ComputePipeline>; KERNELS.len()],
}

impl Kernels {
    pub(super) fn new(gpu: &Gpu) -> Self {
        Self {
            lists_read: layout(gpu, "lists, read", &[true, true, true]),
            lists_write: layout(gpu, "lists, write", &[false, false, false, false]),
            work: layout(gpu, "work", &[true, false]),
            stacks: layout(gpu, "stacks", &[false, false]),
            pipelines: Default::default(),
        }
    }

    /// Compiles the kernels that are about to be used.
    pub(super) fn prepare(&mut self, gpu: &Gpu, kernels: &[Kernel]) -> Result<(), RenderError> {
        for kernel in kernels {
            if self.pipelines[*kernel as usize].is_none() {
                self.pipelines[*kernel as usize] = Some(self.compile(gpu, *kernel)?);
            }
        }
        Ok(())
    }

    /// Adds a dispatch of a prepared kernel over `params.n_items` items.
    pub(super) fn dispatch(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        kernel: Kernel,
        groups: &[&wgpu::BindGroup],
        params: &Params,
    ) {
        let Some(pipeline) = &self.pipelines[kernel as usize] else { return };
        if params.n_items == 0 {
            return;
        }
        pass.set_pipeline(pipeline);
        for (index, group) in groups.iter().enumerate() {
            pass.set_bind_group(index as u32, *group, &[]);
        }
        pass.set_immediates(0, bytemuck::bytes_of(params));
        let (x, y) = grid(params.n_items);
        pass.dispatch_workgroups(x, y, 1);
    }

    fn compile(&self, gpu: &Gpu, kernel: Kernel) -> Result<wgpu::ComputePipeline, RenderError> {
        let (_, entry, access, _) = KERNELS[kernel as usize];
        let groups: &[_] = match access {
            Access::Read => &[Some(&self.lists_read), Some(&self.work)],
            Access::Write => &[Some(&self.lists_write), Some(&self.work)],
            Access::Build => &[Some(&self.lists_write), Some(&self.work), Some(&self.stacks)],
        };
        let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(entry),
            source: wgpu::ShaderSource::Wgsl(source(kernel).into()),
        });
        let layout = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(entry),
            bind_group_layouts: groups,
            immediate_size: size_of::<Params>() as u32,
        });
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: Some(&layout),
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        match pollster::block_on(scope.pop()) {
            None => gpu.check().map(|()| pipeline),
            Some(e) => Err(RenderError::Device(format!("kernel `{entry}` is refused: {e}"))),
        }
    }
}

/// The whole WGSL text of a kernel.
fn source(kernel: Kernel) -> String {
    KERNELS[kernel as usize].3.concat()
}

/// A bind group layout of storage buffers; `true` for those that are only read.
fn layout(gpu: &Gpu, label: &str, read_only: &[bool]) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = (0_u32..)
        .zip(read_only)
        .map(|(binding, read_only)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: wgpu::BufferBindingType::Storage { read_only: *read_only },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(label),
        entries: &entries,
    })
}

/// A bind group of whole buffers.
pub(super) fn bind(
    gpu: &Gpu,
    layout: &wgpu::BindGroupLayout,
    buffers: &[&wgpu::Buffer],
) -> wgpu::BindGroup {
    let entries: Vec<_> = (0_u32..)
        .zip(buffers)
        .map(|(binding, buffer)| wgpu::BindGroupEntry {
            binding,
            resource: buffer.as_entire_binding(),
        })
        .collect();
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout,
        entries: &entries,
    })
}

/// Workgroups along x and y for so many items.
fn grid(n_items: u32) -> (u32, u32) {
    let n_groups = n_items.div_ceil(WORKGROUP);
    let x = n_groups.min(MAX_GROUPS);
    (x, n_groups.div_ceil(x.max(1)))
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use wgpu::naga;

    use super::super::lists::{BAND_CELLS, Counters, N_LAYERS};
    use super::*;

    fn parse(kernel: Kernel) -> naga::Module {
        let text = source(kernel);
        let module = naga::front::wgsl::parse_str(&text)
            .unwrap_or_else(|e| panic!("{kernel:?}: {}", e.emit_to_string(&text)));
        let allowed = naga::valid::Capabilities::IMMEDIATES;
        naga::valid::Validator::new(naga::valid::ValidationFlags::all(), allowed)
            .validate(&module)
            .unwrap_or_else(|e| panic!("{kernel:?}: {}", e.emit_to_string(&text)));
        module
    }

    /// Offset of each member of a struct, by name, and the struct's size.
    fn members(module: &naga::Module, name: &str) -> (Vec<(String, u32)>, u32) {
        let ty = module.types.iter().find(|(_, t)| t.name.as_deref() == Some(name)).unwrap().1;
        let naga::TypeInner::Struct { members, span } = &ty.inner else { panic!("no struct") };
        let named = members.iter().map(|m| (m.name.clone().unwrap(), m.offset)).collect();
        (named, *span)
    }

    /// The value of a `const` of type u32.
    fn constant(module: &naga::Module, name: &str) -> u32 {
        let constant = module.constants.iter().find(|(_, c)| c.name.as_deref() == Some(name));
        match module.global_expressions[constant.unwrap().1.init] {
            naga::Expression::Literal(naga::Literal::U32(value)) => value,
            ref other => panic!("{name} is {other:?}"),
        }
    }

    #[test]
    fn every_kernel_is_valid_wgsl_and_has_its_entry_point() {
        for (k, (kernel, entry, ..)) in KERNELS.iter().enumerate() {
            assert_eq!(*kernel as usize, k, "the table is in the order of the enumeration");
            let module = parse(*kernel);
            let point = module.entry_points.iter().find(|e| e.name == *entry).unwrap();
            assert_eq!(point.workgroup_size, [WORKGROUP, 1, 1]);
        }
    }

    #[test]
    fn structs_and_constants_agree_with_their_mirrors() {
        let module = parse(Kernel::Update);
        macro_rules! mirror {
            ($t:ident: $($f:ident),*) => {
                (vec![$((stringify!($f).to_owned(), offset_of!($t, $f) as u32)),*],
                 size_of::<$t>() as u32)
            };
        }
        let params = mirror!(Params: first_item, n_items, output_at, row_stride, n_pixels,
            n_addresses, size, first_center, sub_bits, background, first_pixel, n_nodes);
        assert_eq!(members(&module, "Params"), params);
        let counters = mirror!(Counters: pool_used, nodes_used, pool_short, too_deep);
        assert_eq!(members(&module, "Counters"), counters);
        assert_eq!(constant(&module, "N_LAYERS"), N_LAYERS);
        assert_eq!(constant(&module, "WORKGROUP"), WORKGROUP);
        assert_eq!(constant(&parse(Kernel::Evaluate), "BAND_QUADS"), BAND_CELLS);
    }

    #[test]
    fn more_workgroups_than_one_axis_takes_are_spread() {
        for n in [1, 64, 65, 65_535 * 64, 65_535 * 64 + 1, 400_000_000] {
            let (x, y) = grid(n);
            assert!(x <= MAX_GROUPS && y <= MAX_GROUPS);
            assert!(u64::from(x) * u64::from(y) * 64 >= u64::from(n));
        }
    }
}
