//! `wildcity eval`.

mod options;
mod summary;

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;

use wildcity_eval::images::ImageList;
use wildcity_eval::{Evaluation, Evaluator, Save, Scene, Settings};
use wildcity_log::{Log, Row, TrackRow};
use wildcity_scene::align::Alignment;
use wildcity_session::OpenScene;

use self::options::{LabelOptions, NetworkOptions, Offsets, RepairerOptions};
use self::summary::{decibels, print_means, print_off_trajectory};
use super::backend_options::BackendOptions;
use super::directories::Twins;
use super::file_notes::{DropBad, print_warnings};
use super::profile_options::ProfileOptions;
use super::scene_source::open_scene;
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
    /// Also a log, as for --log.
    #[arg(long, value_name = "FILE_OR_DIR", required_unless_present = "log")]
    images: Option<PathBuf>,

    /// Compare with everything that a log has (docs/logs.md): the images that it marks as held out,
    /// or else every 8th; its LiDAR, and the boxes of its tracks.
    #[arg(long, value_name = "LOG", conflicts_with_all = ["images", "image_dir", "masks", "boxes", "lidar"])]
    log: Option<PathBuf>,

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
    /// [default: 1; for a log that marks no image as held out, 8]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    every: Option<u32>,

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

/// Of a log that marks no image as held out, every 8th is compared, as the trainers of INRIA and
/// gsplat hold out.
const LOG_EVERY: u32 = 8;

/// The files of `--boxes` and `--lidar` that a log stands for.
fn log_labels(log: &Log) -> anyhow::Result<(Option<PathBuf>, Option<PathBuf>)> {
    // Opening a table tells whether the log has it; its rows are read later.
    let boxes = log.tracks()?.map(|_| log.path(TrackRow::FILE));
    let lidar = log.sweeps()?.map(|_| log.folder().to_owned());
    Ok((boxes, lidar))
}

const EXAMPLES: &str = "\
Examples:
  wildcity eval street --images held-out/transforms.json
  wildcity eval street --images capture --every 8 --image-dir capture/images_4 --align-exposure
  wildcity eval point_cloud.ply --images capture/sparse/0 --every 8 --masks capture/masks --out eval
  wildcity eval street --images views.jsonl --save-images
  wildcity eval street --log log
  wildcity eval street --images held-out/transforms.json --repair repair.json --extrapolate 1,3,5";

impl Eval {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let source =
            self.images.as_ref().or(self.log.as_ref()).context("give --images or --log")?;
        let list = ImageList::read(source, self.image_dir.as_deref(), self.masks.as_deref())?;
        print_warnings(source, &list.warnings)?;
        let default_every = if self.log.is_some() && !list.has_held_out() { LOG_EVERY } else { 1 };
        let list = if self.log.is_some() { list.held_out() } else { list };
        let changes = self.profile.load()?;
        let (scene, own_profile) = open_scene(&self.scene, &self.twins, self.bad)?;
        let alignment = self.alignment(&scene, &list)?;
        let catalog = match &scene {
            OpenScene::Twin(_) => Some(self.twins.catalog()?),
            OpenScene::File(_) => None,
        };
        let scene = Scene {
            source: scene,
            catalog,
            own_profile,
            changes: Box::new(move |profile| changes.apply(profile)),
            alignment,
            backend: self.backend.backend()?,
        };
        let settings = self.settings(source, self.every.unwrap_or(default_every))?;
        let save = |path: &Path, png: &[u8]| {
            let path = self.out.join(path);
            output::create_dir(path.parent().unwrap_or(&self.out))?;
            output::write(&path, png)
        };
        let save: Option<Save<'_>> = self.save_images.then_some(&save);
        // Before the folder is made: mistakes in the inputs leave nothing behind.
        let evaluator = Evaluator::new(&settings, scene, &list, save)?;
        output::create_dir(&self.out)?;
        let bar = progress::count("comparing");
        let evaluation = evaluator.run(&mut progress::show(&bar))?;
        bar.finish_and_clear();
        self.write(&evaluation)
    }

    fn settings(&self, images: &Path, every: u32) -> anyhow::Result<Settings> {
        let (boxes, lidar) = match &self.log {
            Some(log) => log_labels(&Log::open(log)?)?,
            None => (self.labels.boxes.clone(), self.labels.lidar.clone()),
        };
        Ok(Settings {
            scene: self.scene.clone(),
            images: images.display().to_string(),
            every: every as usize,
            align_exposure: self.align_exposure,
            show: self.show,
            offsets_m: self.extrapolate.clone().map(|offsets| offsets.0).unwrap_or_default(),
            boxes,
            lidar,
            lidar_window_s: self.labels.lidar_window,
            lpips: self.networks.lpips.clone(),
            features: self.networks.features.clone(),
            repair: self.repairer.repair.clone(),
            networks: self.repairer.load_options(),
        })
    }

    /// The transform from the axes of the poses to those of the scene.
    fn alignment(&self, source: &OpenScene, list: &ImageList) -> anyhow::Result<Alignment> {
        match (&self.axes, source) {
            (Some(axes), _) => placement::imported(axes, self.scale.unwrap_or(1.0)),
            (None, OpenScene::Twin(resident)) if !list.is_in_scene_axes => {
                placement::from_version(&self.twins.catalog()?, &resident.version)
            }
            (None, _) => Ok(Alignment::IDENTITY),
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
        let mut out = output::stdout();
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
