//! A run from images to Gaussians.
//!
//! Images stay in their files. Another thread decodes the next ones while a step is computed, so
//! that a run holds a few of them at a time, whatever their number.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;
use std::time::Instant;

use serde::Serialize;

use wildcity_render::compare::psnr::psnr_db_u8;
use wildcity_render::gradient::Differentiate;
use wildcity_render::{Frame, Target, View};
use wildcity_scene::random::mix;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::settings::Settings;
use crate::trainer::{Sample, StepReport, TrainError, Trainer};

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
}

/// The images of a run, by their numbers.
pub trait TrainingImages: Sync {
    /// The number of all images.
    fn count(&self) -> usize;

    /// Whether an image is kept from the run, to judge it.
    fn is_held_out(&self, index: usize) -> bool;

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
    pub gaussians: usize,
    /// Since the first step, without evaluations.
    pub seconds: f64,
    /// Mean of the images that are held out, at the steps that are evaluated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out_db: Option<f64>,
    /// Wall time of each stage of the frame and its gradients, in milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// Trains Gaussians. The images that are held out are looked at every `evaluate_every` steps and
/// after the last one. `on_step` is called after each step, and ends the run by returning `false`.
///
/// # Errors
/// An image cannot be read, a setting is out of its range, or nothing is left to learn from.
pub fn run(
    start: Gaussians,
    images: &dyn TrainingImages,
    backend: &dyn Differentiate,
    profile: RenderProfile,
    settings: &Settings,
    evaluate_every: usize,
    on_step: &mut dyn FnMut(&Line) -> bool,
) -> Result<Gaussians, TrainError> {
    let (held_out, learned): (Vec<usize>, Vec<usize>) =
        (0..images.count()).partition(|&index| images.is_held_out(index));
    if learned.is_empty() {
        return Err(TrainError::NoImages { images: images.count(), held_out: held_out.len() });
    }
    let steps = settings.steps;
    let mut trainer = Trainer::new(start, profile, settings.clone())?;
    let evaluator = Evaluator { images, backend, profile, held_out: &held_out };
    thread::scope(|scope| {
        let (sender, next) = sync_channel(AHEAD);
        scope.spawn(move || {
            let order = order(&learned, settings.seed, steps);
            // A receiver that is gone has ended the run.
            order.map(|index| images.load(index)).all(|image| sender.send(image).is_ok())
        });
        let begin = Instant::now();
        let mut evaluated_s = 0.0;
        while trainer.steps_done() < steps {
            let report = step(&mut trainer, backend, &next, &profile)?;
            let done = trainer.steps_done();
            let seconds = begin.elapsed().as_secs_f64() - evaluated_s;
            let mut held_out_db = None;
            if done == steps || done.is_multiple_of(evaluate_every.max(1)) {
                held_out_db = evaluator.mean_db(trainer.model().scene())?;
            }
            evaluated_s = begin.elapsed().as_secs_f64() - seconds;
            let StepReport { l1, dssim, stages_ms, .. } = report;
            let gaussians = trainer.model().len();
            let line = Line { step: done, l1, dssim, gaussians, seconds, held_out_db, stages_ms };
            if !on_step(&line) {
                break;
            }
        }
        Ok(trainer.model().to_gaussians())
    })
}

/// The images of all steps: each once, in a random order, then each again.
fn order(learned: &[usize], seed: u64, steps: usize) -> impl Iterator<Item = usize> {
    let rounds = (0..steps.div_ceil(learned.len()) as u64).flat_map(move |round| {
        let mut order = learned.to_vec();
        order.sort_by_key(|&image| mix(seed ^ mix(round << 32 ^ image as u64)));
        order
    });
    rounds.take(steps)
}

fn step(
    trainer: &mut Trainer,
    backend: &dyn Differentiate,
    next: &Receiver<Result<TrainingImage, String>>,
    profile: &RenderProfile,
) -> Result<StepReport, TrainError> {
    let image = next.recv().unwrap_or_else(|_| Err("the thread that decodes has ended".to_owned()));
    let TrainingImage { view, rgb8, mask } = image.map_err(TrainError::Image)?;
    let rgb: Vec<f32> = rgb8.iter().map(|&value| f32::from(value) / 255.0).collect();
    let weights: Option<Vec<f32>> =
        mask.map(|mask| mask.iter().map(|&counts| if counts { 1.0 } else { 0.0 }).collect());
    let sample = Sample {
        view,
        rgb: &rgb,
        weights: weights.as_deref(),
        depth_m: None,
        background: profile.background.map(|value| value as f32),
    };
    trainer.step(backend, &sample)
}

/// The images that are held out.
struct Evaluator<'a> {
    images: &'a dyn TrainingImages,
    backend: &'a dyn Differentiate,
    profile: RenderProfile,
    held_out: &'a [usize],
}

impl Evaluator<'_> {
    /// The mean of their PSNR; `None` without any.
    fn mean_db(&self, scene: &Scene) -> Result<Option<f64>, TrainError> {
        let mut sum_db = 0.0;
        for &index in self.held_out {
            let TrainingImage { view, rgb8, mask } =
                self.images.load(index).map_err(TrainError::Image)?;
            let mut drawn = vec![0; rgb8.len()];
            let frame = Frame { scene, profile: &self.profile, views: &[view] };
            let target = Target { rgb8: Some(&mut drawn), ..Target::default() };
            self.backend.render(&frame, &mut [target], &|_, _| {})?;
            let counts = |&index: &usize| mask.as_ref().is_none_or(|mask| mask[index / 3]);
            let pairs = (0..rgb8.len()).filter(counts).map(|i| (&drawn[i], &rgb8[i]));
            sum_db += psnr_db_u8(pairs);
        }
        let count = self.held_out.len();
        Ok((count > 0).then(|| sum_db / count as f64))
    }
}
