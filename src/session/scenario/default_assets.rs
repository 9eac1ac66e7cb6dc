//! The assets of actors that name none: generated models, stored like all others, since records
//! name them by hash.

use wildcity_generate::{ACTOR_REVISION, ActorModel, actor_models};
use wildcity_scene::actor::{ActorAsset, AssetDescription};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass, RecordFormat};
use wildcity_twin::store::{Catalog, StoredActor};

/// The generated assets of all models, made if need be. Those that exist already stay as they are.
///
/// # Errors
/// The store cannot be read, or an asset that is missing cannot be written.
pub fn generated_actors(catalog: &Catalog) -> Result<Vec<StoredActor>, String> {
    let source = |name: &str| format!("generated {name}, revision {ACTOR_REVISION}");
    let stored = catalog.actors().map_err(|error| error.to_string())?.actors;
    let mut all = Vec::new();
    let mut missing = Vec::new();
    for name in ActorModel::NAMES {
        // By the source and not by the name, which any asset may have. One of another revision is
        // missing.
        match stored.iter().find(|actor| actor.description.provenance.source == source(name)) {
            Some(actor) => all.push(actor.clone()),
            None => missing.push(name),
        }
    }
    // In most cases; then no model is made.
    if missing.is_empty() {
        return Ok(all);
    }
    for ActorModel { name, class, box_, gaussians } in actor_models() {
        if missing.contains(&name) {
            let provenance = Provenance::new(source(name));
            let description = AssetDescription { name: name.to_owned(), class, box_, provenance };
            let asset =
                ActorAsset::new(&gaussians, description).map_err(|error| error.to_string())?;
            let stored = catalog.put_actor(&asset, RecordFormat::default());
            all.push(stored.map_err(|error| error.to_string())?);
        }
    }
    Ok(all)
}

/// The asset of a class whose size is the nearest: with the least sum of the logarithms of the
/// ratios of length, width and height.
pub(super) fn nearest<'a>(
    actors: &'a [StoredActor],
    class: ActorClass,
    box_: &ActorBox,
) -> Option<&'a StoredActor> {
    let apart = |actor: &StoredActor| {
        // By logarithms, half as long is as far off as twice as long.
        actor.description.box_.ratios(box_).map(|ratio| ratio.ln().abs()).iter().sum::<f64>()
    };
    let of_class = actors.iter().filter(|actor| actor.description.class == class);
    of_class.min_by(|a, b| apart(a).total_cmp(&apart(b)))
}
