//! `wildcity twin rollback`.

use std::io::{self, Write};

use crate::cli::directories::Twins;

/// Make an old version of a twin the latest, under a new number.
///
/// Nothing of what came since is lost: rolling back to the former latest undoes it. Sessions that are
/// open keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "Example:\n  wildcity twin rollback street 3")]
pub(super) struct Rollback {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Number of the version that comes back.
    #[arg(value_name = "NUMBER")]
    number: u64,

    #[command(flatten)]
    twins: Twins,
}

impl Rollback {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let version = self.twins.catalog()?.rollback(&self.twin, self.number)?;
        let (name, number, hash) = (self.twin, version.number, version.hash);
        writeln!(io::stdout(), "twin {name} version {number} is version {}: {hash}", self.number)?;
        Ok(())
    }
}
