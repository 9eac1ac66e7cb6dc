//! `wildcity scenario check`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use super::opened;
use crate::cli::directories::Twins;
use wildcity_session::StoredAssets;

/// Check scenarios against their twins, with every combination of their sweeps.
///
/// Prints one line for each scenario. The first mistake ends the command with exit code 1; it names the place in the
/// file and what is accepted there.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario check cut-in.json
  wildcity scenario check scenarios/*.json --latest")]
pub(in crate::cli) struct Check {
    /// Scenario files; tracks and maps are read from their directories.
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Accept twins, tracks and maps whose hashes differ from those that the scenario names, and say so.
    #[arg(long)]
    latest: bool,

    #[command(flatten)]
    twins: Twins,
}

impl Check {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let mut out = io::stdout().lock();
        for path in &self.files {
            let context = || format!("{}", path.display());
            let opened = opened(path, &catalog)?;
            let cases = opened.document.cases();
            let mut actors = 0;
            let mut unpinned = Vec::new();
            for case in &cases {
                let file = opened.document.with(&case.values).with_context(context)?;
                let version = (&opened.version.manifest, opened.version.hash.as_str());
                let assets = StoredAssets::new(&catalog);
                let loaded = opened
                    .scenarios
                    .resolve(file, case.seed, version, self.latest, &assets)
                    .with_context(|| format!("{}, seed {}", path.display(), case.seed))?;
                actors = actors.max(loaded.scenario.traffic.actors.len());
                unpinned = loaded.unpinned;
            }
            writeln!(
                out,
                "{}: {} episodes in {}@{}, {actors} actors",
                path.display(),
                cases.len(),
                opened.version.manifest.twin,
                opened.version.number,
            )?;
            for line in unpinned {
                writeln!(out, "  not pinned: {line}")?;
            }
        }
        Ok(())
    }
}
