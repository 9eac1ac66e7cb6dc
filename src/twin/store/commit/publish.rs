//! Publishing a version: one commit after the other, each on the latest version, and only if it
//! reverts nothing of others.

use std::collections::BTreeSet;

use wildcity_scene::Manifest;

use crate::ingest::IngestError;
use crate::limits;
use crate::store::diff::Diff;
use crate::store::log::LogRecord;
use crate::store::settings::{VersionChange, VersionSettings};
use crate::store::{StoreError, Version, views};

use super::Commit;
use super::manifest::HashedManifest;

impl Commit {
    /// Publishes exactly what was put as the latest version, all or nothing. If the latest version
    /// has the same content, it is returned, and no new one is made.
    ///
    /// With a `base`, nothing is replaced that other commits changed since that version. Without
    /// one, the latest version is replaced, whatever it contains.
    ///
    /// # Errors
    /// [`StoreError::Overlap`] if others changed since `base` what this would replace; or what
    /// cannot be accepted or written. Nothing of the commit is left then, with one exception:
    /// [`StoreError::NotSynced`] means that the version exists, but might be lost in a power cut.
    pub fn replace(
        self,
        base: Option<u64>,
        settings: VersionSettings,
    ) -> Result<Version, StoreError> {
        let base = base.map(|base| self.catalog.version(&self.name, Some(base))).transpose()?;
        let parent = base.as_ref().map(|base| base.number);
        self.publish_put(parent, settings, |commit, latest, manifest| match (&base, latest) {
            // If the latest version is the base itself, others have changed nothing.
            (Some(base), Some(latest)) if latest != base.number => {
                let latest = commit.catalog.version(&commit.name, Some(latest))?;
                commit.check_overlap(base, &latest, manifest)
            }
            // Without a base, or in a new twin, there is nothing of others to revert.
            _ => Ok(()),
        })
    }

    /// Publishes exactly what was put as the first version of a new twin, all or nothing.
    ///
    /// # Errors
    /// [`StoreError::TwinExists`] if others made a twin of this name meanwhile; otherwise as
    /// [`Commit::replace`].
    pub fn create(self, settings: VersionSettings) -> Result<Version, StoreError> {
        self.publish_put(None, settings, |commit, latest, _| match latest {
            Some(latest) => Err(StoreError::TwinExists { name: commit.name.clone(), latest }),
            None => Ok(()),
        })
    }

    /// Publishes exactly what was put, if `check` accepts it in place of the latest version.
    fn publish_put(
        self,
        parent: Option<u64>,
        settings: VersionSettings,
        check: impl Fn(&Self, Option<u64>, &Manifest) -> Result<(), StoreError>,
    ) -> Result<Version, StoreError> {
        settings.check()?;
        self.check_clamped()?;
        self.publish(parent, |commit, latest| {
            let manifest = commit.new_manifest(settings.clone())?;
            check(commit, latest, &manifest)?;
            commit.put_manifest(manifest)
        })
    }

    /// Publishes the version `base` with the cells that were put in place of its own, all or
    /// nothing. What others committed since `base` is kept, as long as it is in other cells.
    ///
    /// # Errors
    /// [`StoreError::Overlap`] if others changed the same since `base`;
    /// [`StoreError::FieldMismatch`] if the Gaussians were stored in another way than the twin's;
    /// otherwise as [`Commit::replace`].
    pub fn change(self, base: u64, change: VersionChange) -> Result<Version, StoreError> {
        change.check()?;
        self.check_clamped()?;
        let base = self.catalog.version(&self.name, Some(base))?;
        // The sky will be drawn with the profile of the new version: that of the change, or else
        // that of the base.
        match (&change.sky, change.profile) {
            (Some(Some(sky)), profile) => sky.check(&profile.unwrap_or(base.manifest.profile))?,
            // The sky that is kept, too: no session could open a version whose sky is too coarse.
            (None, Some(profile)) if profile.sky_error != base.manifest.profile.sky_error => {
                if let Some(sky) = self.catalog.sky(&base)? {
                    sky.drawable(profile.sky_error).map_err(IngestError::Sky)?;
                }
            }
            (Some(None) | None, _) => {}
        }
        self.publish(Some(base.number), |commit, latest| match latest {
            Some(latest) if latest != base.number => {
                let latest = commit.catalog.version(&commit.name, Some(latest))?;
                let merged = commit.merge(latest.manifest.clone(), &change)?;
                commit.check_overlap(&base, &latest, &merged)?;
                commit.put_manifest(merged)
            }
            _ => {
                let merged = commit.merge(base.manifest.clone(), &change)?;
                commit.put_manifest(merged)
            }
        })
    }

    /// Publishes an old version as the latest, if all of its objects exist.
    pub(super) fn restore(self, number: u64) -> Result<Version, StoreError> {
        self.publish(Some(number), |commit, _| {
            // Publishing is locked: a garbage collection that removed objects has ended, and has
            // recorded the versions. The disk cache may still have objects that were removed, so it
            // is not used.
            let uncached = commit.catalog.uncached();
            let Version { hash, manifest, .. } = uncached.version(&commit.name, Some(number))?;
            // Only presence and size: hashing all chunks would hold the lock for too long, and
            // `fsck` does it.
            for chunk in &manifest.chunks {
                uncached.objects.check_present(&commit.name, &chunk.object, chunk.bytes)?;
            }
            if let Some(sky) = &manifest.sky {
                uncached.objects.check_present(&commit.name, &sky.object, sky.bytes)?;
            }
            if let Some(views) = &manifest.views {
                uncached.objects.check_present(&commit.name, &views.object, views.bytes)?;
            }
            for view in uncached.read_views(&manifest)? {
                for image in views::objects(&view) {
                    uncached.objects.check_present(&commit.name, &image.object, image.bytes)?;
                }
            }
            Ok(HashedManifest { manifest, hash })
        })
    }

    /// Checks that the `new` manifest reverts nothing that other commits changed from the base to
    /// the latest version. The same change on both sides is not a conflict; the other one may be
    /// this commit's own first attempt. If others aligned the twin, every change is one: it was
    /// made for the old axes.
    fn check_overlap(
        &self,
        base: &Version,
        latest: &Version,
        new: &Manifest,
    ) -> Result<(), StoreError> {
        // Theirs lead from the base to the latest version, ours from there to the new one. A change
        // that both made is in the latest version, and so not in ours.
        let theirs = Diff::between(&base.manifest, &latest.manifest);
        let ours = Diff::between(&latest.manifest, new);
        let changed: BTreeSet<_> = ours.cells.iter().map(|differs| differs.cell).collect();
        let cells = theirs.cells.iter().map(|differs| differs.cell);
        let cells: Vec<_> = cells.filter(|cell| changed.contains(cell)).collect();
        let changes_any = !ours.cells.is_empty() || !ours.settings.is_empty();
        let mut settings = theirs.settings;
        settings.retain(|&field| {
            ours.settings.contains(&field) || (field == Diff::ALIGNMENT && changes_any)
        });
        if cells.is_empty() && settings.is_empty() {
            return Ok(());
        }
        Err(StoreError::Overlap {
            name: self.name.clone(),
            base: base.number,
            latest: latest.number,
            cells,
            settings,
        })
    }

    /// Publishes the manifest that `build` makes, given the number of the latest version. If
    /// another commit takes the next number first, the manifest is built again on that version.
    fn publish(
        mut self,
        parent: Option<u64>,
        mut build: impl FnMut(&mut Self, Option<u64>) -> Result<HashedManifest, StoreError>,
    ) -> Result<Version, StoreError> {
        // Held until this commit ends. An object store has no lock: there, the record that is put
        // if absent decides.
        self.staging.lock_publishing()?;
        let mut tries = 1;
        loop {
            let latest = self.catalog.objects.version_numbers(&self.name)?.last().copied();
            let HashedManifest { manifest, hash } = build(&mut self, latest)?;
            // What this commit wrote and the manifest names. Objects of the base are in their
            // places already.
            let own = self.chunks.values().map(|chunk| chunk.object.as_str());
            let sky = manifest.sky.iter().map(|sky| sky.object.as_str());
            let named = [manifest.table.object.as_str(), hash.as_str()];
            let images = self.images.iter().map(String::as_str);
            let objects = own.chain(sky).chain(images).chain(named).collect();

            // With the same content as the latest version, that version is the result.
            // If its record is damaged, the new version follows it.
            if let Some(number) = latest
                && let Ok(record) = self.catalog.record(&self.name, number)
                && record.manifest == hash
            {
                // Even so, the objects are written over those in place, which mends damaged ones.
                self.staging.restore(&objects, number)?;
                return Ok(Version { number, hash, created_us: record.created_us, manifest });
            }

            // Otherwise publish a new version.
            let number = latest.unwrap_or(0) + 1;
            let created_us = self.catalog.clock.now_us();
            let record = LogRecord {
                manifest: hash.clone(),
                created_us,
                commit: Some(self.id.clone()),
                parent,
                kind: self.kind,
            };
            match self.staging.publish(&objects, number, &self.catalog.encode(&record)?) {
                Ok(()) => return Ok(Version { number, hash, created_us, manifest }),
                // The winner may be this very commit, if the answer to its first attempt was lost.
                Err(StoreError::Conflict { .. })
                    if self.catalog.record(&self.name, number)?.commit.as_ref()
                        == Some(&self.id) =>
                {
                    self.staging.restore(&objects, number)?;
                    return Ok(Version { number, hash, created_us, manifest });
                }
                // Another commit was first: everything is checked again against its version.
                Err(StoreError::Conflict { .. }) if tries < limits::PUBLISH_TRIES => tries += 1,
                Err(error) => return Err(error),
            }
        }
    }
}
