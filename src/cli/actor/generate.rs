//! `wildcity actor generate`.

use std::io::Write;

use wildcity_session::generated_actors;

use crate::cli::directories::Twins;
use crate::cli::output;

/// Make the assets of actors that name none: a hatchback, a sedan, a van, a truck, a bus, a
/// pedestrian, a cyclist and a crate.
///
/// A scenario that needs one makes it, too.
///
/// They are made by a program, like the demo street, and lit from above, so that they fit every
/// heading. Those that exist already stay as they are.
#[derive(Debug, clap::Args)]
#[command(after_long_help = "\
Examples:
  wildcity actor generate
  wildcity actor show sedan --picture sedan.png")]
pub(super) struct Generate {
    #[command(flatten)]
    twins: Twins,
}

impl Generate {
    pub(super) fn run(self) -> anyhow::Result<()> {
        let mut out = output::stdout();
        for actor in generated_actors(&self.twins.catalog()?).map_err(anyhow::Error::msg)? {
            writeln!(
                out,
                "actor {}: {}, {} Gaussians\nblake3 {}",
                actor.description.name,
                actor.description.class.name(),
                actor.gaussians(),
                actor.hash,
            )?;
        }
        Ok(())
    }
}
