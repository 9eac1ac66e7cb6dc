//! `wildcity train compare`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, ensure};
use wildcity_render::gradient::Differentiate;
use wildcity_train::compare::ComparedRun;
use wildcity_train::held_out::{HeldOut, judge};
use wildcity_train::page::{Comparison, compared, comparison_page};
use wildcity_train::trainer::Trainer;

use super::options::{Inputs, SourceOptions, fraction};
use super::progress::train;
use crate::cli::output;

/// Train with several sizes of images, numbers of steps and caps, and say which to use.
///
/// Each combination is a run. All are judged by the same held-out images, at the largest --size.
/// DIR/index.html shows PSNR over time, and what each run makes of one image; DIR/compare.json has
/// the same figures. Both are written after each run. No twin is made.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLE)]
pub(in crate::cli) struct Compare {
    #[command(flatten)]
    source: SourceOptions,

    /// Fractions of the images' width.
    #[arg(long, value_name = "FRACTION", value_delimiter = ',', default_values_t = [0.25, 0.5], value_parser = fraction)]
    size: Vec<f64>,

    /// Numbers of steps.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [500, 1_500, 4_500], value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    steps: Vec<u32>,

    /// Most Gaussians at any time [default: that of --settings, or 1000000]
    #[arg(long, value_name = "COUNT", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    cap: Vec<u32>,

    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// A run, and what it shows.
struct Judged {
    run: ComparedRun,
    picture: HeldOut,
    /// Number of images.
    by: usize,
}

const EXAMPLE: &str = "\
Example:
  wildcity train compare log --size 0.25,0.5 --steps 500,1500 --cap 100000,300000 --out compared";

impl Compare {
    pub(super) fn run(mut self) -> anyhow::Result<()> {
        output::create_dir(&self.out)?;
        self.size.sort_by(f64::total_cmp);
        self.size.dedup();
        for numbers in [&mut self.steps, &mut self.cap] {
            numbers.sort_unstable();
            numbers.dedup();
        }
        let backend = &*self.source.hardware.training()?;
        let all = self.combinations()?;
        let largest = all.iter().map(|run| run.0).fold(0.0, f64::max);
        let source = self.source.path()?.display().to_string();
        let mut runs = Vec::new();
        let mut pictures = Vec::new();
        for &(size, steps, cap) in &all {
            let number = runs.len() + 1;
            writeln!(
                io::stderr(),
                "run {number} of {}: size {size}, {steps} steps, cap {cap}",
                all.len()
            )?;
            let Judged { run, picture, by } = self.one(backend, size, steps, cap, largest)?;
            runs.push(run);
            pictures.push(picture);
            let comparison = Comparison {
                source: &source,
                backend: backend.name(),
                judged_by: (by, largest),
                runs: &runs,
                images: &pictures,
            };
            self.write(&comparison)?;
        }
        let mut stdout = output::stdout();
        writeln!(stdout, "size  steps      cap  Gaussians   time, s  held out, dB")?;
        for ComparedRun { size, steps, cap, gaussians, seconds, held_out_db } in &runs {
            writeln!(
                stdout,
                "{size:<4} {steps:>6} {cap:>8} {gaussians:>10} {seconds:>9.1} {held_out_db:>13.2}"
            )?;
        }
        writeln!(stdout, "{}", compared(&source, &runs))?;
        writeln!(stdout, "{}", self.out.join("index.html").display())?;
        Ok(())
    }

    /// Size, steps and cap of each run.
    fn combinations(&self) -> anyhow::Result<Vec<(f64, usize, usize)>> {
        let mut caps: Vec<usize> = self.cap.iter().map(|&cap| cap as usize).collect();
        if caps.is_empty() {
            caps.push(self.source.settings()?.growth.cap);
        }
        let mut all = Vec::new();
        for &size in &self.size {
            for &cap in &caps {
                all.extend(self.steps.iter().map(|&steps| (size, steps as usize, cap)));
            }
        }
        Ok(all)
    }

    /// Makes one run, judged by images of another size.
    fn one(
        &self,
        backend: &dyn Differentiate,
        size: f64,
        steps: usize,
        cap: usize,
        judged_size: f64,
    ) -> anyhow::Result<Judged> {
        let mut settings = self.source.settings()?;
        settings.steps = steps;
        settings.growth.cap = cap;
        let Inputs { images, start, profile, settings, .. } = self.source.open(settings, size)?;
        ensure!(
            !images.images().held_out().is_empty(),
            "no image is held out, so that nothing judges the runs: give --held-out-every"
        );
        let mut trainer = Trainer::new(start, profile, settings.clone())?;
        train(&mut trainer, images.images(), backend, steps, &mut |_, _| Ok(()))?;
        let done = trainer.steps_done();
        ensure!(done == steps, "stopped: {} has the runs before this one", self.out.display());
        let judges = self.source.open(settings, judged_size)?.images;
        let judges = judges.images();
        let judged = judge(&trainer, judges, backend)?;
        let (held_out_db, picture) = judged.context("no image that is held out has a pixel")?;
        let run = ComparedRun {
            size,
            steps,
            cap,
            gaussians: trainer.model().len(),
            seconds: trainer.history().seconds(),
            held_out_db,
        };
        Ok(Judged { run, picture, by: judges.held_out().len() })
    }

    fn write(&self, comparison: &Comparison<'_>) -> anyhow::Result<()> {
        output::write(&self.out.join("index.html"), comparison_page(comparison)?.as_bytes())?;
        output::write(&self.out.join("compare.json"), &serde_json::to_vec_pretty(comparison.runs)?)
    }
}
