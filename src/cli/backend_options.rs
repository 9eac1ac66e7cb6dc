//! Options that choose the backend and the hardware it runs on.

use std::io::{self, Write};

use clap::ValueEnum;

use wildcity_render::Backend;
use wildcity_render::automatic::{self, Selection};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{AdapterChoice, Gpu, MemoryLimits};
use wildcity_render::hybrid::HybridBackend;
use wildcity_render::reference::Reference;
use wildcity_render::stage::Stage;

/// Who renders, for the commands that look at the renderer itself.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct RendererOptions {
    #[command(flatten)]
    backend: BackendOptions,

    /// Run the stages up to and including this one on the cpu backend, and the rest on --device (one in
    /// software too). An image that is wrong with --cpu-through project and right with
    /// --cpu-through sort was spoilt by the GPU's sort; `wildcity bisect` tries them all.
    #[arg(long, value_name = "STAGE", value_enum)]
    cpu_through: Option<StageName>,
}

/// Which backend, on what.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct BackendOptions {
    /// Who renders.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendName,

    #[command(flatten)]
    hardware: HardwareOptions,
}

/// What the backends run on.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct HardwareOptions {
    /// Render threads; 0 for one per core. Pixels do not depend on it.
    #[arg(long, default_value_t = 0, value_parser = threads)]
    threads: usize,

    /// Device of the gpu backend: its number in `wildcity devices`, or a part of its name; the fastest
    /// kind if not given.
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,

    /// Memory of the GPU that Gaussians may take, in GiB; those not drawn for longest make room for
    /// others. What is drawn on the way to the pixels comes on top [default: as much as it has]
    #[arg(long, value_name = "N", value_parser = gib)]
    gpu_memory_gib: Option<f64>,

    /// Instruction set of the cpu backend.
    #[arg(long, value_enum, default_value_t)]
    simd: SimdName,
}

/// The backends of this build.
#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum BackendName {
    /// gpu if `--device` names one, or if there is one in hardware that draws a trial card as the cpu
    /// backend does; else cpu. It is said on standard error.
    #[default]
    Auto,
    /// wgpu on Vulkan, `--device`.
    Gpu,
    /// f32, SIMD, all cores.
    Cpu,
    /// f64 by definition: slow.
    Reference,
}

/// [`Stage`] on the command line.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum StageName {
    /// Gaussians become splats.
    Project,
    /// Splats are put in order of depth.
    Sort,
    /// Every tile gets its list of splats: only rasterize is left to the GPU.
    Bin,
}

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
    /// The best of the machine.
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
    /// Makes the backend, and says on standard error which one it is if nobody named it.
    pub(super) fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        let HardwareOptions { threads, device, simd, .. } = &self.hardware;
        match (self.backend, device) {
            (BackendName::Auto, None) => {
                let limits = self.hardware.limits();
                let Selection { backend, reason } =
                    automatic::select(*threads, (*simd).into(), limits)?;
                writeln!(io::stderr(), "backend {reason}")?;
                Ok(backend)
            }
            (BackendName::Auto | BackendName::Gpu, _) => Ok(Box::new(self.hardware.gpu()?)),
            (_, Some(device)) => {
                anyhow::bail!("--device {device:?} is one of the gpu backend: add --backend gpu")
            }
            (BackendName::Cpu, None) => Ok(Box::new(self.hardware.cpu()?)),
            (BackendName::Reference, None) => Ok(Box::new(Reference)),
        }
    }

    /// The same, but what was recorded is drawn by what drew it, unless another one is named.
    pub(super) fn backend_of(&self, recorded: &str) -> anyhow::Result<Box<dyn Backend>> {
        let named = BackendName::from_str(recorded, false);
        match (self.backend, named) {
            (BackendName::Auto, Ok(backend)) => Self { backend, ..self.clone() }.backend(),
            _ => self.backend(),
        }
    }
}

impl HardwareOptions {
    /// The cpu backend.
    pub(super) fn cpu(&self) -> anyhow::Result<Cpu> {
        Ok(Cpu::new(self.threads, self.simd.into())?)
    }

    /// The gpu backend.
    pub(super) fn gpu(&self) -> anyhow::Result<Gpu> {
        let choice = self.device.clone().map_or(AdapterChoice::Best, AdapterChoice::Named);
        Ok(Gpu::with_limits(&choice, self.threads, self.limits())?)
    }

    fn limits(&self) -> MemoryLimits {
        MemoryLimits {
            mirror_bytes: self.gpu_memory_gib.map_or(u64::MAX, bytes_of_gib),
            ..MemoryLimits::default()
        }
    }
}

impl RendererOptions {
    /// Makes the backend.
    pub(super) fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        let BackendOptions { backend, hardware } = &self.backend;
        match (self.cpu_through, backend) {
            (None, _) => self.backend.backend(),
            (Some(stage), BackendName::Auto | BackendName::Gpu) => {
                Ok(Box::new(HybridBackend::new(hardware.cpu()?, hardware.gpu()?, stage.into())))
            }
            (Some(_), BackendName::Cpu | BackendName::Reference) => anyhow::bail!(
                "--cpu-through leaves the stages after it to the GPU: leave --backend away, or give \
                 --backend gpu"
            ),
        }
    }
}

fn threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(threads) if threads <= wildcity_render::limits::RENDER_THREADS => Ok(threads),
        _ => Err(format!("expected 0 to {}", wildcity_render::limits::RENDER_THREADS)),
    }
}

/// A number of GiB on the command line.
pub(super) fn gib(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(gib) if gib > 0.0 && gib <= 65_536.0 => Ok(gib),
        _ => Err("expected a number above 0, to 65536".to_owned()),
    }
}

/// Bytes of so many GiB.
pub(super) fn bytes_of_gib(gib: f64) -> u64 {
    (gib * f64::from(1 << 30)) as u64
}
