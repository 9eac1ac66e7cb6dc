//! `wildcity twin map strips`.

use std::io::Write;
use std::path::PathBuf;

use crate::cli::directories::{TwinVersion, Twins};
use crate::cli::output;
use wildcity_sim::map::strips_beside;

/// Make a map of strips along the recorded drives of a twin.
///
/// Each drive becomes a lane of its name and a drivable area, from --left-m to its left to
/// --right-m to its right. Only the owner of the twin knows these widths, so they have no default.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin map strips street --left-m 5.2 --right-m 1.7 --out street.map.json")]
pub(in crate::cli) struct Strips {
    /// The twin, as NAME or NAME@NUMBER.
    #[arg(value_name = "TWIN")]
    twin: TwinVersion,

    /// Width of the road to the left of the drive, in metres: 0.1 to 100.
    #[arg(long, value_name = "M", value_parser = width)]
    left_m: f64,

    /// Width of the road to the right of the drive, in metres: 0.1 to 100.
    #[arg(long, value_name = "M", value_parser = width)]
    right_m: f64,

    /// Map file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,

    #[command(flatten)]
    twins: Twins,
}

impl Strips {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let version = self.twins.catalog()?.version(&self.twin.name, self.twin.number)?;
        let map = strips_beside(&version.manifest.trajectories, self.left_m, self.right_m);
        anyhow::ensure!(
            !map.lanes.is_empty(),
            "twin {} has no recorded drive: import one with --trajectory",
            self.twin.name
        );
        output::write(&self.out, map.to_json().as_bytes())?;
        let lanes = output::counted(map.lanes.len(), "lane");
        writeln!(output::stdout(), "{}: {lanes}", self.out.display())?;
        Ok(())
    }
}

fn width(text: &str) -> Result<f64, String> {
    let width_m: Option<f64> = text.parse().ok().filter(|m| (0.1..=100.0).contains(m));
    width_m.ok_or_else(|| "expected metres from 0.1 to 100".to_owned())
}
