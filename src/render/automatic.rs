//! The backend that nobody named: a GPU that has proved itself, or else the cpu.
//!
//! A driver may be wrong in ways that no error tells. So a device draws a card first, twice, and is
//! taken only if both drawings have the same bytes and are what the cpu backend draws.

use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};

use super::compare::psnr::{MIN_PSNR_DB, psnr_db};
use super::cpu::{Cpu, CpuError, Simd};
use super::gpu::{AdapterChoice, Gpu, GpuError, MemoryLimits};
use super::{Backend, Frame, RenderError, Target, View};

/// A backend, and why it and no other.
pub struct Selection {
    /// What renders.
    pub backend: Box<dyn Backend>,
    /// One line for whoever started the program.
    pub reason: String,
}

/// Takes the fastest device in hardware that draws the card right, or else the cpu backend.
/// Devices in software are right and slow, and never taken. `limits` are for a device.
///
/// # Errors
/// As [`Cpu::new`].
pub fn select(threads: usize, simd: Simd, limits: MemoryLimits) -> Result<Selection, CpuError> {
    let cpu = Cpu::new(threads, simd)?;
    let reason = match Gpu::with_limits(&AdapterChoice::Hardware, threads, limits) {
        Ok(gpu) => match self_test(&gpu, &cpu) {
            Ok(db) => {
                let reason = format!("gpu: {}, {db:.1} dB against the cpu backend", gpu.detail());
                return Ok(Selection { backend: Box::new(gpu), reason });
            }
            Err(doubt) => format!("cpu: {} is not trusted, {doubt}", gpu.detail()),
        },
        Err(GpuError::NoAdapter) => "cpu: there is no GPU".to_owned(),
        Err(error) => format!("cpu: {error}"),
    };
    Ok(Selection { backend: Box::new(cpu), reason })
}

/// Why a backend is not taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SelfTestError {
    /// It cannot draw at all.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// It draws something else.
    #[error(
        "its drawing of the trial card is {db:.1} dB from the cpu backend's, not {MIN_PSNR_DB} dB"
    )]
    Wrong {
        /// PSNR of linear colour and opacity, in dB.
        db: f64,
    },
    /// It does not draw the same thing twice.
    #[error("it drew the trial card twice, and not the same")]
    Unstable,
}

/// Has a backend draw the card, and tells its PSNR against `truth` in dB.
///
/// # Errors
/// It fails, differs from itself, or differs from the truth.
pub fn self_test(backend: &dyn Backend, truth: &dyn Backend) -> Result<f64, SelfTestError> {
    let (scene, views) = (card(), card_views());
    let drawn = draw(backend, &scene, &views)?;
    let again = draw(backend, &scene, &views)?;
    // By bits: NaN differs from itself.
    let bits = |image: &[f32]| image.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    if bits(&drawn) != bits(&again) {
        return Err(SelfTestError::Unstable);
    }
    let truth = draw(truth, &scene, &views)?;
    let db = psnr_db(drawn.iter().zip(&truth).map(|(a, b)| f64::from(a - b)));
    // False for NaN too.
    if db >= MIN_PSNR_DB { Ok(db) } else { Err(SelfTestError::Wrong { db }) }
}

/// Gaussians of the card. With two views some 46,000 splats: twelve blocks of the sort, and their 3,072
/// counters are two blocks of the scan.
const CARD_GAUSSIANS: usize = 30_000;

/// A street of Gaussians of all sizes, from 1 to 60 m ahead, with colour that depends on the
/// direction, and some mist over more macro tiles than one thread lists.
fn card() -> Scene {
    let mut card = Gaussians::with_capacity(1, CARD_GAUSSIANS);
    for i in 0..CARD_GAUSSIANS {
        // Fractions that fill [0, 1)ⁿ evenly: multiples of powers of the root of x⁹ = x + 1
        // (Roberts 2018). No generator of random numbers, so that the card never changes.
        let fraction = |power: i32| (0.5 + (i + 1) as f64 * 1.085_f64.powi(-power)).fract();
        let z_m = 60.0_f64.powf(fraction(1));
        let across = |power| 2.0 * fraction(power) - 1.0;
        card.means_m.push([0.9 * z_m * across(2), 0.5 * z_m * across(3), z_m]);
        card.quats_wxyz.push([1.0, across(4) as f32, across(5) as f32, across(6) as f32]);
        let is_mist = i % 256 == 0;
        let ln_scale = |power| {
            let sigma_m = z_m * if is_mist { 0.3 } else { 0.002 * 20.0_f64.powf(fraction(power)) };
            sigma_m.ln() as f32
        };
        card.ln_scales.push([ln_scale(7), ln_scale(8), ln_scale(4)]);
        card.logit_opacities.push(if is_mist { -3.0 } else { 5.0 * across(5) as f32 });
        let degree_0 = [2, 6, 7].map(|power| (across(power) * 0.5 / sh::C0) as f32);
        card.sh.extend(degree_0);
        card.sh.extend((0..9).map(|k| 0.3 * across(1 + k % 8) as f32));
    }
    Scene::from_gaussians(&card)
}

/// Two sizes, neither a multiple of a tile; the larger has 30 macro tiles.
fn card_views() -> [View; 2] {
    [[717, 301], [90, 75]].map(|[width_px, height_px]: [u32; 2]| {
        let [cx, cy] = [width_px, height_px].map(|size| 0.5 * f64::from(size));
        let pinhole = Pinhole { fx: 1.2 * cx, fy: 1.2 * cx, cx, cy };
        View::new(Camera::from_pinhole(width_px, height_px, pinhole), Pose::IDENTITY)
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

    use super::*;
    use crate::gpu::shaders::Shaders;
    use crate::reference::Reference;
    use crate::{FrameStats, OnViewDone};

    fn broken(stage: &str, part: &str, slip: &str) -> Gpu {
        let shaders = Shaders::default().with_mutation(stage, part, slip).unwrap();
        Gpu::with_shaders(&AdapterChoice::Best, 1, shaders)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers")
    }

    #[test]
    fn the_card_shows_something_everywhere() {
        let image = draw(&Reference, &card(), &card_views()).unwrap();
        let mean = image.iter().sum::<f32>() / image.len() as f32;
        assert!((0.2..0.9).contains(&mean), "{mean}");
        assert!(image.chunks_exact(4).all(|rgba| rgba[3] > 0.0));
    }

    #[test]
    fn a_right_device_is_trusted() {
        let cpu = Cpu::new(1, Simd::Best).unwrap();
        let gpu = Gpu::new(&AdapterChoice::Best, 1)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers");
        assert!(self_test(&gpu, &cpu).unwrap() >= 80.0);
        assert!(self_test(&cpu, &Reference).unwrap() >= 80.0);
    }

    /// What a wrong driver would do to one kernel each.
    #[test]
    fn a_wrong_device_is_not() {
        let cpu = Cpu::new(1, Simd::Best).unwrap();
        for (stage, part, slip) in [
            ("project", "let l1 = -(foot.covariance.y * l2)", "let l1 = (foot.covariance.y * l2)"),
            ("scan", "sum = saturating_add(sum, before);", "sum = max(sum, before);"),
            ("sort", "is_last = after == 0u", "is_last = beside == own_bit"),
            (
                "scan",
                "saturating_add(block_sums[block], prefix_before(thread))",
                "max(block_sums[block], prefix_before(thread))",
            ),
            ("bin", "i - prefix_before(holder)", "i"),
            ("expand", "next += countOneBits", "next = first + countOneBits"),
            ("rasterize", "sums.green += weight", "sums.green += 1.02 * weight"),
        ] {
            let doubt = self_test(&broken(stage, part, slip), &cpu);
            // Counts that are wrong may be too many.
            let noticed = matches!(
                doubt,
                Err(SelfTestError::Wrong { .. }
                    | SelfTestError::Unstable
                    | SelfTestError::Render(RenderError::TooMany { .. }))
            );
            assert!(noticed, "{stage}: {doubt:?}");
        }
    }

    /// Something that draws another thing each time, and something that draws NaN.
    struct Restless(AtomicU32, f32);

    impl Backend for Restless {
        fn name(&self) -> &'static str {
            "restless"
        }

        fn render(
            &self,
            _: &Frame<'_>,
            targets: &mut [Target<'_>],
            _: OnViewDone<'_>,
        ) -> Result<FrameStats, RenderError> {
            let count = self.0.fetch_add(1, Relaxed);
            for target in targets {
                target.rgba.as_mut().unwrap().fill(self.1 * count as f32);
            }
            Ok(FrameStats::default())
        }
    }

    #[test]
    fn nor_is_a_restless_one_or_one_that_draws_nothing_finite() {
        let cpu = Cpu::new(1, Simd::Best).unwrap();
        assert_eq!(self_test(&Restless(0.into(), 1e-3), &cpu), Err(SelfTestError::Unstable));
        let nan = self_test(&Restless(0.into(), f32::NAN), &cpu);
        assert!(matches!(nan, Err(SelfTestError::Wrong { db }) if db.is_nan()), "{nan:?}");
    }
}
