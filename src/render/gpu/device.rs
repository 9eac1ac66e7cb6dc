//! Which device, and what went wrong on it. Nothing here panics: a machine without a driver, a name
//! that no adapter has and a device that dies are ordinary errors.

use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};

use futures_util::FutureExt;
use wgpu::{
    Adapter, AdapterInfo, Backends, Buffer, BufferDescriptor, BufferUsages, DeviceDescriptor,
    DeviceType, Features, Instance, InstanceDescriptor, InstanceFlags, Limits, PollType, Queue,
};

use super::layout::{EXPAND_BATCH, MACRO_COLUMNS, MACRO_ROWS, RASTER_BATCH, WORKGROUP};
use crate::RenderError;

/// Why there is no GPU to render on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GpuError {
    /// The machine has no Vulkan driver, or the driver has no device.
    #[error(
        "no Vulkan device: install the GPU's driver, or mesa-vulkan-drivers for a device in \
         software; `wildcity devices` lists what is found"
    )]
    NoAdapter,
    /// Nothing goes by this name or number.
    #[error("no device is called {choice:?}; there are {}", found.join(", "))]
    NoSuchAdapter {
        /// What was asked for.
        choice: String,
        /// What was found, numbered.
        found: Vec<String>,
    },
    /// The driver refuses to open the device.
    #[error("cannot open {name:?}: {reason}")]
    Device {
        /// The adapter's name.
        name: String,
        /// The driver's words.
        reason: String,
    },
    /// The device opened, but a stage could not be compiled for it.
    #[error(transparent)]
    Stages(#[from] RenderError),
    /// The threads that copy images could not be started.
    #[error("cannot start the render threads: {reason}")]
    Threads {
        /// The system's words.
        reason: String,
    },
}

/// Which adapter to use.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum AdapterChoice {
    /// The fastest kind: a card of its own, before one that shares memory, before software.
    #[default]
    Best,
    /// The fastest kind that is not software.
    Hardware,
    /// Its number in [`devices`], or else a part of its name in any case; of several the first.
    Named(String),
}

/// What a device is and can do, as its driver says.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceInfo {
    /// The driver's name for it.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `other`, or `cpu` for software.
    pub kind: &'static str,
    /// The driver and its version.
    pub driver: String,
    /// Most bytes that a shader sees of one buffer.
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
    /// Whether the device times its stages itself.
    pub has_clock: bool,
}

/// The devices of this machine, the fastest kind first, and in the driver's order within a kind.
pub fn devices() -> Vec<DeviceInfo> {
    adapters().iter().map(DeviceInfo::new).collect()
}

impl DeviceInfo {
    fn new(adapter: &Adapter) -> Self {
        let (info, limits) = (adapter.get_info(), adapter.limits());
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

fn adapters() -> Vec<Adapter> {
    let instance = Instance::new(InstanceDescriptor {
        backends: Backends::VULKAN,
        // Every group count is computed by `plan.wgsl` within the limits that the validation would
        // check, at the price of one more dispatch per indirect one.
        // WGPU_VALIDATION=1 in the environment asks for the Vulkan validation layer.
        flags: InstanceFlags::default().with_env() - InstanceFlags::VALIDATION_INDIRECT_CALL,
        ..InstanceDescriptor::new_without_display_handle()
    });
    // Outside of browsers the answer is there at once.
    let found = instance.enumerate_adapters(Backends::VULKAN).now_or_never();
    let mut found = found.unwrap_or_default();
    found.sort_by_key(|adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    });
    found
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
                    Ok(number) => (number < found.len()).then_some(number),
                    Err(_) => infos.iter().position(has_name),
                }
            }
        };
        match (index.and_then(|index| found.into_iter().nth(index)), self) {
            (Some(adapter), _) => Ok(adapter),
            (None, Self::Named(choice)) if !infos.is_empty() => {
                let found = infos.iter().enumerate();
                let found = found.map(|(index, info)| format!("{index}: {}", info.name)).collect();
                Err(GpuError::NoSuchAdapter { choice: choice.clone(), found })
            }
            (None, _) => Err(GpuError::NoAdapter),
        }
    }
}

/// Whether it is worth asking for devices in hardware. Linux gives each a node, those of NVIDIA and of
/// Windows beneath names of their own; where there is none, no Vulkan library is loaded.
fn may_have_hardware() -> bool {
    let nodes = ["/dev/dri", "/dev/nvidiactl", "/dev/dxg"];
    cfg!(not(target_os = "linux")) || nodes.iter().any(|node| Path::new(node).exists())
}

/// An open device.
#[derive(Debug)]
pub(super) struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: Queue,
    pub(super) info: AdapterInfo,
    limits: Limits,
    /// Most bytes of a binding, however many the adapter's own limits allow.
    binding_limit: u64,
    /// The first thing that went wrong since the last look.
    fault: Arc<Mutex<Option<String>>>,
    /// What was made and run, so that who pays for what can be shown.
    totals: Counted,
}

/// [`DeviceTotals`] in the making.
#[derive(Debug, Default)]
struct Counted {
    pipelines: AtomicU64,
    buffers: AtomicU64,
    dispatches: AtomicU64,
}

/// What was made and run on a device since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DeviceTotals {
    /// Kernels that were compiled.
    pub pipelines: u64,
    /// Buffers, those that grew anew.
    pub buffers: u64,
    /// Kernels that were started.
    pub dispatches: u64,
}

impl Device {
    /// Opens a device with all that its adapter can do, but for bindings of at most `binding_limit`
    /// bytes.
    ///
    /// # Errors
    /// There is none, or it does not open.
    pub(super) fn open(choice: &AdapterChoice, binding_limit: u64) -> Result<Self, GpuError> {
        let adapter = choice.find()?;
        let (info, limits) = (adapter.get_info(), adapter.limits());
        let descriptor = DeviceDescriptor {
            required_features: adapter.features() & Features::TIMESTAMP_QUERY,
            required_limits: limits.clone(),
            ..DeviceDescriptor::default()
        };
        let failed = |reason: String| GpuError::Device { name: info.name.clone(), reason };
        let opened = adapter.request_device(&descriptor).now_or_never();
        let opened = opened.ok_or_else(|| failed("the driver does not answer".into()))?;
        let (device, queue) = opened.map_err(|error| failed(error.to_string()))?;

        // At once: an error that nobody listens to would end the process.
        let fault = Arc::new(Mutex::new(None));
        let note = |fault: &Mutex<Option<String>>, reason: String| {
            let mut fault = fault.lock().unwrap_or_else(PoisonError::into_inner);
            fault.get_or_insert(reason);
        };
        let (refused, lost) = (Arc::clone(&fault), Arc::clone(&fault));
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            note(&refused, error.to_string());
        }));
        device.set_device_lost_callback(move |_, message| note(&lost, message));
        Ok(Self { device, queue, info, limits, binding_limit, fault, totals: Counted::default() })
    }

    /// Tells of what went wrong since the last call.
    ///
    /// # Errors
    /// A command was refused, memory ran out, or the device is lost.
    pub(super) fn check(&self) -> Result<(), RenderError> {
        let mut fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        match fault.take() {
            None => Ok(()),
            Some(reason) => Err(self.failed(reason)),
        }
    }

    /// An error of this device.
    pub(super) fn failed(&self, reason: String) -> RenderError {
        RenderError::Device { device: self.info.name.clone(), reason }
    }

    /// Most bytes that a shader sees at once: 128 MiB on lavapipe, 2 GiB on cards.
    pub(super) fn binding_bytes(&self) -> u64 {
        let own = self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size);
        own.min(self.binding_limit) / 256 * 256
    }

    /// Bytes of the device's memory that its buffers take, as the allocator counts them.
    pub(super) fn allocated_bytes(&self) -> Option<u64> {
        self.device.generate_allocator_report().map(|report| report.total_allocated_bytes)
    }

    /// Most splats of a tile that are blended, where what is behind them takes so many iterations. A batch
    /// of `rasterize` takes one iteration, one for each of its splats, and two that load them.
    pub(super) fn tile_splats(&self, behind: u64) -> u64 {
        let batch = u64::from(RASTER_BATCH);
        let blended = |most: u64| most.saturating_sub(behind) / (batch + 3) * batch;
        self.loop_iterations().map_or(u64::MAX, blended)
    }

    /// Most touches of a macro tile that `expand` hands on. Half of the iterations are for batches of
    /// 1,024, 45 each; the other half for tiles that are touched: with at most 64,000 splats a tile
    /// ([`Device::tile_splats`]), 2 million of a macro tile, twice over 256 threads, 16,000 each.
    pub(super) fn macro_touches(&self) -> u64 {
        let batch = u64::from(EXPAND_BATCH);
        self.loop_iterations().map_or(u32::MAX.into(), |most| most / 2 / 45 * batch)
    }

    /// Most tiles of a view that are binned at once, should 256 splats of one workgroup of `emit`
    /// cover all of them: each takes 20 iterations, and 13 for every 256 macro tiles. Those at the
    /// edges of an image may be of a few tiles: half of a macro tile is counted on.
    pub(super) fn view_tiles(&self) -> u64 {
        let splats = u64::from(WORKGROUP);
        let macros = |most: u64| (most / splats - 20) / 13 * 256;
        let tiles = u64::from(MACRO_COLUMNS * MACRO_ROWS / 2);
        self.loop_iterations().map_or(u64::MAX, |most| macros(most) * tiles)
    }

    /// Mesa's software devices leave every loop of a shader, without a word, after so many iterations
    /// in all of its loops together (`LP_MAX_TGSI_LOOP_ITERATIONS`).
    fn loop_iterations(&self) -> Option<u64> {
        (self.info.device_type == DeviceType::Cpu).then_some(65_535)
    }

    /// Nanoseconds per tick of the clock, where the device has one.
    pub(super) fn tick_ns(&self) -> Option<f32> {
        let has_clock = self.device.features().contains(Features::TIMESTAMP_QUERY);
        has_clock.then(|| self.queue.get_timestamp_period())
    }

    /// What was made and run since the device was opened.
    pub(super) fn totals(&self) -> DeviceTotals {
        let Counted { pipelines, buffers, dispatches } = &self.totals;
        let [pipelines, buffers, dispatches] =
            [pipelines, buffers, dispatches].map(|count| count.load(Relaxed));
        DeviceTotals { pipelines, buffers, dispatches }
    }

    /// A kernel was compiled.
    pub(super) fn count_pipeline(&self) {
        self.totals.pipelines.fetch_add(1, Relaxed);
    }

    /// A kernel is started.
    pub(super) fn count_dispatch(&self) {
        self.totals.dispatches.fetch_add(1, Relaxed);
    }

    /// A buffer of its own, at least 256 bytes.
    pub(super) fn buffer(&self, label: &str, bytes: u64, usage: BufferUsages) -> Buffer {
        self.totals.buffers.fetch_add(1, Relaxed);
        self.device.create_buffer(&BufferDescriptor {
            label: Some(label),
            size: bytes.next_multiple_of(256).max(256),
            usage,
            mapped_at_creation: false,
        })
    }

    /// Copies bytes to a buffer, and lets go of the staging memory of copies that are done, so that it
    /// does not pile up. What goes wrong is told by [`Device::check`].
    pub(super) fn write_now(&self, buffer: &Buffer, offset: u64, bytes: &[u8]) {
        self.queue.write_buffer(buffer, offset, bytes);
        self.queue.submit([]);
        let _ = self.device.poll(PollType::Poll);
    }
}
