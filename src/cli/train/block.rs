//! `wildcity train block`.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context, ensure};
use glam::DVec3;
use wildcity_render::gradient::Differentiate;
use wildcity_scene::Scene;
use wildcity_train::blocks::{Blocks, sees};
use wildcity_train::held_out::{held_out_db, scene_db};
use wildcity_train::run::TrainingImages;
use wildcity_train::settings::Settings;
use wildcity_train::trainer::{Fixed, Start, Trainer};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::{Catalog, Version};

use super::block_parts::Parts;
use super::checkpoints::{self, Checkpoints};
use super::images::ChosenImages;
use super::options::{fraction, keep_trained, read_settings};
use super::progress::{evaluate_every, train};
use super::recorded::{RecordedImages, Recording};
use super::start;
use crate::cli::backend_options::HardwareOptions;
use crate::cli::directories::{EditedTwin, Twins};
use crate::cli::{output, progress};

/// Train one block of a twin in detail: a part of its route, on any machine and in any order.
///
/// First make a coarse twin of the whole recording (`wildcity train LOG --out coarse.ply --size
/// 0.25 --twin T`), with its poses and its sky. Then train block 1 of N, 2 of N and so on, here one
/// after the other or on as many machines at the same time: each learns from the images that see
/// its part, with the poses and the sky of the coarse twin and its Gaussians around, and replaces
/// only its own cells of 64 m. Name the version of the coarse twin (T@1), and the result is the
/// same in any order.
///
/// Prints the PSNR of held-out images that see both sides of a border, by the block alone and by
/// the twin: once the blocks beside it are trained, a seam would show as a difference. Gaussians
/// that have moved out of the cells of the block are dropped, and those that have moved in stay.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Block {
    #[command(flatten)]
    edited: EditedTwin,

    #[command(flatten)]
    recorded: RecordedImages,

    /// Which block of how many, for example 2/4.
    #[arg(long, value_name = "I/N")]
    block: BlockOf,

    /// Steps, each on one image [default: that of --settings, or 7000]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: Option<u32>,

    /// Most Gaussians of the block at any time [default: that of --settings, or 1000000]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    cap: Option<u32>,

    /// Train on images of this fraction of their width, from 0.05 to 1.
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0, value_parser = fraction)]
    size: f64,

    /// Hold out one recorded image of N. 0 holds out none.
    #[arg(long, value_name = "N", default_value_t = 8)]
    held_out_every: usize,

    /// Keep the state of the run in this file each 500 steps, and go on from it if it is there: a
    /// scheduler that repeats the command loses nothing. It is removed at the end.
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,

    /// TOML file of all settings, of which poses, sky and exposure stay off [default: those of
    /// `wildcity train settings`]
    #[arg(long, value_name = "FILE")]
    settings: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,

    #[command(flatten)]
    hardware: HardwareOptions,
}

const EXAMPLES: &str = "\
Examples:
  wildcity train log --out coarse.ply --twin street --size 0.25 --cap 500000
  wildcity train block street@1 --images log --block 1/2
  wildcity train block street@1 --images log --block 2/2";

/// A block by its number, counted from 1, and the number of all.
#[derive(Clone, Copy, Debug)]
struct BlockOf {
    number: usize,
    all: usize,
}

impl FromStr for BlockOf {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(number, all)| {
            Some(Self { number: number.parse().ok()?, all: all.parse().ok()? })
        });
        let is_one = |block: &Self| (1..=block.all).contains(&block.number);
        let expected = || format!("{text:?} is no block: give its number and that of all, as 2/4");
        numbers.filter(is_one).ok_or_else(expected)
    }
}

/// What a block is trained on.
#[derive(Clone, Copy)]
struct Trained<'a> {
    base: &'a Version,
    images: &'a ChosenImages<'a>,
    parts: &'a Parts,
    recording: &'a Recording,
}

impl Block {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let name = &self.edited.twin.name;
        ensure!(
            self.edited.twin.number.is_some(),
            "{name}: give the version that all blocks begin from, for example {name}@1: blocks are cut by its Gaussians"
        );
        if let Some(path) = &self.checkpoint {
            output::check_folder("--checkpoint", path)?;
        }
        let catalog = self.twins.catalog()?;
        let base = catalog.version(&self.edited.twin.name, self.edited.twin.number)?;
        let manifest = &base.manifest;
        let settings = self.training_settings(manifest.sh_degree)?;
        let cells: Vec<([i32; 2], u64)> =
            manifest.chunks.iter().map(|chunk| (chunk.cell, chunk.count)).collect();
        let drives = manifest.trajectories.iter().flat_map(|drive| &drive.keyframes);
        let path_m: Vec<DVec3> = drives.map(|key| key.world_from_rig.position_m).collect();
        let BlockOf { number, all } = self.block;
        let blocks = Blocks::new(&cells, &path_m, all).context("--block")?;
        // A run that was stopped after it had published would find its own version here.
        if self.checkpoint.as_ref().is_none_or(|path| !path.exists()) {
            self.check_unchanged(&catalog, &base, blocks.cells(number - 1))?;
        }
        let parts = Parts::read(&catalog, &base, &blocks, number - 1)?;
        ensure!(!parts.moving.is_empty(), "block {number}/{all} has no Gaussians");
        let moving = parts.moving.len();
        let cap = settings.growth.cap;
        ensure!(
            moving <= cap,
            "block {number}/{all} has {moving} Gaussians, more than --cap {cap}: give a larger one, or more blocks"
        );

        let recording = self.recorded.open(&catalog, &base, self.size, self.held_out_every)?;
        let recorded = recording.images.images();
        let sees_one = |points_m: &[DVec3], index: usize| sees(&recorded.view(index), points_m);
        let seeing: Vec<usize> =
            (0..recorded.count()).filter(|&index| sees_one(&parts.own_m, index)).collect();
        // Images that see both sides of a border show whether the blocks fit each other.
        let see_both = seeing.iter().copied().filter(|&index| sees_one(&parts.halo_m, index));
        let across = ChosenImages { all: recorded, chosen: see_both.collect() };
        let images = ChosenImages { all: recorded, chosen: seeing };
        ensure!(
            images.count() > 0,
            "no image sees block {number}/{all}: are the images of this twin?"
        );

        let backend = &*self.hardware.training()?;
        writeln!(
            io::stderr(),
            "block {number}/{all}: {} of 64 m; {} of {} that move and {} around; {}, {} of them held out; backend {}",
            output::counted(blocks.cells(number - 1).len(), "cell"),
            parts.moving.len(),
            output::counted(usize::try_from(manifest.gaussians())?, "Gaussian"),
            parts.around.len(),
            output::counted(images.count(), "image"),
            images.held_out().len(),
            backend.name()
        )?;
        let what = Trained { base: &base, images: &images, parts: &parts, recording: &recording };
        let trainer = self.train(&catalog, &what, settings, backend)?;
        self.publish(&catalog, &base, &blocks, &trainer, &across, backend)?;
        self.checkpoint.as_deref().map_or(Ok(()), checkpoints::remove_file)
    }

    /// Checks, before a long run, that its result can be published: its cells are as they were
    /// in the version that it begins from.
    fn check_unchanged(
        &self,
        catalog: &Catalog,
        base: &Version,
        cells: &BTreeSet<[i32; 2]>,
    ) -> anyhow::Result<()> {
        let latest = catalog.version(&self.edited.twin.name, None)?;
        let objects = |version: &Version| -> BTreeMap<[i32; 2], String> {
            let own = version.manifest.chunks.iter().filter(|chunk| cells.contains(&chunk.cell));
            own.map(|chunk| (chunk.cell, chunk.object.clone())).collect()
        };
        let BlockOf { number, all } = self.block;
        ensure!(
            objects(base) == objects(&latest),
            "block {number}/{all} of twin {} has changed from version {} to {}: it may have been trained already; to \
             train it further, begin from version {2}",
            self.edited.twin.name,
            base.number,
            latest.number
        );
        Ok(())
    }

    /// Takes the run to its end.
    fn train(
        &self,
        catalog: &Catalog,
        what: &Trained<'_>,
        settings: Settings,
        backend: &dyn Differentiate,
    ) -> anyhow::Result<Trainer> {
        let Trained { base, images, parts, recording } = *what;
        let name = &self.edited.twin.name;
        // The sky and the Gaussians around are drawn and not trained: other blocks train those.
        let sky = Cache::new(catalog.clone()).open(name, Some(base.number))?.sky().cloned();
        let fixed = Fixed { sky, chunks: Scene::from_gaussians(&parts.around).chunks };
        let profile = base.manifest.profile;
        let BlockOf { number, all } = self.block;
        let text = format!(
            "{} {} {number}/{all} {profile:?}\n{}{}",
            backend.name(),
            base.hash,
            recording.inputs,
            start::inputs(&parts.moving)
        );
        let checkpoints = self.checkpoint.as_deref().map(|path| Checkpoints::at(path, text));
        let is_there = self.checkpoint.as_ref().is_some_and(|path| path.exists());
        let resumed = match &checkpoints {
            Some(checkpoints) => checkpoints.read(is_there, profile, &settings, fixed.clone())?,
            None => None,
        };
        let mut trainer = match resumed {
            Some(trainer) => trainer,
            None => {
                let means_m: Vec<DVec3> =
                    parts.moving.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
                let logged = recording.images.logged();
                let is_ground = logged.map(|images| images.ground(&means_m)).transpose()?;
                let start = Start {
                    is_ground: is_ground.unwrap_or_default(),
                    gaussians: parts.moving.clone(),
                    world_from_camera: recording.world_from_camera.clone(),
                    rig: logged.map(|images| images.rig.clone()),
                    fixed,
                };
                Trainer::new(start, profile, settings)?
            }
        };
        let resumed_at = trainer.steps_done();
        let before = held_out_db(&trainer, images, backend)?;
        let every = evaluate_every(&trainer);
        let after = train(&mut trainer, images, backend, every, &mut |line, trainer| {
            let is_time = line.step.is_multiple_of(checkpoints::EVERY);
            match &checkpoints {
                Some(checkpoints) if is_time => checkpoints.write(trainer),
                _ => Ok(()),
            }
        })?;
        let done = trainer.steps_done();
        let steps = trainer.settings().steps;
        // A signal has stopped the training: the checkpoint is all that is kept of it.
        if done < steps {
            let mut how = "begin anew";
            if let Some(checkpoints) = &checkpoints {
                checkpoints.write(&trainer)?;
                how = "the same command goes on";
            }
            anyhow::bail!("stopped after {done} of {steps} steps; the twin is as it was: {how}");
        }
        // From here on a repeated command only publishes.
        checkpoints.as_ref().map_or(Ok(()), |checkpoints| checkpoints.write(&trainer))?;
        if let Some((before, (after, seconds))) = before.zip(after) {
            let begun =
                if resumed_at > 0 { format!(" at step {resumed_at}") } else { String::new() };
            writeln!(
                output::stdout(),
                "held out: {before:.2} dB{begun}, and {after:.2} dB after {steps} steps, {seconds:.0} s"
            )?;
        }
        Ok(trainer)
    }

    /// Makes the new version, and compares both sides of its borders.
    fn publish(
        &self,
        catalog: &Catalog,
        base: &Version,
        blocks: &Blocks,
        trainer: &Trainer,
        across: &ChosenImages<'_>,
        backend: &dyn Differentiate,
    ) -> anyhow::Result<()> {
        let BlockOf { number, all } = self.block;
        let bar = progress::count("writing");
        // The same for every block, so that their order does not show.
        let how = format!("blocks={all}: {} steps", trainer.settings().steps);
        let cells = blocks.cells(number - 1);
        let gaussians = trainer.model().to_gaussians();
        let version =
            catalog.replace_cells(base, &gaussians, cells, how, &mut progress::show(&bar))?;
        bar.finish_and_clear();
        let mut stdout = output::stdout();
        let Version { number: version_number, hash, .. } = &version;
        writeln!(
            stdout,
            "twin {} version {version_number}: block {number}/{all}\nblake3 {hash}",
            self.edited.twin.name
        )?;
        if across.held_out().is_empty() {
            writeln!(stdout, "no image that is held out sees both sides of a border")?;
            return Ok(());
        }
        // Read back, so that what is judged has the rounding of the record.
        let published = Parts::read(catalog, &version, blocks, number - 1)?;
        let mut gaussians = published.moving;
        gaussians.append(&published.around);
        let sky = trainer.scene()?.sky;
        let scene = Scene { sky, ..Scene::from_gaussians(&gaussians) };
        let alone = held_out_db(trainer, across, backend)?;
        let joined = scene_db(&scene, trainer, across, backend)?;
        if let Some((alone, joined)) = alone.zip(joined) {
            writeln!(
                stdout,
                "across the borders ({}): {alone:.2} dB by the block alone, {joined:.2} dB by the twin",
                output::counted(across.held_out().len(), "image")
            )?;
        }
        Ok(())
    }

    /// The settings of the run; the harmonics have the degree of the twin.
    fn training_settings(&self, sh_degree: u8) -> anyhow::Result<Settings> {
        let mut settings = match &self.settings {
            None => Settings { sh_degree, ..Settings::default() },
            Some(path) => read_settings(path)?,
        };
        ensure!(
            settings.sh_degree == sh_degree,
            "--settings: sh_degree is {}, and that of the twin {sh_degree}: its blocks have one degree",
            settings.sh_degree
        );
        settings.steps = self.steps.map_or(settings.steps, |steps| steps as usize);
        settings.growth.cap = self.cap.map_or(settings.growth.cap, |cap| cap as usize);
        // Blocks are joined later, and must agree about what they share: poses, exposures and the
        // sky.
        keep_trained(&mut settings);
        settings.check()?;
        Ok(settings)
    }
}
