//! `wildcity actor`.

mod asset_options;
mod cut;
mod generate;
mod import;
mod list;
mod picture;
#[cfg(feature = "http")]
mod push;
mod remove;
mod show;
mod summary;

pub(in crate::cli) use cut::{Region, swept};

/// Make, list, show and remove assets of actors, from which other vehicles and pedestrians are
/// rendered.
///
/// Assets are stored next to the twins, and all twins share them. An asset is identified by the
/// BLAKE3 of its content.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity actor import car.glb --axes '0 0 1 1 0 0 0 1 0'
  wildcity actor push car.glb --axes '0 0 1 1 0 0 0 1 0' --server http://sim:8080
  wildcity actor generate
  wildcity actor list
  wildcity actor show car --picture car.png
  wildcity actor remove car")]
pub(super) struct Actor {
    #[command(subcommand)]
    subcommand: Subcommand,
}

super::subcommands! {
    Subcommand;
    Import(import::Import),
    #[cfg(feature = "http")]
    Push(push::Push),
    Generate(generate::Generate),
    List(list::List),
    Show(show::Show),
    Remove(remove::Remove),
    Cut(cut::Cut),
}

impl Actor {
    pub(super) fn run(self) -> anyhow::Result<()> {
        self.subcommand.run()
    }
}
