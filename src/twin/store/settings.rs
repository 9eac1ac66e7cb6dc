//! The parts of a version other than its cells.

use std::collections::BTreeSet;

use wildcity_scene::align::Alignment;
use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::manifest::Provenance;
use wildcity_scene::{Manifest, RenderProfile, Rig, Trajectory};

use super::StoreError;
use super::sky::NewSky;

/// The parts of a version other than its cells.
#[derive(Clone, Debug)]
pub struct VersionSettings {
    /// How it must be rendered.
    pub profile: RenderProfile,
    /// The rig of the vehicle that recorded it.
    pub rig: Option<Rig>,
    pub trajectories: Vec<Trajectory>,
    /// The sky behind the Gaussians.
    pub sky: Option<NewSky>,
    /// Where the world lies on the earth.
    pub geo: Option<GeoAnchor>,
    /// From the axes and the unit of the capture to the twin's, if they differ.
    pub twin_from_capture: Option<Alignment>,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// The parts of a version, other than cells, that a change replaces. A field that is `None` keeps
/// the base's value.
#[derive(Clone, Debug)]
pub struct VersionChange {
    /// How it must be rendered.
    pub profile: Option<RenderProfile>,
    /// The rig of the vehicle that recorded it.
    pub rig: Option<Rig>,
    pub trajectories: Option<Vec<Trajectory>>,
    /// The sky behind the Gaussians; `Some(None)` removes it.
    pub sky: Option<Option<NewSky>>,
    /// Where the world lies on the earth; `Some(None)` removes it.
    pub geo: Option<Option<GeoAnchor>>,
    /// Where the new version comes from; `None` for an edit, which comes from where its base does,
    /// and has no note.
    pub provenance: Option<Provenance>,
}

impl VersionSettings {
    /// All parts of an existing version but its provenance.
    ///
    /// # Errors
    /// The manifest's alignment is damaged.
    pub(super) fn from_manifest(
        manifest: &Manifest,
        provenance: Provenance,
    ) -> Result<Self, StoreError> {
        Ok(Self {
            profile: manifest.profile,
            rig: manifest.rig.clone(),
            trajectories: manifest.trajectories.clone(),
            sky: manifest.sky.clone().map(NewSky::Kept),
            geo: manifest.geo.clone(),
            twin_from_capture: manifest.alignment()?,
            provenance,
        })
    }

    /// # Errors
    /// Names what cannot be used.
    pub(super) fn check(&self) -> Result<(), StoreError> {
        check(Some(&self.profile), self.rig.as_ref(), &self.trajectories)?;
        self.geo.as_ref().map_or(Ok(()), GeoAnchor::check)?;
        // The sky is last, because baking it takes about a second.
        self.sky.as_ref().map_or(Ok(()), |sky| sky.check(&self.profile))
    }
}

impl VersionChange {
    /// Keeps everything of the base version.
    pub fn edit() -> Self {
        Self {
            profile: None,
            rig: None,
            trajectories: None,
            sky: None,
            geo: None,
            provenance: None,
        }
    }

    /// Keeps everything of the base version but its provenance.
    pub fn new(provenance: Provenance) -> Self {
        Self { provenance: Some(provenance), ..Self::edit() }
    }

    /// Checks everything but the sky, which needs the profile of the base.
    ///
    /// # Errors
    /// Names what cannot be used.
    pub(super) fn check(&self) -> Result<(), StoreError> {
        let trajectories = self.trajectories.as_deref().unwrap_or_default();
        // `Some(None)` removes the place, and needs no check.
        self.geo.iter().flatten().try_for_each(GeoAnchor::check)?;
        check(self.profile.as_ref(), self.rig.as_ref(), trajectories)
    }
}

fn check(
    profile: Option<&RenderProfile>,
    rig: Option<&Rig>,
    trajectories: &[Trajectory],
) -> Result<(), StoreError> {
    profile.map_or(Ok(()), RenderProfile::check)?;
    rig.map_or(Ok(()), Rig::check)?;
    let mut names = BTreeSet::new();
    for trajectory in trajectories {
        trajectory.check()?;
        // Drives are named in scenarios, so that two of one name would be ambiguous.
        if !names.insert(&*trajectory.name) {
            return Err(StoreError::DuplicateTrajectory { name: trajectory.name.clone() });
        }
    }
    Ok(())
}
