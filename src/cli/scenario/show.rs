//! `wildcity scenario show`.

use std::io::Write;
use std::path::PathBuf;

use serde_json::Value;

use super::{given_values, opened, value};
use crate::cli::directories::Twins;
use crate::cli::output;
use wildcity_session::StoredAssets;

/// Show a scenario as an episode runs it: with a seed's jitter, the values of its sweep, and all
/// hashes.
///
/// Prints JSON: the resolved scenario, which is a scenario itself, and its hash, the identity of
/// the episode.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity scenario show cut-in.json
  wildcity scenario show cut-in.json --seed 7 --value v=10 | jq .scenario > frozen.json")]
pub(in crate::cli) struct Show {
    /// The scenario file.
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Seed of the jitter.
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,

    /// Value of a name of the sweep; the first of its list if not given.
    #[arg(long = "value", value_name = "NAME=VALUE", value_parser = value)]
    values: Vec<(String, Value)>,

    /// Accept twins, tracks and maps whose hashes differ from those that the scenario names.
    #[arg(long)]
    latest: bool,

    #[command(flatten)]
    twins: Twins,
}

impl Show {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let opened = opened(&self.file, &catalog)?;
        let mut values = opened.document.first_values();
        values.extend(given_values(&self.values));
        let file = opened.document.with(&values)?;
        let version = (&opened.version.manifest, opened.version.hash.as_str());
        let assets = StoredAssets::new(&catalog);
        let loaded = opened.scenarios.resolve(file, self.seed, version, self.latest, &assets)?;
        let shown = serde_json::json!({
            "hash": loaded.hash,
            "scenario": loaded.scenario.file,
        });
        writeln!(output::stdout(), "{shown:#}")?;
        Ok(())
    }
}
