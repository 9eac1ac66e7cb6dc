//! Times of a step, measured in turn with a step of the twin as it is served.
//!
//! The speed of a machine changes while a report is made. Timed one after another, the last
//! settings took twice as long as the first, because other programs had begun to compile. A step of
//! the served twin right after each step of a setting shows how fast the machine was at that
//! moment; [`super::measurement::normalize_machine_speed`] scales all times to one speed.

use std::time::Instant;

use parking_lot::Mutex;

use super::error::ReportError;
use super::setting::ImageEncoding;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{RenderProfile, Scene};

/// A step of all cameras: rendered, and encoded if it has an encoding.
#[derive(Clone, Copy)]
pub(super) struct Step<'a> {
    pub backend: &'a dyn Backend,
    pub scene: &'a Scene,
    pub profile: &'a RenderProfile,
    pub views: &'a [View],
    pub encoding: Option<ImageEncoding>,
}

/// Times of a step, and of the baseline in turn with it.
#[derive(Default)]
pub(super) struct StepTimes {
    /// Time of each step, in milliseconds.
    pub steps_ms: Vec<f64>,
    /// Time of the baseline's step right after it, in milliseconds.
    pub baseline_ms: Vec<f64>,
    /// Bytes of a step's images as they are sent.
    pub sent_bytes: u64,
}

/// One run of a step.
struct StepRun {
    ms: f64,
    sent_bytes: u64,
}

impl Step<'_> {
    /// Times the step `repeat` times, in turn with `baseline`. One more run of each comes first and
    /// is not counted: it allocates buffers.
    pub(super) fn time(&self, baseline: &Step<'_>, repeat: u32) -> Result<StepTimes, ReportError> {
        let mut times = StepTimes::default();
        let mut own_images = self.empty_images();
        let mut baseline_images = baseline.empty_images();
        // Own step and baseline alternate, so that both see the same disturbances.
        for run in 0..=repeat {
            let own_run = self.run(&mut own_images)?;
            let baseline_run = baseline.run(&mut baseline_images)?;
            times.sent_bytes = own_run.sent_bytes;
            let is_warm_up = run == 0;
            if !is_warm_up {
                times.steps_ms.push(own_run.ms);
                times.baseline_ms.push(baseline_run.ms);
            }
        }
        Ok(times)
    }

    /// Renders the step once.
    pub(super) fn render(&self) -> Result<(), ReportError> {
        self.run(&mut self.empty_images())?;
        Ok(())
    }

    /// An 8-bit image for each view.
    fn empty_images(&self) -> Vec<Vec<u8>> {
        self.views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect()
    }

    /// Renders all images, and encodes each as soon as it is finished, as a session does.
    fn run(&self, images: &mut [Vec<u8>]) -> Result<StepRun, ReportError> {
        let target = |rgb8| Target { rgb8: Some(rgb8), ..Target::default() };
        let mut targets: Vec<Target<'_>> =
            images.iter_mut().map(Vec::as_mut_slice).map(target).collect();
        // Images are finished on several threads. After an error the sum stays that error.
        let sent_bytes: Mutex<Result<u64, String>> = Mutex::new(Ok(0));
        let on_finished = |view: usize, target: &Target<'_>| {
            let rgb8 = target.rgb8.as_deref().unwrap_or_default();
            let file = encode(self.encoding, &self.views[view], rgb8);
            // Not compressed, an image has the size of its pixels.
            let bytes = file.map(|file| file.map_or(rgb8.len(), |file| file.len()) as u64);
            let mut sum = sent_bytes.lock();
            // The first error stays; later images do not replace it by their sizes.
            *sum = sum.clone().and_then(|sum| Ok(sum + bytes?));
        };
        let frame = Frame { scene: self.scene, profile: self.profile, views: self.views };

        let start = Instant::now();
        self.backend.render(&frame, &mut targets, &on_finished)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;

        // After the time was taken, as the error is of no concern to it.
        let sent_bytes =
            sent_bytes.into_inner().map_err(|reason| ReportError::Encode { reason })?;
        Ok(StepRun { ms, sent_bytes })
    }
}

/// The image as a JPEG file, if the encoding is JPEG.
pub(super) fn encode(
    encoding: Option<ImageEncoding>,
    view: &View,
    rgb8: &[u8],
) -> Result<Option<Vec<u8>>, String> {
    match encoding {
        Some(ImageEncoding::Jpeg(quality)) => {
            let camera = &view.camera;
            wildcity_session::jpeg(rgb8, camera.width_px, camera.height_px, quality).map(Some)
        }
        Some(ImageEncoding::Raw) | None => Ok(None),
    }
}
