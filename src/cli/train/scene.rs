//! `wildcity train SOURCE`.

use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use glam::DVec3;
use wildcity_eval::images::ImageList;
use wildcity_log::{ColoredPoint, Log};
use wildcity_scene::align::Alignment;
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile, Rig, Trajectory};
use wildcity_train::ground::is_ground;
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::{PoseMode, Settings, SkyMode};
use wildcity_train::start::{Point, gaussians_from_points};
use wildcity_train::trainer::{Start, Trainer};
use wildcity_twin::ingest::{self, ReadLimits, ReadScene, capture};

use super::checkpoints::{self, Checkpoints};
use super::images::ListedImages;
use super::lines::LinesFile;
use super::log_images::LogImages;
use super::progress::train;
use super::result::Written;
use crate::cli;
use crate::cli::backend_options::HardwareOptions;
use crate::cli::{file_notes, output, progress};

/// What `wildcity train SOURCE` takes.
#[derive(Debug, clap::Args)]
pub(super) struct TrainScene {
    /// The images and their cameras: a log (docs/logs.md), a COLMAP model (its folder, or one with
    /// sparse/0), a transforms.json, or its folder. Of a log, the poses of the rig, the sky and the
    /// ground are trained, too; points and depths are those of its LiDAR, and what moves is left
    /// out.
    #[arg(value_name = "SOURCE", required = true)]
    source: Option<PathBuf>,

    /// PLY file to write, which `wildcity import` and other viewers and trainers read.
    #[arg(long, value_name = "FILE", required = true)]
    out: Option<PathBuf>,

    /// Make a twin of the result: the name of a new twin, or of one that gets a new version.
    #[arg(long, value_name = "NAME")]
    twin: Option<String>,

    /// Axes of the poses, for --twin, in the form of `wildcity import --axes` [default: those of
    /// the twin's latest version, or identity]
    #[arg(long, value_name = "AXES", allow_hyphen_values = true, requires = "twin")]
    axes: Option<String>,

    /// Directory of the twins, for --twin, as for `wildcity import`.
    #[arg(long, value_name = "DIR_OR_URL", requires = "twin")]
    twins: Option<OsString>,

    /// Folder of the images [default: images beside a COLMAP model; the folder of a
    /// transforms.json]
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks, named as the images: pixels darker than half do not count.
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// Points to begin with: a PLY file, or a COLMAP model [default: those of SOURCE; of a log,
    /// those of its LiDAR]
    #[arg(long, value_name = "POINTS")]
    points: Option<PathBuf>,

    /// Gaussians to begin with instead: a scene that was trained here or by another program, in any
    /// format that `wildcity import` reads, in the axes and the unit of SOURCE.
    #[arg(long, value_name = "SCENE", conflicts_with = "points")]
    start: Option<PathBuf>,

    /// Steps, each on one image. Learning rates and growth are scaled to this number.
    /// [default: that of --settings, or 7000]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: Option<u32>,

    /// Most Gaussians at any time; of more points some are chosen [default: that of --settings, or
    /// 1000000]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    cap: Option<u32>,

    /// Train on images of this fraction of their width, from 0.05 to 1: a quarter of the pixels at
    /// 0.5 take a quarter of the time.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    size: f64,

    /// Hold out one image of N, in the order of their names: the scene is not trained on it but
    /// judged by it. 0 holds out none. Of a log that marks images as held out, it holds out these.
    #[arg(long, value_name = "N", default_value_t = 8)]
    held_out_every: usize,

    /// What lies behind all Gaussians: a sky network that is trained, or nothing. The sky is
    /// written beside the file of --out [default: that of --settings; else network for a log, and
    /// off for photographs]
    #[arg(long, value_name = "network|off", value_parser = sky_mode)]
    sky: Option<SkyMode>,

    /// Seed of all random numbers and of the order of images: the same seed and images give the
    /// same file [default: that of --settings, or 0]
    #[arg(long)]
    seed: Option<u64>,

    /// Go on with a run that was stopped. Its state is kept beside the file of --out each 500 steps
    /// and when it is stopped, and the result has the bytes of a run that was not.
    #[arg(long)]
    resume: bool,

    /// TOML file of all settings; --steps, --cap, --seed and --sky change it. `wildcity train
    /// settings` prints the defaults.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    /// Write a line of JSON for each step.
    #[arg(long, value_name = "FILE")]
    lines: Option<PathBuf>,

    #[command(flatten)]
    hardware: HardwareOptions,
}

pub(super) fn fraction(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(fraction) if (0.05..=1.0).contains(&fraction) => Ok(fraction),
        _ => Err("expected a fraction from 0.05 to 1, for example 0.5".to_owned()),
    }
}

fn sky_mode(text: &str) -> Result<SkyMode, String> {
    match text {
        "network" => Ok(SkyMode::Network),
        "off" => Ok(SkyMode::Off),
        _ => Err("expected network or off".to_owned()),
    }
}

impl TrainScene {
    pub(super) fn run(self) -> anyhow::Result<()> {
        // clap requires both.
        let source = self.source.as_deref();
        let source = source.context("give SOURCE: a COLMAP model or a transforms.json")?;
        let out = self.out.as_deref().context("give --out FILE.ply")?;
        check_out(out)?;
        let settings = self.settings()?;
        if Log::is_log(source) {
            return self.train_log(source, out, settings);
        }
        let list = ImageList::read(source, self.image_dir.as_deref(), self.masks.as_deref())?;
        for warning in &list.warnings {
            writeln!(io::stderr(), "warning: {warning}")?;
        }
        let (mut start, profile) = self.start(source, &settings)?;
        let mut images = ListedImages::new(self.size, self.held_out_every);
        images.add(&list, &Alignment::IDENTITY)?;
        start.world_from_camera = images.poses();
        let inputs = images.inputs();
        let trainer =
            self.train(out, Inputs { images: &images, inputs, start, profile, settings })?;
        self.write(out, source, &trainer, None)
    }

    /// Trains on a log: with the poses of its rig, and the points and depths of its LiDAR.
    fn train_log(&self, source: &Path, out: &Path, settings: Settings) -> anyhow::Result<()> {
        ensure!(
            self.image_dir.is_none() && self.masks.is_none(),
            "{} is a log, whose tables name the files: leave --image-dir and --masks out",
            source.display()
        );
        let images = LogImages::new(Log::open(source)?, self.size, self.held_out_every)?;
        if images.left_out > 0 {
            let left_out = output::counted(images.left_out, "image");
            writeln!(io::stderr(), "{left_out} left out: there is no pose at the time")?;
        }
        let (mut start, profile) = match (&self.start, &self.points) {
            (None, None) => (logged_start(&images, &settings)?, RenderProfile::default()),
            _ => self.start(source, &settings)?,
        };
        start.world_from_camera = images.world_from_camera();
        start.rig = Some(images.rig.clone());
        let means_m: Vec<DVec3> =
            start.gaussians.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
        start.is_ground = is_ground(&means_m, &images.rig.world_from_ego);
        let inputs = images.inputs();
        let trainer =
            self.train(out, Inputs { images: &images, inputs, start, profile, settings })?;
        let is_of_rig = trainer.settings().poses.mode != PoseMode::Image;
        let refined = trainer.poses().filter(|_| is_of_rig).map(|poses| images.refined(poses));
        self.write(out, source, &trainer, refined.as_ref())
    }

    /// Takes the run to its end.
    fn train(&self, out: &Path, inputs: Inputs<'_>) -> anyhow::Result<Trainer> {
        let Inputs { images, inputs, start, profile, settings } = inputs;
        let backend = &*self.hardware.training()?;
        writeln!(
            io::stderr(),
            "{}, {} of them held out, {}, backend {}",
            output::counted(images.count(), "image"),
            images.held_out().len(),
            output::counted(start.gaussians.len(), "Gaussian"),
            backend.name()
        )?;
        let gaussians = inputs_of_gaussians(&start.gaussians);
        let inputs = format!("{} {profile:?}\n{inputs}{gaussians}", backend.name());
        let checkpoints = Checkpoints::new(out, inputs);
        let mut trainer = match checkpoints.read(self.resume, profile, &settings)? {
            Some(trainer) => trainer,
            None => Trainer::new(start, profile, settings)?,
        };
        let done = trainer.steps_done();
        let open = |path: &PathBuf| LinesFile::open(path, done);
        let mut lines = self.lines.as_ref().map(open).transpose()?;
        let last = train(&mut trainer, images, backend, &mut |line, trainer| {
            lines.as_mut().map_or(Ok(()), |lines| lines.write(line))?;
            let is_time = line.step.is_multiple_of(checkpoints::EVERY);
            if is_time { checkpoints.write(trainer) } else { Ok(()) }
        })?;
        let steps = trainer.settings().steps;
        if trainer.steps_done() < steps {
            checkpoints.write(&trainer)?;
            anyhow::bail!(
                "stopped after {} of {steps} steps: the same command with --resume goes on",
                trainer.steps_done()
            );
        }
        if let Some((db, seconds)) = last {
            let mut stdout = io::stdout().lock();
            writeln!(stdout, "held out: {db:.2} dB after {steps} steps, {seconds:.0} s")?;
        }
        Ok(trainer)
    }

    /// Writes the result of a run, and makes the twin.
    fn write(
        &self,
        out: &Path,
        source: &Path,
        trainer: &Trainer,
        refined: Option<&(Trajectory, Rig)>,
    ) -> anyhow::Result<()> {
        let written = Written::new(trainer, out, refined)?;
        checkpoints::remove(out)?;
        let options = self.import_options(source, &written);
        written.print(source, trainer.model().len())?;
        match &self.twin {
            Some(twin) => cli::run_command(
                &["import".as_ref(), out.as_os_str(), "--twin".as_ref(), twin.as_ref()],
                options,
            ),
            None => Ok(written.print_import(&options)?),
        }
    }

    /// The options of the import that makes a twin of the result.
    fn import_options(&self, source: &Path, written: &Written) -> cli::Options {
        let Written { sky, drive, rig, .. } = written.clone();
        let log: Option<OsString> = Log::is_log(source).then(|| source.into());
        let axes = self.axes.clone().map(OsString::from);
        vec![
            // The world of a log has z up.
            ("--axes", axes.or_else(|| log.is_some().then(|| "identity".into()))),
            ("--twins", self.twins.clone()),
            ("--sky", sky.map(OsString::from)),
            ("--trajectory", drive.map(OsString::from)),
            ("--rig", rig.map(OsString::from)),
            ("--log", log),
        ]
    }

    fn settings(&self) -> anyhow::Result<Settings> {
        let mut settings = match &self.settings {
            None => Settings::default(),
            Some(path) => read_settings(path)?,
        };
        settings.steps = self.steps.map_or(settings.steps, |steps| steps as usize);
        settings.growth.cap = self.cap.map_or(settings.growth.cap, |cap| cap as usize);
        settings.seed = self.seed.unwrap_or(settings.seed);
        settings.sky.mode = self.sky.unwrap_or(settings.sky.mode);
        settings.check()?;
        Ok(settings)
    }

    /// The Gaussians that the run begins with, and its image formation.
    fn start(&self, source: &Path, settings: &Settings) -> anyhow::Result<(Start, RenderProfile)> {
        let profile = RenderProfile::default();
        let cap = settings.growth.cap;
        if let Some(start) = &self.start {
            let cannot = || format!("--start {}", start.display());
            let bar = progress::bytes("reading");
            let limits = ReadLimits::for_own_file();
            let read = ingest::read_limited(start, &limits, &mut progress::show(&bar));
            let ReadScene { gaussians, notes, .. } = read.with_context(cannot)?;
            bar.finish_and_clear();
            file_notes::print(start, &notes)?;
            let count = gaussians.len();
            ensure!(
                count <= cap,
                "{} has {count} Gaussians, more than --cap {cap}",
                start.display()
            );
            let start = Start { gaussians, ..Start::default() };
            return Ok((start, notes.profile().apply(profile)?));
        }
        let mut points = self.points(source)?;
        let all = points.len();
        if all > cap {
            choose(&mut points, cap, settings.seed);
            writeln!(io::stderr(), "{cap} of {all} points are chosen: --cap")?;
        }
        let gaussians = gaussians_from_points(&points);
        Ok((Start { gaussians, ..Start::default() }, profile))
    }

    fn points(&self, source: &Path) -> anyhow::Result<Vec<Point>> {
        let source = match &self.points {
            Some(points) => points.clone(),
            None => listed_points(source)?,
        };
        ensure!(source.exists(), "there are no points at {}", source.display());
        let read = capture::read_points(&source)?;
        let read = read.filter(|points| !points.is_empty()).with_context(|| {
            format!(
                "{} has no points to begin with: give --points, a PLY file or a COLMAP model with \
                 points3D.bin or points3D.txt",
                source.display()
            )
        })?;
        let point = |point: capture::CapturePoint| Point {
            at_m: DVec3::from_array(point.at),
            rgb: point.rgb8.map(|value| f64::from(value) / 255.0),
        };
        Ok(read.into_iter().map(point).collect())
    }
}

/// What a run needs.
struct Inputs<'a> {
    images: &'a dyn TrainingImages,
    /// A text by which a checkpoint knows the images.
    inputs: String,
    start: Start,
    profile: RenderProfile,
    settings: Settings,
}

/// Images of each camera of a log whose points of the LiDAR a run begins with.
const STARTING_IMAGES: usize = 100;

/// Most points of a LiDAR that a run begins with: more are added where images need them.
const MOST_LIDAR_POINTS: usize = 500_000;

/// Points of the LiDAR of a log in the colours of its images.
fn logged_start(images: &LogImages, settings: &Settings) -> anyhow::Result<Start> {
    let most = settings.growth.cap.min(MOST_LIDAR_POINTS);
    let points = wildcity_log::colored_points(images.log(), images.poses(), STARTING_IMAGES, most)?;
    ensure!(
        !points.is_empty(),
        "the log has no points of a LiDAR that its images show: give --points, a PLY file"
    );
    let point = |point: &ColoredPoint| Point {
        at_m: point.at_m,
        rgb: point.rgb8.map(|value| f64::from(value) / 255.0),
    };
    let points: Vec<Point> = points.iter().map(point).collect();
    Ok(Start { gaussians: gaussians_from_points(&points), ..Start::default() })
}

/// Reads the file of `--settings`.
pub(super) fn read_settings(path: &Path) -> anyhow::Result<Settings> {
    let cannot = || format!("--settings {}", path.display());
    let text = fs::read_to_string(path).with_context(cannot)?;
    toml::from_str(&text).with_context(cannot)
}

/// A text by which a checkpoint knows its Gaussians.
fn inputs_of_gaussians(gaussians: &Gaussians) -> String {
    let Gaussians { sh_degree, means_m, ln_scales, logit_opacities, sh, .. } = gaussians;
    let means_m = means_m.iter().map(|mean_m| DVec3::from_array(*mean_m)).sum::<DVec3>();
    let sum = |values: &[f32]| values.iter().map(|&value| f64::from(value)).sum::<f64>();
    let sums = [ln_scales.as_flattened(), logit_opacities, sh].map(sum);
    format!("{} Gaussians of degree {sh_degree}, {means_m:?} {sums:?}\n", gaussians.len())
}

/// Keeps as many points as `count`, at random.
fn choose(points: &mut Vec<Point>, count: usize, seed: u64) {
    let mut random = Random::new(seed, "points", 0);
    for k in (1..points.len()).rev() {
        points.swap(k, random.below(k + 1));
    }
    points.truncate(count);
}

/// Checks, before a long run, that its file can be written.
fn check_out(out: &Path) -> anyhow::Result<()> {
    let out_name = out.display();
    let is_ply = out.extension().is_some_and(|extension| extension == "ply");
    ensure!(is_ply, "--out {out_name}: the file is a PLY: give it a name that ends with .ply");
    let is_free = !out.exists() || out.is_file();
    ensure!(is_free, "--out {out_name} is a folder or a device: give the name of a file");
    // The folder of a bare name is the current one.
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty());
    let is_there = folder.is_none_or(Path::is_dir);
    ensure!(is_there, "--out {out_name}: there is no such folder: create it");
    Ok(())
}

/// Where the points of a list are: in the PLY file that a transforms.json names, or in its folder,
/// which may be or have a COLMAP model.
fn listed_points(source: &Path) -> anyhow::Result<PathBuf> {
    let mut folder = source;
    let mut list = source.join("transforms.json");
    if source.extension().is_some_and(|extension| extension == "json") {
        folder = source.parent().unwrap_or(source);
        list = source.to_owned();
    }
    if list.is_file() {
        let cannot = || format!("cannot read {}", list.display());
        let text = fs::read(&list).with_context(cannot)?;
        let json: serde_json::Value = serde_json::from_slice(&text).with_context(cannot)?;
        if let Some(name) = json.get("ply_file_path").and_then(serde_json::Value::as_str) {
            return Ok(folder.join(name));
        }
    }
    // The folder of a bare name is the current one.
    Ok(if folder.as_os_str().is_empty() { PathBuf::from(".") } else { folder.to_owned() })
}
