//! Options that choose the backend and the hardware that it runs on.

use std::io::{self, Write};
use std::sync::Arc;
#[cfg(feature = "gpu")]
use std::{collections::BTreeSet, num::NonZero};

#[cfg(feature = "gpu")]
use anyhow::Context as _;
use clap::ValueEnum;

use wildcity_render::Backend;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gradient::Differentiate;
use wildcity_render::reference::Reference;
#[cfg(feature = "gpu")]
use wildcity_render::stage::Stage;
#[cfg(feature = "gpu")]
use wildcity_render::{
    automatic::{self, Selection},
    gpu::{AdapterChoice, Gpu, GpuError, MemoryLimits},
    hybrid::HybridBackend,
    several::SeveralDevices,
};

#[cfg(not(feature = "gpu"))]
use super::left_out::built_without;

/// `--backend` and `--cpu-through`, for commands that examine the renderer.
#[derive(Clone, Debug, clap::Args)]
pub struct RendererOptions {
    #[command(flatten)]
    backend: BackendOptions,

    /// Run the stages up to and including this one on the cpu backend, and the rest on --device,
    /// even if that device is software. If an image is wrong with --cpu-through project and right
    /// with --cpu-through sort, the fault is in the GPU's sort stage. `wildcity dev bisect` tries
    /// all stages.
    #[arg(long, hide = true, value_name = "STAGE", value_enum)]
    cpu_through: Option<StageName>,
}

/// `--backend`, and the hardware that it runs on.
#[derive(Clone, Debug, clap::Args)]
pub struct BackendOptions {
    /// Backend that renders.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendName,

    #[command(flatten)]
    hardware: HardwareOptions,
}

/// `--devices`, for commands that serve many sessions.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Devices {
    /// Several GPUs of one kind, by their numbers in `wildcity dev devices`. A session is placed on
    /// the one with the fewest sessions, and stays there; each has a copy of the twins that its
    /// sessions see.
    #[arg(long, value_name = "N,..", value_delimiter = ',', conflicts_with = "device")]
    devices: Vec<usize>,
}

/// The hardware that the backends run on.
#[derive(Clone, Debug, clap::Args)]
pub struct HardwareOptions {
    /// Render threads; 0 for one per core. Pixels do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = threads)]
    threads: usize,

    /// Device of the gpu backend: its number in `wildcity dev devices`, or a part of its name
    /// [default: the fastest kind]
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,

    /// GPU memory for Gaussians, in GiB. If they need more, the least recently drawn ones are
    /// evicted. Buffers of the render stages need additional memory [default: all that the GPU has]
    #[arg(long, hide = true, value_name = "GIB", value_parser = gib)]
    gpu_memory_gib: Option<f64>,

    /// Instruction set of the cpu backend.
    #[arg(long, hide = true, value_enum, default_value_t)]
    simd: SimdName,
}

/// The backends of this build.
#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum BackendName {
    /// gpu if `--device` names a device, or if a hardware device renders a test image as the cpu
    /// backend does; otherwise cpu. The choice is printed on standard error.
    #[default]
    Auto,
    /// wgpu on Vulkan (on macOS Metal, on Windows DX12, where the build has it), on `--device`.
    Gpu,
    /// f32, SIMD, all cores.
    Cpu,
    /// f64, the definition that the other backends are compared with: slow.
    Reference,
}

/// [`Stage`] on the command line.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum StageName {
    /// Gaussians are projected to splats.
    Project,
    /// Splats are sorted by depth.
    Sort,
    /// Each tile gets its list of splats. Only rasterize is left to the GPU.
    Bin,
}

#[cfg(feature = "gpu")]
impl From<StageName> for Stage {
    fn from(name: StageName) -> Self {
        match name {
            StageName::Project => Self::Project,
            StageName::Sort => Self::Sort,
            StageName::Bin => Self::Bin,
        }
    }
}

/// The instruction sets of [`Simd`].
#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum SimdName {
    /// The best one of the machine.
    #[default]
    Best,
    /// Sixteen lanes.
    Avx512,
    /// Eight lanes, with fused multiply-add.
    Avx2,
    /// Four lanes, without fused multiply-add.
    Sse42,
}

impl From<SimdName> for Simd {
    fn from(name: SimdName) -> Self {
        match name {
            SimdName::Best => Self::Best,
            SimdName::Avx512 => Self::Avx512,
            SimdName::Avx2 => Self::Avx2,
            SimdName::Sse42 => Self::Sse42,
        }
    }
}

impl BackendOptions {
    /// Creates the backend. If it is chosen automatically, prints the choice on standard error.
    pub fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        match (self.backend, &self.hardware.device) {
            (BackendName::Auto, None) => self.hardware.best(),
            // A device that is named asks for the GPU: the choice is no longer automatic.
            (BackendName::Auto | BackendName::Gpu, _) => Ok(Box::new(self.hardware.gpu()?)),
            (_, Some(device)) => anyhow::bail!(
                "--device {device:?} belongs to the gpu backend: add --backend gpu, or omit --device"
            ),
            (BackendName::Cpu, None) => Ok(Box::new(self.hardware.cpu()?)),
            (BackendName::Reference, None) => Ok(Box::new(Reference)),
        }
    }

    /// As [`Self::backend`], on several devices if they are named.
    pub fn backend_on(&self, Devices { devices }: &Devices) -> anyhow::Result<Arc<dyn Backend>> {
        if devices.is_empty() {
            return Ok(Arc::from(self.backend()?));
        }
        anyhow::ensure!(
            matches!(self.backend, BackendName::Auto | BackendName::Gpu),
            "--devices belongs to the gpu backend: add --backend gpu, or omit --devices"
        );
        self.hardware.gpus(devices)
    }

    /// Creates the backend that rendered a recording, unless `--backend` names another one.
    pub fn replay_backend(&self, recorded: &str) -> anyhow::Result<Box<dyn Backend>> {
        let recorded = BackendName::from_str(recorded, false);
        // Another backend may draw other bits, and the hashes of a replay would differ.
        match (self.backend, recorded) {
            (BackendName::Auto, Ok(backend)) => Self { backend, ..self.clone() }.backend(),
            _ => self.backend(),
        }
    }
}

impl HardwareOptions {
    /// Creates the cpu backend.
    pub fn cpu(&self) -> anyhow::Result<Cpu> {
        Ok(Cpu::new(self.threads, self.simd.into())?)
    }

    /// Creates the best backend, and prints the choice on standard error.
    #[cfg(feature = "gpu")]
    fn best(&self) -> anyhow::Result<Box<dyn Backend>> {
        let limits = self.memory_limits();
        let Selection { backend, reason } =
            automatic::select(self.threads, self.simd.into(), limits)?;
        say(&format!("backend {reason}"))?;
        Ok(backend)
    }

    /// Creates the only backend that is fast in this build, and prints that on standard error.
    #[cfg(not(feature = "gpu"))]
    fn best(&self) -> anyhow::Result<Box<dyn Backend>> {
        anyhow::ensure!(
            self.gpu_memory_gib.is_none(),
            "--gpu-memory-gib: {}",
            built_without("gpu")
        );
        say(&format!("backend cpu: {}", built_without("gpu")))?;
        Ok(Box::new(self.cpu()?))
    }

    /// The gpu backend is not in this build.
    ///
    /// # Errors
    /// Always: it says what to build.
    #[cfg(not(feature = "gpu"))]
    fn gpu(&self) -> anyhow::Result<Cpu> {
        anyhow::bail!("--backend gpu: {}", built_without("gpu"))
    }

    /// Creates a gpu backend on each of several devices, which share the render threads.
    #[cfg(feature = "gpu")]
    fn gpus(&self, devices: &[usize]) -> anyhow::Result<Arc<dyn Backend>> {
        let mut numbers = BTreeSet::new();
        if let Some(twice) = devices.iter().find(|number| !numbers.insert(**number)) {
            anyhow::bail!("--devices: {twice} is named twice; its memory would hold all twice");
        }
        let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
        let threads = if self.threads == 0 { cores } else { self.threads };
        let gpu = |number: &usize| {
            let choice = AdapterChoice::Named(number.to_string());
            let share = threads.div_ceil(devices.len());
            let gpu = Gpu::with_limits(&choice, share, self.memory_limits())
                .with_context(|| format!("--devices {number}"))?;
            Ok(Arc::new(gpu) as Arc<dyn Backend>)
        };
        let gpus: anyhow::Result<Vec<_>> = devices.iter().map(gpu).collect();
        Ok(Arc::new(SeveralDevices::new(gpus?).context("--devices")?))
    }

    /// The gpu backend is not in this build.
    ///
    /// # Errors
    /// Always: it says what to build.
    #[cfg(not(feature = "gpu"))]
    fn gpus(&self, _devices: &[usize]) -> anyhow::Result<Arc<dyn Backend>> {
        anyhow::bail!("--devices: {}", built_without("gpu"))
    }

    /// Creates the gpu backend.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> anyhow::Result<Gpu> {
        Ok(self.gpu_or(AdapterChoice::Best)?)
    }

    /// Every backend that computes gradients here: cpu, and gpu if `--device` names a device or the
    /// machine has a hardware device.
    pub fn differentiating(&self) -> anyhow::Result<Vec<Box<dyn Differentiate>>> {
        // In this order, because `training` takes the last one.
        #[allow(unused_mut, reason = "a build without gpu adds none")]
        let mut backends: Vec<Box<dyn Differentiate>> = vec![Box::new(self.cpu()?)];
        #[cfg(feature = "gpu")]
        match self.gpu_or(AdapterChoice::Hardware) {
            Ok(gpu) => backends.push(Box::new(gpu)),
            // A machine without a GPU trains on its processor; a device that is named must exist.
            Err(GpuError::NoAdapter) if self.device.is_none() => {}
            Err(error) => return Err(error.into()),
        }
        #[cfg(not(feature = "gpu"))]
        anyhow::ensure!(self.device.is_none(), "--device: {}", built_without("gpu"));
        Ok(backends)
    }

    /// The backend that a run of training uses: the gpu backend where [`Self::differentiating`] has
    /// it, and cpu elsewhere.
    #[cfg(feature = "train")]
    pub fn training(&self) -> anyhow::Result<Box<dyn Differentiate>> {
        anyhow::Context::context(self.differentiating()?.pop(), "no backend computes gradients")
    }

    /// Creates the gpu backend on the device that `--device` names, or on that of choice.
    #[cfg(feature = "gpu")]
    fn gpu_or(&self, choice: AdapterChoice) -> Result<Gpu, GpuError> {
        let choice = self.device.clone().map_or(choice, AdapterChoice::Named);
        Gpu::with_limits(&choice, self.threads, self.memory_limits())
    }

    #[cfg(feature = "gpu")]
    fn memory_limits(&self) -> MemoryLimits {
        MemoryLimits {
            mirror_bytes: self.gpu_memory_gib.map_or(u64::MAX, bytes_of_gib),
            ..MemoryLimits::default()
        }
    }
}

impl RendererOptions {
    /// Creates the backend that `--backend` and `--cpu-through` choose.
    pub fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        let BackendOptions { backend, hardware } = &self.backend;
        match (self.cpu_through, backend) {
            (None, _) => self.backend.backend(),
            #[cfg(feature = "gpu")]
            (Some(stage), BackendName::Auto | BackendName::Gpu) => {
                Ok(Box::new(HybridBackend::new(hardware.cpu()?, hardware.gpu()?, stage.into())))
            }
            #[cfg(not(feature = "gpu"))]
            (Some(_), BackendName::Auto | BackendName::Gpu) => Ok(Box::new(hardware.gpu()?)),
            (Some(_), BackendName::Cpu | BackendName::Reference) => anyhow::bail!(
                "--cpu-through leaves the later stages to the GPU: leave --backend away, or give \
                 --backend gpu"
            ),
        }
    }
}

/// Tells the choice of the backend: in the log of a program that has one, else on standard error.
fn say(text: &str) -> io::Result<()> {
    // A server logs in the format that was asked for; other commands have no subscriber.
    if tracing::dispatcher::has_been_set() {
        tracing::info!("{text}");
        return Ok(());
    }
    writeln!(io::stderr(), "{text}")
}

fn threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(threads) if threads <= wildcity_render::limits::RENDER_THREADS => Ok(threads),
        _ => Err(format!("expected 0 to {}", wildcity_render::limits::RENDER_THREADS)),
    }
}

/// Parses a number of GiB.
pub fn gib(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(gib) if gib > 0.0 && gib <= 65_536.0 => Ok(gib),
        _ => Err("expected GiB above 0 and up to 65536, for example 2 or 0.5".to_owned()),
    }
}

/// Converts GiB to bytes, rounded down.
pub fn bytes_of_gib(gib: f64) -> u64 {
    (gib * f64::from(1 << 30)) as u64
}
