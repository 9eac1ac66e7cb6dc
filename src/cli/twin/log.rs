//! `wildcity twin log`.

use std::io::{self, Write};

use crate::cli::directories::Twins;
use crate::cli::time::utc;
use wildcity_twin::store::{CommitKind, LogEntry};

/// Show all versions of a twin, oldest first: when and how each was made, and from which version.
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

    /// Print one JSON object per line: number, hash, created_us, kind, parent, commit.
    #[arg(long)]
    json: bool,
}

impl Log {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        for entry in self.twins.catalog()?.versions(&self.twin)? {
            let LogEntry { number, hash, created_us, commit, parent, kind } = entry;
            if self.json {
                let line = serde_json::json!({
                    "number": number, "hash": hash, "created_us": created_us, "kind": kind,
                    "parent": parent, "commit": commit,
                });
                writeln!(out, "{line}")?;
            } else {
                let from = parent.map_or(String::new(), |parent| format!(" of {parent}"));
                // A new file has no parent: an import of a version is an edit of it, such as an alignment.
                let edited = kind == CommitKind::Import && parent.is_some();
                let how = if edited { format!("edit{from}") } else { format!("{kind}{from}") };
                let when = utc(created_us);
                writeln!(out, "{number:>6}  {when}  {how:<16}  {hash}")?;
            }
        }
        Ok(())
    }
}
