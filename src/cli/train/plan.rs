//! `wildcity train plan`.

use std::io::{self, Write};

use anyhow::Context;
use glam::DVec3;
use wildcity_scene::chunk::cell_at;
use wildcity_train::blocks::{Blocks, sees};
use wildcity_train::model::peak_bytes;
use wildcity_train::run::{Line, TrainingImages, run};
use wildcity_train::trainer::Trainer;

use std::collections::BTreeMap;

use super::options::{Inputs, RunOptions};
use crate::cli::output;

/// Say what a run would take, before it runs: images, Gaussians, memory, time, and blocks.
///
/// Takes the options of `wildcity train`. A few steps are made to measure their time on this
/// machine, and nothing is written. With --blocks, says which cells of 64 m and how many images
/// each block would have (`wildcity train block`).
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

/// Steps that are measured. The first ones are slower: nothing is in the caches yet.
const MEASURED: usize = 12;

/// Points that decide which images see a block, at most.
const SAMPLE: usize = 2_000;

/// Steps that are measured, in seconds.
struct Measured {
    /// What depends on the pixels.
    pixels_s: f64,
    /// What grows with the number of Gaussians.
    gaussians_s: f64,
}

impl Plan {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let Inputs { images: opened, start, profile, settings, .. } = self.run.open()?;
        let images = opened.images();
        let mut stdout = io::stdout().lock();
        let held_out = images.held_out().len();
        let pixels: usize = (0..images.count()).map(|k| images.view(k).camera.pixels()).sum();
        let size = self.run.size * self.run.size;
        writeln!(
            stdout,
            "images     {} to learn from, {held_out} held out, of {:.2} megapixels on average",
            images.count() - held_out,
            1e-6 * size * pixels as f64 / images.count().max(1) as f64
        )?;
        let begin = start.gaussians.len();
        let end = settings.counts(begin).last().unwrap_or(begin);
        writeln!(
            stdout,
            "Gaussians  {begin} at the beginning, at most {end} at the end (--cap {})",
            settings.growth.cap
        )?;
        let points_m: Vec<DVec3> =
            start.gaussians.means_m.iter().map(|m| DVec3::from_array(*m)).collect();
        let path_m: Vec<DVec3> = start.world_from_camera.iter().map(|p| p.position_m).collect();
        let sh_degree = settings.sh_degree;
        let backend = &*self.run.hardware.training()?;
        let mut trainer = Trainer::new(start, profile, settings.clone())?;
        let measured = Measured::new(&mut trainer, images, backend)?;
        let resident = peak_resident_bytes();
        let more = end.saturating_sub(begin) * peak_bytes(sh_degree);
        match resident {
            Some(bytes) => writeln!(
                stdout,
                "memory     {:.1} GB: {:.1} now, and {} B for each Gaussian more",
                1e-9 * (bytes + more) as f64,
                1e-9 * bytes as f64,
                peak_bytes(sh_degree)
            )?,
            None => writeln!(stdout, "memory     {} B for each Gaussian", peak_bytes(sh_degree))?,
        }
        let seconds: f64 = settings.counts(begin).map(|count| measured.step_s(count, begin)).sum();
        let [first_ms, last_ms] = [begin, end].map(|count| 1e3 * measured.step_s(count, begin));
        writeln!(
            stdout,
            "time       {} for {} steps of {first_ms:.0} to {last_ms:.0} ms, backend {}, as measured on {MEASURED} steps",
            duration(seconds),
            settings.steps,
            backend.name()
        )?;
        self.print_blocks(&mut stdout, images, &points_m, &path_m)
    }

    fn print_blocks(
        &self,
        out: &mut dyn Write,
        images: &dyn TrainingImages,
        points_m: &[DVec3],
        path_m: &[DVec3],
    ) -> anyhow::Result<()> {
        let mut cells: BTreeMap<[i32; 2], u64> = BTreeMap::new();
        for point_m in points_m {
            *cells.entry(cell_at(&point_m.to_array())).or_default() += 1;
        }
        let cells: Vec<([i32; 2], u64)> = cells.into_iter().collect();
        let blocks = Blocks::new(&cells, path_m, self.blocks.into()).context("--blocks")?;
        for block in 0..usize::from(self.blocks) {
            let owned = blocks.cells(block);
            let is_own = |point_m: &&DVec3| owned.contains(&cell_at(&point_m.to_array()));
            let own_m: Vec<DVec3> = points_m.iter().filter(is_own).copied().collect();
            let every = own_m.len().div_ceil(SAMPLE).max(1);
            let sample_m: Vec<DVec3> = own_m.iter().step_by(every).copied().collect();
            let seeing = (0..images.count()).filter(|&k| sees(&images.view(k), &sample_m)).count();
            writeln!(
                out,
                "block {}/{}  {} of 64 m, {} to begin with, seen by {}",
                block + 1,
                self.blocks,
                output::counted(owned.len(), "cell"),
                output::counted(own_m.len(), "Gaussian"),
                output::counted(seeing, "image")
            )?;
        }
        Ok(())
    }
}

impl Measured {
    fn new(
        trainer: &mut Trainer,
        images: &dyn TrainingImages,
        backend: &dyn wildcity_render::gradient::Differentiate,
    ) -> anyhow::Result<Self> {
        let mut lines: Vec<Line> = Vec::new();
        run(trainer, images, backend, usize::MAX, &mut |line, _| {
            lines.push(line.clone());
            lines.len() < MEASURED
        })?;
        let whole_s = lines.last().map_or(0.0, |line| line.seconds);
        let of_pixels = |name: &str| ["rasterize", "loss", "blend backwards"].contains(&name);
        let stages = lines.iter().flat_map(|line| &line.stages_ms);
        let pixels_ms: f64 = stages.filter(|(name, _)| of_pixels(name)).map(|(_, ms)| ms).sum();
        let steps = lines.len().max(1) as f64;
        let pixels_s = (1e-3 * pixels_ms).min(whole_s) / steps;
        Ok(Self { pixels_s, gaussians_s: whole_s / steps - pixels_s })
    }

    /// The time of a step with some Gaussians, if those that were measured were `measured`.
    fn step_s(&self, count: usize, measured: usize) -> f64 {
        self.pixels_s + self.gaussians_s * count as f64 / measured.max(1) as f64
    }
}

/// The most that this process has had in memory, where the system says it.
fn peak_resident_bytes() -> Option<usize> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: usize = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

/// A time for a person: seconds, minutes, or hours.
fn duration(seconds: f64) -> String {
    match seconds {
        ..120.0 => format!("{seconds:.0} s"),
        ..7_200.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.1} h", seconds / 3_600.0),
    }
}
