//! Frames that are drawn again and again, and how long they took.

use std::time::Instant;

use crate::cli::progress;
use wildcity_render::{Backend, Frame, FrameStats, Target};

/// So many frames.
pub(super) struct Timed {
    /// Wall time of each, in milliseconds.
    pub(super) steps_ms: Vec<f64>,
    /// What the first counted, and the median time of each stage.
    pub(super) stats: FrameStats,
    /// The images of the last, in 8 bit.
    pub(super) images: Vec<Vec<u8>>,
}

/// Draws a frame `count` times, at least once.
pub(super) fn time(
    backend: &dyn Backend,
    frame: &Frame<'_>,
    count: u32,
    label: &'static str,
) -> anyhow::Result<Timed> {
    let mut images: Vec<Vec<u8>> =
        frame.views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();
    let bar = progress::count(label);
    bar.set_length(count.into());
    let mut steps_ms = Vec::new();
    let mut all = Vec::new();
    for _ in 0..count.max(1) {
        let targets = images.iter_mut();
        let mut targets: Vec<Target<'_>> =
            targets.map(|image| Target { rgb8: Some(image), ..Target::default() }).collect();
        let start = Instant::now();
        all.push(backend.render(frame, &mut targets, &|_, _| {})?);
        steps_ms.push(start.elapsed().as_secs_f64() * 1e3);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let mut stats = all[0].clone();
    for (name, ms) in &mut stats.stages_ms {
        let of = |stats: &FrameStats| {
            stats.stages_ms.iter().filter(|(other, _)| other == name).map(|(_, ms)| ms).sum()
        };
        *ms = median(all.iter().map(of));
    }
    Ok(Timed { steps_ms, stats, images })
}

impl Timed {
    /// The median frame, in milliseconds.
    pub(super) fn step_ms(&self) -> f64 {
        median(self.steps_ms.iter().copied())
    }
}

/// The one in the middle, or the mean of the two in the middle.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    0.5 * (values.get(low).unwrap_or(&f64::NAN) + values.get(high).unwrap_or(&f64::NAN))
}
