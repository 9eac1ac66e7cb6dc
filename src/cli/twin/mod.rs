//! `wildcity twin`.

mod align;
mod change;
mod copy;
mod diff;
mod drive;
mod fsck;
mod gc;
mod generate;
mod geo;
mod label;
mod list;
mod log;
mod remove;
mod rollback;
mod sky;
#[cfg(feature = "eval")]
pub(super) mod views;

/// List, generate, check and clean up twins, and manage their versions.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin list
  wildcity twin log street
  wildcity twin fsck street")]
pub(super) struct Twin {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    List(list::List),
    Generate(generate::Generate),
    Log(log::Log),
    Diff(diff::Diff),
    Rollback(rollback::Rollback),
    Gc(gc::Gc),
    Copy(copy::Copy),
    Rename(copy::Rename),
    Remove(remove::Remove),
    Fsck(fsck::Fsck),
    Sky(sky::Sky),
    #[cfg(feature = "eval")]
    Views(Box<views::Views>),
    Geo(geo::Geo),
    Label(label::Label),
    Align(align::Align),
    Drive(drive::Drive),
}

impl Twin {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
