//! `wildcity eval`.

mod compared;
mod drive;
mod labels;
mod networks;
mod off_trajectory;
mod renderer;
mod repairer;
mod saved;
mod summary;

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};

use wildcity_eval::{EvaluatedImage, Evaluation, Subject};
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;

use self::compared::Compared;
use self::drive::Drives;
use self::labels::{LabelOptions, Labels};
use self::networks::{FeatureSet, NetworkOptions, Networks};
use self::off_trajectory::{OffTrajectoryImage, OffTrajectoryViews, Offsets, OnDrive, Tools};
use self::renderer::{Maps, Renderer};
use self::repairer::{Repairer, RepairerOptions};
use self::summary::{decibels, print_means, print_off_trajectory};
use super::backend_options::BackendOptions;
use super::directories::Twins;
use super::file_notes::DropBad;
use super::profile_options::ProfileOptions;
use super::real_images::{ImageList, RealImage, camera_names};
use super::scene_source::Source;
use super::{output, placement, progress};

/// Compare a twin or a scene file with real images that it was not trained on.
///
/// Renders each image with its camera (pose, intrinsics, distortion) and measures PSNR, SSIM and
/// FLIP. Writes report.html (a single self-contained file, the worst images first), eval.json and
/// eval.csv. Means are those of the images' values. Give images that the twin was not trained on,
/// because others give values that are too good: see --images and --every.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Eval {
    /// The name of a twin: NAME, or NAME@NUMBER for an older version; or a scene file in any format
    /// that `wildcity import` reads.
    #[arg(value_name = "SCENE")]
    scene: String,

    /// The images with their cameras: a transforms.json of nerfstudio; a COLMAP model (its folder,
    /// or a folder that has it in sparse/0; text or binary); or a camera list in the format of
    /// `wildcity render --cameras`, one camera per line, with "image" (and optionally "mask").
    /// Poses of a list are in the axes of the scene. Other poses are in the axes of the scene file;
    /// for a twin, they get the axes, scale and alignment with which it was made.
    #[arg(long, value_name = "FILE_OR_DIR")]
    images: PathBuf,

    /// Folder of the images [default: that of transforms.json or of the list; for COLMAP, `images`
    /// next to the model]. Images may be smaller than their cameras, as in images_4: then the
    /// cameras are scaled.
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks: for image NAME.png, NAME.png or NAME.png.png. Black pixels do not count,
    /// such as those of vehicles and pedestrians that the twin does not have [default: the masks
    /// that transforms.json or the list names]
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// Compare every Nth image in the order of their names, starting with the first. The trainers
    /// of INRIA and gsplat hold out every 8th.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,

    /// Axes of the poses, in the form of `wildcity import --axes` [default: as the twin was
    /// imported and aligned; identity for a file and for a list]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true)]
    axes: Option<String>,

    /// Metres per unit of the poses; only with --axes, and applied after it [default: 1]
    #[arg(long, value_name = "M", requires = "axes")]
    scale: Option<f64>,

    /// Also compare after fitting a gain and an offset to each colour channel of each image: for
    /// captures with automatic exposure.
    #[arg(long)]
    align_exposure: bool,

    /// Number of images that the page shows, the worst first.
    #[arg(long, value_name = "N", default_value_t = 24)]
    show: usize,

    /// Also write the rendered images and the error maps in full size, as PNG, to rendered/ and
    /// errors/.
    #[arg(long)]
    save_images: bool,

    /// Directory for the report; created if it is missing.
    #[arg(long, value_name = "DIR", default_value = "wildcity-eval")]
    out: PathBuf,

    /// For each image, also render views at these lateral offsets to the left of the drive, in
    /// metres (negative: right), and compute the metrics that need no real image: trust,
    /// reprojection, flicker. Needs a twin with a drive.
    #[arg(long, value_name = "METRES", allow_hyphen_values = true)]
    extrapolate: Option<Offsets>,

    #[command(flatten)]
    labels: LabelOptions,

    #[command(flatten)]
    networks: NetworkOptions,

    #[command(flatten)]
    repairer: RepairerOptions,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    profile: ProfileOptions,

    #[command(flatten)]
    bad: DropBad,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity eval street --images held-out/transforms.json
  wildcity eval street --images capture --every 8 --image-dir capture/images_4 --align-exposure
  wildcity eval point_cloud.ply --images capture/sparse/0 --every 8 --masks capture/masks --out eval
  wildcity eval street --images views.jsonl --save-images
  wildcity eval street --images held-out/transforms.json --repair repair.json --extrapolate 1,3,5";

/// What renders, repairs and measures the images.
struct Setup {
    renderer: Renderer,
    repairer: Option<Repairer>,
    /// The recorded drives of the twin; `None` without any.
    drives: Option<Drives>,
    labels: Labels,
    networks: Networks,
}

/// Features of all images, if a network computes them.
#[derive(Default)]
struct Features {
    truth: Vec<Vec<f32>>,
    images: FeatureSet,
    /// Features of the views off the trajectory, distance by distance.
    off_trajectory: Vec<FeatureSet>,
}

impl Eval {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let list = ImageList::read(&self.images, self.image_dir.as_deref(), self.masks.as_deref())?;
        let names = camera_names(&list.every(1));
        let images = list.every(1).into_iter().zip(&names).step_by(self.every as usize);
        let images: Vec<(&RealImage, &String)> = images.collect();
        let changes = self.profile.load()?;
        let (source, own_profile) = Source::open(&self.scene, &self.twins, self.bad)?;
        let alignment = self.alignment(&source, &list)?;
        let held_out: Vec<Pose> =
            images.iter().map(|(image, _)| alignment.pose(&image.world_from_camera)).collect();
        let backend = self.backend.backend()?;
        let repairer = self.repairer.load(&source, &self.twins, &held_out)?;
        let drives = match &source {
            Source::Twin(resident) => Drives::from_version(&resident.version),
            Source::File(_) => None,
        };
        ensure!(
            self.extrapolate.is_none() || drives.is_some(),
            "--extrapolate {}: views beside the drive need a twin with a recorded drive; `wildcity twin drive` adds one",
            self.scene
        );
        let maps = Maps {
            depth: self.extrapolate.is_some()
                || self.labels.needs_depth()
                || repairer.as_ref().is_some_and(Repairer::needs_depth),
            normals: repairer.as_ref().is_some_and(Repairer::needs_normals),
        };
        let renderer = Renderer { source, own_profile, changes, backend, alignment, maps };
        let real: Vec<&RealImage> = images.iter().map(|(image, _)| *image).collect();
        let labels = self.labels.load(&renderer.source, &renderer.alignment, &real)?;
        let networks = self.networks.load(&self.repairer.load_options())?;
        let setup = Setup { renderer, repairer, drives, labels, networks };
        let profile = setup.renderer.profile(None)?;
        output::create_dir(&self.out)?;
        let bar = progress::count("comparing");
        bar.set_length(images.len() as u64);
        let mut evaluated: Vec<EvaluatedImage> = Vec::with_capacity(images.len());
        let mut off_trajectory = self.extrapolate.as_ref().map(OffTrajectoryViews::new);
        let mut features = Features::default();
        for (at, (image, camera_name)) in images.iter().enumerate() {
            let about = || format!("image {}", image.name);
            let compared = self.evaluate(&setup, image, camera_name).with_context(about)?;
            features.add(&setup.networks, &compared).with_context(about)?;
            if let Some(views) = &mut off_trajectory {
                let is_shown = at == images.len() / 2;
                let drawn = self.render_off_trajectory(&setup, views, &compared, image, is_shown);
                let drawn = drawn.with_context(about)?;
                let added = features.add_off_trajectory(&setup.networks, &compared, &drawn);
                added.with_context(about)?;
            }
            evaluated.push(compared.scores);
            self.forget_better_pictures(&mut evaluated);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let mut evaluation = Evaluation::new(self.subject(&setup, profile), evaluated);
        let extrapolation = off_trajectory.map(OffTrajectoryViews::finish);
        evaluation.extrapolation = extrapolation.unwrap_or_default();
        evaluation.kid = setup.networks.kid(&features.images, &features.truth)?;
        for (line, set) in evaluation.extrapolation.iter_mut().zip(&features.off_trajectory) {
            line.kid = setup.networks.kid(set, &features.truth)?;
        }
        self.write(&evaluation)
    }

    /// The transform from the axes of the poses to those of the scene.
    fn alignment(&self, source: &Source, list: &ImageList) -> anyhow::Result<Alignment> {
        match (&self.axes, source) {
            (Some(axes), _) => placement::imported(axes, self.scale.unwrap_or(1.0)),
            (None, Source::Twin(resident)) if !list.is_in_scene_axes => {
                placement::from_version(&self.twins.catalog()?, &resident.version)
            }
            (None, _) => Ok(Alignment::IDENTITY),
        }
    }

    /// Renders the views off the trajectory of an image.
    fn render_off_trajectory(
        &self,
        setup: &Setup,
        views: &mut OffTrajectoryViews,
        compared: &Compared,
        image: &RealImage,
        is_shown: bool,
    ) -> anyhow::Result<Vec<OffTrajectoryImage>> {
        let (Some(drives), Some(lens)) = (&setup.drives, &compared.lens) else {
            return Ok(Vec::new());
        };
        let repairer = setup.repairer.as_ref();
        let tools = Tools { renderer: &setup.renderer, repairer, drives };
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
        let offsets = self.extrapolate.iter().flat_map(|offsets| &offsets.0);
        for (offset_m, OffTrajectoryImage { rendered, repaired }) in offsets.zip(&drawn) {
            if self.save_images {
                let name = format!("{offset_m}m/{}", image.name);
                self.save_pixels("beside", &name, rendered, &compared.view)?;
                if let Some(repaired) = repaired {
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
        if shown <= self.show {
            return;
        }
        let shown = evaluated.iter_mut().filter(|image| image.thumbnails.is_some());
        let best = shown.max_by(|a, b| a.compare(b));
        if let Some(best) = best {
            best.thumbnails = None;
        }
    }

    fn subject(&self, setup: &Setup, profile: RenderProfile) -> Subject {
        let renderer = &setup.renderer;
        let version = renderer.source.version();
        Subject {
            scene: version.map_or(self.scene.clone(), |version| version.manifest.twin.clone()),
            version: version.map(|version| version.number),
            version_hash: version.map(|version| version.hash.clone()),
            images: self.images.display().to_string(),
            alignment: renderer.alignment.to_string(),
            every: self.every as usize,
            backend: renderer.backend.name(),
            profile,
            repair: setup.repairer.as_ref().map(Repairer::subject),
            lpips_network: setup.networks.lpips_name(),
            boxes: setup.labels.boxes_subject.clone(),
            lidar: setup.labels.lidar_subject.clone(),
        }
    }

    /// Writes the files, and a summary on standard output.
    fn write(&self, evaluation: &Evaluation) -> anyhow::Result<()> {
        let files = [
            ("report.html", wildcity_eval::page(evaluation)),
            ("eval.json", format!("{:#}\n", serde_json::to_value(evaluation)?)),
            ("eval.csv", evaluation.csv()),
        ];
        for (name, text) in &files {
            output::write(&self.out.join(name), text.as_bytes())?;
        }
        let mut out = io::stdout().lock();
        print_means(&mut out, &evaluation.all)?;
        if let Some(kid) = &evaluation.kid {
            let after =
                kid.repaired.map_or(String::new(), |kid| format!(", repaired {:.5}", kid.mean));
            writeln!(out, "KID by {}: {:.5}{after}", kid.network, kid.rendered.mean)?;
        }
        if let Some(lidar) = evaluation.subject.lidar.as_ref().filter(|lidar| lidar.left_out > 0) {
            writeln!(
                out,
                "{} LiDAR points were left out: no two poses at most 0.2 s apart are around their time",
                lidar.left_out
            )?;
        }
        for one in &evaluation.extrapolation {
            print_off_trajectory(&mut out, one)?;
        }
        if let Some(worst) = evaluation.worst_first().first() {
            writeln!(out, "worst: {}, {}", worst.name, decibels(worst.rendered.scores.psnr_db))?;
        }
        for (name, _) in &files {
            writeln!(out, "{}", self.out.join(name).display())?;
        }
        Ok(())
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
