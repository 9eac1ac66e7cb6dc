//! `wildcity actor list`.

use std::io::Write;

use wildcity_scene::ActorBox;
use wildcity_twin::store::{ActorList, DamagedActor};

use crate::cli::directories::Twins;
use crate::cli::output;

/// List the assets of actors: name, class, size, Gaussians, and hash. An asset that cannot be read
/// is listed as damaged with the reason: make it again, or remove it, unless the disk or the object
/// store failed.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity actor list
  wildcity actor list --twins s3://city/twins")]
pub(super) struct List {
    #[command(flatten)]
    twins: Twins,
}

impl List {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let catalog = self.twins.catalog()?;
        let ActorList { actors, damaged } = catalog.actors()?;
        let mut out = output::stdout();
        if actors.is_empty() && damaged.is_empty() {
            writeln!(
                out,
                "no actors in {}: make one with `wildcity actor import`",
                catalog.dir().display()
            )?;
        }
        for actor in actors {
            let ActorBox { length_m, width_m, height_m } = actor.description.box_;
            writeln!(
                out,
                "{:<20} {:<10} {length_m:.2} x {width_m:.2} x {height_m:.2} m {:>9} Gaussians  {}",
                actor.description.name,
                actor.description.class.name(),
                actor.gaussians(),
                actor.hash,
            )?;
        }
        for DamagedActor { hash, name, reason } in damaged {
            let name = name.as_deref().unwrap_or("-");
            writeln!(out, "{name:<20} damaged: {reason}  {hash}")?;
        }
        Ok(())
    }
}
