//! `wildcity twin map`.

mod check;
#[cfg(feature = "convert")]
mod import;
mod strips;

#[cfg(feature = "convert")]
pub(in crate::cli) use import::origin;

/// Make and check maps: lanes and areas of a twin.
///
/// A twin needs no map. With one, actors can follow lanes, and scores can detect that an ego is off
/// the road.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity twin map import town.xodr --out town.map.json
  wildcity twin map strips street --left-m 5.2 --right-m 1.7 --out street.map.json
  wildcity twin map check street.map.json")]
pub(super) struct MapCommand {
    #[command(subcommand)]
    subcommand: Subcommand,
}

crate::cli::subcommands! {
    Subcommand;
    #[cfg(feature = "convert")]
    Import(import::Import),
    Strips(strips::Strips),
    Check(check::Check),
}

impl MapCommand {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
