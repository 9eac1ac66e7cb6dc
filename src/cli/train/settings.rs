//! `wildcity train settings`.

use std::io::Write;

use crate::cli::output;
use wildcity_train::settings::Settings;

/// Print all settings of training with their defaults, as a file for --settings.
#[derive(Debug, clap::Args)]
#[command(after_long_help = EXAMPLE)]
pub(in crate::cli) struct PrintSettings {}

const EXAMPLE: &str = "\
Example:
  wildcity train settings > train.toml";

impl PrintSettings {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let text = Settings::default().to_commented_toml()?;
        write!(output::stdout(), "{text}")?;
        Ok(())
    }
}
