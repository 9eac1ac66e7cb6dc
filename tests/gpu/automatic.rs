//! The self-test of a device, before `--backend auto` chooses it.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use wildcity_render::automatic::{SelfTestError, self_test};
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};

use crate::gpu::{gpu, gpu_with};
use crate::images::cpu;

/// The reference, which draws one frame, keeps its images (linear colour and opacity), and repeats
/// them: it takes seconds for the frame.
#[derive(Default)]
struct Recorder(Mutex<Vec<Vec<f32>>>);

impl Backend for Recorder {
    fn name(&self) -> &'static str {
        "recorder"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        done: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        let mut kept = self.0.lock().unwrap();
        if kept.is_empty() {
            Reference.render(frame, targets, done)?;
            kept.extend(targets.iter().map(|target| target.rgba.as_deref().unwrap().to_vec()));
        } else {
            for (target, image) in targets.iter_mut().zip(&*kept) {
                target.rgba.as_deref_mut().unwrap().copy_from_slice(image);
            }
        }
        Ok(FrameStats::default())
    }
}

#[test]
fn the_test_scene_covers_every_pixel() {
    let recorder = Recorder::default();
    self_test(&recorder, &cpu()).unwrap();
    let pixels = recorder.0.into_inner().unwrap().concat();
    let mean = pixels.iter().sum::<f32>() / pixels.len() as f32;
    assert!((0.2..0.9).contains(&mean), "{mean}");
    assert!(pixels.chunks_exact(4).all(|rgba| rgba[3] > 0.0));
}

#[test]
fn a_correct_device_passes() {
    assert!(self_test(&*gpu(), &cpu()).unwrap() >= 80.0);
}

/// Each mutation is a fault of one kernel, like that of a wrong driver.
#[test]
fn a_wrong_device_fails() {
    for (stage, part, mutation) in [
        ("project", "let l1 = -(foot.covariance.y * l2)", "let l1 = (foot.covariance.y * l2)"),
        ("scan", "sum = saturating_add(sum, before);", "sum = max(sum, before);"),
        ("sort", "is_last = after == 0u", "is_last = beside == own_bit"),
        (
            "scan",
            "saturating_add(block_sums[block], prefix_before(thread))",
            "max(block_sums[block], prefix_before(thread))",
        ),
        ("bin", "i - prefix_before(band_index)", "i"),
        ("expand", "next += countOneBits", "next = first + countOneBits"),
        ("rasterize", "(*sums).green = fma(weight", "(*sums).green = fma(1.02 * weight"),
        // Only of pixels with several samples.
        ("rasterize", "return values.xz + values.yw;", "return values.xz + values.xz;"),
        ("rasterize", "let second = first + 4u;", "let second = first;"),
    ] {
        let broken = gpu_with(Shaders::default().with_mutation(stage, part, mutation).unwrap());
        let result = self_test(&*broken, &cpu());
        // A wrong count may be too large for a frame.
        let noticed = matches!(
            result,
            Err(SelfTestError::Inaccurate { .. }
                | SelfTestError::Nondeterministic
                | SelfTestError::Render(RenderError::TooMany { .. }))
        );
        assert!(noticed, "{stage}: {result:?}");
    }
}

/// A backend that fills the n-th image with n times a value.
struct Nondeterministic {
    value: f32,
    images: AtomicU32,
}

impl Backend for Nondeterministic {
    fn name(&self) -> &'static str {
        "nondeterministic"
    }

    fn render(
        &self,
        _: &Frame<'_>,
        targets: &mut [Target<'_>],
        _: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        let count = self.images.fetch_add(1, Relaxed);
        for target in targets {
            target.rgba.as_mut().unwrap().fill(self.value * count as f32);
        }
        Ok(FrameStats::default())
    }
}

#[test]
fn a_nondeterministic_device_fails_and_one_that_draws_nan() {
    let with = |value| Nondeterministic { value, images: 0.into() };
    assert_eq!(self_test(&with(1e-3), &cpu()), Err(SelfTestError::Nondeterministic));
    let nan = self_test(&with(f32::NAN), &cpu());
    assert!(matches!(nan, Err(SelfTestError::Inaccurate { db }) if db.is_nan()), "{nan:?}");
}
