//! Writes the version of a push: all of its cells, or none.

use wildcity_scene::{Gaussians, Manifest, RenderProfile};
use wildcity_twin::ingest::{Antialiasing, FileNotes};
use wildcity_twin::store::{
    Catalog, CommitKind, NewSky, StorageOptions, StoreError, Version, VersionChange,
    VersionSettings,
};

use crate::error::PushError;
use crate::request::{CellSelection, PushRequest, profile_with};
use crate::source::provenance;
use crate::status::Push;

/// The content of a version that is not in the request.
pub(crate) struct NewContent<'a> {
    pub(crate) gaussians: &'a Gaussians,
    /// BLAKE3 of each file, in hex.
    pub(crate) hashes: &'a [String],
    /// The axes and scale of each file.
    pub(crate) options: &'a [String],
    /// The render profile of the version.
    pub(crate) profile: RenderProfile,
}

/// The render profile of the version that a push makes: that of the base, or for a new twin the one
/// that its files say, with the changes of the request. Also a warning if the files say another
/// one.
pub(crate) fn merge_profile(
    request: &PushRequest,
    base: Option<&Version>,
    antialiasing: Option<&Antialiasing>,
) -> Result<(RenderProfile, Option<String>), PushError> {
    let notes = FileNotes { antialiasing: antialiasing.cloned(), ..FileNotes::default() };
    let of_files = notes.profile();
    // An existing twin keeps its profile: cells of other pushes were trained for it. Only a new
    // twin takes that of its files.
    let own = match base {
        Some(base) => base.manifest.profile,
        None => of_files.apply(RenderProfile::DEFAULT).map_err(StoreError::from)?,
    };
    let profile = profile_with(own, &request.profile).map_err(StoreError::from)?;
    let sets = |key: &str| request.profile.iter().any(|setting| setting.starts_with(key));
    let is_asked = sets("antialiased=") || sets("blur=");
    let warning = antialiasing.filter(|_| !is_asked).and_then(|said| {
        let Antialiasing { blur_px2, said_by } = said;
        let antialiased = profile.antialiased;
        let blur = profile.blur;
        match *blur_px2 {
            Some(blur_px2) if !antialiased || blur != blur_px2 => Some(format!(
                "{said_by}: the scene was trained with antialiased=true and blur={blur_px2}, and the twin is rendered with \
                 antialiased={antialiased} and blur={blur}; if its other cells were trained so, too, push with \
                 --set antialiased=true --set blur={blur_px2}"
            )),
            None if antialiased => Some(format!(
                "{said_by}: the scene was trained without anti-aliasing, and the twin is rendered with \
                 antialiased=true and blur={blur}; if its other cells were trained so, too, push with \
                 --set antialiased=false"
            )),
            _ => None,
        }
    });
    Ok((profile, warning))
}

/// Writes the version. A push of some cells changes those of the base and keeps the base's
/// settings. A push of all cells replaces the twin, but keeps rig, trajectories, sky, place on the
/// earth and alignment of the base. Neither replaces changes that others made since the base, which
/// is the latest version if the request names none.
pub(crate) fn commit(
    catalog: &Catalog,
    push: &Push,
    request: &PushRequest,
    content: NewContent<'_>,
    base: Option<&Version>,
) -> Result<Version, PushError> {
    let old = base.map(|base| &base.manifest);
    let record = request.record.or(old.map(|old| old.record)).unwrap_or_default();
    let storage = StorageOptions { record, levels: request.levels };
    let mut commit = catalog.begin(&request.twin, CommitKind::Push, storage)?;
    // With `Touched` and `All` no Gaussian is left out: `Touched` is defined by the Gaussians, and
    // `All` also removes the cells without any.
    let only = match &request.cells {
        CellSelection::These(cells) => Some(cells),
        CellSelection::Touched | CellSelection::All => None,
    };
    let progress = &mut |done: u64, total: u64| push.set_progress(done, total);
    commit.put(content.gaussians, only, progress)?;

    let mut provenance = provenance(content.hashes, content.options.to_vec(), request.levels);
    if let Some(note) = &request.note {
        provenance.set_note(note);
    }
    let profile = content.profile;
    let version = match base {
        Some(base) if request.cells != CellSelection::All => {
            // A change without a profile does not conflict with a change of the profile that was
            // committed meanwhile, so it is set only if the request asks for it.
            let profile = (!request.profile.is_empty()).then_some(profile);
            let change = VersionChange { profile, ..VersionChange::new(provenance) };
            commit.change(base.number, change)?
        }
        _ => {
            let settings = VersionSettings {
                profile,
                rig: old.and_then(|old| old.rig.clone()),
                trajectories: old.map(|old| old.trajectories.clone()).unwrap_or_default(),
                sky: old.and_then(|old| old.sky.clone()).map(NewSky::Kept),
                geo: old.and_then(|old| old.geo.clone()),
                twin_from_capture: old
                    .map_or(Ok(None), Manifest::alignment)
                    .map_err(StoreError::from)?,
                provenance,
            };
            // The settings are complete: what is not copied from the old version here would be
            // lost.
            commit.set_views(old.and_then(|old| old.views.clone()));
            // Neither replaces what others committed since `base` was read: both fail with a
            // conflict.
            match base {
                Some(base) => commit.replace(Some(base.number), settings)?,
                None => commit.create(settings)?,
            }
        }
    };
    Ok(version)
}
