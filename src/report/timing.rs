//! How long a step takes: in turn with the twin as it is served, since machines are not always as fast.

use std::time::Instant;

use parking_lot::Mutex;

use super::ReportError;
use super::settings::Sent;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{RenderProfile, Scene};

/// A step of all cameras: drawn, and encoded if it says how images are sent.
#[derive(Clone, Copy)]
pub(super) struct Step<'a> {
    pub backend: &'a dyn Backend,
    pub scene: &'a Scene,
    pub profile: &'a RenderProfile,
    pub views: &'a [View],
    pub sent: Option<Sent>,
}

/// What it takes.
#[derive(Default)]
pub(super) struct Timed {
    /// Time of each step, in milliseconds.
    pub steps_ms: Vec<f64>,
    /// The same of the twin as served, each right after.
    pub served_ms: Vec<f64>,
    /// Bytes of a step's images as they are sent.
    pub sent_bytes: u64,
}

impl Step<'_> {
    /// Times it so often, in turn with the twin as served; the first of each makes room, and is not counted.
    pub(super) fn time(&self, served: &Step<'_>, repeat: u32) -> Result<Timed, ReportError> {
        let mut timed = Timed::default();
        let (mut own_images, mut served_images) = (self.images(), served.images());
        for counted in 0..=repeat {
            let (own_ms, sent_bytes) = self.run(&mut own_images)?;
            let (served_ms, _) = served.run(&mut served_images)?;
            timed.sent_bytes = sent_bytes;
            if counted > 0 {
                timed.steps_ms.push(own_ms);
                timed.served_ms.push(served_ms);
            }
        }
        Ok(timed)
    }

    /// Draws it once.
    pub(super) fn draw(&self) -> Result<(), ReportError> {
        self.run(&mut self.images()).map(|_| ())
    }

    /// Its images, in 8 bits.
    fn images(&self) -> Vec<Vec<u8>> {
        self.views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect()
    }

    /// Draws all images, and encodes them if they are sent so: milliseconds, and bytes to send.
    fn run(&self, images: &mut [Vec<u8>]) -> Result<(f64, u64), ReportError> {
        let target = |rgb8| Target { rgb8: Some(rgb8), ..Target::default() };
        let mut targets: Vec<Target<'_>> =
            images.iter_mut().map(Vec::as_mut_slice).map(target).collect();
        let sent_bytes = Mutex::new(Ok(0));
        let finished = |view: usize, target: &Target<'_>| {
            let rgb8 = target.rgb8.as_deref().unwrap_or_default();
            let file = file(self.sent, &self.views[view], rgb8);
            let bytes = file.map(|file| file.map_or(rgb8.len(), |file| file.len()) as u64);
            let mut sum = sent_bytes.lock();
            *sum = sum.clone().and_then(|sum: u64| Ok(sum + bytes?));
        };
        let frame = Frame { scene: self.scene, profile: self.profile, views: self.views };
        let start = Instant::now();
        self.backend.render(&frame, &mut targets, &finished)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        Ok((ms, sent_bytes.into_inner().map_err(|reason| ReportError::Encode { reason })?))
    }
}

/// A JPEG of an image if it is sent as one.
pub(super) fn file(
    sent: Option<Sent>,
    view: &View,
    rgb8: &[u8],
) -> Result<Option<Vec<u8>>, String> {
    let (width, height) = (view.camera.width_px, view.camera.height_px);
    match sent {
        Some(Sent::Jpeg(quality)) => wildcity_session::jpeg(rgb8, width, height, quality).map(Some),
        Some(Sent::Raw) | None => Ok(None),
    }
}
