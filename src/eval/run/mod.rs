//! An evaluation: renders each real image's view, repairs and measures it, and renders views beside
//! the drive.

mod compared;
mod drive;
mod labels;
mod networks;
mod off_trajectory;
mod renderer;
mod repairer;
mod saved;

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use wildcity_render::Backend;
use wildcity_repair::LoadOptions;
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_session::OpenScene;
use wildcity_twin::store::Catalog;

use self::compared::Compared;
use self::drive::Drives;
use self::labels::Labels;
use self::networks::{FeatureSet, Networks};
use self::off_trajectory::{OffTrajectoryImage, OffTrajectoryViews, OnDrive, Tools};
use self::renderer::{Maps, Renderer};
use self::repairer::Repairer;
use crate::images::{ImageList, RealImage, camera_names};
use crate::{EvaluatedImage, Evaluation, Subject};

pub use renderer::ProfileChanges;

/// What is evaluated, and how.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Name of the scene, if it is a file.
    pub scene: String,
    /// Name of the list of images.
    pub images: String,
    /// Every how many of the images is compared, starting with the first: 1 for all.
    pub every: usize,
    /// Whether images are compared after fitting a gain and an offset to each channel, too.
    pub align_exposure: bool,
    /// Number of images with pictures, the worst ones.
    pub show: usize,
    /// Lateral offsets of views beside the drive, in metres to the left.
    pub offsets_m: Vec<f64>,
    /// File of boxes around moving objects, one JSON object per line.
    pub boxes: Option<PathBuf>,
    /// File of LiDAR points.
    pub lidar: Option<PathBuf>,
    /// Largest time between an image and the points that it is compared with, in seconds.
    pub lidar_window_s: f64,
    /// Manifest of a network that computes the distance between two images.
    pub lpips: Option<PathBuf>,
    /// Manifest of a network that computes the features of an image.
    pub features: Option<PathBuf>,
    /// Manifest of the model that repairs the images.
    pub repair: Option<PathBuf>,
    /// How networks are loaded.
    pub networks: LoadOptions,
}

/// The scene that is evaluated, and what renders it.
pub struct Scene {
    pub source: OpenScene,
    /// The catalog of the twin; `None` for a file.
    pub catalog: Option<Catalog>,
    /// The profile of the scene before its changes.
    pub own_profile: RenderProfile,
    /// Changes of that profile.
    pub changes: Box<ProfileChanges>,
    /// The transform from the axes of the images' poses to those of the scene.
    pub alignment: Alignment,
    pub backend: Box<dyn Backend>,
}

/// Stores a PNG under a path of two or more parts, such as `rendered/front/0001.png`.
pub type Save<'a> = &'a dyn Fn(&Path, &[u8]) -> anyhow::Result<()>;

/// An evaluation that can begin: all its files were read.
pub struct Evaluator<'a> {
    settings: &'a Settings,
    images: Vec<(&'a RealImage, String)>,
    renderer: Renderer,
    repairer: Option<Repairer>,
    /// The recorded drives of the twin; `None` without any.
    drives: Option<Drives>,
    labels: Labels,
    networks: Networks,
    profile: RenderProfile,
    /// Stores the compared images and the maps of their errors; `None` to store none.
    save: Option<Save<'a>>,
}

/// Features of all images, if a network computes them.
#[derive(Default)]
struct Features {
    truth: Vec<Vec<f32>>,
    images: FeatureSet,
    /// Features of the views off the trajectory, distance by distance.
    off_trajectory: Vec<FeatureSet>,
}

/// Compares a scene with the images of a list. `progress` is called with the number of images that
/// are done and of all.
///
/// # Errors
/// A file cannot be read, an image cannot be rendered, or an input does not fit the scene.
pub fn run(
    settings: &Settings,
    scene: Scene,
    images: &ImageList,
    save: Option<Save<'_>>,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<Evaluation> {
    Evaluator::new(settings, scene, images, save)?.run(progress)
}

impl<'a> Evaluator<'a> {
    /// Reads the files that the settings name. `save` stores the compared images.
    ///
    /// # Errors
    /// A file cannot be read, or does not fit the scene or the images.
    pub fn new(
        settings: &'a Settings,
        scene: Scene,
        list: &'a ImageList,
        save: Option<Save<'a>>,
    ) -> anyhow::Result<Self> {
        let Scene { source, catalog, own_profile, changes, alignment, backend } = scene;
        // Of the whole list: with fewer images all may be in one folder, and would get other names.
        let names = camera_names(&list.every(1));
        let named = list.every(1).into_iter().zip(names).step_by(settings.every.max(1));
        let images: Vec<(&RealImage, String)> = named.collect();
        let held_out: Vec<Pose> =
            images.iter().map(|(image, _)| alignment.pose(&image.world_from_camera)).collect();
        let repairer = Repairer::load(settings, &source, catalog.as_ref(), &held_out)?;
        let drives = match &source {
            OpenScene::Twin(resident) => Drives::from_version(&resident.version),
            OpenScene::File(_) => None,
        };
        ensure!(
            settings.offsets_m.is_empty() || drives.is_some(),
            "--extrapolate {}: views beside the drive need a twin with a recorded drive; `wildcity twin drive` adds one",
            settings.scene
        );
        let maps = Maps {
            depth: !settings.offsets_m.is_empty()
                || settings.lidar.is_some()
                || repairer.as_ref().is_some_and(Repairer::needs_depth),
            normals: repairer.as_ref().is_some_and(Repairer::needs_normals),
        };
        let real: Vec<&RealImage> = images.iter().map(|(image, _)| *image).collect();
        let labels = Labels::load(settings, &source, &alignment, &real)?;
        let networks = Networks::load(settings)?;
        // Last, because it takes the source and the alignment, which the others borrow.
        let renderer = Renderer { source, own_profile, changes, backend, alignment, maps };
        let profile = renderer.profile(None)?;
        Ok(Self { settings, images, renderer, repairer, drives, labels, networks, profile, save })
    }

    /// Renders and compares all images.
    ///
    /// # Errors
    /// An image cannot be read, rendered or saved; the error names it.
    pub fn run(&self, progress: &mut dyn FnMut(u64, u64)) -> anyhow::Result<Evaluation> {
        let count = self.images.len();
        let mut evaluated: Vec<EvaluatedImage> = Vec::with_capacity(count);
        let mut views = OffTrajectoryViews::new(&self.settings.offsets_m);
        let mut features = Features::default();
        progress(0, count as u64);
        for (at, (image, camera_name)) in self.images.iter().enumerate() {
            // Only the views of one image are shown, in the middle of the list: a page with all
            // would be too large to open.
            let is_shown = at == count / 2;
            let scores = self.add(image, camera_name, is_shown, &mut views, &mut features);
            evaluated.push(scores.with_context(|| format!("image {}", image.name))?);
            self.forget_better_pictures(&mut evaluated);
            progress(at as u64 + 1, count as u64);
        }
        let mut evaluation = Evaluation::new(self.subject(), evaluated);
        evaluation.extrapolation = views.finish();
        evaluation.kid = self.networks.kid(&features.images, &features.truth)?;
        for (line, set) in evaluation.extrapolation.iter_mut().zip(&features.off_trajectory) {
            line.kid = self.networks.kid(set, &features.truth)?;
        }
        Ok(evaluation)
    }

    /// Evaluates one image, with its views off the trajectory.
    fn add(
        &self,
        image: &RealImage,
        camera_name: &str,
        is_shown: bool,
        views: &mut OffTrajectoryViews,
        features: &mut Features,
    ) -> anyhow::Result<EvaluatedImage> {
        let compared = self.evaluate(image, camera_name)?;
        features.add(&self.networks, &compared)?;
        let drawn = self.render_off_trajectory(views, &compared, image, is_shown)?;
        features.add_off_trajectory(&self.networks, &compared, &drawn)?;
        Ok(compared.scores)
    }

    /// Renders the views off the trajectory of an image.
    fn render_off_trajectory(
        &self,
        views: &mut OffTrajectoryViews,
        compared: &Compared,
        image: &RealImage,
        is_shown: bool,
    ) -> anyhow::Result<Vec<OffTrajectoryImage>> {
        let Some(drives) = &self.drives else { return Ok(Vec::new()) };
        let Some(lens) = &compared.lens else { return Ok(Vec::new()) };
        let tools = Tools { renderer: &self.renderer, repairer: self.repairer.as_ref(), drives };
        let on_drive = OnDrive {
            name: &image.name,
            camera: &compared.camera,
            lens,
            exposure_stops: image.exposure_stops,
            view: &compared.view,
            profile: &compared.profile,
            truth: &compared.truth,
            rendered: &compared.rendered,
            counts: compared.counts.as_deref(),
            is_shown,
        };
        let drawn = views.add(tools, &on_drive)?;
        if self.save.is_some() {
            for (offset_m, beside) in self.settings.offsets_m.iter().zip(&drawn) {
                let name = format!("{offset_m}m/{}", image.name);
                self.save_pixels("beside", &name, &beside.rendered, &compared.view)?;
                if let Some(repaired) = &beside.repaired {
                    self.save_pixels("beside_repaired", &name, repaired, &compared.view)?;
                }
            }
        }
        Ok(drawn)
    }

    /// Keeps only the pictures of the worst images, so that memory does not grow with the number of
    /// images.
    fn forget_better_pictures(&self, evaluated: &mut [EvaluatedImage]) {
        let shown = evaluated.iter().filter(|image| image.thumbnails.is_some()).count();
        if shown <= self.settings.show {
            return;
        }
        let with_pictures = evaluated.iter_mut().filter(|image| image.thumbnails.is_some());
        // One is added at a time, so that removing one is enough.
        if let Some(best) = with_pictures.max_by(|a, b| a.compare(b)) {
            best.thumbnails = None;
        }
    }

    fn subject(&self) -> Subject {
        let Settings { scene, images, every, .. } = self.settings;
        let version = self.renderer.source.version();
        Subject {
            scene: version.map_or(scene.clone(), |version| version.manifest.twin.clone()),
            version: version.map(|version| version.number),
            version_hash: version.map(|version| version.hash.clone()),
            images: images.clone(),
            alignment: self.renderer.alignment.to_string(),
            every: *every,
            backend: self.renderer.backend.name(),
            profile: self.profile,
            repair: self.repairer.as_ref().map(Repairer::subject),
            lpips_network: self.networks.lpips_name(),
            boxes: self.labels.boxes_subject.clone(),
            lidar: self.labels.lidar_subject.clone(),
        }
    }
}

impl Features {
    fn add(&mut self, networks: &Networks, compared: &Compared) -> anyhow::Result<()> {
        let camera = &compared.view.camera;
        let size_px = [camera.width_px, camera.height_px];
        self.truth.extend(networks.features(size_px, &compared.truth)?);
        self.images.rendered.extend(networks.features(size_px, &compared.rendered.rgb8)?);
        if let Some(repaired) = &compared.repaired {
            self.images.repaired.extend(networks.features(size_px, repaired)?);
        }
        Ok(())
    }

    fn add_off_trajectory(
        &mut self,
        networks: &Networks,
        compared: &Compared,
        drawn: &[OffTrajectoryImage],
    ) -> anyhow::Result<()> {
        let camera = &compared.view.camera;
        let size_px = [camera.width_px, camera.height_px];
        // The number of distances is the same for every image, so that only the first one resizes.
        self.off_trajectory.resize_with(drawn.len(), FeatureSet::default);
        for (set, image) in self.off_trajectory.iter_mut().zip(drawn) {
            set.rendered.extend(networks.features(size_px, &image.rendered)?);
            if let Some(repaired) = &image.repaired {
                set.repaired.extend(networks.features(size_px, repaired)?);
            }
        }
        Ok(())
    }
}
