//! Commits a whole version in one call, for scenes that are in memory.

use std::borrow::Cow;

use crate::ingest::IngestError;
use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Gaussians, RenderProfile, Rig, Trajectory};

use super::catalog::check_name;
use super::sky::NewSky;
use super::{Catalog, CommitKind, StorageOptions, StoreError, Version, VersionSettings};

/// The content of a new version of a twin.
#[derive(Clone, Debug)]
pub struct NewVersion<'a> {
    /// The twin's name, `[a-z0-9._-]+`; a new name makes a new twin.
    pub name: &'a str,
    /// The Gaussians, in metres along the twin's axes.
    ///
    /// Owned, their memory is freed as they are written.
    pub gaussians: Cow<'a, Gaussians>,
    /// How they must be rendered.
    pub profile: RenderProfile,
    /// The rig of the vehicle that recorded them.
    pub rig: Option<Rig>,
    pub trajectories: Vec<Trajectory>,
    /// The sky behind them.
    pub sky: Option<NewSky>,
    /// Where the world lies on the earth.
    pub geo: Option<GeoAnchor>,
    /// Where they come from.
    pub provenance: Provenance,
    /// How they are stored.
    pub storage: StorageOptions,
}

impl<'a> NewVersion<'a> {
    /// Only Gaussians, rendered and stored with defaults.
    pub fn from_gaussians(name: &'a str, gaussians: &'a Gaussians, provenance: Provenance) -> Self {
        Self {
            name,
            gaussians: Cow::Borrowed(gaussians),
            profile: RenderProfile::DEFAULT,
            rig: None,
            trajectories: Vec::new(),
            sky: None,
            geo: None,
            provenance,
            storage: StorageOptions::default(),
        }
    }
}

impl Catalog {
    /// Writes a version and makes it the latest, all or nothing. If the latest version has the same
    /// content, it is returned, and no new one is made. `progress` gets the number of Gaussians
    /// written and in all.
    ///
    /// # Errors
    /// Names what cannot be accepted, before anything is written; or as [`super::Commit::replace`].
    pub fn commit(
        &self,
        new: NewVersion<'_>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Version, StoreError> {
        let NewVersion {
            name,
            gaussians,
            profile,
            rig,
            trajectories,
            sky,
            geo,
            provenance,
            storage,
        } = new;
        check_name(name)?;
        // Before anything is written. `put` checks again, which costs little compared with packing.
        validate::check(&gaussians, &Field::twin_name).map_err(IngestError::from)?;
        let settings = VersionSettings {
            profile,
            rig,
            trajectories,
            sky,
            geo,
            // The scene is in the axes of its capture.
            twin_from_capture: None,
            provenance,
        };
        settings.check()?;
        let mut commit = self.begin(name, CommitKind::Import, storage)?;
        commit.put_all(gaussians, None, progress)?;
        commit.replace(None, settings)
    }
}
