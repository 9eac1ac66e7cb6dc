//! `wildcity train plan`.

use std::collections::BTreeMap;
use std::io::Write;
use std::time::Instant;

use anyhow::Context;
use glam::DVec3;
use wildcity_render::View;
use wildcity_render::gradient::Differentiate;
use wildcity_scene::chunk::cell_at;
use wildcity_train::blocks::{Blocks, sees};
use wildcity_train::cache::CachedImages;
use wildcity_train::model::peak_bytes;
use wildcity_train::run::{Line, TrainingImages, halvings, run};
use wildcity_train::trainer::Trainer;

use super::block_parts::sample;
use super::images::ChosenImages;
use super::options::{Inputs, RunOptions, image_pixels};
use super::progress::{CACHE_BYTES, EVALUATIONS};
use crate::cli::{memory, output};

/// Say what a run would take, before it runs: images, Gaussians, memory, time, and blocks.
///
/// A few steps are made to measure their time on this machine, and nothing is written. With
/// --blocks, says about how many cells of 64 m, Gaussians and images each block would have; blocks
/// are cut by the Gaussians of the coarse twin (`wildcity train block`), which are not there yet.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(in crate::cli) struct Plan {
    #[command(flatten)]
    run: RunOptions,

    /// Number of blocks to train one by one, or on several machines.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    blocks: u16,
}

const EXAMPLES: &str = "\
Examples:
  wildcity train plan log --size 0.5 --steps 15000
  wildcity train plan log --blocks 4";

/// Images that are measured: once to decode them, and once without.
const MEASURED: usize = 12;

/// Stages whose time is that of the pixels; all else grows with the number of Gaussians.
const OF_PIXELS: [&str; 3] = ["rasterize", "loss", "blend backwards"];

/// What is measured, in seconds.
struct Measured {
    /// An image, with the sweeps around it.
    decode_s: f64,
    /// A step but for what grows with the number of Gaussians.
    fixed_s: f64,
    /// What grows with it.
    gaussians_s: f64,
}

impl Plan {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let Inputs { images: opened, start, profile, settings, .. } = self.run.open()?;
        let images = opened.images();
        let mut stdout = output::stdout();
        let points_m: Vec<DVec3> =
            start.gaussians.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
        let path_m: Vec<DVec3> = start.world_from_camera.iter().map(|p| p.position_m).collect();
        // Before the steps: more blocks than cells are refused.
        let blocks =
            Blocks::new(&cells(&points_m), &path_m, self.blocks.into()).context("--blocks")?;
        let begin = start.gaussians.len();
        let end = settings.counts(begin).last().unwrap_or(begin);
        let backend = &*self.run.source.hardware.training()?;
        // Whole images are measured: the time of smaller ones follows from their pixels.
        let mut whole = settings.clone();
        whole.coarse.halvings = 0;
        let mut trainer = Trainer::new(start, profile, whole)?;
        let measured = Measured::new(&mut trainer, images, backend)?;

        let held_out = images.held_out().len();
        let learned = images.count() - held_out;
        let pixels = image_pixels(images, self.run.size);
        // Colours, a mask, and depths.
        let decoded = (8.0 * pixels) as usize;
        writeln!(
            stdout,
            "images     {learned} to learn from, {held_out} held out, of {:.2} megapixels on average",
            1e-6 * pixels / images.count().max(1) as f64
        )?;
        writeln!(
            stdout,
            "Gaussians  {begin} at the beginning, at most {end} at the end (--cap {})",
            settings.growth.cap
        )?;
        let each = peak_bytes(trainer.model().sh_degree());
        let more = end.saturating_sub(begin) * each + decoded.min(CACHE_BYTES);
        match memory::status_kib("VmHWM:") {
            Some(kib) => writeln!(
                stdout,
                "memory     {:.1} GB: {:.1} now, {each} B for each Gaussian more, {:.1} GB of decoded images",
                1e-9 * (1024.0 * kib as f64 + more as f64),
                1e-9 * 1024.0 * kib as f64,
                1e-9 * decoded.min(CACHE_BYTES) as f64
            )?,
            None => writeln!(stdout, "memory     {each} B for each Gaussian")?,
        }
        let shares = shares(images, self.run.size, settings.coarse.halvings)?;
        // Images that are not kept are decoded again each time, beside the step.
        let is_decoded = |step: usize| step < learned || decoded > CACHE_BYTES;
        let step_s = |(step, count): (usize, usize)| {
            let pixels = shares[settings.halvings_at(step + 1) as usize];
            let step_s = measured.step_s(count, begin, pixels);
            // Another thread decodes at the same time: the slower of both counts.
            if is_decoded(step) { step_s.max(measured.decode_s) } else { step_s }
        };
        let steps_s: f64 = settings.counts(begin).enumerate().map(step_s).sum();
        let evaluations_s =
            (EVALUATIONS * held_out) as f64 * measured.step_s(end, begin, 1.0) / 2.0;
        let first_pixels = shares[settings.halvings_at(1) as usize];
        let first_ms = 1e3 * measured.step_s(begin, begin, first_pixels);
        let last_ms = 1e3 * measured.step_s(end, begin, 1.0);
        writeln!(
            stdout,
            "time       about {}: {} steps{} of {first_ms:.0} to {last_ms:.0} ms, and {:.0} ms to decode an image; backend {}, \
             measured on {MEASURED} images",
            duration(steps_s + evaluations_s),
            settings.steps,
            self.run.steps_origin(),
            1e3 * measured.decode_s,
            backend.name()
        )?;
        print_blocks(&mut stdout, &blocks, images, &points_m)
    }
}

/// The share of its pixels that an image has on average after it was halved up to so many times,
/// from 0 times.
fn shares(images: &dyn TrainingImages, size: f64, most: u32) -> anyhow::Result<Vec<f64>> {
    let small = |index: usize| {
        let view = images.view(index);
        let side = |px: u32| ((f64::from(px) * size).round() as u64).max(1);
        let camera = view.camera.scaled(side(view.camera.width_px), side(view.camera.height_px))?;
        anyhow::Ok(View { camera, ..view })
    };
    let views = (0..images.count()).map(small).collect::<anyhow::Result<Vec<View>>>()?;
    // Half of each side is a quarter of the pixels; small images are halved less often.
    let share = |wanted: u32| {
        let all = views.iter().map(|view| 0.25_f64.powi(halvings(view, wanted) as i32));
        all.sum::<f64>() / views.len().max(1) as f64
    };
    Ok((0..=most).map(share).collect())
}

/// The cells of some points, with their numbers.
fn cells(points_m: &[DVec3]) -> Vec<([i32; 2], u64)> {
    let mut cells: BTreeMap<[i32; 2], u64> = BTreeMap::new();
    for point_m in points_m {
        *cells.entry(cell_at(&point_m.to_array())).or_default() += 1;
    }
    cells.into_iter().collect()
}

fn print_blocks(
    out: &mut dyn Write,
    blocks: &Blocks,
    images: &dyn TrainingImages,
    points_m: &[DVec3],
) -> anyhow::Result<()> {
    for block in 0..blocks.count() {
        let owned = blocks.cells(block);
        let is_own = |point_m: &&DVec3| owned.contains(&cell_at(&point_m.to_array()));
        let own_m: Vec<DVec3> = points_m.iter().filter(is_own).copied().collect();
        let count = own_m.len();
        let sample_m = sample(own_m);
        let seeing = (0..images.count()).filter(|&k| sees(&images.view(k), &sample_m)).count();
        writeln!(
            out,
            "block {}/{}  {} of 64 m, {} to begin with, seen by {}",
            block + 1,
            blocks.count(),
            output::counted(owned.len(), "cell"),
            output::counted(count, "Gaussian"),
            output::counted(seeing, "image")
        )?;
    }
    Ok(())
}

impl Measured {
    fn new(
        trainer: &mut Trainer,
        images: &dyn TrainingImages,
        backend: &dyn Differentiate,
    ) -> anyhow::Result<Self> {
        let learned = (0..images.count()).filter(|&index| !images.is_held_out(index));
        // Spread over the list: images of one place would all show as many Gaussians.
        let every = images.count().div_ceil(MEASURED).max(1);
        let chosen: Vec<usize> = learned.step_by(every).collect();
        let count = chosen.len();
        let chosen = ChosenImages { all: images, chosen };
        // Decoded beforehand, so that the steps below measure no decoding.
        let images = CachedImages::new(&chosen, usize::MAX);
        let begin = Instant::now();
        for index in 0..count {
            images.load(index).map_err(anyhow::Error::msg)?;
        }
        let decode_s = begin.elapsed().as_secs_f64() / count.max(1) as f64;
        let mut lines: Vec<Line> = Vec::new();
        run(trainer, &images, backend, usize::MAX, &mut |line, _| {
            lines.push(line.clone());
            lines.len() < MEASURED
        })?;
        let steps = lines.len().max(1) as f64;
        let step_s = lines.last().map_or(0.0, |line| line.seconds) / steps;
        let stages = lines.iter().flat_map(|line| &line.stages_ms);
        let is_of_pixels = |name: &str| OF_PIXELS.contains(&name);
        let pixels_ms: f64 = stages.filter(|(name, _)| is_of_pixels(name)).map(|(_, ms)| ms).sum();
        // The sum of the stages may exceed the step, if some of them overlap.
        let fixed_s = (1e-3 * pixels_ms / steps).min(step_s);
        Ok(Self { decode_s, fixed_s, gaussians_s: step_s - fixed_s })
    }

    /// The time of a step with some Gaussians, if those that were measured were `measured`, on an
    /// image with a share of the pixels.
    fn step_s(&self, count: usize, measured: usize, pixels: f64) -> f64 {
        pixels * self.fixed_s + self.gaussians_s * count as f64 / measured.max(1) as f64
    }
}

/// A time for a person: seconds, minutes, or hours.
fn duration(seconds: f64) -> String {
    match seconds {
        ..120.0 => format!("{seconds:.0} s"),
        ..7_200.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.1} h", seconds / 3_600.0),
    }
}
