//! Memory, traffic and GPU work of one step of a street, with each feature of a scene and without:
//! a scene pays only for the features that it has.
//!
//! These are counts (pipelines, buffers, dispatches, bytes), not times: they are the same on every
//! machine, and show at once if the base scene pays for a feature that it does not have.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use serde::Serialize;

use super::error::ReportError;
use super::measure::sky_bytes;
use wildcity_render::compare::images::view_along;
use wildcity_render::cpu::Cpu;
use wildcity_render::gpu::{Gpu, GpuUsage};
use wildcity_render::gradient::{GaussianImages, Gradients};
use wildcity_render::{Backend, Frame, FrameStats, RollingShutter, Target, View};
use wildcity_scene::actor::{ContactShadow, PlacedChunk};
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::{
    Bivariate, Fisheye, Lens, ShutterDirection, Windshield, WindshieldReference,
};
use wildcity_scene::sky::{CubeMap, Layer, Network, SkyModel};
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene, SemanticClass, Sky, lod};

/// Counts of the street with one feature.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FeatureCounts {
    /// The feature, for example `SH degree 1`.
    #[serde(rename = "with")]
    pub feature: &'static str,
    /// The resources of one step.
    pub counts: ResourceCounts,
}

/// The resources that one step takes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ResourceCounts {
    /// Gaussians in the frame.
    pub gaussians: u64,
    /// Bytes per Gaussian in host memory.
    #[serde(rename = "host_bytes")]
    pub host_bytes_per_gaussian: f64,
    /// Other host memory in bytes: sky maps, images of hoods.
    #[serde(rename = "beside_bytes")]
    pub other_host_bytes: u64,
    /// Bytes per pixel in host memory.
    #[serde(rename = "host_pixel_bytes")]
    pub host_bytes_per_pixel: u64,
    /// Evaluations of a Gaussian at a pixel by the cpu backend.
    pub evaluations: u64,
    /// The resources on a device. `None` without a device.
    pub device: Option<DeviceCounts>,
}

/// The resources that one step takes on a device that renders nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DeviceCounts {
    /// Bytes per Gaussian in device memory.
    #[serde(rename = "gaussian_bytes")]
    pub bytes_per_gaussian: f64,
    /// Pipelines that were compiled.
    pub pipelines: u64,
    /// Buffers that were created.
    pub buffers: u64,
    /// Dispatches of a step.
    pub dispatches: u64,
    /// Bytes that the stages move at least.
    pub moved_bytes: u64,
    /// Bytes per pixel that are read back to the host.
    #[serde(rename = "pixel_bytes")]
    pub read_back_bytes_per_pixel: u64,
}

/// Headings of the columns, in the order of [`ResourceCounts::cells`].
pub const COLUMNS: [&str; 11] = [
    "Gaussians",
    "host memory, B per Gaussian",
    "other host memory, kB",
    "host memory, B per pixel",
    "evaluations on the cpu backend",
    "device memory, B per Gaussian",
    "pipelines compiled",
    "buffers created",
    "dispatches per step",
    "device memory traffic, MB per step",
    "read back, B per pixel",
];

/// Why the table has no row for repair.
pub const WITHOUT_REPAIR: &str = "Repair adds nothing here: a model gets the finished images of sessions that ask for it, and its \
     library is loaded with the first of them.";

/// A feature: its name, and how it changes the base step.
struct Feature {
    name: &'static str,
    add: fn(&mut Step),
}

const fn feature(name: &'static str, add: fn(&mut Step)) -> Feature {
    Feature { name, add }
}

const FEATURES: [Feature; 24] = [
    feature("nothing else", |_| {}),
    // The same colours with more coefficients: only memory and traffic may change, not the image.
    feature("SH degree 1", |step| step.scene = Scene::from_gaussians(&street(1))),
    feature("SH degree 3", |step| step.scene = Scene::from_gaussians(&street(3))),
    feature("levels of detail, 1 m", |step| step.scene = with_levels(&step.scene, 1.0)),
    feature("antialiasing", |step| step.profile.antialiased = true),
    feature("background", |step| step.profile.background = [0.5, 0.6, 0.8]),
    feature("sky of images", |step| {
        // One colour: the counts do not depend on the content of a map.
        step.set_sky(SkyModel::cube(CubeMap::uniform(DVec3::splat(0.5))));
    }),
    feature("sky, baked", |step| step.set_sky(sky_network())),
    feature("sky, exact", |step| {
        step.set_sky(sky_network());
        step.profile.sky_error = 0.0;
    }),
    feature("fisheye", |step| {
        step.view.camera.lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, 0.0, 0.0], None));
    }),
    feature("windshield", |step| step.view.camera.windshield = Some(windshield())),
    feature("rolling shutter", |step| {
        // Half a metre during the exposure: more than any rounding that would make it a
        // camera at rest.
        let mut first = step.view.world_from_camera;
        first.position_m.x -= 0.5;
        let direction = ShutterDirection::TopToBottom;
        step.view.rolling_shutter =
            Some(RollingShutter { direction, world_from_camera_first: first });
    }),
    feature("exposure", |step| {
        let matrix = [[1.1, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.9]];
        step.appearance.exposure = Some(Exposure { matrix, offset: [0.0; 3] });
    }),
    feature("hood", |step| {
        let rgba8 = [20, 20, 25, 255].repeat(step.view.camera.pixels());
        // An overlay consists of whole rows, and this one is all rows of the image: it is valid.
        step.appearance.overlay = Overlay::new(step.view.camera.width_px, rgba8).ok().map(Arc::new);
    }),
    feature("depth", |step| step.depth = true),
    feature("depth and opacity", |step| {
        step.depth = true;
        step.opacity = true;
    }),
    // The host computes normals from the depth.
    feature("normals", |step| {
        step.depth = true;
        step.normals = true;
    }),
    feature("two actors", |step| step.place_actors(DVec3::ZERO)),
    // Moving while the rows of a camera at rest are exposed.
    feature("two moving actors", |step| {
        step.place_actors(DVec3::new(0.0, -0.9, 0.0));
        step.view.readout = Some(ShutterDirection::TopToBottom);
    }),
    feature("instance ids", |step| step.instances = true),
    // A scene that has classes, without a target for them.
    feature("classes", Step::set_classes),
    feature("semantics", |step| {
        step.set_classes();
        step.semantics = true;
    }),
    // The host computes the trust from the opacity.
    feature("trust", |step| step.opacity = true),
    // Only a trainer asks for them.
    feature("gradients", |step| step.gradients = true),
];

/// Renders the street with each feature on the cpu backend and on a device, and counts.
/// `open_device` opens a device that has rendered nothing yet; it gives none if there is no device.
///
/// # Errors
/// A frame cannot be rendered.
pub fn count_features(
    cpu: &Cpu,
    open_device: &dyn Fn() -> Option<Gpu>,
) -> Result<Vec<FeatureCounts>, ReportError> {
    let count = |feature: Feature| {
        // A fresh step and a fresh device for each feature, so that nothing of another is counted.
        let mut step = Step::base();
        (feature.add)(&mut step);
        let counts = step.counts(cpu, open_device())?;
        Ok(FeatureCounts { feature: feature.name, counts })
    };
    FEATURES.into_iter().map(count).collect()
}

/// A street of SH degree `degree`. Its colours are those of degree 0 with coefficients of 0 above.
fn street(degree: u8) -> Gaussians {
    let mut street = wildcity_generate::canyon(20_000, &mut |_, _| {});
    // The generated street has SH degree 1: 12 coefficients, of which the first 3 are degree 0.
    street.sh = street.sh.chunks_exact(12).flat_map(|sh| sh[..3].to_vec()).collect();
    street.sh_degree = 0;
    street.raise_sh_degree(degree);
    street
}

/// Each chunk at its coarsest level that has at most this error, in metres.
fn with_levels(scene: &Scene, max_error_m: f32) -> Scene {
    let coarsest = |chunk: &Arc<Chunk>| {
        let levels = lod::levels(chunk);
        let allowed = levels.take_while(|level| level.error_m <= max_error_m);
        // Without a level within the error the chunk is drawn in full.
        allowed.last().map_or_else(|| chunk.clone(), |level| Arc::new(level.chunk))
    };
    Scene { chunks: scene.chunks.iter().map(coarsest).collect(), ..scene.clone() }
}

/// A sky network with three octaves and 16 neurons. It is smooth enough to be baked into a small
/// map.
fn sky_network() -> SkyModel {
    let layer = |outputs: usize, inputs: usize| {
        // Fixed numbers without a pattern: the network has to be the same in every run, no more.
        let numbers = |count: usize| (0..count).map(|i| 0.4 * (1.7 * i as f32).sin()).collect();
        Layer { outputs, inputs, weight: numbers(outputs * inputs), bias: numbers(outputs) }
    };
    // Three octaves of sine and cosine of three coordinates, and the coordinates: 21 inputs.
    let layers = [layer(16, 21), layer(16, 16), layer(3, 16)];
    SkyModel::network(Network::new(layers, Vec::new()).expect("the sizes of the layers match"))
}

/// A windshield that turns rays by some milliradians.
fn windshield() -> Windshield {
    let plane = |field, coefficients: [f64; 3]| {
        Bivariate::new(field, &coefficients)
            .expect("three coefficients are a polynomial of order 1")
    };
    // h(phi, theta) = -0.004 + 1.002 phi and 0.005 + 1.01 theta: nearly the identity.
    let horizontal = plane("horizontal", [-0.004, 1.002, 0.0]);
    let vertical = plane("vertical", [0.005, 0.0, 1.01]);
    Windshield::new(WindshieldReference::Forward, horizontal, vertical)
}

/// A scene, one camera, and the outputs that are asked for.
struct Step {
    scene: Scene,
    profile: RenderProfile,
    view: View,
    appearance: Appearance,
    depth: bool,
    opacity: bool,
    normals: bool,
    instances: bool,
    semantics: bool,
    gradients: bool,
}

impl Step {
    /// The street without features, seen by one pinhole camera.
    fn base() -> Self {
        let camera_m = DVec3::new(-20.0, 0.3, 1.6);
        Self {
            scene: Scene::from_gaussians(&street(0)),
            profile: RenderProfile::default(),
            view: view_along([320, 180], 240.0, camera_m, DVec3::X, DVec3::NEG_Z),
            appearance: Appearance::default(),
            depth: false,
            opacity: false,
            normals: false,
            instances: false,
            semantics: false,
            gradients: false,
        }
    }

    /// Two actors of one asset, with shadows and a tint. `since_start_m` is their way during the
    /// exposure.
    fn place_actors(&mut self, since_start_m: DVec3) {
        // Standard deviations of 2 cm.
        let size = 0.02_f64.ln() as f32;
        let mut ball = Gaussians::with_capacity(1, 500);
        for i in 0..500 {
            // 499 is prime: each factor permutes the multiples, and the 500 points fill a box of 4
            // x 1.8 x 1.5 m.
            let at = |k: usize| (i * k % 499) as f64 / 499.0;
            ball.means_m.push([4.0 * at(31) - 2.0, 1.8 * at(57) - 0.9, 1.5 * at(71)]);
            ball.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            ball.ln_scales.push([size; 3]);
            ball.logit_opacities.push(3.0);
            ball.sh.extend([0.1; 12]);
        }
        let chunk = Arc::new(Scene::single_chunk(&ball));
        // Both ahead of the camera at x = -20, one behind the other.
        for (actor, x) in [-8.0, -2.0].into_iter().enumerate() {
            let pose = Pose { position_m: DVec3::new(x, 0.0, 0.0), ..Pose::IDENTITY };
            let placed = PlacedChunk::at_rest(Arc::clone(&chunk), pose, actor as u16);
            let mut start = pose;
            start.position_m -= since_start_m;
            self.scene.placed.push(PlacedChunk {
                world_from_actor_at_start: start,
                tint: [1.0, 0.5, 0.5],
                shadow: Some(ContactShadow { length_m: 4.0, width_m: 1.8 }),
                ..placed
            });
        }
    }

    fn set_classes(&mut self) {
        for chunk in &mut self.scene.chunks {
            let classes = vec![SemanticClass::Building; chunk.len()];
            *chunk = Arc::new(Chunk::clone(chunk).with_classes(Some(classes)));
        }
    }

    fn set_sky(&mut self, model: SkyModel) {
        self.scene.sky = Some(Arc::new(Sky::new(model, DMat3::IDENTITY)));
    }

    fn counts(&self, cpu: &Cpu, device: Option<Gpu>) -> Result<ResourceCounts, ReportError> {
        // The counts of the cpu backend do not depend on its threads.
        let evaluations = self.render(cpu)?.evaluations;
        let device = device.map(|gpu| self.device_counts(&gpu)).transpose()?.flatten();
        let gaussians = self.scene.gaussians() as u64;
        // Requested planes as 0 or 1, for the sum of their bytes.
        let ids = 2 * u64::from(self.instances) + u64::from(self.semantics);
        let floats = u64::from(self.depth) + u64::from(self.opacity) + 3 * u64::from(self.normals);
        let sky_bytes = sky_bytes(&self.scene, &self.profile)?;
        let hood_bytes = self.appearance.overlay.as_ref().map_or(0, |hood| hood.rgba8().len());
        Ok(ResourceCounts {
            gaussians,
            host_bytes_per_gaussian: self.scene.bytes() as f64 / gaussians as f64,
            other_host_bytes: sky_bytes + hood_bytes as u64,
            // 8-bit colour, u16 for instance ids, u8 for classes, and f32 for the other outputs.
            // Gradients take colour and opacity, the derivatives by them, and 24 B that each tile
            // keeps.
            host_bytes_per_pixel: if self.gradients { 56 } else { 3 + ids + 4 * floats },
            evaluations,
            device,
        })
    }

    /// None if the device was lost in the meantime.
    fn device_counts(&self, gpu: &Gpu) -> Result<Option<DeviceCounts>, ReportError> {
        // The first frame grows the buffers, perhaps in several attempts; the second one is
        // counted.
        self.render(gpu)?;
        let dispatches = |usage: &GpuUsage| usage.totals.dispatches;
        // Totals are since the device was opened; a lost device has no usage.
        let before = gpu.usage().as_ref().map_or(0, dispatches);
        self.render(gpu)?;
        Ok(gpu.usage().map(|usage| DeviceCounts {
            bytes_per_gaussian: usage.mirror_bytes as f64 / self.scene.gaussians() as f64,
            pipelines: usage.totals.pipelines,
            buffers: usage.totals.buffers,
            dispatches: dispatches(&usage) - before,
            moved_bytes: usage.last_frame.stage_bytes().iter().map(|(_, bytes)| bytes).sum(),
            read_back_bytes_per_pixel: usage.last_frame.pixel_bytes,
        }))
    }

    fn render(&self, backend: &dyn Backend) -> Result<FrameStats, ReportError> {
        let views = &[self.view];
        let frame = Frame { scene: &self.scene, profile: &self.profile, views };
        if let (true, Some(backend)) = (self.gradients, backend.as_differentiate()) {
            // The derivatives of half the sum of squares are the images themselves.
            let mut loss = |images: &[GaussianImages]| images.to_vec();
            let mut gradients = Gradients::default();
            return Ok(backend.differentiate(&frame, false, &mut loss, &mut gradients)?);
        }
        let pixels = self.view.camera.pixels();
        let plane = |wanted: bool, values: usize| wanted.then(|| vec![0.0; values * pixels]);
        let mut rgb8 = vec![0; 3 * pixels];
        let mut depth_m = plane(self.depth, 1);
        let mut opacity = plane(self.opacity, 1);
        let mut normals = plane(self.normals, 3);
        let mut instances = self.instances.then(|| vec![0; pixels]);
        let mut semantics = self.semantics.then(|| vec![0; pixels]);
        let target = Target {
            rgb8: Some(&mut rgb8),
            depth_m: depth_m.as_deref_mut(),
            opacity: opacity.as_deref_mut(),
            normals: normals.as_deref_mut(),
            instances: instances.as_deref_mut(),
            semantics: semantics.as_deref_mut(),
            // A backend gets no appearance at all if it would change nothing: that row has
            // to cost nothing.
            appearance: (!self.appearance.is_identity()).then_some(&self.appearance),
            ..Target::default()
        };
        Ok(backend.render(&frame, &mut [target], &|_, _| {})?)
    }
}

impl ResourceCounts {
    /// The counts as text, in the order of [`COLUMNS`].
    pub fn cells(&self) -> [String; 11] {
        let on_device = |text: &dyn Fn(&DeviceCounts) -> String| {
            self.device.as_ref().map_or_else(|| "none".to_owned(), text)
        };
        [
            self.gaussians.to_string(),
            format!("{:.1}", self.host_bytes_per_gaussian),
            format!("{:.1}", self.other_host_bytes as f64 / 1e3),
            self.host_bytes_per_pixel.to_string(),
            self.evaluations.to_string(),
            on_device(&|d| format!("{:.1}", d.bytes_per_gaussian)),
            on_device(&|d| d.pipelines.to_string()),
            on_device(&|d| d.buffers.to_string()),
            on_device(&|d| d.dispatches.to_string()),
            on_device(&|d| format!("{:.2}", d.moved_bytes as f64 / 1e6)),
            on_device(&|d| d.read_back_bytes_per_pixel.to_string()),
        ]
    }
}
