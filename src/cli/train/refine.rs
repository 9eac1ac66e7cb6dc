//! `wildcity train refine`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};
use wildcity_eval::images::ImageList;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, Manifest};
use wildcity_train::held_out::held_out_db;
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::{PoseMode, Settings, SkyMode};
use wildcity_train::trainer::{Fixed, Start, Trainer};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

use super::images::{ListedImages, WithAugmented};
use super::options::{fraction, read_settings};
use super::progress::train;
use super::recorded::{RecordedImages, Recording};
use crate::cli::backend_options::HardwareOptions;
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::{output, progress};

/// Train a twin further, on the images of its recording and on views off its drives.
///
/// `wildcity augment` renders views off the drives, repairs them with a model and writes them with
/// masks and weights. This command trains the Gaussians of the twin on them, beside the recorded
/// images, and makes a new version of the twin, which is accurate farther off its drives.
/// `wildcity train loop` does this round by round. Poses, sky and the number of Gaussians stay as
/// they are.
///
/// Three steps of ten are made on the views of --augmented. The loss of each view has the weight
/// that its list says. Prints the PSNR of the recorded images that were held out, before and after.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Refine {
    #[command(flatten)]
    edited: EditedTwin,

    #[command(flatten)]
    recorded: RecordedImages,

    /// Views off the drives: a folder DIR/round_N of `wildcity augment`. May be given again.
    #[arg(long, value_name = "DIR")]
    augmented: Vec<PathBuf>,

    /// Steps, each on one image.
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: u32,

    /// Train on images of this fraction of their width, from 0.05 to 1.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    size: f64,

    /// Hold out one recorded image of N. 0 holds out none.
    #[arg(long, value_name = "N", default_value_t = 8)]
    held_out_every: usize,

    /// TOML file of all settings, of which growth, poses, sky and exposure stay off [default: those
    /// of `wildcity train settings`, with a tenth of the learning rate of means]
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity augment street --repair model.json --round 1 --out augmented
  wildcity train refine street --images capture --augmented augmented/round_1";

impl Refine {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let settings = self.training_settings()?;
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let read = |dir: &PathBuf| {
            let list = ImageList::read(dir, None, None);
            list.with_context(|| format!("--augmented {}", dir.display()))
        };
        let rounds: Vec<ImageList> = self.augmented.iter().map(read).collect::<Result<_, _>>()?;
        let mut augmented = ListedImages::new(self.size, 0);
        for round in &rounds {
            // `augment` writes poses in the twin's axes.
            augmented.add(round, &Alignment::IDENTITY)?;
        }
        let Recording { images: recorded, mut world_from_camera, .. } =
            self.recorded.open(&catalog, &base, self.size, self.held_out_every)?;
        world_from_camera.extend(augmented.poses());
        let images = WithAugmented { recorded: &*recorded, augmented: &augmented };
        self.refine(&catalog, &base, &images, world_from_camera, settings)
    }

    /// Trains the twin on the images, and makes a new version of it.
    fn refine(
        &self,
        catalog: &Catalog,
        base: &Version,
        images: &dyn TrainingImages,
        world_from_camera: Vec<Pose>,
        settings: Settings,
    ) -> anyhow::Result<()> {
        let backend = &*self.hardware.training()?;

        let Manifest { sh_degree, profile, .. } = base.manifest;
        let mut gaussians = Gaussians { sh_degree, ..Gaussians::default() };
        catalog.visit_full_detail(base, &|_| true, &mut |section| gaussians.append(&section))?;
        let name = &self.edited.twin.name;
        ensure!(!gaussians.is_empty(), "twin {name} has no Gaussians");
        writeln!(
            io::stderr(),
            "twin {name} version {}: {}; {}, {} of them held out; backend {}",
            base.number,
            output::counted(gaussians.len(), "Gaussian"),
            output::counted(images.count(), "image"),
            images.held_out().len(),
            backend.name()
        )?;
        let resident = Cache::new(self.twins.catalog()?).open(name, Some(base.number))?;
        let start = Start {
            gaussians,
            world_from_camera,
            fixed: Fixed { sky: resident.sky().cloned(), ..Fixed::default() },
            ..Start::default()
        };
        let mut trainer = Trainer::new(start, profile, settings)?;
        let before = held_out_db(&trainer, images, backend)?;
        let after = train(&mut trainer, images, backend, &mut |_, _| Ok(()))?;
        let steps = trainer.settings().steps;
        let done = trainer.steps_done();
        ensure!(done == steps, "stopped after {done} of {steps} steps: the twin is as it was");

        let bar = progress::count("writing");
        let how = format!("refine={}", self.description());
        let gaussians = trainer.model().to_gaussians();
        let version =
            catalog.replace_gaussians(base, &gaussians, how, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let Version { number, hash, .. } = &version;
        let mut stdout = io::stdout().lock();
        if let Some((before, (after, seconds))) = before.zip(after) {
            writeln!(
                stdout,
                "held out: {before:.2} dB, and {after:.2} dB after {steps} steps, {seconds:.0} s"
            )?;
        }
        writeln!(
            stdout,
            "twin {name} version {number}: {} Gaussians\nblake3 {hash}",
            gaussians.len()
        )?;
        Ok(())
    }

    /// What the provenance of the version says.
    fn description(&self) -> String {
        let rounds = self.augmented.iter().filter_map(|dir| dir.file_name());
        let rounds: Vec<String> = rounds.map(|name| name.display().to_string()).collect();
        format!("{} steps, {}", self.steps, rounds.join(", "))
    }

    fn training_settings(&self) -> anyhow::Result<Settings> {
        let mut settings = Settings::default();
        settings.rates.mean *= 0.1;
        if let Some(path) = &self.settings {
            settings = read_settings(path)?;
        }
        settings.steps = self.steps as usize;
        settings.poses.mode = PoseMode::Off;
        settings.sky.mode = SkyMode::Off;
        settings.exposure.on = false;
        settings.growth.from = 0;
        settings.growth.until = 0;
        settings.growth.noise = 0.0;
        settings.check()?;
        Ok(settings)
    }
}
