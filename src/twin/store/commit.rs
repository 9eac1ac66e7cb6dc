//! Making a version: cells are written one after the other, invisible to readers, and then
//! published at once.

use std::collections::{BTreeMap, BTreeSet};

use crate::ingest::IngestError;
use crate::limits;
use wildcity_scene::manifest::{ChunkEntry, ObjectRef, ViewsRef};
use wildcity_scene::record::Clamped;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Gaussians, Manifest};

use super::backend::Staging;
use super::catalog::check_name;
use super::density::check_density;
use super::diff::Diff;
use super::log::{CommitKind, LogRecord};
use super::pack::{CellPacker, StorageOptions};
use super::settings::{VersionChange, VersionSettings};
use super::{Catalog, StoreError, Version, chunk_file};

/// A version in preparation. Dropped before it is published, it leaves nothing behind. Several
/// commits of one twin may be in preparation at once; only publishing waits for others.
#[derive(Debug)]
pub struct Commit {
    catalog: Catalog,
    name: String,
    id: String,
    kind: CommitKind,
    storage: StorageOptions,
    sh_degree: Option<u8>,
    staging: Box<dyn Staging>,
    /// The cells that were put, by (cell y, cell x).
    chunks: BTreeMap<[i32; 2], ChunkEntry>,
    clamped: Clamped,
    /// Objects of recorded images that were put.
    images: BTreeSet<String>,
    /// The recorded images of the version, if they differ from those of the base.
    views: Option<Option<ViewsRef>>,
}

/// What one [`Commit::put`] stored.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCells {
    /// A chunk for each cell, in order of (cell y, cell x).
    pub chunks: Vec<ChunkEntry>,
    /// Number of Gaussians in cells that were not to be stored.
    pub left_out: u64,
}

/// A manifest and its hash.
struct HashedManifest {
    manifest: Manifest,
    /// 64 lower-case hex digits.
    hash: String,
}

impl Catalog {
    /// Begins a version of a twin, `[a-z0-9._-]+`. Publishing under a new name makes a new twin.
    ///
    /// # Errors
    /// [`StoreError::Name`]; what killed commits left cannot be removed, or nothing can be written.
    pub fn begin(
        &self,
        name: &str,
        kind: CommitKind,
        storage: StorageOptions,
    ) -> Result<Commit, StoreError> {
        check_name(name)?;
        self.remove_abandoned_commits(Some(name))?;
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        Ok(Commit {
            staging: self.objects.begin_staging(name, &id)?,
            catalog: self.clone(),
            name: name.to_owned(),
            id,
            kind,
            storage,
            sh_degree: None,
            chunks: BTreeMap::new(),
            clamped: Clamped::default(),
            images: BTreeSet::new(),
            views: None,
        })
    }

    /// Makes an old version the latest, under a new number, so that the versions since then are
    /// kept. If it is the latest already, it is returned, and no new one is made.
    ///
    /// # Errors
    /// As [`Catalog::version`]; a version that cannot be read in full is not restored. A failed
    /// rollback leaves nothing behind, except for [`StoreError::NotSynced`].
    pub fn rollback(&self, name: &str, number: u64) -> Result<Version, StoreError> {
        // Checked early, before anything is written; restoring checks again, and more thoroughly.
        self.version(name, Some(number))?;
        self.begin(name, CommitKind::Rollback, StorageOptions::default())?.restore(number)
    }
}

impl Commit {
    /// Its identity, 32 hex digits. The log names it once the version is published.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Writes Gaussians, in metres along the twin's axes, as whole cells with their levels of
    /// detail; only the cells of `only`, if given. `progress` gets the number of Gaussians written
    /// and in all.
    ///
    /// A twin of any size can be put part by part, as long as no cell is in two parts.
    ///
    /// # Errors
    /// Before anything is written: a Gaussian that cannot be used, [`StoreError::Scattered`], a cell that was put
    /// before, an SH degree other than that of an earlier part. Otherwise what could not be written; nothing
    /// of this call is part of the version then.
    pub fn put(
        &mut self,
        gaussians: &Gaussians,
        only: Option<&BTreeSet<[i32; 2]>>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<StoredCells, StoreError> {
        validate::check(gaussians, &Field::twin_name).map_err(IngestError::from)?;
        let sh_degree = gaussians.sh_degree;
        self.check_field("sh_degree", Some(sh_degree), self.sh_degree.unwrap_or(sh_degree))?;
        let packer = CellPacker::new(gaussians, self.storage, only);
        check_density(packer.cells().count(), packer.gaussians())?;
        if let Some(cell) = packer.cells().find(|&[x, y]| self.chunks.contains_key(&[y, x])) {
            return Err(StoreError::DuplicateCell { name: self.name.clone(), cell });
        }
        let (chunks, clamped) = packer.put(&mut *self.staging, progress)?;
        self.sh_degree = Some(sh_degree);
        self.clamped.merge(&clamped);
        let by_cell = |chunk: &ChunkEntry| ([chunk.cell[1], chunk.cell[0]], chunk.clone());
        self.chunks.extend(chunks.iter().map(by_cell));
        Ok(StoredCells { left_out: gaussians.len() as u64 - packer.gaussians(), chunks })
    }

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
            (Some(base), Some(latest)) if latest != base.number => {
                let latest = commit.catalog.version(&commit.name, Some(latest))?;
                commit.check_overlap(base, &latest, manifest)
            }
            _ => Ok(()),
        })
    }

    /// Publishes exactly what was put as the first version of a new twin, all or nothing.
    ///
    /// # Errors
    /// [`StoreError::TwinExists`] if others made a twin of this name meanwhile; otherwise as [`Commit::replace`].
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
        if let Some(Some(sky)) = &change.sky {
            sky.check(&change.profile.unwrap_or(base.manifest.profile))?;
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
    fn restore(self, number: u64) -> Result<Version, StoreError> {
        self.publish(Some(number), |commit, _| {
            // Publishing is locked: a garbage collection that removed objects has ended, and has
            // recorded the versions. The disk cache may still have objects that were removed, so it
            // is not used.
            let uncached = commit.catalog.uncached();
            let Version { hash, manifest, .. } = uncached.version(&commit.name, Some(number))?;
            for chunk in &manifest.chunks {
                uncached.objects.check_present(&commit.name, &chunk.object, chunk.bytes)?;
            }
            if let Some(sky) = &manifest.sky {
                uncached.objects.check_present(&commit.name, &sky.object, sky.bytes)?;
            }
            if let Some(views) = &manifest.views {
                uncached.objects.check_present(&commit.name, &views.object, views.bytes)?;
            }
            for view in uncached.views_of(&manifest)? {
                for image in super::views::objects(&view) {
                    uncached.objects.check_present(&commit.name, &image.object, image.bytes)?;
                }
            }
            Ok(HashedManifest { manifest, hash })
        })
    }

    /// The catalog that it will be published in.
    pub(super) fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Writes an object of recorded images.
    pub(super) fn put_object(&mut self, bytes: &[u8]) -> Result<ObjectRef, StoreError> {
        let stored = self.staging.put(Box::new(|out| out.write_all(bytes)))?;
        self.images.insert(stored.hash.clone());
        Ok(ObjectRef { object: stored.hash, bytes: stored.bytes })
    }

    /// Sets the recorded images of the version: those of [`Commit::put_views`], those of another version of the twin,
    /// or none. Otherwise [`Commit::change`] keeps those of its base, and [`Commit::replace`] has none.
    pub fn set_views(&mut self, views: Option<ViewsRef>) {
        self.views = Some(views);
    }

    /// A manifest with the cells that were put, and no others. Its table is not written yet.
    fn new_manifest(&mut self, settings: VersionSettings) -> Result<Manifest, StoreError> {
        let VersionSettings { profile, rig, trajectories, sky, geo, twin_from_capture, provenance } =
            settings;
        Ok(Manifest {
            format: Manifest::FORMAT,
            twin: self.name.clone(),
            profile,
            sh_degree: self.sh_degree.unwrap_or(0),
            record: self.storage.record,
            table: ObjectRef { object: String::new(), bytes: 0 },
            chunks: self.chunks.values().cloned().collect(),
            rig,
            trajectories,
            sky: sky.map(|sky| sky.put(&mut *self.staging)).transpose()?,
            views: self.views.clone().flatten(),
            geo,
            twin_from_capture,
            provenance,
        })
    }

    /// A version's manifest with the cells that were put in place of its own. The table is still
    /// the version's.
    fn merge(
        &mut self,
        mut manifest: Manifest,
        change: &VersionChange,
    ) -> Result<Manifest, StoreError> {
        self.check_field("sh_degree", self.sh_degree, manifest.sh_degree)?;
        self.check_field("record", Some(self.storage.record), manifest.record)?;
        let VersionChange { profile, rig, trajectories, sky, geo, provenance } = change.clone();
        let edited = provenance.is_none().then(|| manifest.clone());
        if let Some(sky) = sky {
            manifest.sky = sky.map(|sky| sky.put(&mut *self.staging)).transpose()?;
        }
        manifest.views = self.views.clone().unwrap_or(manifest.views);
        manifest.profile = profile.unwrap_or(manifest.profile);
        manifest.rig = rig.or(manifest.rig);
        manifest.trajectories = trajectories.unwrap_or(manifest.trajectories);
        manifest.geo = geo.unwrap_or(manifest.geo);
        // Before the provenance is replaced, which may be the only place that has it.
        manifest.twin_from_capture = manifest.alignment()?;
        let own = manifest.chunks.into_iter().map(|chunk| ([chunk.cell[1], chunk.cell[0]], chunk));
        let mut chunks: BTreeMap<_, _> = own.collect();
        chunks.extend(self.chunks.clone());
        manifest.chunks = chunks.into_values().collect();
        match provenance {
            Some(provenance) => manifest.provenance = provenance,
            // An edit that changes nothing makes no version, so it keeps the note.
            None if edited.as_ref() == Some(&manifest) => {}
            None => manifest.provenance = manifest.provenance.of_edit(),
        }
        Ok(manifest)
    }

    /// Checks that the `new` manifest reverts nothing that other commits changed from the base to the
    /// latest version. The same change on both sides is not a conflict; the other one may be this commit's
    /// own first attempt. If others aligned the twin, every change is one: it was made for the old axes.
    fn check_overlap(
        &self,
        base: &Version,
        latest: &Version,
        new: &Manifest,
    ) -> Result<(), StoreError> {
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

    /// Writes the table and the manifest.
    fn put_manifest(&mut self, mut manifest: Manifest) -> Result<HashedManifest, StoreError> {
        let Manifest { chunks, sh_degree, record, .. } = &manifest;
        let table = chunk_file::table(chunks, *sh_degree, *record)
            .map_err(StoreError::io("encode a table for", self.catalog.dir()))?;
        check_size("table", table.len(), limits::TABLE_BYTES)?;
        let stored = self.staging.put(Box::new(|out| out.write_all(&table)))?;
        manifest.table = ObjectRef { object: stored.hash, bytes: stored.bytes };
        let bytes = self.catalog.encode(&manifest)?;
        check_size("manifest", bytes.len(), limits::MANIFEST_BYTES)?;
        let hash = self.staging.put(Box::new(|out| out.write_all(&bytes)))?.hash;
        Ok(HashedManifest { manifest, hash })
    }

    /// Publishes the manifest that `build` makes, given the number of the latest version. If
    /// another commit takes the next number first, the manifest is built again on that version.
    fn publish(
        mut self,
        parent: Option<u64>,
        mut build: impl FnMut(&mut Self, Option<u64>) -> Result<HashedManifest, StoreError>,
    ) -> Result<Version, StoreError> {
        self.staging.lock_publishing()?;
        let mut tries = 1;
        loop {
            let latest = self.catalog.objects.version_numbers(&self.name)?.last().copied();
            let HashedManifest { manifest, hash } = build(&mut self, latest)?;
            let own = self.chunks.values().map(|chunk| chunk.object.as_str());
            let sky = manifest.sky.iter().map(|sky| sky.object.as_str());
            let named = [manifest.table.object.as_str(), hash.as_str()];
            let images = self.images.iter().map(String::as_str);
            let objects = own.chain(sky).chain(images).chain(named).collect();

            // With the same content as the latest version, that version is the result.
            if let Some(number) = latest
                && let Ok(record) = self.catalog.record(&self.name, number)
                && record.manifest == hash
            {
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
                Err(StoreError::Conflict { .. }) if tries < limits::PUBLISH_TRIES => tries += 1,
                Err(error) => return Err(error),
            }
        }
    }

    /// Checks that what is stored here fits what is stored already.
    fn check_field<T: PartialEq + std::fmt::Display>(
        &self,
        field: &'static str,
        stored: Option<T>,
        needed: T,
    ) -> Result<(), StoreError> {
        match stored {
            Some(stored) if stored != needed => Err(StoreError::FieldMismatch {
                name: self.name.clone(),
                field,
                stored: stored.to_string(),
                needed: needed.to_string(),
            }),
            _ => Ok(()),
        }
    }

    /// Checks that the record format can hold the Gaussians that were put.
    fn check_clamped(&self) -> Result<(), StoreError> {
        let gaussians = self.chunks.values().map(|chunk| chunk.count).sum::<u64>();
        match self.clamped.worst() {
            Some((field, count)) if count as f64 > limits::CLAMPED_SHARE * gaussians as f64 => {
                Err(StoreError::Clamped { record: self.storage.record, field, count, gaussians })
            }
            _ => Ok(()),
        }
    }
}

fn check_size(what: &'static str, bytes: usize, limit: u64) -> Result<(), StoreError> {
    let bytes = bytes as u64;
    if bytes > limit { Err(StoreError::ManifestSize { what, bytes, limit }) } else { Ok(()) }
}
