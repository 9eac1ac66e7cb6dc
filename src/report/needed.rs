//! Only what is needed: what one step of a street holds, moves and runs, with each feature and without.
//!
//! Counts, not times: they are the same on every machine, and a base scene that pays for a feature of
//! others is seen at once.

use serde::Serialize;

use super::ReportError;
use super::drawing::look;
use crate::generate;
use crate::render::cpu::Cpu;
use crate::render::gpu::{Gpu, GpuUse};
use crate::render::{Backend, Frame, Target, View};
use crate::scene::{Gaussians, RenderProfile, Scene};

/// One street with one feature.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The feature, as `SH degree 1`.
    pub with: &'static str,
    /// What was counted.
    pub counts: Counts,
}

/// What one step takes. Those of a device are absent where there is none.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Counts {
    /// Bytes of a Gaussian in the host's memory.
    pub host_bytes: f64,
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

/// Names of the columns, in order of [`Counts::texts`].
pub const COLUMNS: [&str; 8] = [
    "B of a Gaussian, host",
    "evaluations, cpu",
    "B of a Gaussian, device",
    "pipelines",
    "buffers",
    "dispatches",
    "MB moved",
    "B of a pixel back",
];

/// A feature: its name, the colour's degree, a change of the profile, and whether depth and opacity are
/// wanted.
type Feature = (&'static str, u8, Option<&'static str>, bool, bool);

const FEATURES: [Feature; 6] = [
    ("nothing else", 0, None, false, false),
    ("SH degree 1", 1, None, false, false),
    ("SH degree 3", 3, None, false, false),
    ("antialiasing", 0, Some("antialiased=true"), false, false),
    ("depth", 0, None, true, false),
    ("depth and opacity", 0, None, true, true),
];

/// Draws the street with each feature. `device` opens a device that drew nothing yet, or says that there
/// is none.
///
/// # Errors
/// A frame cannot be drawn.
pub fn rows(cpu: &Cpu, device: &dyn Fn() -> Option<Gpu>) -> Result<Vec<Row>, ReportError> {
    FEATURES
        .into_iter()
        .map(|(with, degree, change, depth, opacity)| {
            let scene = Scene::from_gaussians(&street(degree));
            let mut profile = RenderProfile::default();
            change.map_or(Ok(()), |change| profile.set(change))?;
            let step = Step { scene, profile, depth, opacity };
            Ok(Row { with, counts: step.counts(cpu, device())? })
        })
        .collect()
}

/// A street with colours of a degree, as flat where the base is.
fn street(degree: u8) -> Gaussians {
    let mut street = generate::canyon(20_000, &mut |_, _| {});
    let flat = street.sh.chunks_exact(12).flat_map(|colour| colour[..3].to_vec()).collect();
    (street.sh, street.sh_degree) = (flat, 0);
    street.raise_sh_degree(degree);
    street
}

struct Step {
    scene: Scene,
    profile: RenderProfile,
    depth: bool,
    opacity: bool,
}

impl Step {
    fn counts(&self, cpu: &Cpu, device: Option<Gpu>) -> Result<Counts, ReportError> {
        let evaluations = self.draw(cpu)?;
        let device = match device {
            None => None,
            Some(gpu) => {
                // The first frame makes room, perhaps in several tries.
                self.draw(&gpu)?;
                let before = gpu.usage().map_or(0, |usage| usage.made.dispatches);
                self.draw(&gpu)?;
                gpu.usage().map(|usage| self.of_device(&usage, before))
            }
        };
        let host_bytes = self.scene.bytes() as f64 / self.scene.gaussians() as f64;
        Ok(Counts { host_bytes, evaluations, device })
    }

    fn of_device(&self, usage: &GpuUse, dispatches_before: u64) -> DeviceCounts {
        DeviceCounts {
            gaussian_bytes: usage.mirror_bytes as f64 / self.scene.gaussians() as f64,
            pipelines: usage.made.pipelines,
            buffers: usage.made.buffers,
            dispatches: usage.made.dispatches - dispatches_before,
            moved_bytes: usage.last.bytes().iter().map(|(_, bytes)| bytes).sum(),
            pixel_bytes: 4 * usage.last.planes,
        }
    }

    fn draw(&self, backend: &dyn Backend) -> Result<u64, ReportError> {
        let view = view();
        let pixels = view.camera.pixels();
        let (mut rgb8, mut depth_m, mut opacity) =
            (vec![0; 3 * pixels], vec![0.0; pixels], vec![0.0; pixels]);
        let target = Target {
            rgba: None,
            rgb8: Some(&mut rgb8),
            depth_m: self.depth.then_some(&mut depth_m),
            opacity: self.opacity.then_some(&mut opacity),
            appearance: None,
        };
        let frame = Frame { scene: &self.scene, profile: &self.profile, views: &[view] };
        Ok(backend.render(&frame, &mut [target], &|_, _| {})?.evaluations)
    }
}

fn view() -> View {
    use glam::DVec3;
    look([320, 180], 240.0, DVec3::new(-20.0, 0.3, 1.6), DVec3::X, DVec3::NEG_Z)
}

impl Counts {
    /// In words, by [`COLUMNS`].
    pub fn texts(&self) -> [String; 8] {
        let device = |text: &dyn Fn(&DeviceCounts) -> String| {
            self.device.as_ref().map_or_else(|| "no device".to_owned(), text)
        };
        [
            format!("{:.1}", self.host_bytes),
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
