//! `wildcity twin list`.

use std::io::{self, Write};

use crate::cli::directories::Twins;

/// List all twins with their latest versions.
#[derive(Debug, clap::Args)]
pub(super) struct List {
    #[command(flatten)]
    twins: Twins,

    /// Print one JSON object a line: name, number, hash.
    #[arg(long)]
    json: bool,
}

impl List {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        for twin in self.twins.catalog()?.twins()? {
            let (name, number, hash) = (&twin.name, twin.number, &twin.hash);
            if self.json {
                let line = serde_json::json!({ "name": name, "number": number, "hash": hash });
                writeln!(out, "{line}")?;
            } else {
                writeln!(out, "{name:<24} version {number:<6} {hash}")?;
            }
        }
        Ok(())
    }
}
