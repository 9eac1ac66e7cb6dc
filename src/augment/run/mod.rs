//! A round from start to end: draws the views through a server, and writes the data set.

mod drawn_cameras;
mod samples;
mod view_sessions;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::mpsc;
use tokio::task::spawn_blocking;

use wildcity_scene::geometry::Bounds;
use wildcity_twin::store::{Catalog, Version};

use self::samples::write_samples;
use self::view_sessions::ViewSessions;
use crate::{
    AugmentError, CameraModel, ColmapForm, ColmapModel, Folder, Header, MadeWith, Options, Place,
    Plan, Point, PointSample, Sample, Surroundings, TrainingCamera, TrainingImage, limits,
    transforms,
};

pub use view_sessions::PLACE_TIMEOUT;

/// The views of a round, and how they are written.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Number of the round, from 1.
    pub round: u32,
    /// Lateral offsets that the rounds lead to, in metres.
    pub offsets_m: Vec<f64>,
    /// Distance between two views along a drive, in metres.
    pub every_m: f64,
    /// Names of the cameras; none for all of the rig.
    pub cameras: Vec<String>,
    /// Longest side of an image, in pixels; `None` for the rig's.
    pub side_px: Option<u32>,
    /// Whether the lenses of the rig stay.
    pub lenses: bool,
    /// Largest number of points of the COLMAP model.
    pub points: u32,
    /// Seed of the choice of the points.
    pub seed: u64,
    pub colmap: ColmapForm,
    /// Name of the model that repairs images and the least trust of these; `None` without repair.
    pub model: Option<(String, f64)>,
    /// The axes of the capture in those of the twin, if they are known, for augment.json.
    pub world_from_capture: Option<String>,
    /// Folder of the rounds.
    pub out: PathBuf,
}

/// A data set of one round.
#[derive(Debug)]
pub struct Round {
    /// The folder `round_N` of the files.
    pub dir: PathBuf,
    /// Offsets of its views, in metres.
    pub offsets_m: Vec<f64>,
    /// Number of cameras that were drawn.
    pub cameras: usize,
    pub samples: Vec<Sample>,
    /// Samples of an earlier run, which were not drawn again.
    pub kept: usize,
    /// Samples of an earlier run that were missing or damaged, and drawn again.
    pub damaged: usize,
}

/// A round that can begin: the views to draw.
pub struct Augmentation<'a> {
    settings: &'a Settings,
    catalog: &'a Catalog,
    version: Version,
    plan: Plan,
    places: Vec<Place>,
    cameras: Vec<TrainingCamera>,
    lens_model: CameraModel,
}

/// Called with what is done (`checking`, `drawing`), how much of it, and how much there is.
pub type Progress<'a> = &'a mut dyn FnMut(&'static str, u64, u64);

impl<'a> Augmentation<'a> {
    /// Plans the views of a round. None is drawn before [`Self::run`].
    ///
    /// # Errors
    /// A setting is out of range, or the version has no drive or no such camera.
    pub fn new(
        settings: &'a Settings,
        catalog: &'a Catalog,
        version: Version,
    ) -> anyhow::Result<Self> {
        let Settings { round, offsets_m, every_m, cameras, side_px, lenses, .. } = settings;
        let plan = Plan::new(*round, offsets_m, *every_m)?;
        let cameras = drawn_cameras::cameras(&version, cameras, *side_px, *lenses)?;
        let lens_model = CameraModel::from_cameras(&cameras)?;
        let places = plan.places(&version.manifest.trajectories)?;
        let samples = places.len() * cameras.len();
        let limit = limits::MOST_SAMPLES;
        if samples > limit {
            return Err(AugmentError::Samples { samples, limit }.into());
        }
        Ok(Self { settings, catalog, version, plan, places, cameras, lens_model })
    }

    /// Draws the missing samples through the server at a URL, which has the twin and the model, and
    /// writes the data set.
    ///
    /// # Errors
    /// The server or the model fails, or a file cannot be written: the next run continues.
    pub async fn run(&self, url: &str, progress: Progress<'_>) -> anyhow::Result<Round> {
        let model = self.settings.model.as_ref().map(|(name, least)| (name.as_str(), *least));
        let mut sessions = ViewSessions::open(url, &self.version, &self.cameras, model).await?;
        let dir = self.settings.out.join(format!("round_{}", self.plan.round()));
        let folder = Folder::open(&dir, self.header(&sessions), &mut |done, all| {
            progress("checking", done, all);
        })?;
        let kept = folder.count();
        let damaged = folder.damaged();
        let folder = self.draw(&mut sessions, folder, progress).await?;
        sessions.close().await?;
        let samples = self.write(folder)?;
        Ok(Round {
            dir,
            offsets_m: self.plan.offsets_m(),
            cameras: self.cameras.len(),
            samples,
            kept,
            damaged,
        })
    }

    /// Draws the missing samples. One place is written while the next one is rendered.
    async fn draw(
        &self,
        sessions: &mut ViewSessions,
        folder: Folder,
        progress: Progress<'_>,
    ) -> anyhow::Result<Folder> {
        let is_done = |place: &Place| {
            self.cameras.iter().all(|camera| folder.has(&place.image_name(&camera.name)))
        };
        let missing: Vec<&Place> = self.places.iter().filter(|place| !is_done(place)).collect();
        let all = (self.places.len() * self.cameras.len()) as u64;
        let done = Arc::new(AtomicU64::new(folder.count() as u64));
        let (sender, receiver) = mpsc::channel(1);
        let cameras = self.cameras.clone();
        let counter = done.clone();
        let writer = spawn_blocking(move || write_samples(folder, &cameras, receiver, &counter));
        for place in missing {
            progress("drawing", done.load(Ordering::Relaxed), all);
            let drawn = sessions.draw(place).await?;
            // The writer ends early only if it failed; then it returns the reason.
            if sender.send((place.clone(), drawn)).await.is_err() {
                break;
            }
        }
        drop(sender);
        writer.await?
    }

    fn header(&self, sessions: &ViewSessions) -> Header {
        let Settings { side_px, lenses, points, seed, colmap, .. } = self.settings;
        let options = Options {
            round: self.plan.round(),
            wanted_offsets_m: self.plan.wanted_m().to_vec(),
            every_m: self.plan.every_m(),
            cameras: self.cameras.iter().map(|camera| camera.name.clone()).collect(),
            side_px: *side_px,
            lenses: *lenses,
            points: *points,
            seed: *seed,
            colmap: colmap.extension().to_owned(),
        };
        Header {
            made_with: MadeWith {
                twin: self.version.manifest.twin.clone(),
                version_hash: self.version.hash.clone(),
                backend: sessions.backend().to_owned(),
                repair: sessions.repaired_with(),
                options,
            },
            version: self.version.number,
            offsets_m: self.plan.offsets_m(),
            world_from_capture: self.settings.world_from_capture.clone(),
        }
    }

    /// Writes transforms.json, the COLMAP model and augment.json.
    fn write(&self, folder: Folder) -> anyhow::Result<Vec<Sample>> {
        let names = self
            .places
            .iter()
            .flat_map(|place| self.cameras.iter().map(|camera| place.image_name(&camera.name)));
        let names: Vec<String> = names.collect();
        let samples = folder.samples(&names);
        let transforms = transforms(self.lens_model, &self.cameras, &samples);
        folder.write("transforms.json", format!("{transforms:#}\n").as_bytes())?;
        let images: Vec<TrainingImage> = samples.iter().map(TrainingImage::from).collect();
        let colmap = ColmapModel {
            model: self.lens_model,
            cameras: &self.cameras,
            images: &images,
            points: &self.sampled_points()?,
        };
        for (name, bytes) in colmap.files(self.settings.colmap) {
            folder.write(&format!("sparse/0/{name}"), &bytes)?;
        }
        folder.finish(&samples)?;
        Ok(samples)
    }

    fn sampled_points(&self) -> anyhow::Result<Vec<Point>> {
        let near = Surroundings::from_places(&self.places);
        let most = self.settings.points as usize;
        let mut sample = PointSample::new(self.settings.seed, most, near.clone());
        if most > 0 {
            let is_near = |bounds: &Bounds| near.meet(bounds);
            self.catalog.visit_full_detail(&self.version, &is_near, &mut |section| {
                sample.add(&section);
            })?;
        }
        Ok(sample.into_points())
    }
}
