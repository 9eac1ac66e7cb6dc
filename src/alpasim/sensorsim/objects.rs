//! The assets of dynamic objects that were drawn lately.
//!
//! A rollout asks for the same objects ten times a second: an asset stays in memory for [`limits::SCENE_IDLE`], so that
//! neither is a box made nor an asset read again.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::Mutex;

use wildcity_scene::geometry::Pose;
use wildcity_session::{Engine, StillActor, StillAsset};

use super::status::SensorsimError;
use crate::limits;
use crate::object::{ObjectLook, actor_of_centre};
use crate::scene::{LocalFrame, SceneError};
use crate::wire::sensorsim as wire;

/// Assets by what follows the `@` of a track's id.
#[derive(Default)]
pub(super) struct ObjectAssets(Mutex<BTreeMap<String, (StillAsset, Instant)>>);

/// A dynamic object of a request: what it is drawn from, and the poses of the middle of its box in the world.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Object {
    id: String,
    look: ObjectLook,
    world_from_centre: Pose,
    world_from_centre_at_start: Pose,
}

impl Object {
    /// An object of a request.
    ///
    /// # Errors
    /// Its id stands for nothing, or a pose is missing or invalid.
    pub(super) fn read(
        object: &wire::DynamicObject,
        frame: &LocalFrame,
    ) -> Result<Self, SensorsimError> {
        let look = ObjectLook::of_track(&object.track_id)?;
        let field = "dynamic_objects.pose_pair";
        let pair = object.pose_pair.ok_or(SceneError::Missing { field })?;
        let end = frame.world_from("dynamic_objects.pose_pair.end_pose", pair.end_pose.as_ref())?;
        let start = match &pair.start_pose {
            Some(start) => frame.world_from("dynamic_objects.pose_pair.start_pose", Some(start))?,
            None => end,
        };
        let id = object.track_id.clone();
        Ok(Self { id, look, world_from_centre: end, world_from_centre_at_start: start })
    }

    /// Whether its id does not say what it is.
    pub(super) fn is_unknown(&self) -> bool {
        self.look == ObjectLook::Unknown
    }

    /// What follows the `@` of its id.
    fn key(&self) -> &str {
        self.id.rsplit_once('@').map_or("", |(_, look)| look)
    }
}

impl ObjectAssets {
    /// What is drawn of some objects.
    ///
    /// # Errors
    /// There is no such asset, or too little memory for it.
    pub(super) async fn actors(
        &self,
        engine: &Arc<Engine>,
        objects: &[Object],
    ) -> Result<Vec<StillActor>, SensorsimError> {
        let mut actors = Vec::with_capacity(objects.len());
        for object in objects {
            let asset = self.asset(engine, object).await?;
            let size = asset.asset().description.box_;
            actors.push(StillActor {
                world_from_actor: actor_of_centre(&object.world_from_centre, &size),
                world_from_actor_at_start: actor_of_centre(
                    &object.world_from_centre_at_start,
                    &size,
                ),
                asset,
            });
        }
        Ok(actors)
    }

    async fn asset(
        &self,
        engine: &Arc<Engine>,
        object: &Object,
    ) -> Result<StillAsset, SensorsimError> {
        // Held while an asset is read, so that simultaneous requests read it once.
        let mut known = self.0.lock().await;
        if let Some((asset, drawn)) = known.get_mut(object.key()) {
            *drawn = Instant::now();
            return Ok(asset.clone());
        }
        let asset = match &object.look {
            ObjectLook::Asset(name) => StillAsset::Stored(engine.open_actor(name.clone()).await?),
            look => {
                let made = look.made().map_err(|error| SensorsimError::Invalid(error.to_string()));
                let none = || SensorsimError::Invalid(format!("{:?} is no box", object.id));
                StillAsset::Made(Arc::new(made?.ok_or_else(none)?))
            }
        };
        if known.len() >= limits::OBJECT_ASSETS {
            let oldest = known.iter().min_by_key(|(_, (_, drawn))| *drawn);
            let oldest = oldest.map(|(key, _)| key.clone());
            oldest.and_then(|key| known.remove(&key));
        }
        known.insert(object.key().to_owned(), (asset.clone(), Instant::now()));
        Ok(asset)
    }

    /// Forgets the assets that were not drawn for [`limits::SCENE_IDLE`].
    pub(super) async fn forget_idle(&self) {
        self.0.lock().await.retain(|_, (_, drawn)| drawn.elapsed() < limits::SCENE_IDLE);
    }
}
