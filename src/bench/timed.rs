//! Renders a frame several times and measures how long each run takes.

use std::time::Instant;

use wildcity::cli::progress;
use wildcity_render::{Backend, Frame, FrameStats, Target};

/// The times of a frame that was rendered several times.
pub(super) struct Timed {
    /// Wall time of each run, in milliseconds.
    pub(super) steps_ms: Vec<f64>,
    /// Counts of the first run, and the median time of each stage.
    pub(super) stats: FrameStats,
    /// The 8-bit images of the last run.
    pub(super) images: Vec<Vec<u8>>,
}

/// Renders a frame `count` times, but at least once.
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
    // At least one frame was rendered. Counts are the same in all, and only the times differ.
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
    /// Median time of a run, in milliseconds.
    pub(super) fn step_ms(&self) -> f64 {
        median(self.steps_ms.iter().copied())
    }
}

/// The middle value, or the mean of the two middle values. NaN without values.
pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let at = |index: usize| values.get(index).copied().unwrap_or(f64::NAN);
    let last = values.len().saturating_sub(1);
    // Of an odd number both places are the same.
    0.5 * (at(last / 2) + at(values.len() / 2))
}
