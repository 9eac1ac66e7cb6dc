//! `wildcity alpasim`.

mod export;

/// Files for AlpaSim.
#[derive(Debug, clap::Args)]
pub(super) struct Alpasim {
    #[command(subcommand)]
    command: Command,
}

super::subcommands! {
    Command;
    Export(export::Export),
}

impl Alpasim {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.command.run()
    }
}
