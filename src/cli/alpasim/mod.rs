//! `wildcity alpasim`.

mod export;

/// Files for AlpaSim.
#[derive(Debug, clap::Args)]
pub(super) struct Alpasim {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Export(export::Export),
}

impl Alpasim {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.command {
            Command::Export(command) => command.run(),
        }
    }
}
