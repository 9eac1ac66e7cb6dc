//! `wildcity twin rollback`.

use std::io::Write;

use crate::cli::directories::Twins;
use crate::cli::output;

/// Make an old version of a twin the latest version again, under a new number.
///
/// Later versions are not lost: roll back to the former latest version to undo this. Open sessions
/// keep the version that they have.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "Example:\n  wildcity twin rollback street 3")]
pub(super) struct Rollback {
    /// The twin's name.
    #[arg(value_name = "TWIN")]
    twin: String,

    /// Number of the old version.
    #[arg(value_name = "NUMBER")]
    number: u64,

    #[command(flatten)]
    twins: Twins,
}

impl Rollback {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let version = self.twins.catalog()?.rollback(&self.twin, self.number)?;
        writeln!(
            output::stdout(),
            "twin {} version {} has the content of version {}\nblake3 {}",
            self.twin,
            version.number,
            self.number,
            version.hash
        )?;
        Ok(())
    }
}
