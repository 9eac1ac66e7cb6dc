//! `wildcity twin list`.

use std::io::Write;

use wildcity_twin::store::DamagedTwin;

use crate::cli::directories::Twins;
use crate::cli::output;

/// List all twins with the number and hash of their latest versions. A twin whose newest log record
/// cannot be read is listed as damaged; `wildcity twin fsck --repair` sets the record aside.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = "Examples:\n  wildcity twin list\n  wildcity twin list --twins s3://fleet/twins --json"
)]
pub(super) struct List {
    #[command(flatten)]
    twins: Twins,

    /// Print one JSON object per line: name, number, hash; or name, damaged.
    #[arg(long)]
    json: bool,
}

impl List {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        let list = self.twins.catalog()?.twins()?;
        for twin in list.twins {
            if self.json {
                let line = serde_json::json!({
                    "name": twin.name, "number": twin.number, "hash": twin.hash,
                });
                writeln!(out, "{line}")?;
            } else {
                writeln!(out, "{:<24} version {:<6} {}", twin.name, twin.number, twin.hash)?;
            }
        }
        // Listed and not an error: one damaged twin must not hide the others.
        for DamagedTwin { name, error } in list.damaged {
            if self.json {
                let line = serde_json::json!({ "name": name, "damaged": error.to_string() });
                writeln!(out, "{line}")?;
            } else {
                writeln!(out, "{name:<24} damaged: {error}")?;
            }
        }
        Ok(())
    }
}
