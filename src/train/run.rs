//! A run from images to Gaussians.
//!
//! Images stay in their files. Another thread decodes the next ones while a step is computed, so
//! that a run holds a few of them at a time, whatever their number.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;
use std::time::Instant;

use wildcity_render::gradient::Differentiate;
use wildcity_scene::random::{mix, to_unit};

use crate::held_out::Evaluator;
pub use crate::history::Line;
pub use crate::images::{TrainingImage, TrainingImages, halvings};
use crate::sample::Sample;
use crate::settings::Settings;
use crate::trainer::{StepReport, TrainError, Trainer};

/// Images that are decoded ahead of the step.
const AHEAD: usize = 2;

/// Takes a run from the step at which it is to its last. The images that are held out are looked at
/// every `evaluate_every` steps and after the last one. `on_step` is called after each step, and
/// ends the run by returning `false`.
///
/// # Errors
/// An image cannot be read, or nothing is left to learn from.
pub fn run(
    trainer: &mut Trainer,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
    evaluate_every: usize,
    on_step: &mut dyn FnMut(&Line, &Trainer) -> bool,
) -> Result<(), TrainError> {
    let count = images.count();
    let learned: Vec<usize> = (0..count).filter(|&index| !images.is_held_out(index)).collect();
    if learned.is_empty() {
        return Err(TrainError::NoImages { images: count, held_out: count });
    }
    let places: Vec<_> = learned.iter().map(|&index| (index, images.place(index))).collect();
    trainer.count(&places);
    let steps = trainer.settings().steps;
    let first = trainer.steps_done();
    let settings = trainer.settings().clone();
    // A run that goes on draws the images of its earlier steps, too, so that the next ones are
    // those of a run that was never stopped.
    let order = (1..=steps).zip(Order::new(&learned, images, &settings)).skip(first);
    let evaluator = Evaluator::new(images, backend);
    thread::scope(|scope| {
        // The thread waits with one more image, and ends when `next` is dropped.
        let (sender, next) = sync_channel(AHEAD);
        scope.spawn(move || {
            // A receiver that is gone has ended the run.
            let load = |(step, index)| {
                let image = images.load(index)?.halved(settings.halvings_at(step));
                Ok((index, image.map_err(|e| format!("{}: {e}", images.name(index)))?))
            };
            order.map(load).all(|image| sender.send(image).is_ok())
        });
        let begin = Instant::now();
        let earlier_s = trainer.history().seconds();
        let mut evaluated_s = 0.0;
        while trainer.steps_done() < steps {
            let report = step(trainer, backend, &next, images)?;
            let done = trainer.steps_done();
            let seconds = earlier_s + begin.elapsed().as_secs_f64() - evaluated_s;
            let mut held_out_db = None;
            if done == steps || done.is_multiple_of(evaluate_every.max(1)) {
                held_out_db = evaluator.mean_db(trainer)?;
            }
            // What has passed beyond the time of the steps.
            evaluated_s = earlier_s + begin.elapsed().as_secs_f64() - seconds;
            let line = Line::new(trainer, report, seconds, held_out_db);
            trainer.remember(&line);
            if !on_step(&line, trainer) {
                break;
            }
        }
        Ok(())
    })
}

impl Line {
    fn new(trainer: &Trainer, report: StepReport, seconds: f64, held_out_db: Option<f64>) -> Self {
        let StepReport { l1, dssim, disparity, sky, ground, stages_ms, .. } = report;
        let step = trainer.steps_done();
        let gaussians = trainer.model().len();
        Self { step, l1, dssim, disparity, sky, ground, gaussians, seconds, held_out_db, stages_ms }
    }
}

/// The images of all steps. Each kind of image goes round in an order that is random each time.
struct Order {
    /// The images that were recorded, and those that were not.
    kinds: [Vec<usize>; 2],
    /// Steps of each kind so far.
    done: [usize; 2],
    /// Of the second kind.
    share: f64,
    seed: u64,
    step: u64,
}

impl Order {
    fn new(learned: &[usize], images: &dyn TrainingImages, settings: &Settings) -> Self {
        let (augmented, recorded): (Vec<usize>, Vec<usize>) =
            learned.iter().partition(|&&index| images.is_augmented(index));
        let share = if augmented.is_empty() {
            0.0
        } else if recorded.is_empty() {
            1.0
        } else {
            settings.augmented_share
        };
        Self { kinds: [recorded, augmented], done: [0; 2], share, seed: settings.seed, step: 0 }
    }
}

impl Iterator for Order {
    type Item = usize;

    fn next(&mut self) -> Option<usize> {
        self.step += 1;
        let kind = usize::from(to_unit(mix(self.seed ^ mix(!self.step))) < self.share);
        let images = &mut self.kinds[kind];
        let place = self.done[kind] % images.len();
        if place == 0 {
            let round = (self.done[kind] / images.len()) as u64;
            // A shuffle without a state: a run that goes on in the middle of a round finds the same
            // order.
            images.sort_by_key(|&image| mix(self.seed ^ mix(round << 32 ^ image as u64)));
        }
        self.done[kind] += 1;
        Some(images[place])
    }
}

fn step(
    trainer: &mut Trainer,
    backend: &dyn Differentiate,
    next: &Receiver<Result<(usize, TrainingImage), String>>,
    images: &dyn TrainingImages,
) -> Result<StepReport, TrainError> {
    let image = next.recv().unwrap_or_else(|_| Err("the thread that decodes has ended".to_owned()));
    let (index, image) = image.map_err(TrainError::Image)?;
    if !image.counts() {
        return Ok(trainer.skip());
    }
    let TrainingImage { view, rgb8, mask, mut sky, mut depth_m, weight, exposure } = image;
    if let Some((depth_m, mask)) = depth_m.as_mut().zip(mask.as_ref()) {
        // What does not count has no depth either.
        let left_out = depth_m.iter_mut().zip(mask).filter(|(_, counts)| !**counts);
        left_out.for_each(|(depth_m, _)| *depth_m = 0.0);
    }
    let rgb: Vec<f32> = rgb8.iter().map(|&value| f32::from(value) / 255.0).collect();
    // What does not count shows no sky either.
    if let Some((sky, mask)) = sky.as_mut().zip(mask.as_ref()) {
        sky.iter_mut().zip(mask).for_each(|(is_sky, counts)| *is_sky &= *counts);
    }
    let weights: Option<Vec<f32>> =
        mask.map(|mask| mask.iter().map(|&counts| if counts { 1.0 } else { 0.0 }).collect());
    let background = trainer.profile().background;
    let sample = Sample {
        view,
        image: index,
        place: images.place(index),
        rgb: &rgb,
        weights: weights.as_deref(),
        sky: sky.as_deref(),
        depth_m: depth_m.as_deref(),
        background: background.map(|value| value as f32),
        weight,
        exposure,
    };
    trainer.step(backend, &sample)
}
