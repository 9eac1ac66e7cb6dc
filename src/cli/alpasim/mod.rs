//! `wildcity alpasim`.

mod drive;
mod export;

/// Drive with drivers of AlpaSim, and export scenes for its runtime.
///
/// `wildcity serve --alpasim` is a renderer for its runtime.
#[derive(Debug, clap::Args)]
pub(super) struct Alpasim {
    #[command(subcommand)]
    command: Command,
}

super::subcommands! {
    Command;
    Drive(Box<drive::Drive>),
    Export(export::Export),
}

impl Alpasim {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.command.run()
    }
}
