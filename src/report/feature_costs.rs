//! Only what is needed: what one step of a street holds, moves and runs, with each feature and without.
//!
//! ResourceCounts, not times: they are the same on every machine, and a base scene that pays for a feature of
//! others is seen at once.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use serde::Serialize;

use super::ReportError;
use super::measure::sky_bytes;
use wildcity_render::compare::images::view_along;
use wildcity_render::cpu::Cpu;
use wildcity_render::gpu::{Gpu, GpuUsage};
use wildcity_render::{Backend, Frame, FrameStats, RenderError, RollingShutter, Target, View};
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::geometry::camera::{
    Bivariate, Fisheye, Lens, ShutterDirection, Windshield, WindshieldReference,
};
use wildcity_scene::sky::{CubeMap, Layer, Network, SkyModel};
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene, Sky, lod};

/// One street with one feature.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FeatureCounts {
    /// The feature, as `SH degree 1`.
    pub with: &'static str,
    /// What was counted.
    pub counts: ResourceCounts,
}

/// What one step takes. Those of a device are absent where there is none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ResourceCounts {
    /// Gaussians in the frame.
    pub gaussians: u64,
    /// Bytes of one in the host's memory.
    pub host_bytes: f64,
    /// Bytes besides them there: maps of skies, images of hoods.
    pub beside_bytes: u64,
    /// Bytes of a pixel there.
    pub host_pixel_bytes: u64,
    /// Evaluations of a Gaussian at a pixel by the cpu backend.
    pub evaluations: u64,
    /// What a device does.
    pub device: Option<DeviceCounts>,
}

/// What one step takes on a device that draws nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DeviceCounts {
    /// Bytes of a Gaussian in its memory.
    pub gaussian_bytes: f64,
    /// Kernels that were compiled.
    pub pipelines: u64,
    /// Buffers that were made.
    pub buffers: u64,
    /// Kernels that a step starts.
    pub dispatches: u64,
    /// Bytes that the stages move, at least.
    pub moved_bytes: u64,
    /// Bytes of a pixel that go back to the host.
    pub pixel_bytes: u64,
}

/// Names of the columns, in order of [`ResourceCounts::texts`].
pub const COLUMNS: [&str; 11] = [
    "Gaussians",
    "B each, host",
    "kB besides, host",
    "B of a pixel, host",
    "evaluations, cpu",
    "B each, device",
    "pipelines",
    "buffers",
    "dispatches",
    "MB moved",
    "B of a pixel back",
];

/// What this build has not, so that no twin can pay for it.
pub const ABSENT: &str =
    "Nothing repairs images: there is no code, library, buffer or pipeline of it.";

/// A feature, and what it changes.
type Feature = (&'static str, fn(&mut Step));

const FEATURES: [Feature; 18] = [
    ("nothing else", |_| {}),
    ("SH degree 1", |step| step.scene = Scene::from_gaussians(&street(1))),
    ("SH degree 3", |step| step.scene = Scene::from_gaussians(&street(3))),
    ("levels of detail, 1 m", |step| step.scene = coarser(&step.scene, 1.0)),
    ("antialiasing", |step| step.profile.antialiased = true),
    ("background", |step| step.profile.background = [0.5, 0.6, 0.8]),
    ("sky of images", |step| step.behind(SkyModel::cube(CubeMap::uniform(DVec3::splat(0.5))))),
    ("sky, baked", |step| step.behind(network())),
    ("sky, exact", |step| {
        step.behind(network());
        step.profile.sky_error = 0.0;
    }),
    ("fisheye", |step| {
        step.view.camera.lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, 0.0, 0.0], None));
    }),
    ("windshield", |step| step.view.camera.windshield = Some(windshield())),
    ("rolling shutter", |step| {
        let mut first = step.view.world_from_camera;
        first.position_m.x -= 0.5;
        let direction = ShutterDirection::TopToBottom;
        step.view.rolling_shutter =
            Some(RollingShutter { direction, world_from_camera_first: first });
    }),
    ("exposure", |step| {
        let matrix = [[1.1, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.9]];
        step.appearance.exposure = Some(Exposure { matrix, offset: [0.0; 3] });
    }),
    ("hood", |step| {
        let rgba8 = [20, 20, 25, 255].repeat(step.view.camera.pixels());
        // Whole rows: it is one.
        step.appearance.overlay = Overlay::new(step.view.camera.width_px, rgba8).ok().map(Arc::new);
    }),
    ("depth", |step| step.depth = true),
    ("depth and opacity", |step| (step.depth, step.opacity) = (true, true)),
    // Normals are computed of the depth, on the host.
    ("normals", |step| (step.depth, step.normals) = (true, true)),
    // Trust is computed of the opacity, on the host.
    ("trust", |step| step.opacity = true),
];

/// Draws the street with each feature. `device` opens a device that drew nothing yet, or says that there
/// is none.
///
/// # Errors
/// A frame cannot be drawn.
pub fn count_features(
    cpu: &Cpu,
    device: &dyn Fn() -> Option<Gpu>,
) -> Result<Vec<FeatureCounts>, ReportError> {
    let counted = |(with, change): Feature| {
        let mut step = Step::base();
        change(&mut step);
        Ok(FeatureCounts { with, counts: step.counts(cpu, device())? })
    };
    FEATURES.into_iter().map(counted).collect()
}

/// A street with colours of a degree, as flat where the base is.
fn street(degree: u8) -> Gaussians {
    let mut street = wildcity_generate::canyon(20_000, &mut |_, _| {});
    let flat = street.sh.chunks_exact(12).flat_map(|colour| colour[..3].to_vec()).collect();
    (street.sh, street.sh_degree) = (flat, 0);
    street.raise_sh_degree(degree);
    street
}

/// The coarsest level of each chunk with at most this error, in metres.
fn coarser(scene: &Scene, error_m: f32) -> Scene {
    let level = |chunk: &Arc<Chunk>| {
        let levels = lod::levels(chunk).into_iter();
        let fine = levels.take_while(|level| level.error_m <= error_m);
        fine.last().map_or_else(|| chunk.clone(), |level| Arc::new(level.chunk))
    };
    Scene { chunks: scene.chunks.iter().map(level).collect(), ..scene.clone() }
}

/// A sky of three octaves and 16 neurons, gentle enough to be baked coarsely.
fn network() -> SkyModel {
    let layer = |outputs: usize, inputs: usize| {
        let numbers = |count: usize| (0..count).map(|i| 0.4 * (1.7 * i as f32).sin()).collect();
        Layer { outputs, inputs, weight: numbers(outputs * inputs), bias: numbers(outputs) }
    };
    let layers = [layer(16, 21), layer(16, 16), layer(3, 16)];
    SkyModel::network(Network::new(layers, Vec::new()).expect("layers that fit each other"))
}

/// One that turns rays by some milliradians.
fn windshield() -> Windshield {
    let plane = |field, plane: [f64; 3]| Bivariate::new(field, &plane).expect("three are order 1");
    let horizontal = plane("horizontal", [-0.004, 1.002, 0.0]);
    let vertical = plane("vertical", [0.005, 0.0, 1.01]);
    Windshield::new(WindshieldReference::Forward, horizontal, vertical)
}

struct Step {
    scene: Scene,
    profile: RenderProfile,
    view: View,
    appearance: Appearance,
    depth: bool,
    opacity: bool,
    normals: bool,
}

impl Step {
    fn base() -> Self {
        let eye_m = DVec3::new(-20.0, 0.3, 1.6);
        Self {
            scene: Scene::from_gaussians(&street(0)),
            profile: RenderProfile::default(),
            view: view_along([320, 180], 240.0, eye_m, DVec3::X, DVec3::NEG_Z),
            appearance: Appearance::default(),
            depth: false,
            opacity: false,
            normals: false,
        }
    }

    fn behind(&mut self, model: SkyModel) {
        self.scene.sky = Some(Arc::new(Sky::new(model, DMat3::IDENTITY)));
    }

    fn counts(&self, cpu: &Cpu, device: Option<Gpu>) -> Result<ResourceCounts, ReportError> {
        let FrameStats { evaluations, .. } = self.draw(cpu)?;
        let device = device.map(|gpu| self.of_device(&gpu)).transpose()?.flatten();
        let gaussians = self.scene.gaussians() as u64;
        let floats = u64::from(self.depth) + u64::from(self.opacity) + 3 * u64::from(self.normals);
        let sky_bytes = sky_bytes(&self.scene, &self.profile)?;
        let hood_bytes = self.appearance.overlay.as_ref().map_or(0, |hood| hood.rgba8().len());
        Ok(ResourceCounts {
            gaussians,
            host_bytes: self.scene.bytes() as f64 / gaussians as f64,
            beside_bytes: sky_bytes + hood_bytes as u64,
            host_pixel_bytes: 3 + 4 * floats,
            evaluations,
            device,
        })
    }

    /// `None` if it was lost meanwhile.
    fn of_device(&self, gpu: &Gpu) -> Result<Option<DeviceCounts>, ReportError> {
        // The first frame makes room, perhaps in several tries.
        self.draw(gpu)?;
        let dispatches = |usage: &GpuUsage| usage.totals.dispatches;
        let before = gpu.usage().as_ref().map_or(0, dispatches);
        self.draw(gpu)?;
        Ok(gpu.usage().map(|usage| DeviceCounts {
            gaussian_bytes: usage.mirror_bytes as f64 / self.scene.gaussians() as f64,
            pipelines: usage.totals.pipelines,
            buffers: usage.totals.buffers,
            dispatches: dispatches(&usage) - before,
            moved_bytes: usage.last_frame.stage_bytes().iter().map(|(_, bytes)| bytes).sum(),
            pixel_bytes: 4 * usage.last_frame.planes,
        }))
    }

    fn draw(&self, backend: &dyn Backend) -> Result<FrameStats, RenderError> {
        let pixels = self.view.camera.pixels();
        let mut rgb8 = vec![0; 3 * pixels];
        let plane = |wanted: bool, values: usize| wanted.then(|| vec![0.0; values * pixels]);
        let (mut depth_m, mut opacity) = (plane(self.depth, 1), plane(self.opacity, 1));
        let mut normals = plane(self.normals, 3);
        let target = Target {
            rgb8: Some(&mut rgb8),
            depth_m: depth_m.as_deref_mut(),
            opacity: opacity.as_deref_mut(),
            normals: normals.as_deref_mut(),
            appearance: (!self.appearance.is_identity()).then_some(&self.appearance),
            ..Target::default()
        };
        let views = &[self.view];
        let frame = Frame { scene: &self.scene, profile: &self.profile, views };
        backend.render(&frame, &mut [target], &|_, _| {})
    }
}

impl ResourceCounts {
    /// In words, by [`COLUMNS`].
    pub fn texts(&self) -> [String; 11] {
        let device = |text: &dyn Fn(&DeviceCounts) -> String| {
            self.device.as_ref().map_or_else(|| "none".to_owned(), text)
        };
        [
            self.gaussians.to_string(),
            format!("{:.1}", self.host_bytes),
            format!("{:.1}", self.beside_bytes as f64 / 1e3),
            self.host_pixel_bytes.to_string(),
            self.evaluations.to_string(),
            device(&|d| format!("{:.1}", d.gaussian_bytes)),
            device(&|d| d.pipelines.to_string()),
            device(&|d| d.buffers.to_string()),
            device(&|d| d.dispatches.to_string()),
            device(&|d| format!("{:.2}", d.moved_bytes as f64 / 1e6)),
            device(&|d| d.pixel_bytes.to_string()),
        ]
    }
}
