//! `wildcity twin log`.

use std::io::{self, Write};

use crate::cli::directories::Twins;
use crate::cli::output;
use crate::cli::time::utc;
use wildcity_twin::store::{LogEntry, StoreError};

/// Show all versions of a twin, oldest first: when and how each was made, from which version, and
/// the note of its push.
#[derive(Debug, clap::Args)]
#[command(
    after_long_help = "Examples:\n  wildcity twin log street\n  wildcity twin log street --json | jq .created_us"
)]
pub(super) struct Log {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    twins: Twins,

    /// Print one JSON object per line: number, hash, created_us, kind, parent, commit, note.
    #[arg(long)]
    json: bool,
}

impl Log {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        let catalog = self.twins.catalog()?;
        for entry in catalog.versions(&self.twin)? {
            // Older builds, which did not show notes, gave edits the note of their base.
            let is_edit = entry.is_edit();
            let how = entry.kind_name();
            let note = match catalog.provenance(&self.twin, &entry) {
                Ok(provenance) => provenance.note().filter(|_| !is_edit).map(str::to_owned),
                Err(StoreError::GarbageCollected { .. }) => None,
                Err(error) => {
                    writeln!(io::stderr(), "version {}: no note: {error}", entry.number)?;
                    None
                }
            };
            let LogEntry { number, hash, created_us, commit, parent, .. } = entry;
            if self.json {
                let line = serde_json::json!({
                    "number": number, "hash": hash, "created_us": created_us, "kind": how,
                    "parent": parent, "commit": commit, "note": note,
                });
                writeln!(out, "{line}")?;
            } else {
                let from = parent.map_or(String::new(), |parent| format!(" of {parent}"));
                let how = format!("{how}{from}");
                let when = utc(created_us);
                // A note may have several lines; a version has one.
                let note = note.map(|note| format!("  {}", note.replace(char::is_control, " ")));
                let note = note.unwrap_or_default();
                writeln!(out, "{number:>6}  {when}  {how:<16}  {hash}{note}")?;
            }
        }
        Ok(())
    }
}
