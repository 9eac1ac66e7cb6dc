//! `wildcity train SOURCE`.

use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use wildcity_eval::images::ImageList;
use wildcity_log::Log;
use wildcity_scene::align::Alignment;
use wildcity_scene::{RenderProfile, Rig, Trajectory};
use wildcity_train::held_out::{HeldOut, held_out_images};
use wildcity_train::page::{Contents, page};
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::{PoseMode, Settings, SkyMode};
use wildcity_train::trainer::{Fixed, Start, Trainer};

use super::checkpoints::{self, Checkpoints};
use super::images::ListedImages;
use super::lines::LinesFile;
use super::log_images::LogImages;
use super::progress::train;
use super::result::Written;
use super::start::{self, StartOptions};
use crate::cli;
use crate::cli::backend_options::HardwareOptions;
use crate::cli::output;

/// What `wildcity train SOURCE` takes.
#[derive(Debug, clap::Args)]
pub(super) struct TrainScene {
    /// The images and their cameras: a log (docs/logs.md), a COLMAP model (its folder, or one with
    /// sparse/0), a transforms.json, or its folder. Of a log, the poses of the rig, the sky and the
    /// ground are trained, too; points and depths are those of its LiDAR, and what moves is left
    /// out.
    #[arg(value_name = "SOURCE", required = true)]
    source: Option<PathBuf>,

    /// PLY file to write, which `wildcity import` and other viewers and trainers read. A page about
    /// the run is beside it: FILE.html.
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

    #[command(flatten)]
    start: StartOptions,

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
        let (mut start, profile) = self.start.read(source, &settings)?;
        let mut images = ListedImages::new(self.size, self.held_out_every);
        images.add(&list, &Alignment::IDENTITY)?;
        start.world_from_camera = images.poses();
        let inputs = images.inputs();
        let trained =
            self.train(out, Inputs { images: &images, inputs, start, profile, settings })?;
        self.write(out, source, &trained, &[], None)
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
        let (start, profile) = self.start.read_for_log(source, &images, &settings)?;
        let inputs = images.inputs();
        let trained =
            self.train(out, Inputs { images: &images, inputs, start, profile, settings })?;
        let trainer = &trained.trainer;
        let is_of_rig = trainer.settings().poses.mode != PoseMode::Image;
        let refined = trainer.poses().filter(|_| is_of_rig).map(|poses| images.refined(poses));
        self.write(out, source, &trained, &images.camera_names(), refined.as_ref())
    }

    /// Takes the run to its end.
    fn train(&self, out: &Path, inputs: Inputs<'_>) -> anyhow::Result<Trained> {
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
        let gaussians = start::inputs(&start.gaussians);
        let inputs = format!("{} {profile:?}\n{inputs}{gaussians}", backend.name());
        let checkpoints = Checkpoints::new(out, inputs);
        let mut trainer =
            match checkpoints.read(self.resume, profile, &settings, Fixed::default())? {
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
        let held_out = held_out_images(&trainer, images, backend, PICTURES)?;
        let held_out_count = images.held_out().len();
        let counts = [images.count() - held_out_count, held_out_count];
        Ok(Trained { trainer, held_out, images: counts })
    }

    /// Writes the result of a run, and makes the twin.
    fn write(
        &self,
        out: &Path,
        source: &Path,
        trained: &Trained,
        cameras: &[String],
        refined: Option<&(Trajectory, Rig)>,
    ) -> anyhow::Result<()> {
        let Trained { trainer, held_out, images } = trained;
        let written = Written::new(trainer, out, refined)?;
        let name = source.display().to_string();
        let contents = Contents { source: &name, trainer, images: *images, held_out, cameras };
        output::write(&written.page, page(&contents)?.as_bytes())?;
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

/// Held-out images on the page of a run.
const PICTURES: usize = 6;

/// A run that has reached its end.
struct Trained {
    trainer: Trainer,
    held_out: Vec<HeldOut>,
    /// Images that it has learned from, and those that were held out.
    images: [usize; 2],
}

/// Reads the file of `--settings`.
pub(super) fn read_settings(path: &Path) -> anyhow::Result<Settings> {
    let cannot = || format!("--settings {}", path.display());
    let text = fs::read_to_string(path).with_context(cannot)?;
    toml::from_str(&text).with_context(cannot)
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
