//! `wildcity train compare`.

use std::env;
use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use wildcity_render::gradient::Differentiate;
use wildcity_train::compare::ComparedRun;
use wildcity_train::held_out::judge;
use wildcity_train::page::{Comparison, compared, comparison_page};
use wildcity_train::trainer::Trainer;

use super::options::{Inputs, SourceOptions, fraction};
use super::progress::train;
use crate::cli::moved::quoted;
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

    /// Most Gaussians at any time [default: that of --settings, or one for each 32 pixels of the
    /// largest images, at most 1000000]
    #[arg(long, value_name = "COUNT", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    cap: Vec<u32>,

    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

const EXAMPLE: &str = "\
Example:
  wildcity train compare log --size 0.25,0.5 --steps 500,1500 --cap 100000,300000 --out compared";

impl Compare {
    pub(super) fn run(mut self) -> anyhow::Result<()> {
        output::create_dir(&self.out)?;
        // Sorted and each once, so that the order of the options does not change the table.
        self.size.sort_by(f64::total_cmp);
        self.size.dedup();
        for numbers in [&mut self.steps, &mut self.cap] {
            numbers.sort_unstable();
            numbers.dedup();
        }
        let backend = &*self.source.hardware.training()?;
        let largest = self.size.iter().copied().fold(0.0, f64::max);
        // Sorted: a scene to begin with may have as many as the largest one.
        let largest_cap = self.cap.last().map(|&cap| cap as usize);
        let Inputs { images: opened, settings, .. } =
            self.source.open(self.source.settings()?, largest, largest_cap)?;
        let all = self.combinations(settings.growth.cap);
        // All runs are judged by the same images, the largest: small ones hide what is blurred.
        let judges = opened.images();
        ensure!(
            !judges.held_out().is_empty(),
            "no image is held out, so that nothing judges the runs: give --held-out-every"
        );
        let source = self.source.path()?.display().to_string();
        let command = command_of_a_run(env::args_os());
        let mut runs = Vec::new();
        let mut pictures = Vec::new();
        for &(size, steps, cap) in &all {
            let number = runs.len() + 1;
            writeln!(
                io::stderr(),
                "run {number} of {}: size {size}, {steps} steps, cap {cap}",
                all.len()
            )?;
            // Stopped by a signal: what is complete has been written already.
            let Some(trainer) = self.train(backend, size, steps, cap)? else {
                let done = output::counted(runs.len(), "run");
                bail!("stopped: {done} of {} complete", all.len());
            };
            let judged = judge(&trainer, judges, backend)?
                .context("no image that is held out has a pixel that counts")?;
            runs.push(ComparedRun {
                size,
                steps,
                cap,
                gaussians: trainer.model().len(),
                seconds: trainer.history().seconds(),
                held_out_db: judged.mean_db,
            });
            pictures.push(judged.middle);
            // After each run, so that hours of work are not lost if a later one fails.
            self.write(&Comparison {
                source: &source,
                command: &command,
                backend: backend.name(),
                judged_by: (judged.images, largest),
                runs: &runs,
                images: &pictures,
            })?;
        }
        let mut stdout = output::stdout();
        writeln!(stdout, "size  steps      cap  Gaussians   time, s  held out, dB")?;
        for ComparedRun { size, steps, cap, gaussians, seconds, held_out_db } in &runs {
            writeln!(
                stdout,
                "{size:<4} {steps:>6} {cap:>8} {gaussians:>10} {seconds:>9.1} {held_out_db:>13.2}"
            )?;
        }
        writeln!(stdout, "{}", compared(&command, &runs))?;
        writeln!(stdout, "{}", self.out.join("index.html").display())?;
        Ok(())
    }

    /// Size, steps and cap of each run. Without `--cap` all have the one of the largest images.
    fn combinations(&self, cap: usize) -> Vec<(f64, usize, usize)> {
        let mut caps: Vec<usize> = self.cap.iter().map(|&cap| cap as usize).collect();
        if caps.is_empty() {
            caps.push(cap);
        }
        let mut all = Vec::new();
        for &size in &self.size {
            for &cap in &caps {
                all.extend(self.steps.iter().map(|&steps| (size, steps as usize, cap)));
            }
        }
        all
    }

    /// Makes one run; `None` if the process was asked to stop before its end.
    fn train(
        &self,
        backend: &dyn Differentiate,
        size: f64,
        steps: usize,
        cap: usize,
    ) -> anyhow::Result<Option<Trainer>> {
        let mut settings = self.source.settings()?;
        settings.steps = steps;
        let Inputs { images, start, profile, settings, .. } =
            self.source.open(settings, size, Some(cap))?;
        let mut trainer = Trainer::new(start, profile, settings)?;
        train(&mut trainer, images.images(), backend, steps, &mut |_, _| Ok(()))?;
        let is_done = trainer.steps_done() == steps;
        Ok(is_done.then_some(trainer))
    }

    fn write(&self, comparison: &Comparison<'_>) -> anyhow::Result<()> {
        output::write(&self.out.join("index.html"), comparison_page(comparison)?.as_bytes())?;
        output::write(&self.out.join("compare.json"), &serde_json::to_vec_pretty(comparison.runs)?)
    }
}

/// The command that makes one of the runs, but for its size, steps and cap: that of a comparison
/// with its other options.
fn command_of_a_run(arguments: impl Iterator<Item = OsString>) -> String {
    let mut words = arguments
        .map(|word| word.to_string_lossy().into_owned())
        .skip_while(|word| word != "compare")
        .skip(1);
    let mut command = "wildcity train".to_owned();
    while let Some(word) = words.next() {
        let (name, has_value) = match word.split_once('=') {
            Some((name, _)) => (name, true),
            None => (&word[..], false),
        };
        if ["--size", "--steps", "--cap", "--out"].contains(&name) {
            if !has_value {
                words.next();
            }
            continue;
        }
        command += &format!(" {}", quoted(&word));
    }
    command + " --out scene.ply"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_of_a_run_keeps_what_is_not_compared() {
        let words = [
            "wildcity",
            "train",
            "compare",
            "--cap",
            "9",
            "my log",
            "--steps=1,2",
            "--sky",
            "off",
            "--out",
            "there",
        ];
        let command = command_of_a_run(words.into_iter().map(OsString::from));
        assert_eq!(command, "wildcity train 'my log' --sky off --out scene.ply");
    }
}
