//! `wildcity train`.

mod check;

/// Train twins: check the gradients of this machine.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub(super) struct Train {
    #[command(subcommand)]
    command: TrainCommand,
}

#[derive(Debug, clap::Subcommand)]
enum TrainCommand {
    Check(check::Check),
}

impl Train {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.command {
            TrainCommand::Check(command) => command.run(),
        }
    }
}
