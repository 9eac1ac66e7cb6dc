//! `wildcity log`.

mod check;
mod export;
mod generate;
mod show;
mod split;

/// Make, check, cut and convert logs: recorded drives with their images, LiDAR, poses and tracks.
///
/// A log is a folder in the format wildcity.log/1 (docs/logs.md). `python -m wildcity.logs` makes
/// one of a data set or a bag.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity log generate demo --out log --length-m 30
  wildcity log check log
  wildcity log split log --out parts
  wildcity log export log --out capture")]
pub(super) struct LogCommand {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    Show(show::Show),
    Check(check::Check),
    Split(split::SplitCommand),
    Export(export::Export),
    Generate(Box<generate::Generate>),
}

impl LogCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
