//! `wildcity twin map check`.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;

use crate::cli::output;
use wildcity_sim::map::{Map, MapFile};
use wildcity_twin::ingest;

/// Check a map, and count its lanes and areas.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin map check street.map.json")]
pub(in crate::cli) struct Check {
    /// The map file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let context = || format!("{}", self.file.display());
        let bytes = ingest::read_whole(&self.file, wildcity_sim::limits::MAP_BYTES as u64);
        let map = MapFile::parse(&bytes.with_context(context)?)
            .and_then(Map::new)
            .with_context(context)?;
        let file = map.file();
        writeln!(
            output::stdout(),
            "{}: {}, {}, {}",
            self.file.display(),
            output::counted(file.lanes.len(), "lane"),
            output::counted(file.areas.len(), "area"),
            output::counted(file.stop_lines.len(), "stop line")
        )?;
        Ok(())
    }
}
