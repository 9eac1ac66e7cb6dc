//! `wildcity actor remove`.

use std::io::Write;

use anyhow::Context as _;

use crate::cli::directories::Twins;
use crate::cli::output;

/// Remove an asset, to free disk space or its name.
///
/// Running episodes keep it in memory. Afterwards, scenarios that name it are refused, and recorded
/// episodes that show it cannot be replayed, until the same asset is made again. No twin changes.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity actor remove car --dry-run
  wildcity actor remove 9f0c21ab")]
pub(super) struct Remove {
    /// The asset: its name if no other has it, or the first digits of its hash; it may be damaged.
    #[arg(value_name = "ACTOR")]
    actor: String,

    /// Only print what would be removed.
    #[arg(long)]
    dry_run: bool,

    #[command(flatten)]
    twins: Twins,
}

impl Remove {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let removed = catalog.remove_actor(&self.actor, self.dry_run);
        let hash = removed.with_context(|| format!("{}", catalog.dir().display()))?;
        let removed = if self.dry_run { "would remove" } else { "removed" };
        writeln!(output::stdout(), "{removed} actor {}\nblake3 {hash}", self.actor)?;
        Ok(())
    }
}
