//! `wildcity twin`.

mod align;
pub(super) mod blind;
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
mod map;
mod remove;
mod rig;
mod rollback;
mod route;
mod show;
mod sky;
#[cfg(feature = "eval")]
pub(super) mod views;

#[cfg(feature = "convert")]
pub(super) use map::origin as map_origin;
pub(super) use rig::find_rig;

/// List, show, generate, check and clean up twins; their versions, cameras, drives and maps.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin list
  wildcity twin show street
  wildcity twin log street
  wildcity twin fsck street")]
pub(super) struct Twin {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    List(list::List),
    Show(show::Show),
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
    Rig(rig::RigCommand),
    Route(route::Route),
    Map(map::MapCommand),
}

impl Twin {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
