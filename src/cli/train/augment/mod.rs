//! `wildcity train augment`.

mod options;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;

use wildcity_augment::{Augmentation, ColmapForm, PLACE_TIMEOUT, Round, Sample, Settings, limits};
use wildcity_repair::Models;
use wildcity_server::{Config, Directories};
use wildcity_twin::store::{Catalog, Version};

use self::options::{ModelOptions, metres};
use crate::cli::backend_options::BackendOptions;
use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::{output, placement, progress};

/// Render views of a twin off its recorded drives, repair them, and write them as training data.
///
/// A twin is accurate on its drives and less accurate off them. This command renders the twin off
/// its drives, repairs the images with a model, and writes them with masks, depth and poses, so
/// that a trainer can learn from them as from recorded images, but with less weight. A twin that is
/// trained on these images is accurate at larger distances from the drives.
///
/// A model can correct small errors; where the image is far off, it hallucinates. So the views move
/// away from the drives in rounds: round N renders at min(0.5 m x N, OFFSET) for each OFFSET of
/// --offsets, to the left and to the right of the drive, every --every metres, with the heading of
/// the drive and all cameras. Train on a round, push the twin, and render the next round from it.
/// Each round has its own folder, DIR/round_N.
///
/// Images have no overlay, exposure or rolling shutter. Poses are in the twin's axes. To continue
/// an interrupted run, run the same command again. docs/augmentation.md explains how to train with
/// it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Augment {
    /// The twin: NAME, or NAME@NUMBER for an older version.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// Lateral offsets that the rounds lead to, in metres, separated by commas, each to both sides
    /// of the drives.
    #[arg(long, value_name = "M,..", default_value = "1,3,5", value_delimiter = ',', value_parser = metres)]
    offsets: Vec<f64>,

    /// Distance between two views along a drive, in metres: 2 or 2m.
    #[arg(long, value_name = "M", default_value = "2", value_parser = metres)]
    every: f64,

    /// The round N: views are at most 0.5 m x N off the drives.
    #[arg(long, value_name = "N", default_value_t = 1)]
    round: u32,

    /// Cameras of the rig, separated by commas [default: all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    cameras: Vec<String>,

    /// Longest side of an image, in pixels; larger images of the rig are rendered at a reduced size
    /// [default: the rig's]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    side: Option<u32>,

    /// Keep the lenses of the rig. Without this option, each lens is replaced by a pinhole with its
    /// field of view, up to 100°. transforms.json and COLMAP can describe pinholes, OpenCV lenses
    /// with k1, k2, p1 and p2, and OpenCV fisheyes; other lenses and windshields are refused.
    #[arg(long)]
    lenses: bool,

    /// Largest number of points of the COLMAP model: opaque Gaussians within 100 m of a view,
    /// chosen at random.
    #[arg(long, value_name = "N", default_value_t = limits::POINTS, value_parser = clap::value_parser!(u32).range(0..=MOST_POINTS))]
    points: u32,

    /// Seed of the choice of the points.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,

    /// Format of the COLMAP model.
    #[arg(long, value_name = "FORM", value_enum, default_value_t)]
    colmap: ColmapName,

    /// Directory of the rounds; created if it is missing.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    #[command(flatten)]
    model: ModelOptions,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    backend: BackendOptions,
}

const EXAMPLES: &str = "\
In DIR/round_N:
  images/          images to train on: repaired, or as rendered without --repair
  rendered/        the same images before the repair
  masks/           255 where the opacity is at least 1/2 and within the lens' field
  depth/           16-bit PNG in millimetres up to 65 m, 0 for none
  transforms.json  cameras, poses and weights, for nerfstudio and `wildcity eval`
  sparse/0         the same as a COLMAP model, with Gaussians as points
  augment.json     the settings of the run, and the hash of each file

Examples:
  wildcity train augment street --repair model.json --offsets 1,3,5 --every 2m --round 1 --out augmented
  wildcity train augment street --offsets 3 --round 6 --side 720 --cameras front,front_left,front_right --out plain
  wildcity eval street --axes identity --images augmented/round_1/transforms.json";

/// [`limits::MOST_POINTS`], as clap takes it.
const MOST_POINTS: i64 = limits::MOST_POINTS as i64;

/// [`ColmapForm`] on the command line.
#[derive(Clone, Copy, Debug, Default, clap::ValueEnum)]
enum ColmapName {
    /// Text: cameras.txt, images.txt, points3D.txt.
    #[default]
    Txt,
    /// Binary: cameras.bin, images.bin, points3D.bin.
    Bin,
}

impl From<ColmapName> for ColmapForm {
    fn from(name: ColmapName) -> Self {
        match name {
            ColmapName::Txt => Self::Text,
            ColmapName::Bin => Self::Binary,
        }
    }
}

impl Augment {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let version = catalog.version(&self.twin.name, self.twin.number)?;
        let models = Arc::new(self.model.models()?);
        let settings = self.settings(&catalog, &version, &models);
        let augmentation = Augmentation::new(&settings, &catalog, version)?;
        output::create_dir(&self.out)?;
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
        // The records of the two sessions, which are not needed afterwards.
        let scratch = tempfile::tempdir().context("cannot create a temporary directory")?;
        let bar = progress::count("drawing");
        let drawn = runtime.block_on(async {
            let running = wildcity_server::start(self.server(scratch.path(), models)?).await?;
            let mut show = |what, done, all| {
                bar.set_message(what);
                bar.set_length(all);
                bar.set_position(done);
            };
            // The server is stopped whether or not drawing failed.
            let drawn = augmentation.run(&running.url(), &mut show).await;
            running.stop().await;
            drawn
        });
        bar.finish_and_clear();
        self.print(&drawn?)
    }

    fn settings(&self, catalog: &Catalog, version: &Version, models: &Models) -> Settings {
        let model = models.names().next().map(|name| (name.to_owned(), self.model.at_least));
        // Some versions do not record the axes of their capture, such as pushed ones.
        let axes = placement::from_version(catalog, version).ok();
        Settings {
            round: self.round,
            offsets_m: self.offsets.clone(),
            every_m: self.every,
            cameras: self.cameras.clone(),
            side_px: self.side,
            lenses: self.lenses,
            points: self.points,
            seed: self.seed,
            colmap: self.colmap.into(),
            model,
            world_from_capture: axes.map(|alignment| alignment.to_string()),
            out: self.out.clone(),
        }
    }

    fn server(&self, scratch: &Path, models: Arc<Models>) -> anyhow::Result<Config> {
        let directories = Directories {
            twins: self.twins.dir()?,
            episodes: scratch.join("episodes"),
            scenarios: scratch.join("scenarios"),
            uploads: scratch.join("uploads"),
        };
        let mut config = Config {
            cache: self.twins.cache(),
            repairs: models,
            ..Config::local(directories, Arc::from(self.backend.backend()?))
        };
        // A step of this server draws and repairs all images of a place, on a machine of any speed.
        config.limits.step = PLACE_TIMEOUT;
        Ok(config)
    }

    fn print(&self, round: &Round) -> anyhow::Result<()> {
        let Round { dir, offsets_m, cameras, samples, kept, damaged } = round;
        if *damaged > 0 {
            writeln!(
                io::stderr(),
                "{damaged} samples were missing or damaged, and were drawn again"
            )?;
        }
        let offsets_m: Vec<String> = offsets_m.iter().map(f64::to_string).collect();
        let trust = samples.iter().map(|sample| sample.trust).sum::<f64>() / samples.len() as f64;
        let is_repaired = |sample: &&Sample| {
            sample.repair.as_ref().is_some_and(|repair| repair.status == "repaired")
        };
        let mut out = output::stdout();
        writeln!(
            out,
            "round {}: {} of {} at {} m beside the drives; {} repaired, {kept} from an earlier run; \
             mean trust {trust:.2}",
            self.round,
            output::counted(samples.len(), "image"),
            output::counted(*cameras, "camera"),
            offsets_m.join(", "),
            samples.iter().filter(is_repaired).count()
        )?;
        for name in ["transforms.json", "sparse/0", "augment.json"] {
            writeln!(out, "{}", dir.join(name).display())?;
        }
        Ok(())
    }
}
