//! The options of a run: on what it trains, and how.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::de::DeserializeOwned;

use wildcity_eval::images::ImageList;
use wildcity_log::Log;
use wildcity_scene::RenderProfile;
use wildcity_scene::align::Alignment;
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::{PoseMode, Settings, SkyMode};
use wildcity_train::trainer::Start;

use super::images::ListedImages;
use super::log_images::LogImages;
use super::start::StartOptions;
use crate::cli::backend_options::HardwareOptions;
use crate::cli::output;

/// On what a run trains, and how.
#[derive(Debug, clap::Args)]
pub(super) struct RunOptions {
    #[command(flatten)]
    pub(super) source: SourceOptions,

    /// Steps, each on one image. Learning rates and growth are scaled to this number.
    /// [default: that of --settings, or 7000]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: Option<u32>,

    /// Most Gaussians at any time; of more points some are chosen [default: that of --settings, or
    /// one for each 32 pixels of the images, at most 1000000]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    cap: Option<u32>,

    /// Train on images of this fraction of their width, from 0.05 to 1: a quarter of the pixels at
    /// 0.5 take a quarter of the time.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    pub(super) size: f64,
}

/// On what runs train, whatever their length and the size of their images.
#[derive(Debug, clap::Args)]
pub(super) struct SourceOptions {
    /// The images and their cameras: a log (docs/logs.md), a COLMAP model (its folder, or one with
    /// sparse/0), a transforms.json, or its folder. Of a log, the poses of the rig, the sky and the
    /// ground are trained, too; points and depths are those of its LiDAR, and what moves is left
    /// out.
    #[arg(value_name = "SOURCE", required = true)]
    source: Option<PathBuf>,

    /// Folder of the images [default: images beside a COLMAP model; the folder of a
    /// transforms.json]
    #[arg(long, value_name = "DIR")]
    image_dir: Option<PathBuf>,

    /// Folder of masks, named as the images: pixels darker than half do not count.
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    #[command(flatten)]
    start: StartOptions,

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

    /// TOML file of all settings; --steps, --cap, --seed and --sky change it. `wildcity train
    /// settings` prints the defaults.
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    #[command(flatten)]
    pub(super) hardware: HardwareOptions,
}

/// What a run needs.
pub(super) struct Inputs {
    pub(super) images: OpenedImages,
    /// A text by which a checkpoint knows the images.
    pub(super) inputs: String,
    pub(super) start: Start,
    pub(super) profile: RenderProfile,
    pub(super) settings: Settings,
}

/// The images of a run.
pub(super) enum OpenedImages {
    Listed(ListedImages),
    Logged(Box<LogImages>),
}

impl OpenedImages {
    pub(super) fn images(&self) -> &dyn TrainingImages {
        match self {
            Self::Listed(images) => images,
            Self::Logged(images) => &**images,
        }
    }

    /// Those of a log.
    pub(super) fn logged(&self) -> Option<&LogImages> {
        match self {
            Self::Listed(_) => None,
            Self::Logged(images) => Some(images),
        }
    }
}

impl RunOptions {
    /// Reads all that the run begins with but the images themselves.
    pub(super) fn open(&self) -> anyhow::Result<Inputs> {
        let mut settings = self.source.settings()?;
        settings.steps = self.steps.map_or(settings.steps, |steps| steps as usize);
        self.source.open(settings, self.size, self.cap.map(|cap| cap as usize))
    }

    /// What says how many steps the run makes, if it is not --steps: for the line of `train plan`.
    pub(super) fn steps_origin(&self) -> &'static str {
        match (self.steps, &self.source.settings) {
            (Some(_), _) => "",
            (None, Some(_)) => " (--settings; --steps changes it)",
            (None, None) => " (the default; --steps changes it)",
        }
    }
}

impl SourceOptions {
    /// The log or list of images.
    pub(super) fn path(&self) -> anyhow::Result<&Path> {
        // clap requires it.
        self.source.as_deref().context("give SOURCE: a log, a COLMAP model or a transforms.json")
    }

    /// Reads all that a run on images of a fraction of their width begins with.
    ///
    /// # Errors
    /// A setting is out of its range, or a file cannot be read.
    pub(super) fn open(
        &self,
        mut settings: Settings,
        size: f64,
        cap: Option<usize>,
    ) -> anyhow::Result<Inputs> {
        settings.growth.cap = cap.unwrap_or(settings.growth.cap);
        settings.check()?;
        let source = self.path()?;
        ensure!(
            source.exists(),
            "there is no {}: give a log, a COLMAP model or a transforms.json",
            source.display()
        );
        if Log::is_log(source) {
            return self.open_log(source, settings, size, cap);
        }
        let list = ImageList::read(source, self.image_dir.as_deref(), self.masks.as_deref())?;
        for warning in &list.warnings {
            writeln!(io::stderr(), "warning: {warning}")?;
        }
        let mut images = ListedImages::new(size, self.held_out_every);
        images.add(&list, &Alignment::IDENTITY)?;
        self.bound_by_pixels(&mut settings, cap, image_pixels(&images, size))?;
        let (mut start, profile) = self.start.read(source, &settings)?;
        start.world_from_camera = images.poses();
        let inputs = images.inputs();
        Ok(Inputs { images: OpenedImages::Listed(images), inputs, start, profile, settings })
    }

    /// A log has poses of a rig, and points and depths of a LiDAR.
    fn open_log(
        &self,
        source: &Path,
        mut settings: Settings,
        size: f64,
        cap: Option<usize>,
    ) -> anyhow::Result<Inputs> {
        ensure!(
            self.image_dir.is_none() && self.masks.is_none(),
            "{} is a log, whose tables name the files: leave --image-dir and --masks out",
            source.display()
        );
        let images = LogImages::new(Log::open(source)?, size, self.held_out_every)?;
        if images.left_out > 0 {
            let left_out = output::counted(images.left_out, "image");
            writeln!(io::stderr(), "{left_out} left out: there is no pose at the time")?;
        }
        self.bound_by_pixels(&mut settings, cap, image_pixels(&images, size))?;
        let (start, profile) = self.start.read_for_log(source, &images, &settings)?;
        let inputs = images.inputs()?;
        let images = OpenedImages::Logged(Box::new(images));
        Ok(Inputs { images, inputs, start, profile, settings })
    }

    /// Bounds the Gaussians by what the images determine, unless an option or a file says how many
    /// there may be, or the run begins with a scene, which is not cut.
    fn bound_by_pixels(
        &self,
        settings: &mut Settings,
        cap: Option<usize>,
        pixels: f64,
    ) -> anyhow::Result<()> {
        if cap.is_none() && !self.start.is_scene() && !self.settings_have_cap()? {
            let determined = (pixels / PIXELS_PER_GAUSSIAN).ceil().max(1.0) as usize;
            // More Gaussians than the images can determine fit noise.
            settings.growth.cap = settings.growth.cap.min(determined);
        }
        Ok(())
    }

    /// Whether the file of `--settings` says how many Gaussians there may be.
    fn settings_have_cap(&self) -> anyhow::Result<bool> {
        let Some(path) = &self.settings else { return Ok(false) };
        // As a table and not as settings, in which an absent field has its default already.
        let table: toml::Table = read_toml(path)?;
        Ok(table.get("growth").is_some_and(|growth| growth.get("cap").is_some()))
    }

    /// The settings of `--settings` with those of the options. They are not checked yet.
    pub(super) fn settings(&self) -> anyhow::Result<Settings> {
        let mut settings = match &self.settings {
            None => Settings::default(),
            Some(path) => read_settings(path)?,
        };
        if self.settings.is_none() && self.start.is_scene() {
            // It has its shape already: small images would blur it.
            settings.coarse.halvings = 0;
        }
        settings.seed = self.seed.unwrap_or(settings.seed);
        settings.sky.mode = self.sky.unwrap_or(settings.sky.mode);
        Ok(settings)
    }
}

/// Pixels of the images for each Gaussian: 96 values, most of which neighbouring images repeat. A
/// Gaussian of degree 1 has 23. Eleven photographs of 0.38 megapixels would have a million
/// otherwise, four pixels for each.
const PIXELS_PER_GAUSSIAN: f64 = 32.0;

/// The pixels of all images, at a fraction of their width.
pub(super) fn image_pixels(images: &dyn TrainingImages, size: f64) -> f64 {
    let whole: usize = (0..images.count()).map(|k| images.view(k).camera.pixels()).sum();
    // Both sides are scaled.
    size * size * whole as f64
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

/// Leaves all but the Gaussians as it is: the poses, the sky and the exposures. The Gaussians have
/// their shape already, so that no step learns from a small image.
pub(super) fn keep_trained(settings: &mut Settings) {
    settings.poses.mode = PoseMode::Off;
    settings.sky.mode = SkyMode::Off;
    settings.exposure.on = false;
    settings.coarse.halvings = 0;
}

/// Reads the file of `--settings`.
pub(super) fn read_settings(path: &Path) -> anyhow::Result<Settings> {
    read_toml(path)
}

fn read_toml<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let cannot = || format!("--settings {}", path.display());
    let text = fs::read_to_string(path).with_context(cannot)?;
    toml::from_str(&text).with_context(cannot)
}
