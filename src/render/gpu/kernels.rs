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
    /// Pixels along a side of a picture.
    pub(super) size: i32,
    /// Lattice coordinate of the first pixel's centre.
    pub(super) first_center: i32,
    /// log2 of the lattice steps in a pixel.
    pub(super) sub_bits: u32,
    /// The background as a fragment.
    pub(super) background: u32,
    /// Building and reading back: the view.
    pub(super) view: u32,
    /// Building: nodes of the stacks.
    pub(super) n_nodes: u32,
    /// Nodes of the pool.
    pub(super) n_pool: u32,
    /// log2 of the invocations that share an item of a move (see item.wgsl).
    pub(super) lane_bits: u32,
}

/// A kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kernel {
    /// Empty lists, enter the reference.
    Clear,
    /// Triangles to stacks.
    Append,
    /// Stacks to lists.
    Sort,
    /// Make a move.
    Update,
    /// Depth bounds of tiles.
    Bounds,
    /// Read a view's fronts back.
    Fronts,
    /// Judge moves of any number of triangles.
    Evaluate,
    /// Judge moves of few triangles under flat shading.
    Evaluate6,
    /// Likewise.
    Evaluate8,
    /// Likewise.
    Evaluate12,
    /// Likewise.
    Evaluate16,
}

/// How a kernel uses the fragment lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Access {
    Read,
    Write,
    Build,
}

/// How a kernel is made.
struct Recipe {
    kernel: Kernel,
    /// Entry point.
    entry: &'static str,
    access: Access,
    text: &'static [&'static str],
    /// Triangles that come, and vectors of ids that go, for which the text is unrolled.
    unrolled: Option<(u32, u32)>,
}

const ITEM: &str = include_str!("../shaders/item.wgsl");

const KERNELS: [Recipe; 11] = {
    const COMMON: &str = include_str!("../shaders/common.wgsl");
    const LISTS: &str = include_str!("../shaders/lists.wgsl");
    const JUDGE: &str = include_str!("../shaders/judge.wgsl");
    const CLEAR: &[&str] = &[COMMON, LISTS, include_str!("../shaders/clear.wgsl")];
    const APPEND: &[&str] = &[COMMON, LISTS, include_str!("../shaders/append.wgsl")];
    const SORT: &[&str] = &[COMMON, LISTS, include_str!("../shaders/sort.wgsl")];
    const UPDATE: &[&str] = &[COMMON, LISTS, ITEM, include_str!("../shaders/update.wgsl")];
    const BOUNDS: &[&str] = &[COMMON, include_str!("../shaders/bounds.wgsl")];
    const FRONTS: &[&str] = &[COMMON, include_str!("../shaders/fronts.wgsl")];
    const EVALUATE: &[&str] = &[COMMON, ITEM, JUDGE, include_str!("../shaders/evaluate.wgsl")];
    const UNROLLED: &[&str] = &[COMMON, ITEM, JUDGE, include_str!("../shaders/unrolled.wgsl")];
    const fn recipe(
        kernel: Kernel,
        entry: &'static str,
        access: Access,
        text: &'static [&'static str],
    ) -> Recipe {
        Recipe { kernel, entry, access, text, unrolled: None }
    }
    const fn unrolled(kernel: Kernel, added: u32, removed: u32) -> Recipe {
        let unrolled = Some((added, removed));
        Recipe { kernel, entry: "evaluate", access: Access::Read, text: UNROLLED, unrolled }
    }
    [
        recipe(Kernel::Clear, "clear", Access::Write, CLEAR),
        recipe(Kernel::Append, "append", Access::Build, APPEND),
        recipe(Kernel::Sort, "sort", Access::Build, SORT),
        recipe(Kernel::Update, "update", Access::Write, UPDATE),
        recipe(Kernel::Bounds, "bounds", Access::Read, BOUNDS),
        recipe(Kernel::Fronts, "fronts", Access::Read, FRONTS),
        recipe(Kernel::Evaluate, "evaluate", Access::Read, EVALUATE),
        unrolled(Kernel::Evaluate6, 6, 3),
        unrolled(Kernel::Evaluate8, 8, 3),
        unrolled(Kernel::Evaluate12, 12, 4),
        unrolled(Kernel::Evaluate16, 16, 5),
    ]
};

impl Kernel {
    /// Whether lanes share its items: those of moves.
    fn is_shared(self) -> bool {
        KERNELS[self as usize].text.contains(&ITEM)
    }

    /// The cheapest kernel that judges moves of `n_added` triangles that come and `n_removed`
    /// vectors of ids that go.
    pub(super) fn judging(is_plain: bool, n_added: u32, n_removed: u32) -> Self {
        if !is_plain {
            return Self::Evaluate;
        }
        KERNELS
            .iter()
            .find(|r| r.unrolled.is_some_and(|(n, m)| n_added <= n && n_removed <= m))
            .map_or(Self::Evaluate, |r| r.kernel)
    }
}

/// Layouts of the bind groups, and the pipelines made so far.
pub(super) struct Kernels {
    /// Group 0 for kernels that only read the lists.
    pub(super) lists_read: wgpu::BindGroupLayout,
    /// Group 0 for kernels that change them.
    pub(super) lists_write: wgpu::BindGroupLayout,
    /// Group 1: input, output and texels.
    pub(super) work: wgpu::BindGroupLayout,
    /// Group 2: the stacks that lists are built from.
    pub(super) stacks: wgpu::BindGroupLayout,
    /// Whether a texture gives something off (`GLOWS` in common.wgsl).
    glows: bool,
    pipelines: [Option<wgpu::ComputePipeline>; KERNELS.len()],
}

impl Kernels {
    /// For textures of which some give something off, or none do.
    pub(super) fn new(gpu: &Gpu, glows: bool) -> Self {
        Self {
            lists_read: layout(gpu, "lists, read", &[READ_FOUR, READ_FOUR, READ_ONE, READ]),
            lists_write: layout(
                gpu,
                "lists, write",
                &[WRITE_FOUR, WRITE_FOUR, WRITE_ONE, WRITE, WRITE],
            ),
            work: layout(gpu, "work", &[READ_INPUT, WRITE, READ_TEXELS]),
            stacks: layout(gpu, "stacks", &[WRITE, WRITE]),
            glows,
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
        let lane_bits = if kernel.is_shared() { params.lane_bits } else { 0 };
        let (x, y) = grid(params.n_items << lane_bits);
        pass.dispatch_workgroups(x, y, 1);
    }

    fn compile(&self, gpu: &Gpu, kernel: Kernel) -> Result<wgpu::ComputePipeline, RenderError> {
        let Recipe { entry, access, .. } = KERNELS[kernel as usize];
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
            compilation_options: wgpu::PipelineCompilationOptions {
                constants: &[("GLOWS", f64::from(u8::from(self.glows)))],
                ..wgpu::PipelineCompilationOptions::default()
            },
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
    let recipe = &KERNELS[kernel as usize];
    let text = recipe.text.concat();
    let Some((n_added, n_removed)) = recipe.unrolled else { return text };
    let repeat = |line: &str, name: &str, n: u32| -> String {
        (0..n).map(|k| line.replace(name, &k.to_string()) + "\n").collect()
    };
    text.lines()
        .map(|line| match line {
            comment if comment.trim_start().starts_with("//") => String::new(),
            line if line.contains("{k}") => repeat(line, "{k}", n_added),
            line if line.contains("{m}") => repeat(line, "{m}", n_removed),
            line => line.to_owned() + "\n",
        })
        .collect()
}

const fn buffer(read_only: bool) -> wgpu::BindingType {
    wgpu::BindingType::Buffer {
        ty: wgpu::BufferBindingType::Storage { read_only },
        has_dynamic_offset: false,
        min_binding_size: None,
    }
}

const fn texture(
    format: wgpu::TextureFormat,
    access: wgpu::StorageTextureAccess,
    view_dimension: wgpu::TextureViewDimension,
) -> wgpu::BindingType {
    wgpu::BindingType::StorageTexture { access, format, view_dimension }
}

const READ: wgpu::BindingType = buffer(true);
const WRITE: wgpu::BindingType = buffer(false);
const READ_INPUT: wgpu::BindingType = texture(
    wgpu::TextureFormat::Rgba32Uint,
    wgpu::StorageTextureAccess::ReadOnly,
    wgpu::TextureViewDimension::D2,
);
const READ_TEXELS: wgpu::BindingType = texture(
    wgpu::TextureFormat::R32Uint,
    wgpu::StorageTextureAccess::ReadOnly,
    wgpu::TextureViewDimension::D2,
);
const READ_FOUR: wgpu::BindingType = texture(
    wgpu::TextureFormat::Rgba32Uint,
    wgpu::StorageTextureAccess::ReadOnly,
    wgpu::TextureViewDimension::D2Array,
);
const WRITE_FOUR: wgpu::BindingType = texture(
    wgpu::TextureFormat::Rgba32Uint,
    wgpu::StorageTextureAccess::ReadWrite,
    wgpu::TextureViewDimension::D2Array,
);
const READ_ONE: wgpu::BindingType = texture(
    wgpu::TextureFormat::R32Uint,
    wgpu::StorageTextureAccess::ReadOnly,
    wgpu::TextureViewDimension::D2Array,
);
const WRITE_ONE: wgpu::BindingType = texture(
    wgpu::TextureFormat::R32Uint,
    wgpu::StorageTextureAccess::ReadWrite,
    wgpu::TextureViewDimension::D2Array,
);

fn layout(gpu: &Gpu, label: &str, types: &[wgpu::BindingType]) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = (0_u32..)
        .zip(types)
        .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: *ty,
            count: None,
        })
        .collect();
    gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(label),
        entries: &entries,
    })
}

/// A bind group of these resources.
pub(super) fn bind(
    gpu: &Gpu,
    layout: &wgpu::BindGroupLayout,
    resources: &[wgpu::BindingResource<'_>],
) -> wgpu::BindGroup {
    let entries: Vec<_> = (0_u32..)
        .zip(resources)
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() })
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

    use super::super::{
        lists::{Counters, MAX_DEPTH},
        pack::{BAND_CELLS, CUT_OFF},
        work::{INPUT_WIDTH_BITS, TEXELS_WIDTH_BITS},
    };
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
        for (k, Recipe { kernel, entry, .. }) in KERNELS.iter().enumerate() {
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
        let params = mirror!(Params: first_item, n_items, output_at, size, first_center,
            sub_bits, background, view, n_nodes, n_pool, lane_bits);
        assert_eq!(members(&module, "Params"), params);
        let counters =
            mirror!(Counters: pool_used, nodes_used, pool_short, too_deep, cut_off, unsorted);
        assert_eq!(members(&module, "Counters"), counters);
        assert_eq!(constant(&module, "INPUT_WIDTH_BITS"), INPUT_WIDTH_BITS);
        assert_eq!(constant(&module, "TEXELS_WIDTH_BITS"), TEXELS_WIDTH_BITS);
        assert_eq!(constant(&module, "WORKGROUP"), WORKGROUP);
        assert_eq!(constant(&module, "CUT_OFF"), CUT_OFF);
        assert_eq!(constant(&module, "MAX_DEPTH"), MAX_DEPTH);
        assert_eq!(constant(&parse(Kernel::Evaluate), "BAND_CELLS"), BAND_CELLS);
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
