//! Choosing and opening a device, its limits, and its errors. Nothing here panics: a machine
//! without a driver, a name that no adapter has, and a device that is lost are ordinary errors.
//!
//! # Software devices
//!
//! The backend is tested on Mesa's software device, lavapipe. Such devices leave a shader's loops,
//! without an error, after 65,535 iterations of all of its loops together. The limits
//! [`Device::max_tile_batches`], [`Device::max_view_tiles`] and [`Device::max_traced_candidates`]
//! keep each shader below that number: frames are split into more regions, or refused, and sweeps
//! into more dispatches. Other devices have no such limit.

use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use futures_util::FutureExt;
use parking_lot::Mutex;
use wgpu::{
    Adapter, AdapterInfo, Backend, Backends, Buffer, BufferDescriptor, BufferUsages,
    DeviceDescriptor, DeviceType, Features, Instance, InstanceDescriptor, InstanceFlags, Limits,
    PollType, Queue,
};

use super::layout::{MACRO_COLUMNS, MACRO_ROWS, WORKGROUP};
use super::shaders::Shaders;
use super::tuning::Tuning;
use crate::RenderError;
use crate::lidar::MOST_HITS;

/// What to do without any device.
pub const NO_DEVICE: &str = if cfg!(any(feature = "metal", feature = "dx12")) {
    "no Vulkan, Metal or DX12 device: install the GPU's driver"
} else {
    "no Vulkan device: install the GPU's driver, or mesa-vulkan-drivers for a software device"
};

/// Why there is no GPU to render on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GpuError {
    /// The machine has no driver, or the driver has no device.
    #[error("{}; `wildcity dev devices` lists the devices that are found", NO_DEVICE)]
    NoAdapter,
    /// No device has this name or number.
    #[error("no device is called {choice:?}; the devices are {}", found.join(", "))]
    NoSuchAdapter {
        /// The requested name or number.
        choice: String,
        /// The devices that were found, numbered.
        found: Vec<String>,
    },
    /// The driver refuses to open the device.
    #[error("cannot open {name:?}: {reason}")]
    Device { name: String, reason: String },
    /// The device opened, but a shader could not be compiled for it.
    #[error(transparent)]
    Stages(#[from] RenderError),
    /// The threads that copy images could not be started.
    #[error("cannot start the render threads: {reason}")]
    Threads { reason: String },
}

/// Which adapter to use.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum AdapterChoice {
    /// The fastest kind: discrete before integrated before virtual before software.
    #[default]
    Best,
    /// The fastest kind that is not software.
    Hardware,
    /// The device with this number in [`devices`], or else the first one whose name contains this
    /// text, in upper or lower case.
    Named(String),
}

/// Properties and limits of a device, as its driver reports them.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceInfo {
    /// The driver's name for it.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `other`, or `cpu` for software.
    pub kind: &'static str,
    /// The driver and its version.
    pub driver: String,
    /// Most bytes of one storage buffer binding.
    pub binding_bytes: u64,
    /// Most bytes of one buffer.
    pub buffer_bytes: u64,
    /// Most threads of a workgroup.
    pub workgroup_threads: u32,
    /// Memory of a workgroup, in bytes.
    pub workgroup_bytes: u32,
    /// Most workgroups of a dimension of a dispatch.
    pub groups_per_dimension: u32,
    /// Fewest and most threads of a subgroup.
    pub subgroup_threads: RangeInclusive<u32>,
    /// Whether the device can time its stages (timestamp queries).
    pub has_clock: bool,
}

/// The devices of this machine, the fastest kind first, in the driver's order within a kind.
pub fn devices() -> Vec<DeviceInfo> {
    adapters().iter().map(DeviceInfo::new).collect()
}

impl DeviceInfo {
    fn new(adapter: &Adapter) -> Self {
        let info = adapter.get_info();
        let limits = adapter.limits();
        Self {
            kind: match info.device_type {
                DeviceType::DiscreteGpu => "discrete",
                DeviceType::IntegratedGpu => "integrated",
                DeviceType::VirtualGpu => "virtual",
                DeviceType::Other => "other",
                DeviceType::Cpu => "cpu",
            },
            driver: format!("{} {}", info.driver, info.driver_info),
            binding_bytes: limits.max_storage_buffer_binding_size,
            buffer_bytes: limits.max_buffer_size,
            workgroup_threads: limits.max_compute_invocations_per_workgroup,
            workgroup_bytes: limits.max_compute_workgroup_storage_size,
            groups_per_dimension: limits.max_compute_workgroups_per_dimension,
            subgroup_threads: info.subgroup_min_size..=info.subgroup_max_size,
            has_clock: adapter.features().contains(Features::TIMESTAMP_QUERY),
            name: info.name,
        }
    }
}

/// The interfaces to devices that the program was built for: Vulkan, and with the features `metal`
/// and `dx12` those of macOS and Windows.
const BACKENDS: Backends = Backends::VULKAN
    .union(if cfg!(feature = "metal") { Backends::METAL } else { Backends::empty() })
    .union(if cfg!(feature = "dx12") { Backends::DX12 } else { Backends::empty() });

fn adapters() -> Vec<Adapter> {
    let instance = Instance::new(InstanceDescriptor {
        backends: BACKENDS,
        // wgpu's validation of indirect dispatches costs one more dispatch each. It is not needed:
        // `plan.wgsl` computes all workgroup counts within the limits that it would check.
        // WGPU_VALIDATION=1 in the environment enables the Vulkan validation layer.
        flags: InstanceFlags::default().with_env() - InstanceFlags::VALIDATION_INDIRECT_CALL,
        ..InstanceDescriptor::new_without_display_handle()
    });
    // Outside of browsers this future is ready at once.
    let listed = instance.enumerate_adapters(BACKENDS).now_or_never();
    let mut found = listed.unwrap_or_default();
    let infos: Vec<AdapterInfo> = found.iter().map(Adapter::get_info).collect();
    let mut index = 0..;
    found.retain(|_| index.next().is_none_or(|index| !is_listed_twice(&infos, index)));
    // Stable: devices of one kind keep the driver's order. `AdapterChoice::Named` is a place in
    // this list.
    found.sort_by_key(|adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    });
    found
}

/// Whether a device of Vulkan is also listed by the system's own interface (Metal or DX12), which
/// is preferred. Devices of one interface that have the same name are several cards.
fn is_listed_twice(infos: &[AdapterInfo], index: usize) -> bool {
    let AdapterInfo { backend, name, .. } = &infos[index];
    let is_own = |info: &AdapterInfo| info.backend != Backend::Vulkan && info.name == *name;
    *backend == Backend::Vulkan && infos.iter().any(is_own)
}

impl AdapterChoice {
    fn find(&self) -> Result<Adapter, GpuError> {
        let found = match self {
            Self::Hardware if !may_have_hardware() => Vec::new(),
            _ => adapters(),
        };
        let infos: Vec<AdapterInfo> = found.iter().map(Adapter::get_info).collect();
        let index = match self {
            Self::Best => (!found.is_empty()).then_some(0),
            Self::Hardware => infos.iter().position(|info| info.device_type != DeviceType::Cpu),
            Self::Named(choice) => {
                let name = choice.to_lowercase();
                let has_name = |info: &AdapterInfo| info.name.to_lowercase().contains(&name);
                match choice.parse::<usize>() {
                    // A number that no device has is an error, even if it is a part of a device's
                    // name: with one card less, another one would be used in silence.
                    Ok(number) => (number < found.len()).then_some(number),
                    Err(_) => infos.iter().position(has_name),
                }
            }
        };
        match (index.and_then(|index| found.into_iter().nth(index)), self) {
            (Some(adapter), _) => Ok(adapter),
            (None, Self::Named(choice)) if !infos.is_empty() => {
                let numbered = infos.iter().enumerate();
                let found =
                    numbered.map(|(index, info)| format!("{index}: {}", info.name)).collect();
                Err(GpuError::NoSuchAdapter { choice: choice.clone(), found })
            }
            (None, _) => Err(GpuError::NoAdapter),
        }
    }
}

/// Whether the machine may have a hardware device. Linux has device nodes for them, under separate
/// names for NVIDIA's driver and for WSL; without any of them, the Vulkan library need not be
/// loaded.
fn may_have_hardware() -> bool {
    let nodes = ["/dev/dri", "/dev/nvidiactl", "/dev/dxg"];
    cfg!(not(target_os = "linux")) || nodes.iter().any(|node| Path::new(node).exists())
}

/// An open device, and the shaders that run on it.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: Queue,
    pub(super) adapter: Adapter,
    pub(super) info: AdapterInfo,
    shaders: Shaders,
    limits: Limits,
    tuning: Tuning,
    /// Most bytes of a binding, even if the adapter allows more.
    binding_limit: u64,
    /// The first error. It stays: several frames may be in flight, and the device is given up after
    /// an error.
    fault: Arc<Mutex<Option<String>>>,
    /// Counts of created objects and dispatches, so that the cost of each feature can be reported.
    totals: AtomicTotals,
}

/// The counters behind [`DeviceTotals`].
#[derive(Debug, Default)]
struct AtomicTotals {
    pipelines: AtomicU64,
    buffers: AtomicU64,
    dispatches: AtomicU64,
}

/// Counts of created objects and dispatches on a device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DeviceTotals {
    /// Kernels that were compiled.
    pub pipelines: u64,
    /// Buffers that were created; a buffer that grows counts again.
    pub buffers: u64,
    /// Kernels that were started.
    pub dispatches: u64,
}

impl Device {
    /// Opens a device with its adapter's limits, except that bindings hold at most `binding_limit`
    /// bytes.
    ///
    /// # Errors
    /// There is no such device, or the driver does not open it.
    pub(super) fn open(
        choice: &AdapterChoice,
        shaders: &Shaders,
        binding_limit: u64,
        tuning: Option<Tuning>,
    ) -> Result<Self, GpuError> {
        Self::on(choice.find()?, shaders, binding_limit, tuning)
    }

    /// As [`Device::open`], on an adapter that was found before.
    ///
    /// # Errors
    /// The driver does not open it.
    pub(super) fn on(
        adapter: Adapter,
        shaders: &Shaders,
        binding_limit: u64,
        tuning: Option<Tuning>,
    ) -> Result<Self, GpuError> {
        let info = adapter.get_info();
        let limits = adapter.limits();
        let descriptor = DeviceDescriptor {
            required_features: adapter.features()
                & (Features::TIMESTAMP_QUERY | Features::SUBGROUP),
            // wgpu's default limits are far below those of graphics cards.
            required_limits: limits.clone(),
            ..DeviceDescriptor::default()
        };
        let failed = |reason: String| GpuError::Device { name: info.name.clone(), reason };
        let answer = adapter.request_device(&descriptor).now_or_never();
        let opened = answer.ok_or_else(|| failed("the driver does not respond".into()))?;
        let (device, queue) = opened.map_err(|error| failed(error.to_string()))?;

        let tuning = tuning.unwrap_or_else(|| Tuning::new(&info, device.features(), &limits));

        // The handlers are set first of all: without one, an error ends the process.
        let fault = Arc::new(Mutex::new(None));
        let keep_first = |fault: &Mutex<Option<String>>, reason: String| {
            fault.lock().get_or_insert(reason);
        };
        let on_error = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            keep_first(&on_error, error.to_string());
        }));
        let on_lost = Arc::clone(&fault);
        device.set_device_lost_callback(move |_, message| keep_first(&on_lost, message));
        Ok(Self {
            device,
            queue,
            adapter,
            info,
            shaders: shaders.clone(),
            limits,
            tuning,
            binding_limit,
            fault,
            totals: AtomicTotals::default(),
        })
    }

    /// Which kernels run on this device.
    pub(super) fn tuning(&self) -> Tuning {
        self.tuning
    }

    /// The shaders that run on this device.
    pub(super) fn shaders(&self) -> &Shaders {
        &self.shaders
    }

    /// Reports the first error of this device.
    ///
    /// # Errors
    /// A command was invalid, memory ran out, or the device is lost.
    pub(super) fn check(&self) -> Result<(), RenderError> {
        match self.fault.lock().clone() {
            None => Ok(()),
            Some(reason) => Err(self.failed(reason)),
        }
    }

    /// How long a frame may take on this device before it counts as lost. Software Vulkan compiles
    /// a shader on one thread when it runs for the first time, which takes long while other
    /// programs run.
    pub(super) fn frame_timeout(&self) -> Duration {
        match self.info.device_type {
            DeviceType::Cpu => Duration::from_secs(300),
            _ => Duration::from_secs(60),
        }
    }

    /// An error of this device.
    pub(super) fn failed(&self, reason: String) -> RenderError {
        RenderError::Device { device: self.info.name.clone(), reason }
    }

    /// Most bytes of a binding, a multiple of 256: 128 MiB on lavapipe, 2 GiB on graphics cards.
    pub(super) fn binding_bytes(&self) -> u64 {
        let own = self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size);
        own.min(self.binding_limit) / 256 * 256
    }

    /// Bytes of device memory that the buffers take, as the allocator counts them.
    pub(super) fn allocated_bytes(&self) -> Option<u64> {
        self.device.generate_allocator_report().map(|report| report.total_allocated_bytes)
    }

    /// Most batches of splats that a tile can blend, if the background takes
    /// `background_iterations` loop iterations of a thread of `rasterize`.
    ///
    /// The end of a loop counts as an iteration, and so does a loop that no thread of a vector
    /// enters. A batch takes at most 95: 1, 3 to load two splats, 17 to transpose a word, 5 for
    /// four words, 17 for the 32 splats of each word (two at a time), and 1 at their end; 96 leaves
    /// one to spare. Besides, a thread takes 17 to find its view among 16, 5 at the end of the
    /// batches, 4 x 33 for the owners of four pixels among 2^32, and 8 x 5 for those that most
    /// samples have: 194 of 200.
    pub(super) fn max_tile_batches(&self, background_iterations: u64) -> u32 {
        let batches = |most: u64| most.saturating_sub(200 + background_iterations) / 96;
        self.loop_iterations().map_or(u32::MAX, |most| batches(most) as u32)
    }

    /// Most tiles of a view that can be binned at once, even if all 256 splats of a workgroup of
    /// `emit` cover all of them.
    ///
    /// Each splat takes 20 iterations, and 13 for every 256 macro tiles. Macro tiles at the edges
    /// of an image have fewer tiles; on average at least half of a macro tile's tiles are assumed.
    pub(super) fn max_view_tiles(&self) -> u64 {
        let splats = u64::from(WORKGROUP);
        let macro_tiles = |most: u64| (most / splats - 20) / 13 * 256;
        let tiles = u64::from(MACRO_COLUMNS * MACRO_ROWS / 2);
        self.loop_iterations().map_or(u64::MAX, |most| macro_tiles(most) * tiles)
    }

    /// Most splats of a tile whose gradients can be summed.
    ///
    /// A batch of 64 takes at most 18 iterations: 1, one for each four splats, and 1 at their end;
    /// or 10 where its sums are 0. A thread takes 17 to find its tile and 17 to find its view
    /// besides.
    pub(super) fn max_gradient_splats(&self) -> u64 {
        self.loop_iterations().map_or(u64::MAX, |most| (most - 40) / 18 * 64)
    }

    /// Most macro tiles of a view whose sums a splat can gather: a search takes at most 28
    /// iterations, and 2 to come to it.
    pub(super) fn max_gradient_macro_tiles(&self) -> u64 {
        self.loop_iterations().map_or(u64::MAX, |most| most / 30)
    }

    /// Most candidates of a tile that its beams can be compared with at once.
    ///
    /// A candidate takes at most 2 x 179 iterations: one for each hit of its beam that it is put in
    /// front of, one for each that is counted, and one at the end of both; and 3 of the two loops
    /// over candidates.
    pub(super) fn max_traced_candidates(&self) -> u64 {
        let of_one = 2 * (MOST_HITS as u64 + 1) + 3;
        self.loop_iterations().map_or(u64::from(u32::MAX), |most| (most - 2) / of_one)
    }

    /// Loop iterations of a shader, in all of its loops together, after which Mesa's software
    /// devices leave every loop without an error (`LP_MAX_TGSI_LOOP_ITERATIONS`). `None` for other
    /// devices.
    fn loop_iterations(&self) -> Option<u64> {
        (self.info.device_type == DeviceType::Cpu).then_some(65_535)
    }

    /// Nanoseconds per tick of the device's clock; `None` if it has none.
    pub(super) fn tick_ns(&self) -> Option<f32> {
        let has_clock = self.device.features().contains(Features::TIMESTAMP_QUERY);
        has_clock.then(|| self.queue.get_timestamp_period())
    }

    /// Counts of created objects and dispatches since the device was opened.
    pub(super) fn totals(&self) -> DeviceTotals {
        let AtomicTotals { pipelines, buffers, dispatches } = &self.totals;
        let [pipelines, buffers, dispatches] =
            [pipelines, buffers, dispatches].map(|count| count.load(Relaxed));
        DeviceTotals { pipelines, buffers, dispatches }
    }

    /// Counts a kernel that is compiled.
    pub(super) fn count_pipeline(&self) {
        // No other data depends on the counts: relaxed order is enough.
        self.totals.pipelines.fetch_add(1, Relaxed);
    }

    /// Counts a kernel that is started.
    pub(super) fn count_dispatch(&self) {
        self.totals.dispatches.fetch_add(1, Relaxed);
    }

    /// Creates a buffer of at least 256 bytes.
    pub(super) fn buffer(&self, label: &str, bytes: u64, usage: BufferUsages) -> Buffer {
        self.totals.buffers.fetch_add(1, Relaxed);
        self.device.create_buffer(&BufferDescriptor {
            label: Some(label),
            // An empty buffer cannot be bound, and copies take whole words.
            size: bytes.next_multiple_of(256).max(256),
            usage,
            mapped_at_creation: false,
        })
    }

    /// Copies bytes to a buffer at once, and frees the staging memory of finished copies, so that
    /// it does not accumulate. [`Device::check`] reports errors.
    pub(super) fn write_now(&self, buffer: &Buffer, offset: u64, bytes: &[u8]) {
        self.queue.write_buffer(buffer, offset, bytes);
        self.queue.submit([]);
        let _ = self.device.poll(PollType::Poll);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_is_listed_once_and_two_cards_twice() {
        let info = |backend, name: &str| AdapterInfo {
            name: name.to_owned(),
            ..AdapterInfo::new(DeviceType::DiscreteGpu, backend)
        };
        let listed = |infos: &[AdapterInfo]| {
            (0..infos.len()).filter(|index| !is_listed_twice(infos, *index)).collect::<Vec<_>>()
        };
        let both = [info(Backend::Vulkan, "M2"), info(Backend::Metal, "M2")];
        assert_eq!(listed(&both), [1]);
        let cards = [info(Backend::Vulkan, "H200"), info(Backend::Vulkan, "H200")];
        assert_eq!(listed(&cards), [0, 1]);
        let other = [info(Backend::Vulkan, "llvmpipe"), info(Backend::Dx12, "RTX")];
        assert_eq!(listed(&other), [0, 1]);
    }
}
