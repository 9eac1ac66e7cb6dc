//! `wildcity episode list`.

use std::io::Write;

use wildcity_episode::{EpisodeFile, list};

use crate::cli::directories::Episodes;
use crate::cli::output;

use super::bad_input;
use super::folder::{records, runs_in};

/// List the recorded episodes, newest first.
///
/// --episodes may be the folder of a run, which has the records in its folder `episodes`. A record
/// is named SCENARIO-SEED-NUMBER, with a sweep SCENARIO-COMBINATION-SEED-NUMBER; the second attempt
/// after a technical failure has .2 after the seed.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct List {
    /// Largest number of episodes to list.
    #[arg(long, value_name = "N", default_value_t = 50)]
    most: usize,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode list
  wildcity episode list --most 5 --episodes run";

impl List {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let dir = records(&self.episodes)?;
        let listed = list(&dir)
            .map_err(|error| bad_input(format!("cannot read {}: {error}", dir.display())))?;
        let mut out = output::stdout();
        if listed.is_empty() {
            writeln!(out, "no episodes in {}", dir.display())?;
            for records in runs_in(&dir) {
                writeln!(out, "look in     {}", records.display())?;
            }
            return Ok(());
        }
        writeln!(
            out,
            "{:<32} {:<20} {:>12}  {:<14} scenario, verdict",
            "record", "twin", "", "end"
        )?;
        // Only what is printed is read: a record may be large.
        for one in listed.iter().take(self.most) {
            let text = match EpisodeFile::read(&one.path) {
                Ok(episode) => line(&episode),
                Err(error) => format!("cannot be read: {error}"),
            };
            writeln!(out, "{:<32} {text}", one.name)?;
        }
        if listed.len() > self.most {
            writeln!(out, "and {} more (--most {})", listed.len() - self.most, listed.len())?;
        }
        Ok(())
    }
}

fn line(episode: &EpisodeFile) -> String {
    let steps = episode.driven().last().map_or(0, |frame| frame.step);
    let end = match (&episode.end, &episode.cut) {
        (Some(end), None) => end.outcome.as_str(),
        (_, Some(_)) => "damaged",
        (None, None) => "no end",
    };
    let scenario = episode.scenario.as_ref().map_or("", |scenario| scenario.name.as_str());
    let verdict = episode.result.as_ref().map_or("", |result| result.verdict.as_str());
    let twin = format!("{}@{}", episode.header.twin, episode.header.version);
    format!("{twin:<20} {steps:>6} steps  {end:<14} {scenario} {verdict}").trim_end().to_owned()
}
