//! A run from images to Gaussians.
//!
//! Images stay in their files. Another thread decodes the next ones while a step is computed, so
//! that a run holds a few of them at a time, whatever their number.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;
use std::time::Instant;

use serde::Serialize;

use wildcity_render::View;
use wildcity_render::gradient::Differentiate;
use wildcity_scene::random::{mix, to_unit};

use crate::held_out::Evaluator;
use crate::poses::Place;
use crate::sample::Sample;
use crate::settings::Settings;
use crate::trainer::{StepReport, TrainError, Trainer};

/// Images that are decoded ahead of the step.
const AHEAD: usize = 2;

/// An image that has been decoded.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingImage {
    pub view: View,
    /// `[height, width, 3]`: red, green and blue.
    pub rgb8: Vec<u8>,
    /// `[height, width]`: the pixels that count; all without it.
    pub mask: Option<Vec<bool>>,
    /// `[height, width]`: the pixels that show the sky, where that is known.
    pub sky: Option<Vec<bool>>,
    /// `[height, width]`: measured depths in metres; 0 where there is none.
    pub depth_m: Option<Vec<f32>>,
    /// Factor of the losses, 1 for an image that was recorded.
    pub weight: f32,
    /// Recorded factor of all colours against the other images.
    pub exposure: f32,
}

impl TrainingImage {
    /// What it takes in memory.
    pub(crate) fn bytes(&self) -> usize {
        let flags = [&self.mask, &self.sky].into_iter().flatten().map(Vec::len).sum::<usize>();
        self.rgb8.len() + flags + 4 * self.depth_m.as_ref().map_or(0, Vec::len)
    }

    /// Whether some pixel counts: what moves may hide all of an image.
    pub(crate) fn counts(&self) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.contains(&true))
    }
}

/// The images of a run, by their numbers.
pub trait TrainingImages: Sync {
    /// The number of all images.
    fn count(&self) -> usize;

    /// Whether an image is kept from the run, to judge it.
    fn is_held_out(&self, index: usize) -> bool;

    /// The images that are kept from the run.
    fn held_out(&self) -> Vec<usize> {
        (0..self.count()).filter(|&index| self.is_held_out(index)).collect()
    }

    /// Whether an image was rendered and repaired, and not recorded: of these,
    /// [`Settings::augmented_share`] of the steps are made.
    fn is_augmented(&self, _: usize) -> bool {
        false
    }

    /// The poses of the run's rig that an image has; `None` for images without a rig.
    fn place(&self, index: usize) -> Option<Place>;

    /// The camera of an image at its whole size, at the recorded pose.
    fn view(&self, index: usize) -> View;

    /// The name of an image, for a person.
    fn name(&self, index: usize) -> String;

    /// Decodes an image.
    ///
    /// # Errors
    /// The error names the file, for a person.
    fn load(&self, index: usize) -> Result<TrainingImage, String>;
}

/// A step of a run, as a line of JSON.
#[derive(Clone, Debug, Serialize)]
pub struct Line {
    /// Steps that are done.
    pub step: usize,
    pub l1: f64,
    pub dssim: f64,
    /// In 1/m; 0 without measured depths.
    pub disparity: f64,
    /// The mean opacity where the sky is; 0 without a mask of it.
    pub sky: f64,
    /// The weighted sum of the ground's terms.
    pub ground: f64,
    pub gaussians: usize,
    /// Since the first step, without evaluations, and without the time that a run was stopped.
    pub seconds: f64,
    /// Mean of the images that are held out, at the steps that are evaluated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_db: Option<f64>,
    /// Wall time of each stage of the frame and its gradients, in milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
}

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
    let steps = trainer.settings().steps;
    let first = trainer.steps_done();
    let order = Order::new(&learned, images, trainer.settings()).take(steps).skip(first);
    let evaluator = Evaluator::new(images, backend);
    thread::scope(|scope| {
        let (sender, next) = sync_channel(AHEAD);
        scope.spawn(move || {
            // A receiver that is gone has ended the run.
            let load = |index| images.load(index).map(|image| (index, image));
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
