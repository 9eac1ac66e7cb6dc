//! `wildcity actor generate`, and the assets that the demo needs.

use std::io::{self, Write};

use wildcity_generate::{ACTOR_REVISION, ActorModel, actor_models};
use wildcity_scene::RecordFormat;
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::manifest::Provenance;
use wildcity_twin::store::{Catalog, StoredActor};

use crate::cli::directories::Twins;

/// Make the assets of the demo: a hatchback, a sedan, a van and a pedestrian.
///
/// They are made by a program, like the demo street, and lit from above, so that they fit every heading. Those that
/// exist already stay as they are.
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
        let mut out = io::stdout().lock();
        for actor in generated(&self.twins.catalog()?)? {
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

/// The assets of all generated models, made if need be.
pub(in crate::cli) fn generated(catalog: &Catalog) -> anyhow::Result<Vec<StoredActor>> {
    let source = |name: &str| format!("generated {name}, revision {ACTOR_REVISION}");
    let stored = catalog.actors()?.actors;
    let mut all = Vec::new();
    let mut missing = Vec::new();
    for name in ActorModel::NAMES {
        match stored.iter().find(|actor| actor.description.provenance.source == source(name)) {
            Some(actor) => all.push(actor.clone()),
            None => missing.push(name),
        }
    }
    if missing.is_empty() {
        return Ok(all);
    }
    for ActorModel { name, class, box_, gaussians } in actor_models() {
        if !missing.contains(&name) {
            continue;
        }
        let provenance = Provenance::of(source(name));
        let description = AssetDescription { name: name.to_owned(), class, box_, provenance };
        let asset = ActorAsset::new(&gaussians, description)?;
        all.push(catalog.put_actor(&asset, RecordFormat::default())?);
    }
    Ok(all)
}
