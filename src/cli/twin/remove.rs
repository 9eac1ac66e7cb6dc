//! `wildcity twin remove`.

use std::io::Write;

use crate::cli::directories::Twins;
use crate::cli::output;

/// Remove a twin with all of its versions.
///
/// Nothing is removed while a server uses a version of it. Recorded episodes stay, and can no
/// longer be rendered again. Assets of actors stay: all twins share them.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Example:
  wildcity twin remove old-street")]
pub(super) struct Remove {
    /// Name of the twin.
    #[arg(value_name = "TWIN")]
    twin: String,

    #[command(flatten)]
    twins: Twins,
}

impl Remove {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.twins.catalog()?.remove(&self.twin)?;
        writeln!(output::stdout(), "removed twin {}", self.twin)?;
        Ok(())
    }
}
