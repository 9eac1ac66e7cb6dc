//! Assets of actors.

use crate::fault::Fault;
use wildcity_protocol::http;
use wildcity_push::{AssetRequest, AssetSettings, limits};
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_twin::store::{ActorList, DamagedActor, StoredActor, StoredLevel};

use super::http::{parse_field, requested_files};
use super::mistake::read_body;

/// The body of `POST /v1/actors`, checked as far as it can be without the files.
pub(crate) fn new_actor(body: &[u8]) -> Result<AssetRequest, Fault> {
    let http::NewActor { name, class, files, gaussians, record } = read_body(body)?;
    let request = AssetRequest {
        files: requested_files(files)?,
        settings: AssetSettings {
            name,
            class: match class {
                http::ActorClass::Vehicle => ActorClass::Vehicle,
                http::ActorClass::Pedestrian => ActorClass::Pedestrian,
                http::ActorClass::Bicycle => ActorClass::Bicycle,
                http::ActorClass::Object => ActorClass::Object,
            },
            // The default is chosen here, so that the provenance always has a number.
            mesh_gaussians: gaussians.unwrap_or(limits::ACTOR_MESH_GAUSSIANS),
            record: record
                .map(|text| parse_field("record", &text))
                .transpose()?
                .unwrap_or_default(),
        },
    };
    // Before any upload is looked up: a refused request pins no file.
    request.check()?;
    Ok(request)
}

/// The body of `GET /v1/actors`.
pub(crate) fn actors(list: &ActorList, with_provenance: bool) -> http::ActorList {
    let damaged = |damaged: &DamagedActor| {
        let DamagedActor { hash, name, reason } = damaged.clone();
        http::DamagedActor { hash, name, reason }
    };
    http::ActorList {
        actors: list.actors.iter().map(|one| actor(one, with_provenance)).collect(),
        damaged: list.damaged.iter().map(damaged).collect(),
    }
}

/// An asset. Its provenance may name a twin.
pub(crate) fn actor(actor: &StoredActor, with_provenance: bool) -> http::ActorAsset {
    let description = &actor.description;
    let ActorBox { length_m, width_m, height_m } = description.box_;
    let Provenance { source, builder, options } = description.provenance.clone();
    let provenance = http::ActorProvenance { source, builder, options };
    let level = |level: &StoredLevel| http::ActorLevel {
        gaussians: level.count.into(),
        error_m: level.error_m,
        bytes: level.bytes.into(),
    };
    http::ActorAsset {
        hash: actor.hash.clone(),
        name: description.name.clone(),
        class: match description.class {
            ActorClass::Vehicle => http::ActorClass::Vehicle,
            ActorClass::Pedestrian => http::ActorClass::Pedestrian,
            ActorClass::Bicycle => http::ActorClass::Bicycle,
            ActorClass::Object => http::ActorClass::Object,
        },
        box_: http::ActorBox { length_m, width_m, height_m },
        // A token that is limited to some twins must not learn the names of others.
        provenance: Some(provenance).filter(|_| with_provenance),
        gaussians: actor.gaussians(),
        sh_degree: actor.sh_degree,
        record: actor.record.to_string(),
        bytes: actor.bytes,
        levels: actor.levels.iter().map(level).collect(),
    }
}
