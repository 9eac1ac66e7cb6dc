//! The assets of dynamic objects that were drawn recently.
//!
//! A rollout requests the same objects ten times a second. So an asset stays in memory for
//! [`limits::SCENE_IDLE`], and is not made or read again. Names are resolved anew for every
//! request, because an asset may be removed, and its name given to another one.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use parking_lot::Mutex;

use wildcity_scene::geometry::Pose;
use wildcity_session::{Engine, SessionError, StillActor};
use wildcity_twin::residency::{ResidencyError, ResidentActor};

use super::status::SensorsimError;
use crate::limits;
use crate::object::{ObjectShape, actor_of_centre};
use crate::scene::{LocalFrame, SceneError};
use crate::wire::sensorsim as wire;

/// Assets and the times when they were last drawn, by hash for assets of the store, and by key for
/// boxes.
#[derive(Default)]
pub(super) struct ObjectAssets(Mutex<BTreeMap<String, (Arc<ResidentActor>, Instant)>>);

/// A dynamic object of a request: its shape, and the poses of the middle of its box in the world.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Object {
    shape: ObjectShape,
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
        let shape = ObjectShape::from_track(&object.track_id)?;
        let field = "dynamic_objects.pose_pair";
        let pair = object.pose_pair.ok_or(SceneError::Missing { field })?;
        let end = frame.world_from("dynamic_objects.pose_pair.end_pose", pair.end_pose.as_ref())?;
        // Without a pose at the start the object is at rest during the exposure.
        let start = match &pair.start_pose {
            Some(start) => frame.world_from("dynamic_objects.pose_pair.start_pose", Some(start))?,
            None => end,
        };
        Ok(Self { shape, world_from_centre: end, world_from_centre_at_start: start })
    }

    /// Whether its id does not describe the object.
    pub(super) fn is_unknown(&self) -> bool {
        self.shape == ObjectShape::Unknown
    }
}

impl ObjectAssets {
    /// The actors to draw for some objects.
    ///
    /// # Errors
    /// There is no such asset, or too little memory for it.
    pub(super) async fn actors(
        self: &Arc<Self>,
        engine: &Arc<Engine>,
        objects: &[Object],
    ) -> Result<Vec<StillActor>, SensorsimError> {
        // Without objects no thread is needed.
        if objects.is_empty() {
            return Ok(Vec::new());
        }
        let shapes: Vec<ObjectShape> = objects.iter().map(|object| object.shape.clone()).collect();
        let own = self.clone();
        let engine = engine.clone();
        // Assets may be read from disk or made, neither of which an async thread must do.
        let read = tokio::task::spawn_blocking(move || own.assets(&engine, &shapes));
        let assets = read.await.map_err(|_| SessionError::Crashed)??;
        let placed = objects.iter().zip(assets).map(|(object, asset)| {
            // The size of the asset, and not that of the id: an id with a name has none.
            let size = asset.asset().description.box_;
            StillActor {
                world_from_actor: actor_of_centre(&object.world_from_centre, &size),
                world_from_actor_at_start: actor_of_centre(
                    &object.world_from_centre_at_start,
                    &size,
                ),
                asset,
            }
        });
        Ok(placed.collect())
    }

    /// The asset of each shape. Equal shapes are looked up once.
    fn assets(
        &self,
        engine: &Engine,
        shapes: &[ObjectShape],
    ) -> Result<Vec<Arc<ResidentActor>>, SensorsimError> {
        let mut by_key: BTreeMap<String, Arc<ResidentActor>> = BTreeMap::new();
        let mut assets = Vec::with_capacity(shapes.len());
        for shape in shapes {
            let key = shape.key();
            let asset = match by_key.get(&key) {
                Some(asset) => asset.clone(),
                None => {
                    let asset = self.asset(engine, shape, &key)?;
                    by_key.insert(key, asset.clone());
                    asset
                }
            };
            assets.push(asset);
        }
        Ok(assets)
    }

    fn asset(
        &self,
        engine: &Engine,
        shape: &ObjectShape,
        key: &str,
    ) -> Result<Arc<ResidentActor>, SensorsimError> {
        // The asset of a box or of a complete hash. Names are not keys.
        if let Some(asset) = self.known(key) {
            return Ok(asset);
        }
        let made = shape.box_asset().map_err(|error| SensorsimError::Invalid(error.to_string()))?;
        if let Some(box_asset) = made {
            return self.load(key, || engine.hold_actor(key, box_asset.clone()));
        }
        // From the name, or the first characters of a hash, to the hash, which is the key.
        let hash = engine.catalog().find_actor(key).map_err(SessionError::from)?.hash;
        match self.known(&hash) {
            Some(asset) => Ok(asset),
            None => self.load(&hash, || engine.actor(&hash)),
        }
    }

    fn known(&self, key: &str) -> Option<Arc<ResidentActor>> {
        let mut known = self.0.lock();
        let (asset, drawn) = known.get_mut(key)?;
        *drawn = Instant::now();
        Some(asset.clone())
    }

    /// Loads an asset into memory. If there is too little memory, drops assets that no request
    /// draws, and tries once more.
    fn load(
        &self,
        key: &str,
        load: impl Fn() -> Result<Arc<ResidentActor>, SessionError>,
    ) -> Result<Arc<ResidentActor>, SensorsimError> {
        let asset = match load() {
            // A count of 1 is the map's own reference. A request in progress holds another one.
            Err(SessionError::Residency(ResidencyError::NoRoomForActor { .. })) => {
                self.0.lock().retain(|_, (asset, _)| Arc::strong_count(asset) > 1);
                load()?
            }
            loaded => loaded?,
        };
        let mut known = self.0.lock();
        // The oldest leaves. 384 entries are searched in microseconds, so no list in order of use
        // is kept.
        if !known.contains_key(key) && known.len() >= limits::OBJECT_ASSETS {
            let oldest =
                known.iter().min_by_key(|(_, (_, drawn))| *drawn).map(|(key, _)| key.clone());
            oldest.and_then(|key| known.remove(&key));
        }
        known.insert(key.to_owned(), (asset.clone(), Instant::now()));
        Ok(asset)
    }

    /// Drops the assets that were not drawn for [`limits::SCENE_IDLE`].
    pub(super) fn forget_idle(&self) {
        self.0.lock().retain(|_, (_, drawn)| drawn.elapsed() < limits::SCENE_IDLE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_twin::residency::Cache;
    use wildcity_twin::store::Catalog;

    /// If there is too little memory, only assets that no request draws are dropped.
    #[test]
    fn assets_that_no_request_draws_make_room() {
        let shape = ObjectShape::from_track("7@4x2x1").unwrap();
        let asset = shape.box_asset().unwrap().unwrap();
        let dir = tempfile::tempdir().unwrap();
        // The memory holds two assets, so that the third one needs the room of another.
        let cache = Cache::limited(Catalog::open(dir.path()).unwrap(), Some(2 * asset.bytes()));
        let assets = ObjectAssets::default();
        let load = |key: &str| assets.load(key, || Ok(cache.hold_actor(key, asset.clone())?));
        let drawn = load("drawn").unwrap();
        drop(load("idle").unwrap());
        let third = load("third").unwrap();
        let known = |key: &str| assets.known(key).is_some();
        assert!(known("drawn") && !known("idle") && known("third"));
        assert_eq!(cache.stats().reserved_bytes, 2 * asset.bytes());

        // All assets in memory are being drawn, so the request is refused, and no asset is dropped.
        let refused = load("fourth").unwrap_err();
        assert!(refused.to_string().contains("memory"), "{refused}");
        assert!(known("drawn") && known("third") && !known("fourth"));
        drop((drawn, third));
        load("fourth").unwrap();
        assert!(known("fourth") && !known("drawn") && !known("third"));
    }
}
