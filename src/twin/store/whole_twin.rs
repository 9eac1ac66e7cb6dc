//! Copies of twins under other names, and removal of whole twins.

use std::collections::BTreeSet;

use super::catalog::check_name;
use super::log::CommitKind;
use super::pack::StorageOptions;
use super::settings::VersionSettings;
use super::{Catalog, Commit, StoreError, Version, views};

impl Catalog {
    /// Makes a new twin of one version of another twin, or of its latest one. The new version has
    /// another hash, because a manifest has the name of its twin, and the same images.
    ///
    /// # Errors
    /// [`StoreError::TwinExists`]; the version cannot be read, or the copy cannot be written.
    /// Nothing is left of it then.
    pub fn copy(&self, from: &str, number: Option<u64>, to: &str) -> Result<Version, StoreError> {
        self.check_new(to)?;
        let version = self.version(from, number)?;
        let (commit, settings) = self.begin_copy(&version, CommitKind::Import, to)?;
        commit.create(settings)
    }

    /// Gives a twin another name: copies each of its versions, the oldest first, and removes the
    /// twin. Versions that were garbage-collected are left out, and so numbers may change.
    ///
    /// # Errors
    /// [`StoreError::TwinExists`]; [`StoreError::Leased`] if a version is in use;
    /// [`StoreError::Conflict`] if a version was committed meanwhile; a version cannot be read, or
    /// its copy cannot be written. Then the old twin is whole, and the new one has what was copied.
    /// If the old twin cannot be removed, the new one is whole: [`Catalog::remove`] the old one.
    pub fn rename(&self, from: &str, to: &str) -> Result<Version, StoreError> {
        self.check_new(to)?;
        self.check_unused(from)?;
        let gone = self.collected(from)?;
        let entries = self.versions(from)?;
        let known: BTreeSet<u64> = entries.iter().map(|entry| entry.number).collect();
        let mut last = None;
        for entry in entries {
            // Its objects are removed, so that there is nothing to copy.
            if gone.contains(&entry.number) {
                continue;
            }
            let version = self.version(from, Some(entry.number))?;
            let (commit, settings) = self.begin_copy(&version, entry.kind, to)?;
            // The first copy makes the twin. Each further one is based on the one before it.
            let copied = match last {
                None => commit.create(settings)?,
                Some(_) => commit.replace(last, settings)?,
            };
            last = Some(copied.number);
        }
        // Last, so that a copy that fails leaves the old twin whole.
        self.remove_known(from, Some(&known))?;
        self.version(to, None)
    }

    /// Removes a twin with all of its versions. A removal that was stopped can be repeated: until
    /// it is complete, the versions count as garbage-collected.
    ///
    /// # Errors
    /// [`StoreError::NoTwin`]; [`StoreError::Leased`] if a version is in use, and nothing is
    /// removed; or what cannot be removed.
    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        self.remove_known(name, None)
    }

    /// As [`Catalog::remove`], if the twin has no versions but those that are known.
    fn remove_known(&self, name: &str, known: Option<&BTreeSet<u64>>) -> Result<(), StoreError> {
        check_name(name)?;
        // Only for the error of a twin that does not exist.
        self.latest(name)?;
        self.check_unused(name)?;
        self.objects.remove_twin(name, &mut || {
            // Publishing is locked, or this is an object store, where the last commit wins.
            let numbers: BTreeSet<u64> = self.objects.version_numbers(name)?.into_iter().collect();
            // A version that was not copied would be lost.
            if let Some(number) = known.and_then(|known| numbers.difference(known).next()) {
                return Err(StoreError::Conflict { name: name.to_owned(), number: *number });
            }
            self.mark_collected(name, &numbers, self.clock.now_us())
        })
    }

    fn check_new(&self, name: &str) -> Result<(), StoreError> {
        check_name(name)?;
        match self.objects.version_numbers(name)?.last() {
            None => Ok(()),
            Some(&latest) => Err(StoreError::TwinExists { name: name.to_owned(), latest }),
        }
    }

    fn check_unused(&self, name: &str) -> Result<(), StoreError> {
        match self.live_leases(name, self.clock.now_us())?.first() {
            None => Ok(()),
            Some(lease) => Err(StoreError::Leased { name: name.to_owned(), number: lease.version }),
        }
    }

    /// A commit with the objects of a version of another twin, and the settings that publish it.
    fn begin_copy(
        &self,
        version: &Version,
        kind: CommitKind,
        to: &str,
    ) -> Result<(Commit, VersionSettings), StoreError> {
        let manifest = &version.manifest;
        let storage = StorageOptions { record: manifest.record, levels: manifest.has_levels() };
        let mut commit = self.begin(to, kind, storage)?;
        // An object longer than the manifest says is damaged, and is not read further.
        let read = |hash: &str, bytes: u64| self.objects.read_object(&manifest.twin, hash, bytes);
        commit.put_chunks(manifest, &mut |chunk| read(&chunk.object, chunk.bytes))?;
        if let Some(sky) = &manifest.sky {
            commit.put_object(&read(&sky.object, sky.bytes)?)?;
        }
        if manifest.views.is_some() {
            let recorded = self.views(version)?;
            // Views may share an object, such as a mask.
            let mut put = BTreeSet::new();
            for object in recorded.iter().flat_map(views::objects) {
                if put.insert(&object.object) {
                    commit.put_image(&read(&object.object, object.bytes)?)?;
                }
            }
            let table = commit.put_views(&recorded)?;
            commit.set_views(Some(table));
        }
        let settings = VersionSettings::from_manifest(manifest, manifest.provenance.clone())?;
        Ok((commit, settings))
    }
}
