//! A run that shows how far it is, and stops when it is asked to.

use std::io::{self, IsTerminal};

use wildcity_render::gradient::Differentiate;
use wildcity_train::cache::CachedImages;
use wildcity_train::run::{Line, TrainingImages, run};
use wildcity_train::trainer::Trainer;

use super::checkpoints::StopsAtSignal;
use super::lines::log;
use crate::cli::progress;

/// How often the images that are held out are looked at in a run.
pub(super) const EVALUATIONS: usize = 10;

/// Steps from one look at the images that are held out to the next.
pub(super) fn evaluate_every(trainer: &Trainer) -> usize {
    (trainer.settings().steps / EVALUATIONS).max(1)
}

/// Held-out images on the page of a run.
pub(super) const PICTURES: usize = 6;

/// Decoded images are kept up to this size: 1,800 of 360 x 232 px with depths.
pub(super) const CACHE_BYTES: usize = 1 << 30;

/// Goes on to the last step, or until the process is asked to stop. The images that are held out
/// are looked at every `evaluate_every` steps, and `each` is called after each step. Returns their
/// PSNR, when it was measured last, and the seconds until then.
pub(super) fn train(
    trainer: &mut Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
    evaluate_every: usize,
    each: &mut dyn FnMut(&Line, &Trainer) -> anyhow::Result<()>,
) -> anyhow::Result<Option<(f64, f64)>> {
    let signal = StopsAtSignal::new()?;
    let bar = progress::count("training");
    bar.set_length(trainer.settings().steps as u64);
    let mut last = None;
    let mut failed = None;
    let mut on_step = |line: &Line, trainer: &Trainer| {
        bar.set_position(line.step as u64);
        // Only the last evaluation is returned: later lines have none.
        if let Some(db) = line.held_out_db {
            bar.set_message(format!("{db:.2} dB"));
            last = Some((db, line.seconds));
        }
        let mut said = Ok(());
        // A log has no bar.
        if line.step.is_multiple_of(evaluate_every) && !io::stderr().is_terminal() {
            said = log(line).map_err(anyhow::Error::from);
        }
        failed = said.and_then(|()| each(line, trainer)).err();
        failed.is_none() && !signal.stops()
    };
    let images = CachedImages::new(images, CACHE_BYTES);
    run(trainer, &images, backend, evaluate_every, &mut on_step)?;
    bar.finish_and_clear();
    failed.map_or(Ok(last), Err)
}
