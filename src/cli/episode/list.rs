//! `wildcity episode list`.

use std::io::{self, Write};

use wildcity_episode::{EpisodeFile, list};

use crate::cli::directories::Episodes;

/// List the recorded episodes, newest first.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct List {
    /// How many to list.
    #[arg(long, value_name = "N", default_value_t = 50)]
    most: usize,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode list
  wildcity episode list --most 5 --episodes run/episodes";

impl List {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let dir = self.episodes.dir()?;
        let listed = list(&dir)?;
        let mut out = io::stdout().lock();
        for one in listed.iter().take(self.most) {
            let text = match EpisodeFile::read(&one.path) {
                Ok(episode) => line(&episode),
                Err(error) => format!("cannot be read: {error}"),
            };
            writeln!(out, "{:<32} {text}", one.name)?;
        }
        if listed.is_empty() {
            writeln!(out, "no episodes in {}", dir.display())?;
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
