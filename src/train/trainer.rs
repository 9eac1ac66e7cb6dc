//! The steps of a training run.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use wildcity_render::gradient::{Differentiate, GaussianImages, Gradients};
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::columns;
use wildcity_scene::geometry::Pose;
use wildcity_scene::random::mix;
use wildcity_scene::sky::{Network, Sky, SkyModel};
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene};

use crate::compose::Exposure;
pub use crate::error::TrainError;
use crate::exposures::TrainedExposures;
use crate::ground;
use crate::growth::relocate_and_grow;
use crate::history::{History, Line};
use crate::loss::ground::Terms;
use crate::model::{AdamStep, Model, rates};
pub use crate::objective::StepReport;
use crate::objective::{Objective, Outcome};
use crate::poses::{Place, PoseMoves, PoseStep, RigPoses, TrainedPoses};
use crate::sample::Sample;
use crate::settings::{PoseMode, Settings, SkyMode};
use crate::sky::TrainedSky;

/// What a run begins with.
#[derive(Clone, Debug, Default)]
pub struct Start {
    pub gaussians: Gaussians,
    /// Whether each Gaussian lies on the ground ([`ground::is_ground`]); empty if none does.
    pub is_ground: Vec<bool>,
    /// The recorded pose of each image of the run.
    pub world_from_camera: Vec<Pose>,
    /// The recorded poses of the rig that took the images.
    pub rig: Option<RigPoses>,
    /// What is drawn and not trained.
    pub fixed: Fixed,
}

/// What a run draws and does not train.
#[derive(Clone, Debug, Default)]
pub struct Fixed {
    /// A sky. With one, no other is trained.
    pub sky: Option<Arc<Sky>>,
    /// Gaussians that surround those of the run.
    pub chunks: Vec<Arc<Chunk>>,
}

/// A training run: its Gaussians and all else that it trains, and how far it is.
#[derive(Debug)]
pub struct Trainer {
    pub(crate) settings: Settings,
    pub(crate) profile: RenderProfile,
    pub(crate) model: Model,
    /// As they were recorded.
    pub(crate) rig: Option<RigPoses>,
    pub(crate) poses: Option<TrainedPoses>,
    pub(crate) exposures: Option<TrainedExposures>,
    pub(crate) sky: Option<TrainedSky>,
    pub(crate) fixed_sky: Option<Arc<Sky>>,
    pub(crate) step: usize,
    pub(crate) history: History,
    pub(crate) gradients: Gradients,
}

impl Trainer {
    /// A run, with the image formation of a profile.
    ///
    /// # Errors
    /// A setting is out of its range, or there are no Gaussians.
    pub fn new(
        start: Start,
        profile: RenderProfile,
        settings: Settings,
    ) -> Result<Self, TrainError> {
        settings.check()?;
        let Start { gaussians, is_ground, world_from_camera, rig, fixed } = start;
        let Fixed { sky, chunks } = fixed;
        if gaussians.means_m.is_empty() {
            return Err(TrainError::Empty);
        }
        validate::check(&gaussians, &Field::plain_name)?;
        if ![0, gaussians.len()].contains(&is_ground.len()) {
            return Err(TrainError::Count {
                what: "labels of the ground",
                given: is_ground.len(),
                wanted: gaussians.len(),
            });
        }
        if settings.poses.mode == PoseMode::Rig && rig.is_none() {
            return Err(TrainError::NoRig);
        }
        let images = world_from_camera.len();
        let own =
            // A pose per image is a rig that was in as many places, with one camera at its origin.
            RigPoses { world_from_ego: world_from_camera, ego_from_camera: vec![Pose::IDENTITY] };
        let poses = match settings.poses.mode {
            PoseMode::Off => None,
            PoseMode::Image => Some(own),
            // `Auto` without a rig trains no poses; `Rig` without one was refused above.
            PoseMode::Auto | PoseMode::Rig => rig.clone(),
        };
        let trains_sky = match settings.sky.mode {
            _ if sky.is_some() => false,
            SkyMode::Off => false,
            SkyMode::Network => true,
            SkyMode::Auto => rig.is_some(),
        };
        Ok(Self {
            model: Model::new(gaussians, is_ground, settings.sh_degree, chunks),
            poses: poses.map(TrainedPoses::new),
            exposures: settings.exposure.on.then(|| TrainedExposures::new(images)),
            sky: trains_sky.then(|| TrainedSky::new(&settings.sky, images, settings.seed)),
            fixed_sky: sky,
            gradients: Gradients::default(),
            step: 0,
            history: History::default(),
            rig,
            settings,
            profile,
        })
    }

    /// The Gaussians as they are now.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The settings of the run.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The image formation of the run.
    pub fn profile(&self) -> &RenderProfile {
        &self.profile
    }

    /// The scene as a server would draw it: the Gaussians, and the sky, if the run has one.
    ///
    /// # Errors
    /// As [`Trainer::sky`].
    pub fn scene(&self) -> Result<Scene, TrainError> {
        let trained = |network| Arc::new(Sky::new(SkyModel::network(network), DMat3::IDENTITY));
        let sky = self.sky()?.map(trained).or_else(|| self.fixed_sky.clone());
        Ok(Scene { sky, ..self.model.scene().clone() })
    }

    /// The network of the sky with the mean appearance, if the run has one.
    ///
    /// # Errors
    /// A weight has left the range of networks.
    pub fn sky(&self) -> Result<Option<Network>, TrainError> {
        Ok(self.sky.as_ref().map(TrainedSky::network).transpose()?)
    }

    /// The poses as they are now, if they are trained: those of the rig, or of each image.
    pub fn poses(&self) -> Option<&RigPoses> {
        self.poses.as_ref().map(TrainedPoses::now)
    }

    /// The exposure of each image as it is now, if it is trained: after the recorded one.
    pub fn exposures(&self) -> Option<Vec<Exposure<f32>>> {
        let exposures = self.exposures.as_ref()?;
        Some((0..exposures.images()).map(|image| exposures.exposure(image, 1.0)).collect())
    }

    /// A camera of the run at the pose that it has now.
    pub fn view(&self, view: View, image: usize, place: Option<Place>) -> View {
        match (&self.poses, self.trained_place(image, place)) {
            (Some(poses), Some(place)) => poses.view(view, place),
            _ => view,
        }
    }

    /// The curves of the run so far.
    pub fn history(&self) -> &History {
        &self.history
    }

    /// Adds a step to the curves.
    pub(crate) fn remember(&mut self, line: &Line) {
        self.history.add(line, self.settings.steps);
    }

    /// How far the poses have moved from the recorded ones, if they are trained.
    pub fn moves(&self) -> Option<PoseMoves> {
        self.poses.as_ref().map(TrainedPoses::moves)
    }

    /// Says from which images the run learns, and which poses of its rig they have.
    pub(crate) fn count(&mut self, images: &[(usize, Option<Place>)]) {
        let place = |&(image, place): &(usize, Option<Place>)| self.trained_place(image, place);
        let places: Vec<Option<Place>> = images.iter().map(place).collect();
        if let Some(poses) = &mut self.poses {
            poses.count(&places);
        }
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
        if self.images().is_some_and(|images| sample.image >= images) {
            return Err(TrainError::NoImage { image: sample.image });
        }
        let place = self.trained_place(sample.image, sample.place);
        if let Some((poses, place)) = self.poses.as_ref().zip(place)
            && !poses.now().has(place)
        {
            return Err(TrainError::Place { image: sample.image, place });
        }
        let objective = Objective {
            sample,
            view: self.view(sample.view, sample.image, sample.place),
            weights: &self.settings.loss,
            exposure: self.exposure(sample),
            sky: self.sky.as_ref(),
            fixed_sky: self.fixed_sky.as_deref(),
        };
        let depth = sample.depth_m.is_some() && self.settings.loss.disparity > 0.0;
        let views = [objective.view];
        let frame = Frame { scene: self.model.scene(), profile: &self.profile, views: &views };
        let mut outcome = None;
        let mut loss = |images: &[GaussianImages]| {
            let mut by_images = Vec::new();
            // The frame has one view, so the loop runs once.
            for images in images {
                let (by, at) = objective.at(images);
                by_images.push(by);
                outcome = Some(at);
            }
            by_images
        };
        let stats = backend.differentiate(&frame, depth, &mut loss, &mut self.gradients)?;
        // Before anything moves: Adam divides by 1 - decay^step, which is 0 at step 0.
        self.step += 1;
        let mut report = StepReport::default();
        if let Some(outcome) = outcome {
            self.move_cameras(sample, place, &outcome)?;
            report = outcome.report;
        }
        // Before the Gaussians move, since the terms add to their gradients.
        report.ground = self.add_ground(sample);
        self.move_gaussians(sample)?;
        self.grow();
        report.visible = stats.visible_pairs;
        report.stages_ms = stats.stages_ms;
        Ok(report)
    }

    /// Number of images, if something is trained of each.
    fn images(&self) -> Option<usize> {
        let exposures = self.exposures.as_ref().map(TrainedExposures::images);
        exposures.or_else(|| self.sky.as_ref().map(TrainedSky::images))
    }

    /// Goes on to the next step without learning: of an image that shows nothing that counts.
    pub(crate) fn skip(&mut self) -> StepReport {
        self.step += 1;
        self.grow();
        StepReport::default()
    }

    /// Which poses are trained of an image: those of the rig, or its own.
    fn trained_place(&self, image: usize, place: Option<Place>) -> Option<Place> {
        match self.settings.poses.mode {
            PoseMode::Image => Some(Place::new(image, 0)),
            _ => place,
        }
    }

    fn exposure(&self, sample: &Sample<'_>) -> Exposure<f32> {
        match &self.exposures {
            Some(exposures) => exposures.exposure(sample.image, sample.exposure),
            None => Exposure::gain(sample.exposure),
        }
    }

    /// Moves the poses, the exposure and the sky of an image.
    fn move_cameras(
        &mut self,
        sample: &Sample<'_>,
        place: Option<Place>,
        outcome: &Outcome,
    ) -> Result<(), TrainError> {
        let image = sample.image;
        let not_finite = |by: &str| {
            let by = by.to_owned();
            Err(TrainError::NotFinite { step: self.step, image, by })
        };
        let fall = f64::from(self.fall());
        if let Some((poses, place)) = self.poses.as_mut().zip(place) {
            let by = self.gradients.twists.first().copied().unwrap_or_default();
            // Adam keeps the mean of squares, and the square of a finite number may overflow.
            if !by.to_array().iter().all(|by| (by * by).is_finite()) {
                return not_finite("its pose");
            }
            let settings = &self.settings.poses;
            let first_rates = poses.rates(place, settings, self.settings.steps);
            let rates = first_rates.map(|rates| rates.map(|rate| rate * fall));
            poses.step(&PoseStep { place, by, rates, weight: settings.weight });
        }
        if let Some(exposures) = &mut self.exposures {
            let settings = &self.settings.exposure;
            if !outcome.by_exposure.is_finite() {
                return not_finite("its exposure");
            }
            let rates = [settings.rate, settings.weight];
            exposures.step(image, sample.exposure, &outcome.by_exposure, rates);
        }
        if let Some((sky, (seen, by))) = self.sky.as_mut().zip(outcome.sky.as_ref()) {
            let settings = &self.settings.sky;
            if !sky.step(image, seen, by, [settings.rate, settings.embedding_rate]) {
                return not_finite("the sky");
            }
        }
        Ok(())
    }

    /// Adds the derivatives of the terms of the ground.
    fn add_ground(&mut self, sample: &Sample<'_>) -> f64 {
        let settings = &self.settings.ground;
        let share = settings.share(self.settings.unscaled(self.step));
        let ego = sample.place.and_then(|place| self.rig.as_ref()?.world_from_ego.get(place.ego));
        let Some(ego) = ego else { return 0.0 };
        // The first chunk is the one that is trained; what is fixed follows it.
        let Some(gradients) = self.gradients.chunks.first_mut() else { return 0.0 };
        if share == 0.0 || !self.model.has_ground() {
            return 0.0;
        }
        let axis = |axis: DVec3| (ego.rotation * axis).as_vec3().to_array();
        let terms = Terms {
            up: axis(DVec3::Z),
            forward: axis(DVec3::X),
            slice_m: settings.slice_m,
            height: share * settings.height,
            upright: share * settings.upright,
            opaque: share * settings.opaque,
        };
        ground::add_terms(&self.model, &terms, gradients)
    }

    fn move_gaussians(&mut self, sample: &Sample<'_>) -> Result<(), TrainError> {
        let adam = self.adam_step();
        let Some(gradients) = self.gradients.chunks.first() else { return Ok(()) };
        match self.model.step(gradients, &adam) {
            None => Ok(()),
            Some(gaussian) => Err(TrainError::NotFinite {
                step: self.step,
                image: sample.image,
                by: format!("Gaussian {gaussian}"),
            }),
        }
    }

    /// The factor of the learning rates that fall to a hundredth.
    fn fall(&self) -> f32 {
        0.01_f32.powf(self.step as f32 / self.settings.steps as f32)
    }

    fn adam_step(&self) -> AdamStep {
        let Settings { steps, rates: of, loss, growth, .. } = &self.settings;
        let mean = of.mean * self.fall();
        // A degree more every sixth of the first half of the run.
        let degree = (12 * self.step / steps).min(self.settings.sh_degree.into()) as u8;
        let count = self.model.len() as f32;
        AdamStep {
            rates: rates(&self.settings, mean, degree, columns(self.model.sh_degree())),
            corrections: [0.9_f32, 0.999].map(|decay| 1.0 - decay.powi(self.step as i32)),
            // Means: over the opacities, and over three scales of each Gaussian.
            regularisers: [loss.opacity / count, loss.scale / (3.0 * count)],
            noise: growth.noise * mean,
            least_opacity: growth.least_opacity,
            seed: mix(self.settings.seed ^ mix(self.step as u64)),
        }
    }

    fn grow(&mut self) {
        if self.settings.grows_at(self.step) {
            // The complement keeps these draws apart from the noise of the same step.
            let seed = mix(self.settings.seed ^ mix(!(self.step as u64)));
            relocate_and_grow(&mut self.model, &self.settings, seed);
        }
    }
}
