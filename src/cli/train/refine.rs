//! `wildcity train refine`.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use wildcity_eval::images::ImageList;
use wildcity_render::gradient::Differentiate;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, Manifest};
use wildcity_train::held_out::{held_out_db, held_out_images};
use wildcity_train::page::Contents;
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::Settings;
use wildcity_train::trainer::{Fixed, Start, Trainer};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

use super::images::{ListedImages, WithAugmented};
use super::options::{fraction, keep_trained, read_settings};
use super::progress::{PICTURES, evaluate_every, train};
use super::recorded::{RecordedImages, Recording};
use crate::cli::backend_options::HardwareOptions;
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::{output, progress};

/// Train a twin further, on the images of its recording and on views off its drives.
///
/// `wildcity train augment` renders views off the drives, repairs them with a model and writes them
/// with masks and weights. This command trains the Gaussians of the twin on them, beside the
/// recorded images, and makes a new version of the twin, which is accurate farther off its drives.
/// `wildcity train loop` does this round by round. Poses, sky and the number of Gaussians stay as
/// they are.
///
/// Three steps of ten are made on the views of --augmented. The loss of each view has the weight
/// that its list says. Prints the PSNR of the recorded images that were held out, and of one view
/// of eight off the drives, which is not trained on, before and after: how near the twin comes to
/// what the model has made of it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Refine {
    #[command(flatten)]
    edited: EditedTwin,

    #[command(flatten)]
    recorded: RecordedImages,

    /// Views off the drives: a folder DIR/round_N of `wildcity train augment`. May be given again.
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

    /// Write a page about the run: held-out images beside what the twin shows, and curves.
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,

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
  wildcity train augment street --repair model.json --round 1 --out augmented
  wildcity train refine street --images capture --augmented augmented/round_1";

/// One view of so many off the drives judges a run.
const JUDGES: u8 = 8;

/// Views that judge a run, by their distance from the drives in centimetres.
type Judges = BTreeMap<u32, ListedImages>;

/// The distance from the drive that the name of a view of `wildcity train augment` says, in
/// centimetres: 150 of `front/log_00012.00_left1.50.png`.
fn offset_cm(name: &str) -> Option<u32> {
    let (_, offset) = name.strip_suffix(".png")?.rsplit_once('_')?;
    let offset = offset.strip_prefix("left").or_else(|| offset.strip_prefix("right"))?;
    let offset_m: f64 = offset.parse().ok()?;
    Some((100.0 * offset_m).round() as u32)
}

/// Whether a round says that no model has repaired its views. Views of other programs say nothing.
fn is_unrepaired(dir: &Path) -> bool {
    let text = fs::read(dir.join("augment.json")).unwrap_or_default();
    let json: serde_json::Value = serde_json::from_slice(&text).unwrap_or_default();
    json.pointer("/made_with/repair").is_some_and(serde_json::Value::is_null)
}

/// How well the twin shows them.
fn judged(
    judges: &Judges,
    trainer: &Trainer,
    backend: &dyn Differentiate,
) -> anyhow::Result<Vec<(u32, Option<f64>)>> {
    let judge = |(offset, images): (&u32, &ListedImages)| {
        Ok((*offset, held_out_db(trainer, images, backend)?))
    };
    judges.iter().map(judge).collect()
}

impl Refine {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let settings = self.training_settings()?;
        if let Some(page) = &self.page {
            output::check_folder("--page", page)?;
        }
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let read = |dir: &PathBuf| {
            let list = ImageList::read(dir, None, None);
            list.with_context(|| format!("--augmented {}", dir.display()))
        };
        let rounds: Vec<ImageList> = self.augmented.iter().map(read).collect::<Result<_, _>>()?;
        let mut augmented = ListedImages::new(self.size, 0);
        let mut judges = Judges::new();
        for image in rounds.iter().flat_map(|round| round.every(1)) {
            // By its name, so that both sides and all cameras have their share.
            let is_judge = blake3::hash(image.name.as_bytes()).as_bytes()[0].is_multiple_of(JUDGES);
            // Centimetres as an integer can be a key; a number of metres cannot.
            let offset = offset_cm(&image.name).filter(|_| is_judge);
            let images = match offset {
                Some(offset) => {
                    judges.entry(offset).or_insert_with(|| ListedImages::new(self.size, 1))
                }
                None => &mut augmented,
            };
            // `augment` writes poses in the twin's axes.
            images.add_one(image, &Alignment::IDENTITY)?;
        }
        let Recording { images: recorded, mut world_from_camera, .. } =
            self.recorded.open(&catalog, &base, self.size, self.held_out_every)?;
        world_from_camera.extend(augmented.poses());
        let images = WithAugmented { recorded: recorded.images(), augmented: &augmented };
        self.refine(&catalog, &base, &images, &judges, world_from_camera, settings)
    }

    /// Trains the twin on the images, and makes a new version of it.
    fn refine(
        &self,
        catalog: &Catalog,
        base: &Version,
        images: &dyn TrainingImages,
        judges: &Judges,
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
        let before_off = judged(judges, &trainer, backend)?;
        let every = evaluate_every(&trainer);
        let after = train(&mut trainer, images, backend, every, &mut |_, _| Ok(()))?;
        let steps = trainer.settings().steps;
        let done = trainer.steps_done();
        ensure!(done == steps, "stopped after {done} of {steps} steps: the twin is as it was");

        let after_off = judged(judges, &trainer, backend)?;

        let bar = progress::count("writing");
        let how = format!("refine={}", self.description());
        let gaussians = trainer.model().to_gaussians();
        let version =
            catalog.replace_gaussians(base, &gaussians, how, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let Version { number, hash, .. } = &version;
        let mut stdout = output::stdout();
        if let Some((before, (after, seconds))) = before.zip(after) {
            writeln!(
                stdout,
                "held out: {before:.2} dB, and {after:.2} dB after {steps} steps, {seconds:.0} s"
            )?;
        }
        // A twin that has changed can only be less like its own views.
        let are_own = self.augmented.iter().all(|dir| is_unrepaired(dir));
        let note = if are_own { " (its own views: no model has repaired them)" } else { "" };
        for ((offset, before), (_, after)) in before_off.into_iter().zip(after_off) {
            if let Some((before, after)) = before.zip(after) {
                let views = output::counted(judges[&offset].count(), "view");
                writeln!(
                    stdout,
                    "{:.2} m off the drives, {views} not trained on: {before:.2} dB, and {after:.2} dB{note}",
                    f64::from(offset) / 100.0
                )?;
            }
        }
        writeln!(
            stdout,
            "twin {name} version {number}: {} Gaussians\nblake3 {hash}",
            gaussians.len()
        )?;
        match &self.page {
            Some(page) => self.write_page(page, &trainer, images, backend),
            None => Ok(()),
        }
    }

    fn write_page(
        &self,
        page: &Path,
        trainer: &Trainer,
        images: &dyn TrainingImages,
        backend: &dyn Differentiate,
    ) -> anyhow::Result<()> {
        let held_out = held_out_images(trainer, images, backend, PICTURES)?;
        let source = format!("{}, {}", self.edited.twin.name, self.description());
        let all_held_out = images.held_out().len();
        let contents = Contents {
            source: &source,
            trainer,
            images: [images.count() - all_held_out, all_held_out],
            held_out: &held_out,
            cameras: &[],
        };
        output::write(page, wildcity_train::page::page(&contents)?.as_bytes())
    }

    /// What the provenance of the version says.
    fn description(&self) -> String {
        let rounds = self.augmented.iter().filter_map(|dir| dir.file_name());
        let rounds: Vec<String> = rounds.map(|name| name.display().to_string()).collect();
        format!("{} steps, {}", self.steps, rounds.join(", "))
    }

    fn training_settings(&self) -> anyhow::Result<Settings> {
        let mut settings = Settings::default();
        // The scene is trained already: positions need only small steps.
        settings.rates.mean *= 0.1;
        if let Some(path) = &self.settings {
            settings = read_settings(path)?;
        }
        settings.steps = self.steps as usize;
        keep_trained(&mut settings);
        // No growth and no noise: the number of Gaussians stays, and what is learned already is
        // kept.
        settings.growth.from = 0;
        settings.growth.until = 0;
        settings.growth.noise = 0.0;
        settings.check()?;
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_views_say_how_far_they_are() {
        assert_eq!(offset_cm("front/log_00012.00_left1.50.png"), Some(150));
        assert_eq!(offset_cm("images/rear/a_b_00002.10_right0.30.png"), Some(30));
        for other in ["front/0001.png", "front/log_left1.50.jpg", "front/log_leftx.png"] {
            assert_eq!(offset_cm(other), None, "{other}");
        }
    }
}
