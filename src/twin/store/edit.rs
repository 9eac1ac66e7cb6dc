//! Editing a version: other axes and unit, other drives, another rig. The Gaussians are otherwise
//! the same.

use std::collections::BTreeSet;

use glam::DMat3;

use wildcity_scene::align::Alignment;
use wildcity_scene::manifest::{Provenance, SkyRef};
use wildcity_scene::{Gaussians, Rig, Trajectory};

use super::log::CommitKind;
use super::pack::StorageOptions;
use super::settings::{VersionChange, VersionSettings};
use super::sky::NewSky;
use super::{Catalog, Commit, StoreError, Version, views};

/// The changes of an edit.
#[derive(Clone, Debug)]
pub struct Edit {
    /// Turns, moves and scales the Gaussians, the drives and the sky; the identity leaves the
    /// stored bytes as they are.
    pub alignment: Alignment,
    /// Drives in the new axes. A drive replaces the one of its name.
    pub trajectories: Vec<Trajectory>,
    /// The rig in metres; the base's stays if there is none.
    pub rig: Option<Rig>,
}

impl Catalog {
    /// Makes a version with the Gaussians of an existing one in other axes and another unit, and
    /// with other drives.
    ///
    /// The rig stays as it is, since it is in metres of the vehicle, and so does the profile. A
    /// place on the earth is of the old axes, and is dropped if they change. The version remembers
    /// the alignment, with earlier ones, as the way from its capture. All Gaussians are in memory
    /// at once. `progress` gets the number of Gaussians written and in all.
    ///
    /// # Errors
    /// The base cannot be read; what the edit makes is out of a twin's bounds, or all alignments
    /// together are out of theirs; others changed the twin since the base
    /// ([`StoreError::Overlap`]); or as a commit.
    pub fn edit(
        &self,
        base: &Version,
        edit: Edit,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Version, StoreError> {
        let Edit { alignment, trajectories: new, rig } = edit;
        let manifest = &base.manifest;
        let is_aligned = alignment != Alignment::IDENTITY;
        let mut trajectories = manifest.trajectories.clone();
        if is_aligned {
            trajectories = trajectories.iter().map(|drive| alignment.drive(drive)).collect();
        }
        let is_kept = |drive: &Trajectory| new.iter().all(|other| other.name != drive.name);
        trajectories.retain(is_kept);
        trajectories.extend(new);
        let storage = StorageOptions { record: manifest.record, levels: manifest.has_levels() };
        let mut commit = self.begin(&manifest.twin, CommitKind::Import, storage)?;
        // The Gaussians stay: a change of the other parts keeps the stored bytes.
        if !is_aligned {
            let trajectories = Some(trajectories);
            let change = VersionChange { trajectories, rig, ..VersionChange::edit() };
            return commit.change(base.number, change);
        }

        let mut provenance = manifest.provenance.for_edit();
        provenance.options.push(format!("align={alignment}"));
        let before = manifest.alignment()?;
        // Alignments compose: twin_from_capture = new * before.
        let twin_from_capture = before.map_or(alignment, |before| alignment.after(&before));
        // Checked before all Gaussians are read.
        twin_from_capture.check()?;
        let mut gaussians = Gaussians { sh_degree: manifest.sh_degree, ..Gaussians::default() };
        self.visit_full_detail(base, &|_| true, &mut |section| gaussians.append(&section))?;
        alignment.apply(&mut gaussians);
        commit.put(&gaussians, None, progress)?;
        let settings = VersionSettings {
            profile: manifest.profile,
            rig: rig.or_else(|| manifest.rig.clone()),
            trajectories,
            sky: manifest.sky.as_ref().map(|sky| NewSky::Kept(turned(sky, &alignment))),
            geo: None,
            twin_from_capture: Some(twin_from_capture),
            provenance,
        };
        // The poses of recorded images are in the twin's axes. The objects of the images stay.
        if manifest.views.is_some() {
            let views = commit.put_views(&views::aligned(&self.views(base)?, &alignment))?;
            commit.set_views(Some(views));
        }
        commit.replace(Some(base.number), settings)
    }
}

impl Catalog {
    /// Makes a version with other Gaussians, such as after training, and with all else of an
    /// existing one. `how` is added to the options of its provenance. `progress` gets the number of
    /// Gaussians written and in all.
    ///
    /// # Errors
    /// The Gaussians are out of a twin's bounds; others changed the twin since the base
    /// ([`StoreError::Overlap`]); or as a commit.
    pub fn replace_gaussians(
        &self,
        base: &Version,
        gaussians: &Gaussians,
        how: String,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Version, StoreError> {
        let manifest = &base.manifest;
        let (mut commit, provenance) = self.begin_training(base, how)?;
        commit.put(gaussians, None, progress)?;
        let settings = VersionSettings::from_manifest(manifest, provenance)?;
        if manifest.views.is_some() {
            let views = commit.put_views(&self.views(base)?)?;
            commit.set_views(Some(views));
        }
        commit.replace(Some(base.number), settings)
    }
}

impl Catalog {
    /// Makes a version with other Gaussians in some cells, such as after training a part of the
    /// twin, and with all else of an existing one. Gaussians in other cells are left out, and a
    /// cell without any is no longer there. What others have changed in other cells since the base
    /// is kept, so that parts can be trained at the same time. `how` is added to the options of its
    /// provenance. `progress` gets the number of Gaussians written and in all.
    ///
    /// # Errors
    /// The Gaussians are out of a twin's bounds; others changed one of the cells since the base
    /// ([`StoreError::Overlap`]); or as a commit.
    pub fn replace_cells(
        &self,
        base: &Version,
        gaussians: &Gaussians,
        cells: &BTreeSet<[i32; 2]>,
        how: String,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Version, StoreError> {
        let (mut commit, provenance) = self.begin_training(base, how)?;
        commit.remove(cells);
        commit.put(gaussians, Some(cells), progress)?;
        commit.change(base.number, VersionChange::new(provenance))
    }
}

impl Catalog {
    /// Begins a version with other Gaussians, stored as those of the base, and its provenance.
    fn begin_training(
        &self,
        base: &Version,
        how: String,
    ) -> Result<(Commit, Provenance), StoreError> {
        let manifest = &base.manifest;
        let storage = StorageOptions { record: manifest.record, levels: manifest.has_levels() };
        let mut provenance = manifest.provenance.for_edit();
        provenance.options.push(how);
        Ok((self.begin(&manifest.twin, CommitKind::Import, storage)?, provenance))
    }
}

/// The sky after the world was turned.
fn turned(sky: &SkyRef, alignment: &Alignment) -> SkyRef {
    // The manifest has rows; `DMat3` has columns.
    let rows = DMat3::from_cols_array_2d(&sky.sky_from_world).transpose();
    // sky_from_new = sky_from_old * old_from_new.
    let turned = rows * alignment.old_from_new();
    SkyRef { sky_from_world: turned.transpose().to_cols_array_2d(), ..sky.clone() }
}
