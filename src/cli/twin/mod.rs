//! `wildcity twin`.

mod align;
mod change;
mod diff;
mod drive;
mod fsck;
mod gc;
mod generate;
mod geo;
mod list;
mod log;
mod rollback;
mod sky;
#[cfg(feature = "eval")]
mod views;

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

#[derive(Debug, clap::Subcommand)]
enum Subcommand {
    List(list::List),
    Generate(generate::Generate),
    Log(log::Log),
    Diff(diff::Diff),
    Rollback(rollback::Rollback),
    Gc(gc::Gc),
    Fsck(fsck::Fsck),
    Sky(sky::Sky),
    #[cfg(feature = "eval")]
    Views(Box<views::Views>),
    Geo(geo::Geo),
    Align(align::Align),
    Drive(drive::Drive),
}

impl Twin {
    pub(super) fn run(self) -> anyhow::Result<()> {
        match self.subcommand {
            Subcommand::List(list) => list.run(),
            Subcommand::Generate(generate) => generate.run(),
            Subcommand::Log(log) => log.run(),
            Subcommand::Diff(diff) => diff.run(),
            Subcommand::Rollback(rollback) => rollback.run(),
            Subcommand::Gc(gc) => gc.run(),
            Subcommand::Fsck(fsck) => fsck.run(),
            Subcommand::Sky(sky) => sky.run(),
            #[cfg(feature = "eval")]
            Subcommand::Views(views) => views.run(),
            Subcommand::Geo(geo) => geo.run(),
            Subcommand::Align(align) => align.run(),
            Subcommand::Drive(drive) => drive.run(),
        }
    }
}
