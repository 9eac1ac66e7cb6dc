//! Twins with reserved memory.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::Mutex;

use wildcity_session::{Engine, StillViews, Stills};
use wildcity_twin::residency::Resident;

use super::status::SensorsimError;
use crate::limits;

/// A version of a twin, and the memory for its worst frame.
struct OpenVersion {
    stills: Arc<Stills>,
    /// The scenes that were drawn, with the time of the last frame.
    scenes: BTreeMap<String, Instant>,
}

/// The versions that were drawn in the last [`limits::SCENE_IDLE`].
#[derive(Default)]
pub(super) struct OpenVersions {
    versions: Mutex<BTreeMap<(String, u64), OpenVersion>>,
    /// Scenes that were requested with unknown objects, each logged once.
    warned: parking_lot::Mutex<BTreeSet<String>>,
}

impl OpenVersions {
    /// Returns the renderer of a version, with enough memory for these views.
    ///
    /// # Errors
    /// Too many versions are open, or too little memory is left.
    pub(super) async fn stills(
        &self,
        engine: &Arc<Engine>,
        resident: Arc<Resident>,
        scene: &str,
        views: StillViews<'_>,
    ) -> Result<Arc<Stills>, SensorsimError> {
        let version = &resident.version;
        let key = (version.manifest.twin.clone(), version.number);
        // Held while memory is reserved, so that simultaneous requests reserve it once.
        let mut open = self.versions.lock().await;
        if !open.contains_key(&key) && open.len() >= limits::OPEN_SCENES {
            let oldest = open
                .iter()
                .min_by_key(|(_, version)| version.last_drawn())
                .map(|(key, _)| key.clone());
            oldest.and_then(|key| open.remove(&key));
        }
        // Taken out, so that its reservation can be dropped before the larger one is made.
        let known = open.remove(&key);
        let enough = match &known {
            Some(version) => version.stills.covers(views).await?,
            None => false,
        };
        let mut scenes = known.as_ref().map(|version| version.scenes.clone()).unwrap_or_default();
        // The scenes of the version outlive a change of its reservation.
        scenes.insert(scene.to_owned(), Instant::now());
        if scenes.len() > limits::DRAWN_SCENES {
            // The list is for display: the one that was drawn first is left out.
            let first = scenes.iter().min_by_key(|(_, drawn)| **drawn);
            let oldest = first.map(|(scene, _)| scene.clone());
            oldest.and_then(|scene| scenes.remove(&scene));
        }
        let stills = match known {
            Some(version) if enough => version.stills,
            // The smaller reservation is dropped first, so that its memory counts as free.
            other => {
                drop(other);
                Arc::new(Stills::open(engine.clone(), resident, views).await?)
            }
        };
        open.insert(key, OpenVersion { stills: stills.clone(), scenes });
        Ok(stills)
    }

    /// The scenes that were drawn in the last [`limits::SCENE_IDLE`].
    pub(super) async fn recent(&self) -> Vec<String> {
        let open = self.versions.lock().await;
        open.values().flat_map(|version| version.scenes.keys().cloned()).collect()
    }

    /// Logs, once per scene, that objects are drawn as grey boxes.
    pub(super) fn warn_of_unknown_objects(&self, scene: &str) {
        let mut warned = self.warned.lock();
        // Clients choose the starts of scenes freely, so the set has a bound.
        if warned.len() < limits::LISTED_SCENES && warned.insert(scene.to_owned()) {
            tracing::warn!(scene, "dynamic objects without an @ in their track_id are grey boxes");
        }
    }

    /// Drops scenes that were not drawn for [`limits::SCENE_IDLE`], and frees the memory of their
    /// versions.
    pub(super) async fn forget_idle(&self) {
        let mut open = self.versions.lock().await;
        open.retain(|_, version| {
            // The reservation belongs to the version, and goes with the last of its scenes.
            version.scenes.retain(|_, drawn| drawn.elapsed() < limits::SCENE_IDLE);
            !version.scenes.is_empty()
        });
    }
}

impl OpenVersion {
    fn last_drawn(&self) -> Option<Instant> {
        self.scenes.values().max().copied()
    }
}
