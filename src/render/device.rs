//! Graphics adapters and the one device that a worker computes on.
//!
//! Invariants:
//! 1. whatever a driver does wrong arrives as a [`RenderError`], never as a panic: errors that
//!    wgpu reports out of turn are kept and returned by the next wait;
//! 2. no wait is longer than [`WAIT_LIMIT`].
//!
//! Knows nothing of scenes or moves.

use std::{
    sync::{Arc, Mutex, PoisonError, mpsc},
    time::Duration,
};

use super::evaluator::RenderError;

/// The longest that the host waits for one submission: far beyond any, so that only a hung driver
/// meets it.
const WAIT_LIMIT: Duration = Duration::from_secs(60);

/// What the host can tell of an adapter without opening it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// The driver's name for it; `llvmpipe` is Mesa's lavapipe, the processor itself.
    pub name: String,
    /// `discrete gpu`, `integrated gpu`, `virtual gpu`, `cpu` or `other`.
    pub kind: &'static str,
    /// Driver and its version.
    pub driver: String,
    /// Why it cannot be used, if it cannot.
    pub unfit: Option<String>,
}

/// The kind of an adapter that computes on the processor.
pub(super) const SOFTWARE: &str = "cpu";

/// Every Vulkan adapter of this machine, in the driver's order. Empty without a Vulkan driver.
pub fn adapters() -> Vec<AdapterInfo> {
    enumerate().iter().map(describe).collect()
}

/// A device, its queue, and what went wrong on it.
pub(super) struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) info: AdapterInfo,
    /// Bytes of one storage binding, at most.
    pub(super) max_binding: u64,
    /// Pixels along a texture's side, at most.
    pub(super) max_texture_side: u32,
    fault: Arc<Mutex<Option<String>>>,
}

pub(super) fn enumerate() -> Vec<wgpu::Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN;
    descriptor.flags = wgpu::InstanceFlags::empty();
    let instance = wgpu::Instance::new(descriptor);
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN))
}

pub(super) fn describe(adapter: &wgpu::Adapter) -> AdapterInfo {
    let info = adapter.get_info();
    let kind = match info.device_type {
        wgpu::DeviceType::DiscreteGpu => "discrete gpu",
        wgpu::DeviceType::IntegratedGpu => "integrated gpu",
        wgpu::DeviceType::VirtualGpu => "virtual gpu",
        wgpu::DeviceType::Cpu => SOFTWARE,
        wgpu::DeviceType::Other => "other",
    };
    let driver = format!("{} {}", info.driver, info.driver_info);
    let driver = driver.trim().to_owned();
    AdapterInfo { name: info.name, kind, driver, unfit: unfit(adapter) }
}

/// What the kernels need of an adapter.
const FEATURES: wgpu::Features =
    wgpu::Features::IMMEDIATES.union(wgpu::Features::TEXTURE_ADAPTER_SPECIFIC_FORMAT_FEATURES);

/// Why the kernels cannot run on an adapter, if they cannot.
fn unfit(adapter: &wgpu::Adapter) -> Option<String> {
    let missing = FEATURES.difference(adapter.features());
    if !missing.is_empty() {
        return Some(format!("it lacks {missing}"));
    }
    [wgpu::TextureFormat::Rgba32Uint, wgpu::TextureFormat::R32Uint].into_iter().find_map(|format| {
        let flags = adapter.get_texture_format_features(format).flags;
        let fit = flags.contains(wgpu::TextureFormatFeatureFlags::STORAGE_READ_WRITE);
        (!fit).then(|| format!("it cannot read and write {format:?} textures"))
    })
}

impl Gpu {
    /// Opens an adapter with all that it allows.
    pub(super) fn open(adapter: &wgpu::Adapter) -> Result<Self, RenderError> {
        let info = describe(adapter);
        if let Some(why) = &info.unfit {
            return Err(RenderError::Device(format!("cannot use `{}`: {why}", info.name)));
        }
        let limits = adapter.limits();
        let max_binding = limits.max_storage_buffer_binding_size;
        let max_texture_side = limits.max_texture_dimension_2d;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("lookalike"),
            required_features: FEATURES,
            required_limits: limits,
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| RenderError::Device(format!("cannot open `{}`: {e}", info.name)))?;
        let fault = Arc::new(Mutex::new(None));
        let keep = |fault: &Arc<Mutex<Option<String>>>| {
            let fault = fault.clone();
            move |message: String| {
                fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(message);
            }
        };
        let on_error = keep(&fault);
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| on_error(e.to_string())));
        let on_loss = keep(&fault);
        device.set_device_lost_callback(move |reason, message| {
            on_loss(format!("device lost ({reason:?}): {message}"));
        });
        Ok(Self { device, queue, info, max_binding, max_texture_side, fault })
    }

    /// What went wrong since the device was opened.
    pub(super) fn check(&self) -> Result<(), RenderError> {
        let fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        match &*fault {
            None => Ok(()),
            Some(message) => Err(RenderError::Device(message.clone())),
        }
    }

    /// A buffer of `size` bytes (rounded up to a multiple of 16, and at least that).
    pub(super) fn buffer(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: size.max(1).next_multiple_of(16),
            usage,
            mapped_at_creation: false,
        })
    }

    /// A texture of (width, height, layers).
    pub(super) fn texture(
        &self,
        label: &str,
        (width, height, layers): (u32, u32, u32),
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> wgpu::Texture {
        self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some(label),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: layers },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        })
    }

    /// Waits for everything submitted so far.
    pub(super) fn wait(&self) -> Result<(), RenderError> {
        let waiting = wgpu::PollType::Wait { submission_index: None, timeout: Some(WAIT_LIMIT) };
        let waited = self.device.poll(waiting);
        self.check()?;
        match waited {
            Ok(_) => Ok(()),
            Err(e) => Err(RenderError::Device(format!("no answer from the device: {e}"))),
        }
    }

    /// Waits, then hands the first `size` bytes of a mappable buffer to `take`.
    pub(super) fn read<T>(
        &self,
        buffer: &wgpu::Buffer,
        size: u64,
        take: impl FnOnce(&[u8]) -> T,
    ) -> Result<T, RenderError> {
        let (tell, told) = mpsc::sync_channel(1);
        buffer.map_async(wgpu::MapMode::Read, 0..size, move |outcome| {
            // Nobody listens any more when the wait below timed out.
            let _ = tell.try_send(outcome);
        });
        self.wait()?;
        let failed = |what: String| RenderError::Device(format!("cannot read back: {what}"));
        match told.try_recv() {
            Ok(Ok(())) => {}
            Ok(Err(e)) => return Err(failed(e.to_string())),
            Err(_) => return Err(failed("the device did not answer".into())),
        }
        let out = {
            let view = buffer.get_mapped_range(0..size).map_err(|e| failed(e.to_string()))?;
            take(&view)
        };
        buffer.unmap();
        Ok(out)
    }
}
