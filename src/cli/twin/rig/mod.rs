//! `wildcity twin rig`.

mod check;
mod draw;
mod lookup;
mod show;

pub(in crate::cli) use lookup::find_rig;

/// Show the cameras of a rig, draw them, and check that their images show points where they should.
///
/// RIG is a preset (see `wildcity twin rig show`), or a JSON file as `wildcity import --rig` reads
/// it.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin rig show
  wildcity twin rig check alpamayo2
  wildcity twin rig draw vehicle6 --out vehicle6.svg")]
pub(super) struct RigCommand {
    #[command(subcommand)]
    subcommand: Subcommand,
}

crate::cli::subcommands! {
    Subcommand;
    Show(show::Show),
    Check(check::Check),
    Draw(draw::Draw),
}

impl RigCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
