//! `wildcity twin diff`.

use std::io::Write;

use crate::cli::directories::Twins;
use crate::cli::output;
use wildcity_twin::store::{CellDiff, CellSize, Diff as Differences};

/// Show which cells differ between two versions of a twin, with their Gaussians and bytes in each.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "Example:\n  wildcity twin diff street 3 4")]
pub(super) struct Diff {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Number of the first version.
    #[arg(value_name = "BEFORE")]
    before: u64,

    /// Number of the second version.
    #[arg(value_name = "AFTER")]
    after: u64,

    #[command(flatten)]
    twins: Twins,
}

impl Diff {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let Differences { cells, kept, settings } =
            catalog.diff(&self.twin, self.before, self.after)?;
        let mut out = output::stdout();
        let mut added = 0;
        let mut removed = 0;
        let mut changed = 0;
        for CellDiff { cell: [x, y], before, after } in &cells {
            let (sign, count) = match (before, after) {
                // A cell that neither version has is not in the list.
                (None, _) => ("+", &mut added),
                (_, None) => ("-", &mut removed),
                _ => ("~", &mut changed),
            };
            *count += 1;
            let cell = format!("{x},{y}");
            writeln!(out, "{sign} {cell:>12}  {} -> {}", size(before), size(after))?;
        }
        writeln!(out, "{added} cells added, {removed} removed, {changed} changed, {kept} kept")?;
        if !settings.is_empty() {
            writeln!(out, "other {}", settings.join(", "))?;
        }
        Ok(())
    }
}

fn size(size: &Option<CellSize>) -> String {
    match size {
        Some(CellSize { gaussians, bytes }) => format!("{gaussians} Gaussians, {bytes} bytes"),
        None => "nothing".to_owned(),
    }
}
