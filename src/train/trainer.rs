//! The steps of a training run.

use wildcity_render::gradient::{Differentiate, GaussianImages, GradientError, Gradients};
use wildcity_render::{Frame, RenderError, View};
use wildcity_scene::chunk::columns;
use wildcity_scene::random::mix;
use wildcity_scene::validate::{self, BadGaussians, Field};
use wildcity_scene::{Gaussians, RenderProfile};

use crate::compose::{Background, Exposure, compose, compose_gradient};
use crate::growth::relocate_and_grow;
use crate::loss::{disparity, dssim, l1, masked};
use crate::model::{AdamStep, Model, rates};
use crate::settings::{SettingError, Settings};

/// An image to learn from.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    pub view: View,
    /// `[height, width, 3]`: the colours of the image, 0 to 1.
    pub rgb: &'a [f32],
    /// `[height, width]`: the weight of each pixel; 0 leaves it out.
    pub weights: Option<&'a [f32]>,
    /// `[height, width]`: measured depths in metres; 0 where there is none.
    pub depth_m: Option<&'a [f32]>,
    /// The colour behind all Gaussians.
    pub background: [f32; 3],
}

/// A training run: its Gaussians, and how far it is.
#[derive(Debug)]
pub struct Trainer {
    settings: Settings,
    profile: RenderProfile,
    model: Model,
    gradients: Gradients,
    step: usize,
}

/// The losses of a step, without their weights.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    pub l1: f64,
    pub dssim: f64,
    /// In 1/m; 0 without measured depths.
    pub disparity: f64,
    /// Number of visible Gaussians.
    pub visible: u64,
    /// Wall time of each stage of the frame and its gradients, in milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
}

/// Why a run cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    #[error(transparent)]
    Setting(#[from] SettingError),
    #[error(transparent)]
    Gradient(#[from] GradientError),
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An image of the run cannot be read.
    #[error("{0}")]
    Image(String),
    /// Nothing is left to learn from.
    #[error(
        "of {images} images {held_out} are held out, and none is left to learn from: give more images, or hold out none"
    )]
    NoImages { images: usize, held_out: usize },
    /// No Gaussian to begin with.
    #[error("there are no points to begin with: give a cloud of points, or a scene to refine")]
    Empty,
    /// Values that no scene may have.
    #[error("Gaussians to begin with: {0}")]
    Invalid(BadGaussians),
    /// A derivative that f32 does not hold: the run cannot go on from here.
    #[error("step {step}: a derivative by Gaussian {gaussian} is not finite")]
    NotFinite { step: usize, gaussian: usize },
    /// A colour, weight or depth that counts and is no number of its range.
    #[error(
        "value {index} of the {image} is {value}; colours are finite, weights and depths not below 0"
    )]
    Value { image: &'static str, index: usize, value: f32 },
    /// An image of another size than its camera's.
    #[error("the {image} has {given} values, and the camera's size asks for {wanted}")]
    Size { image: &'static str, given: usize, wanted: usize },
}

impl From<BadGaussians> for TrainError {
    fn from(cause: BadGaussians) -> Self {
        Self::Invalid(cause)
    }
}

impl Trainer {
    /// A run from some Gaussians, with the image formation of a profile.
    ///
    /// # Errors
    /// A setting is out of its range, or there are no Gaussians.
    pub fn new(
        gaussians: Gaussians,
        profile: RenderProfile,
        settings: Settings,
    ) -> Result<Self, TrainError> {
        settings.check()?;
        if gaussians.means_m.is_empty() {
            return Err(TrainError::Empty);
        }
        validate::check(&gaussians, &Field::plain_name)?;
        let model = Model::new(gaussians, settings.sh_degree);
        Ok(Self { settings, profile, model, gradients: Gradients::default(), step: 0 })
    }

    /// The Gaussians as they are now.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Number of steps that have been made.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// Learns from one image.
    ///
    /// # Errors
    /// The sample has the wrong size, or a derivative is not finite.
    pub fn step(
        &mut self,
        backend: &dyn Differentiate,
        sample: &Sample<'_>,
    ) -> Result<StepReport, TrainError> {
        sample.check()?;
        let views = [sample.view];
        let mut report = StepReport::default();
        let depth = sample.depth_m.is_some() && self.settings.loss.disparity > 0.0;
        let frame = Frame { scene: self.model.scene(), profile: &self.profile, views: &views };
        let settings = &self.settings;
        let mut loss = |images: &[GaussianImages]| match images {
            [images] => vec![image_loss(images, sample, settings, &mut report)],
            _ => Vec::new(),
        };
        let stats = backend.differentiate(&frame, depth, &mut loss, &mut self.gradients)?;
        report.visible = stats.visible_pairs;
        report.stages_ms = stats.stages_ms;

        self.step += 1;
        let adam = self.adam_step();
        if let Some(gradients) = self.gradients.chunks.first()
            && let Some(gaussian) = self.model.step(gradients, &adam)
        {
            return Err(TrainError::NotFinite { step: self.step, gaussian });
        }
        self.grow();
        Ok(report)
    }

    fn adam_step(&self) -> AdamStep {
        let Settings { steps, rates: of, loss, growth, .. } = &self.settings;
        let share = self.step as f32 / *steps as f32;
        let mean = of.mean * 0.01_f32.powf(share);
        // A degree more every sixth of the first half of the run.
        let degree = (12 * self.step / steps).min(self.settings.sh_degree.into()) as u8;
        let count = self.model.len() as f32;
        AdamStep {
            rates: rates(&self.settings, mean, degree, columns(self.model.sh_degree())),
            corrections: [0.9_f32, 0.999].map(|decay| 1.0 - decay.powi(self.step as i32)),
            regularisers: [loss.opacity / count, loss.scale / (3.0 * count)],
            noise: growth.noise * mean,
            least_opacity: growth.least_opacity,
            seed: mix(self.settings.seed ^ mix(self.step as u64)),
        }
    }

    fn grow(&mut self) {
        let growth = &self.settings.growth;
        let [from, until] = [growth.from, growth.until].map(|step| self.settings.scaled(step));
        // In short runs as often as in long ones: opacities take their time to fall.
        let is_time = self.step.is_multiple_of(growth.every);
        if is_time && self.step >= from && self.step < until {
            let seed = mix(self.settings.seed ^ mix(!(self.step as u64)));
            relocate_and_grow(&mut self.model, growth, seed);
        }
    }
}

impl Sample<'_> {
    fn check(&self) -> Result<(), TrainError> {
        let pixels = self.view.camera.pixels();
        let sizes = [
            ("image", Some(self.rgb.len()), 3 * pixels),
            ("mask", self.weights.map(<[f32]>::len), pixels),
            ("depth", self.depth_m.map(<[f32]>::len), pixels),
        ];
        for (image, given, wanted) in sizes {
            if let Some(given) = given.filter(|&given| given != wanted) {
                return Err(TrainError::Size { image, given, wanted });
            }
        }
        // A NaN is in no range.
        let is_fault = |value: &f32| !(0.0..=f32::MAX).contains(value);
        let out_of_range = |values: &[f32]| values.iter().position(is_fault);
        for (image, values) in [("mask", self.weights), ("depth", self.depth_m)] {
            if let Some((values, index)) = values.and_then(|v| Some((v, out_of_range(v)?))) {
                return Err(TrainError::Value { image, index, value: values[index] });
            }
        }
        let counts = |index: usize| self.weights.is_none_or(|weights| weights[index / 3] > 0.0);
        let is_fault = |index: &usize| !self.rgb[*index].is_finite() && counts(*index);
        match (0..self.rgb.len()).find(is_fault) {
            Some(index) => Err(TrainError::Value { image: "image", index, value: self.rgb[index] }),
            None => Ok(()),
        }
    }
}

/// The derivatives of the loss by the images of the Gaussians.
fn image_loss(
    images: &GaussianImages,
    sample: &Sample<'_>,
    settings: &Settings,
    report: &mut StepReport,
) -> GaussianImages {
    let background = Background::Color(sample.background);
    let exposure = Exposure::identity();
    let image = compose(&images.rgb, &images.opacity, background, &exposure);
    let weights = &settings.loss;
    let camera = &sample.view.camera;
    let size_px = [camera.width_px, camera.height_px].map(|px| px as usize);

    let absolute = l1(&image, sample.rgb, sample.weights);
    report.l1 = absolute.value;
    let mut total = absolute.scaled(1.0 - weights.dssim);
    if weights.dssim > 0.0 {
        // Masked pixels are 0 on both sides.
        let mut similarity = match sample.weights {
            None => dssim(size_px, &image, sample.rgb),
            Some(mask) => dssim(size_px, &masked(&image, mask), &masked(sample.rgb, mask)),
        };
        if let Some(mask) = sample.weights {
            similarity.by = masked(&similarity.by, mask);
        }
        report.dssim = similarity.value;
        total = total.plus(&similarity.scaled(weights.dssim));
    }
    let composed = compose_gradient(&images.rgb, &images.opacity, background, &exposure, &total.by);
    let mut by =
        GaussianImages { rgb: composed.rgb, opacity: composed.opacity, depth_sum_m: Vec::new() };
    if let Some(measured_m) = sample.depth_m.filter(|_| !images.depth_sum_m.is_empty()) {
        let loss = disparity(&images.opacity, &images.depth_sum_m, measured_m);
        report.disparity = loss.value;
        let loss = loss.scaled(weights.disparity);
        for (by, more) in by.opacity.iter_mut().zip(loss.by_opacity) {
            *by += more;
        }
        by.depth_sum_m = loss.by_depth_sum;
    }
    by
}
