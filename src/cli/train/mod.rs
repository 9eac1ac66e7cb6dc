//! `wildcity train`.

mod check;

use super::subcommands::subcommands;

/// Train twins: check the gradients of this machine.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub(super) struct Train {
    #[command(subcommand)]
    command: TrainCommand,
}

subcommands! { TrainCommand;
    Check(check::Check),
}

impl Train {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.command.run()
    }
}
