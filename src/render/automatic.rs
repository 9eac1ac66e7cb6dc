//! Automatic choice of a backend (`--backend auto`): a GPU that passes a self-test, or else the
//! cpu.
//!
//! A driver may be wrong without reporting an error. So a device first draws a small test scene
//! twice. It is used only if both images have the same bytes and agree with those of the cpu
//! backend.

use glam::DVec2;
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};

use super::compare::psnr::{MIN_PSNR_DB, psnr_db};
use super::cpu::{Cpu, CpuError, Simd};
use super::gpu::{AdapterChoice, Gpu, GpuError, MemoryLimits};
use super::{Backend, Frame, RenderError, Target, View};

/// The chosen backend, and the reason for the choice.
pub struct Selection {
    pub backend: Box<dyn Backend>,
    /// One line for the operator.
    pub reason: String,
}

/// Chooses the fastest hardware device if it passes the self-test, or else the cpu backend.
/// Software devices are correct but slow, and are never chosen. `limits` apply to a device.
///
/// # Errors
/// As [`Cpu::new`].
pub fn select(threads: usize, simd: Simd, limits: MemoryLimits) -> Result<Selection, CpuError> {
    // The cpu backend is made first in any case: it is the truth of the self-test.
    let cpu = Cpu::new(threads, simd)?;
    let reason = match Gpu::with_limits(&AdapterChoice::Hardware, threads, limits) {
        Ok(gpu) => match self_test(&gpu, &cpu) {
            Ok(db) => {
                let reason = format!("gpu: {}, {db:.1} dB against the cpu backend", gpu.detail());
                return Ok(Selection { backend: Box::new(gpu), reason });
            }
            Err(error) => format!("cpu: {} failed its self-test, {error}", gpu.detail()),
        },
        Err(GpuError::NoAdapter) => "cpu: there is no GPU".to_owned(),
        Err(error) => format!("cpu: {error}"),
    };
    Ok(Selection { backend: Box::new(cpu), reason })
}

/// Why a backend did not pass the self-test.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SelfTestError {
    /// It cannot draw the test scene.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Its images differ from those of the cpu backend.
    #[error(
        "its image of the test scene has {db:.1} dB against the cpu backend's, below {MIN_PSNR_DB} dB"
    )]
    Inaccurate {
        /// PSNR of linear colour and opacity, in dB.
        db: f64,
    },
    /// Two images of the same scene differ.
    #[error("two images of the test scene differ")]
    Nondeterministic,
}

/// Draws the test scene with a backend, and returns its PSNR against `truth` in dB.
///
/// # Errors
/// The backend fails, its images differ from each other, or they differ from the truth.
pub fn self_test(backend: &dyn Backend, truth: &dyn Backend) -> Result<f64, SelfTestError> {
    let scene = test_scene();
    let views = test_views();
    // A race in a kernel or a driver shows up as a difference between two equal frames.
    let first = draw(backend, &scene, &views)?;
    let second = draw(backend, &scene, &views)?;
    // Compare bits, since a NaN differs from itself.
    let bits = |image: &[f32]| image.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    if bits(&first) != bits(&second) {
        return Err(SelfTestError::Nondeterministic);
    }
    let truth = draw(truth, &scene, &views)?;
    let db = psnr_db(first.iter().zip(&truth).map(|(a, b)| f64::from(a - b)));
    // False for a NaN too.
    if db >= MIN_PSNR_DB { Ok(db) } else { Err(SelfTestError::Inaccurate { db }) }
}

/// Gaussians of the test scene. Its two views have about 46,000 splats, which are twelve blocks of
/// the sort. Their 3,072 counters are two blocks of the scan. So every kernel runs with more than
/// one workgroup.
const TEST_GAUSSIANS: usize = 30_000;

/// Gaussians of all sizes, 1 to 60 m ahead, with colours of SH degree 1. Every 256th is large and
/// faint (fog), and covers more macro tiles than one thread lists.
fn test_scene() -> Scene {
    let mut gaussians = Gaussians::with_capacity(1, TEST_GAUSSIANS);
    for i in 0..TEST_GAUSSIANS {
        // A low-discrepancy sequence: multiples of powers of the root of x⁹ = x + 1, modulo 1
        // (Roberts 2018). It needs no random number generator, so that the scene never changes.
        let fraction = |power: i32| (0.5 + (i + 1) as f64 * 1.085_f64.powi(-power)).fract();
        // Depths from 1 to 60 m with equal shares of their logarithm, so that every size on the
        // image occurs, and directions within the field: 0.9 and 0.5 are slopes.
        let z_m = 60.0_f64.powf(fraction(1));
        let across = |power| 2.0 * fraction(power) - 1.0;
        gaussians.means_m.push([0.9 * z_m * across(2), 0.5 * z_m * across(3), z_m]);
        gaussians.quats_wxyz.push([1.0, across(4) as f32, across(5) as f32, across(6) as f32]);
        let is_fog = i % 256 == 0;
        let ln_scale = |power| {
            // From 0.2 % to 4 % of the distance: with a focal length of 430 px, 0.9 to 17 px.
            let sigma_m = z_m * if is_fog { 0.3 } else { 0.002 * 20.0_f64.powf(fraction(power)) };
            sigma_m.ln() as f32
        };
        gaussians.ln_scales.push([ln_scale(7), ln_scale(8), ln_scale(4)]);
        gaussians.logit_opacities.push(if is_fog { -3.0 } else { 5.0 * across(5) as f32 });
        // The colour is 0.5 + C0 c, so that these coefficients give 0 to 1.
        let degree_0 = [2, 6, 7].map(|power| (across(power) * 0.5 / sh::C0) as f32);
        gaussians.sh.extend(degree_0);
        // Three coefficients of degree 1 for each of the three channels.
        gaussians.sh.extend((0..9).map(|k| 0.3 * across(1 + k % 8) as f32));
    }
    Scene::from_gaussians(&gaussians)
}

/// Two image sizes, neither a multiple of the tile's; the larger has 30 macro tiles. The smaller
/// has a third of the native sides, and so several samples a pixel.
fn test_views() -> [View; 2] {
    [[717, 301, 1], [90, 75, 3]].map(|[width_px, height_px, native]: [u32; 3]| {
        let [cx, cy] = [width_px, height_px].map(|size| 0.5 * f64::from(size));
        // A focal length of 0.6 widths: the image ends at a slope of 1/1.2, just within 0.9.
        let pinhole = Pinhole { fx: 1.2 * cx, fy: 1.2 * cx, cx, cy };
        let native_size_px = Some(f64::from(native) * DVec2::new(2.0 * cx, 2.0 * cy));
        let camera = Camera::from_pinhole(width_px, height_px, pinhole);
        View::new(Camera { native_size_px, ..camera }, Pose::IDENTITY)
    })
}

/// Linear colour and opacity of all views, one after another.
fn draw(backend: &dyn Backend, scene: &Scene, views: &[View]) -> Result<Vec<f32>, RenderError> {
    let profile = RenderProfile::default();
    let pixels = |view: &View| view.camera.pixels();
    let mut images: Vec<Vec<f32>> = views.iter().map(|v| vec![0.0; 4 * pixels(v)]).collect();
    let targets = images.iter_mut();
    let mut targets: Vec<Target<'_>> =
        targets.map(|image| Target { rgba: Some(image), ..Target::default() }).collect();
    backend.render(&Frame { scene, profile: &profile, views }, &mut targets, &|_, _| {})?;
    Ok(images.concat())
}
