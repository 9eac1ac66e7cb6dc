//! `wildcity episode export`.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::PathBuf;

use anyhow::Context as _;

use wildcity_episode::{EpisodeFile, export};

use crate::cli::directories::Episodes;

/// Export an episode as MCAP, for Foxglove, Rerun and others: indexed, compressed, with schemas.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub(super) struct Export {
    /// The episode: its file, or its name as `wildcity episode list` prints it.
    #[arg(value_name = "EPISODE")]
    episode: PathBuf,

    /// The MCAP file to write.
    #[arg(long, value_name = "FILE")]
    mcap: PathBuf,

    #[command(flatten)]
    episodes: Episodes,
}

const EXAMPLES: &str = "\
Examples:
  wildcity episode export agent-1 --mcap agent-1.mcap
  wildcity episode export run/episodes/straight-0-1.jsonl --mcap straight.mcap";

impl Export {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let path = super::file_of(&self.episode, &self.episodes)?;
        let episode = super::read(&self.episode, &self.episodes)?;
        let rig = EpisodeFile::rig(&path)?;
        // A reader never finds half a file: it has its name only when it is whole.
        let temporary = self.mcap.with_extension("mcap.tmp");
        let cannot = || format!("cannot write {}", self.mcap.display());
        let file = BufWriter::new(File::create(&temporary).with_context(cannot)?);
        let exported = export(&episode, rig.as_ref(), file);
        let renamed = exported.map_err(anyhow::Error::from).and_then(|exported| {
            std::fs::rename(&temporary, &self.mcap).with_context(cannot)?;
            Ok(exported)
        });
        if renamed.is_err() {
            // The first error is the one to report.
            let _ = std::fs::remove_file(&temporary);
        }
        let exported = renamed?;
        let mut out = io::stdout().lock();
        writeln!(out, "exported    {} messages to {}", exported.messages, self.mcap.display())?;
        if exported.without_calibration > 0 {
            let count = exported.without_calibration;
            writeln!(
                out,
                "note        {count} cameras have lenses that a calibration cannot describe"
            )?;
        }
        Ok(())
    }
}
