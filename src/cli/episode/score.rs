//! `wildcity episode score`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context as _;
use serde_json::json;

use wildcity_episode::{EpisodeFile, EpisodeResult, result};

use crate::cli::directories::Episodes;
use crate::cli::output;

/// Score recorded episodes from their records only, without a renderer or a twin.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Score {
    /// The episodes: their files, or their names as `wildcity episode list` prints them.
    #[arg(value_name = "EPISODE", required = true)]
    episodes_to_score: Vec<PathBuf>,

    /// Print one JSON object per episode, with the values from which each score was computed.
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode score agent-1
  wildcity episode score --json run/episodes/*.jsonl";

impl Score {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        for path in &self.episodes_to_score {
            let episode = super::read(path, &self.episodes)?;
            let name = EpisodeFile::episode_name(path);
            let scored = result(&episode).with_context(|| {
                format!(
                    "{name} cannot be scored: it has no frame, or its agent drove several steps with one request, which \
                     leaves no poses between"
                )
            })?;
            if self.json {
                writeln!(out, "{}", json!({ "episode": name, "result": scored }))?;
            } else {
                table(&mut out, &name, &scored)?;
            }
        }
        Ok(())
    }
}

fn table(out: &mut impl Write, name: &str, scored: &EpisodeResult) -> io::Result<()> {
    writeln!(out, "{name}: {}", scored.verdict)?;
    for fault in &scored.faults {
        writeln!(out, "  fault   {}", fault.text(&scored.scores))?;
    }
    for reason in &scored.not_judged {
        writeln!(out, "  not judged: {reason}")?;
    }
    for (score, line) in &scored.scores {
        match (line.value, &line.reason) {
            (Some(value), _) => writeln!(out, "  {score:<36} {value:.4}")?,
            (None, reason) => {
                writeln!(out, "  {score:<36} none: {}", reason.as_deref().unwrap_or("unknown"))?;
            }
        }
    }
    Ok(())
}
