//! What the rendering commands share: a scene to render, cameras, a profile, a backend.

use std::borrow::Cow;
use std::io::{self, Write};
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use clap::ValueEnum;

use wildcity_render::automatic::{Automatic, automatic};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::gpu::{AdapterChoice, Gpu, MemoryLimits};
use wildcity_render::reference::Reference;
use wildcity_render::relay::Relay;
use wildcity_render::stage::Stage;
use wildcity_render::{Backend, View};
use wildcity_scene::{RenderProfile, Scene};
use wildcity_twin::ingest::cameras::{self, ListedCamera};
use wildcity_twin::ingest::{self};
use wildcity_twin::residency::{Cache, Pinned, Resident};

use super::places::{TwinVersion, Twins};
use super::progress;

/// A scene, cameras and settings on the command line.
#[derive(Debug, clap::Args)]
pub(super) struct SceneSource {
    /// A scene file (PLY or safetensors), or the name of a twin (NAME or NAME@VERSION).
    #[arg(value_name = "SCENE")]
    scene: String,

    /// JSON list of cameras in the scene's own axes: name, width, height, fx, fy, cx, cy, position
    /// (or position_ply), R_world_to_cam (rows), and optionally near.
    #[arg(long, value_name = "FILE")]
    cameras: PathBuf,

    #[command(flatten)]
    twins: Twins,

    /// A setting of the render profile, over the twin's or gsplat's; may be given again. Keys: near,
    /// far, blur, antialiased, alpha_cap, alpha_cut, stop, tau_px, reach_m.
    #[arg(long = "profile", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// Who renders, for the commands that look at the renderer itself.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Renderer {
    #[command(flatten)]
    engine: Engine,

    /// Run the stages up to and including this one on the cpu backend, and the rest on --device (one in
    /// software too). An image that is wrong with --cpu-through project and right with
    /// --cpu-through sort was spoilt by the GPU's sort; `wildcity bisect` tries them all.
    #[arg(long, value_name = "STAGE", value_enum)]
    cpu_through: Option<StageName>,
}

/// Which backend, on what.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Engine {
    /// Who renders.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendName,

    #[command(flatten)]
    machine: Machine,
}

/// What the backends run on.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Machine {
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

impl Engine {
    /// Makes the backend, and says on standard error which one it is if nobody named it.
    pub(super) fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        let Machine { threads, device, simd, .. } = &self.machine;
        match (self.backend, device) {
            (BackendName::Auto, None) => {
                let limits = self.machine.limits();
                let Automatic { backend, reason } = automatic(*threads, (*simd).into(), limits)?;
                writeln!(io::stderr(), "backend {reason}")?;
                Ok(backend)
            }
            (BackendName::Auto | BackendName::Gpu, _) => Ok(Box::new(self.machine.gpu()?)),
            (_, Some(device)) => {
                anyhow::bail!("--device {device:?} is one of the gpu backend: add --backend gpu")
            }
            (BackendName::Cpu, None) => Ok(Box::new(self.machine.cpu()?)),
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

impl Machine {
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

impl Renderer {
    /// Makes the backend.
    pub(super) fn backend(&self) -> anyhow::Result<Box<dyn Backend>> {
        let Engine { backend, machine } = &self.engine;
        match (self.cpu_through, backend) {
            (None, _) => self.engine.backend(),
            (Some(stage), BackendName::Auto | BackendName::Gpu) => {
                Ok(Box::new(Relay::new(machine.cpu()?, machine.gpu()?, stage.into())))
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

/// What a rendering command draws.
pub(super) struct Ready {
    source: Source,
    pub(super) shots: Vec<Shot>,
}

/// A camera with the profile that it is rendered with.
pub(super) struct Shot {
    pub(super) name: String,
    pub(super) view: View,
    pub(super) profile: RenderProfile,
}

/// Where scenes come from.
enum Source {
    /// A file: always drawn in full.
    File(Scene),
    /// A twin: drawn with as much detail as the cameras need.
    Twin(Arc<Resident>),
}

/// What is drawn of a source, in memory for as long as this lives.
pub(super) enum Drawn<'a> {
    Whole(Cow<'a, Scene>),
    Needed(Pinned),
}

impl Deref for Drawn<'_> {
    type Target = Scene;

    fn deref(&self) -> &Scene {
        match self {
            Self::Whole(scene) => scene,
            Self::Needed(pinned) => pinned,
        }
    }
}

impl Source {
    fn scene(&self, shots: &[Shot]) -> anyhow::Result<Drawn<'_>> {
        let views: Vec<View> = shots.iter().map(|shot| shot.view).collect();
        Ok(match (self, shots) {
            (Self::Twin(resident), [first, ..]) => {
                Drawn::Needed(resident.scene(&wildcity_session::eyes(&views), &first.profile)?)
            }
            (Self::Twin(_), []) => Drawn::Whole(Cow::default()),
            (Self::File(scene), _) => Drawn::Whole(Cow::Borrowed(scene)),
        })
    }
}

impl Ready {
    /// What a frame of one shot draws.
    pub(super) fn scene_of(&self, shot: &Shot) -> anyhow::Result<Drawn<'_>> {
        self.source.scene(std::slice::from_ref(shot))
    }

    /// What one frame of all shots draws.
    pub(super) fn scene(&self) -> anyhow::Result<Drawn<'_>> {
        self.source.scene(&self.shots)
    }
}

impl SceneSource {
    /// Reads the scene and the cameras.
    pub(super) fn open(&self) -> anyhow::Result<Ready> {
        let cameras =
            cameras::read(&self.cameras).with_context(|| format!("{}", self.cameras.display()))?;
        let (source, profile) = self.source()?;
        let shots = cameras.into_iter().map(|camera| self.shot(camera, profile));
        let shots = shots.collect::<anyhow::Result<Vec<_>>>()?;
        Ok(Ready { source, shots })
    }

    /// A camera's own near counts more than the twin's, and less than one on the command line.
    fn shot(&self, camera: ListedCamera, mut profile: RenderProfile) -> anyhow::Result<Shot> {
        let ListedCamera { name, camera, world_from_camera, near } = camera;
        profile.near = near.unwrap_or(profile.near);
        for setting in &self.settings {
            profile.set(setting)?;
        }
        profile.check().with_context(|| format!("camera {name:?}"))?;
        Ok(Shot { name, view: View::new(camera, world_from_camera), profile })
    }

    fn source(&self) -> anyhow::Result<(Source, RenderProfile)> {
        let path = Path::new(&self.scene);
        // A pipe or a device too, so that it is refused as one; a directory may share a twin's name.
        if path.exists() && !path.is_dir() {
            let bar = progress::bytes("reading");
            let gaussians = ingest::read(path, &mut progress::show(&bar))
                .with_context(|| format!("{}", path.display()))?;
            bar.finish_and_clear();
            let scene = Scene::from_gaussians(&gaussians);
            return Ok((Source::File(scene), RenderProfile::default()));
        }
        let named: TwinVersion = self.scene.parse().map_err(anyhow::Error::msg)?;
        let cache = Cache::new(self.twins.catalog()?);
        let resident = cache.open(&named.name, named.number).with_context(|| {
            format!("{:?} is no file, and as the name of a twin it fails", self.scene)
        })?;
        let profile = resident.version.manifest.profile;
        Ok((Source::Twin(resident), profile))
    }
}
