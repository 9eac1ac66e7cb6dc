//! `wildcity episode compare`.

use std::io::Write;
use std::path::PathBuf;

use wildcity_render::cpu::{Cpu, Simd};
use wildcity_suite::{ComparedPictures, Comparison, DrivenRun, SuiteResult, Tolerance};

use crate::cli::directories::Twins;
use crate::cli::exit::Exit;
use crate::cli::output;

use super::bad_input;

/// Compare two runs of a suite: is the driver worse than before?
///
/// Two episodes with the same scenario, values of the sweep and seed are a pair. Prints the
/// verdicts that changed, then the mean difference of each score over the pairs with its 95 %
/// interval. Pairs in different versions of the twin or of the scenario are not compared, nor are
/// different versions of a score.
///
/// The exit code is 1 if the run is worse: if any episode that passed before does not pass now,
/// because it failed or has no verdict. For a driver that does not repeat exactly, --worse-by
/// pass_rate=0.05 compares the pass rates over all pairs instead. Scores count only if --worse-by
/// names them. It is 0 if the run is not worse, and 2 if a file cannot be read or the runs cannot
/// be compared.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Compare {
    /// The earlier run: its result.json, or its folder.
    #[arg(value_name = "BEFORE")]
    before: PathBuf,

    /// The later run.
    #[arg(value_name = "AFTER")]
    after: PathBuf,

    /// By how much pass_rate, or the mean of a score, may be worse; may be given several times.
    /// pass_rate=0 compares only the pass rates, and not each episode.
    #[arg(long, value_name = "NAME=AMOUNT")]
    worse_by: Vec<Tolerance>,

    /// Write the comparison as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,

    /// Write the comparison as a web page, with the drives of both runs side by side. Their
    /// pictures are rendered again from the records, if the twins are there.
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,

    #[command(flatten)]
    twins: Twins,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode compare main/result.json run/result.json
  wildcity episode compare main run --worse-by pass_rate=0.05 --html comparison.html
  wildcity episode compare main run --worse-by bench2drive.driving=2 --worse-by alpasim.min_ade_5s=0.1";

impl Compare {
    /// Pictures of both runs for the page.
    fn pictures(
        &self,
        comparison: &Comparison,
        runs: &[DrivenRun<'_>; 2],
    ) -> anyhow::Result<ComparedPictures> {
        let backend = Cpu::new(0, Simd::Best)?;
        Ok(comparison.pictures(runs, &self.twins.catalog()?, &backend))
    }

    pub(super) fn run(self) -> anyhow::Result<()> {
        let before = SuiteResult::read(&self.before).map_err(bad_input)?;
        let after = SuiteResult::read(&self.after).map_err(bad_input)?;
        let rule = self.worse_by.iter().cloned().collect();
        let comparison = Comparison::new(&before, &after, &rule).map_err(bad_input)?;
        if let Some(path) = &self.json {
            output::write(path, comparison.to_json().as_bytes())?;
        }
        if let Some(path) = &self.html {
            let run = |result, run| DrivenRun { result, episodes: SuiteResult::records(run) };
            let runs = [run(&before, &self.before), run(&after, &self.after)];
            let pictures = self.pictures(&comparison, &runs)?;
            output::write(path, comparison.to_page(&runs, &pictures).as_bytes())?;
        }
        let conclusion = comparison.conclusion();
        let mut out = output::stdout();
        write!(out, "{}", comparison.to_text())?;
        if comparison.worse {
            return Err(Exit::finding(1, conclusion).into());
        }
        writeln!(out, "{conclusion}")?;
        Ok(())
    }
}
