//! Making a version: cells are put one after the other, seen by nobody, and then published at once.

use std::collections::{BTreeMap, BTreeSet};

use crate::ingest::IngestError;
use crate::limits;
use wildcity_scene::manifest::{ChunkEntry, ObjectRef, Provenance};
use wildcity_scene::record::Clamped;
use wildcity_scene::validate::{self, Field};
use wildcity_scene::{Gaussians, Manifest, RecordFormat, RenderProfile, Rig, Trajectory};

use super::catalog::check_name;
use super::diff::Diff;
use super::log::{CommitKind, LogRecord};
use super::objects::Staging;
use super::pack::CellPacker;
use super::sky::NewSky;
use super::{Catalog, StoreError, Version, chunk_file, recover};

/// A version in the making. Dropped before it is published, it leaves nothing behind; several of one
/// twin may be in preparation at once, and only publishing waits for others.
#[derive(Debug)]
pub struct Commit {
    catalog: Catalog,
    name: String,
    id: String,
    kind: CommitKind,
    storage: StorageOptions,
    sh_degree: Option<u8>,
    staging: Staging,
    /// What was put, by (cell y, cell x).
    chunks: BTreeMap<[i32; 2], ChunkEntry>,
    clamped: Clamped,
}

/// How Gaussians are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StorageOptions {
    /// In how many bits.
    pub record: RecordFormat,
    /// Whether levels of detail are made, too.
    pub levels: bool,
}

impl Default for StorageOptions {
    fn default() -> Self {
        Self { record: RecordFormat::default(), levels: true }
    }
}

/// What one [`Commit::put`] stored.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCells {
    /// A chunk for each cell, in order of (cell y, cell x).
    pub chunks: Vec<ChunkEntry>,
    /// Gaussians of cells that were not asked for.
    pub left_out: u64,
}

/// What a version consists of beside its cells.
#[derive(Clone, Debug)]
pub struct VersionSettings {
    /// How it must be rendered.
    pub profile: RenderProfile,
    /// The vehicle that recorded it.
    pub rig: Option<Rig>,
    /// Recorded drives.
    pub trajectories: Vec<Trajectory>,
    /// What is behind everything.
    pub sky: Option<NewSky>,
    /// Where it comes from.
    pub provenance: Provenance,
}

/// What changes of a version beside the cells that were put: what is none stays.
#[derive(Clone, Debug)]
pub struct VersionChange {
    /// How it must be rendered.
    pub profile: Option<RenderProfile>,
    /// The vehicle that recorded it.
    pub rig: Option<Rig>,
    /// Recorded drives, all of them.
    pub trajectories: Option<Vec<Trajectory>>,
    /// What is behind everything; `Some(None)` takes the sky away.
    pub sky: Option<Option<NewSky>>,
    /// Where the new version comes from.
    pub provenance: Provenance,
}

/// A manifest and its hash, 64 lower-case hex digits.
type Hashed = (Manifest, String);

impl Catalog {
    /// Begins a version of a twin, `[a-z0-9._-]+`; a new name makes a new twin when it is published.
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
        recover::clean(self)?;
        let id = uuid::Uuid::now_v7().as_simple().to_string();
        Ok(Commit {
            staging: self.objects.stage(name, &id)?,
            catalog: self.clone(),
            name: name.to_owned(),
            id,
            kind,
            storage,
            sh_degree: None,
            chunks: BTreeMap::new(),
            clamped: Clamped::default(),
        })
    }
}

impl Commit {
    /// Its identity, 32 hex digits: the log names it once it is published.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Writes Gaussians, in metres along the twin's axes, as whole cells, levels of detail included;
    /// `only` those cells, if given. `progress` gets Gaussians written and Gaussians in all.
    ///
    /// A twin of any size is put part by part, as long as no cell is in two of them.
    ///
    /// # Errors
    /// Before anything is written: a Gaussian that cannot be used, a cell that was put before, an SH
    /// degree that is not that of an earlier part. Otherwise what could not be written; nothing of
    /// this call is part of the version then.
    pub fn put(
        &mut self,
        gaussians: &Gaussians,
        only: Option<&BTreeSet<[i32; 2]>>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<StoredCells, StoreError> {
        validate::check(gaussians, &Field::twin_name).map_err(IngestError::from)?;
        let sh_degree = gaussians.sh_degree;
        self.check_field("sh_degree", Some(sh_degree), self.sh_degree.unwrap_or(sh_degree))?;
        let cells = CellPacker::new(gaussians, self.storage, only);
        if let Some(cell) = cells.cells().find(|&[x, y]| self.chunks.contains_key(&[y, x])) {
            return Err(StoreError::DuplicateCell { name: self.name.clone(), cell });
        }
        let (chunks, clamped) = cells.put(&mut self.staging, progress)?;
        self.sh_degree = Some(sh_degree);
        self.clamped.merge(&clamped);
        let by_cell = |chunk: &ChunkEntry| ([chunk.cell[1], chunk.cell[0]], chunk.clone());
        self.chunks.extend(chunks.iter().map(by_cell));
        Ok(StoredCells { left_out: gaussians.len() as u64 - cells.gaussians(), chunks })
    }

    /// Makes the latest version exactly what was put, all or nothing. The same content as the latest
    /// version's is that version: no new one is made.
    ///
    /// With a `base`, nothing is replaced that others committed since that version; with none, whatever
    /// is there is.
    ///
    /// # Errors
    /// [`StoreError::Overlap`] if others changed since `base` what this would be in place of; what
    /// cannot be accepted, or could not be written, and then nothing of it is left.
    /// [`StoreError::NotSynced`] alone means that the version is there, but might not be after a
    /// power cut.
    pub fn replace(
        self,
        base: Option<u64>,
        settings: VersionSettings,
    ) -> Result<Version, StoreError> {
        settings.check()?;
        self.check_clamped()?;
        let base = base.map(|base| self.catalog.version(&self.name, Some(base))).transpose()?;
        self.publish(base.as_ref().map(|base| base.number), |commit, latest| {
            let VersionSettings { profile, rig, trajectories, sky, provenance } = settings.clone();
            let sky = sky.map(|sky| sky.put(&mut commit.staging)).transpose()?;
            let chunks: Vec<_> = commit.chunks.values().cloned().collect();
            let (sh_degree, record) = (commit.sh_degree.unwrap_or(0), commit.storage.record);
            let manifest = Manifest {
                format: Manifest::FORMAT,
                twin: commit.name.clone(),
                profile,
                sh_degree,
                record,
                table: ObjectRef { object: String::new(), bytes: 0 },
                chunks,
                rig,
                trajectories,
                sky,
                provenance,
            };
            if let (Some(base), Some(latest)) = (&base, latest)
                && latest != base.number
            {
                let latest = commit.catalog.version(&commit.name, Some(latest))?;
                commit.check_overlap(base, &latest, &manifest)?;
            }
            commit.complete(manifest)
        })
    }

    /// Makes the latest version that of number `base` with the cells that were put in place of its
    /// own, all or nothing. What others committed since `base` stays, as long as it is in other
    /// cells.
    ///
    /// # Errors
    /// [`StoreError::Overlap`] if others changed the same since `base`; [`StoreError::FieldMismatch`] if
    /// Gaussians were stored in another way than the twin's; otherwise as [`Commit::replace`].
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
                commit.complete(merged)
            }
            _ => {
                let merged = commit.merge(base.manifest.clone(), &change)?;
                commit.complete(merged)
            }
        })
    }

    /// Makes the latest version an old one, if all of it is there.
    pub(super) fn restore(self, number: u64) -> Result<Version, StoreError> {
        self.publish(Some(number), |commit, _| {
            // Whoever removed objects while this waited for its turn is done, and has said so; and what
            // the disk cache keeps of them is not there.
            let there = commit.catalog.uncached();
            let Version { hash, manifest, .. } = there.version(&commit.name, Some(number))?;
            for chunk in &manifest.chunks {
                there.objects.check_present(&commit.name, &chunk.object, chunk.bytes)?;
            }
            if let Some(sky) = &manifest.sky {
                there.objects.check_present(&commit.name, &sky.object, sky.bytes)?;
            }
            Ok((manifest, hash))
        })
    }

    /// A version with the cells that were put in place of its own, and the table that it had.
    fn merge(
        &mut self,
        mut manifest: Manifest,
        change: &VersionChange,
    ) -> Result<Manifest, StoreError> {
        self.check_field("sh_degree", self.sh_degree, manifest.sh_degree)?;
        self.check_field("record", Some(self.storage.record), manifest.record)?;
        let VersionChange { profile, rig, trajectories, sky, provenance } = change.clone();
        if let Some(sky) = sky {
            manifest.sky = sky.map(|sky| sky.put(&mut self.staging)).transpose()?;
        }
        manifest.profile = profile.unwrap_or(manifest.profile);
        manifest.rig = rig.or(manifest.rig);
        manifest.trajectories = trajectories.unwrap_or(manifest.trajectories);
        manifest.provenance = provenance;
        let own = manifest.chunks.into_iter().map(|chunk| ([chunk.cell[1], chunk.cell[0]], chunk));
        let mut chunks: BTreeMap<_, _> = own.collect();
        chunks.extend(self.chunks.clone());
        manifest.chunks = chunks.into_values().collect();
        Ok(manifest)
    }

    /// Whether nothing that others changed from the base to the latest becomes something else by what
    /// is `new`. What they made the same is no loss, and may have been this commit's own first try.
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
        let mut settings = theirs.settings;
        settings.retain(|field| ours.settings.contains(field));
        if cells.is_empty() && settings.is_empty() {
            return Ok(());
        }
        let (name, base, latest) = (self.name.clone(), base.number, latest.number);
        Err(StoreError::Overlap { name, base, latest, cells, settings })
    }

    /// Puts the table and the manifest. Returns the manifest and its hash.
    fn complete(&mut self, mut manifest: Manifest) -> Result<Hashed, StoreError> {
        let Manifest { chunks, sh_degree, record, .. } = &manifest;
        let table = chunk_file::table(chunks, *sh_degree, *record)
            .map_err(StoreError::io("encode a table for", self.catalog.dir()))?;
        check_size("table", table.len(), limits::TABLE_BYTES)?;
        let put = self.staging.put(|out| out.write_all(&table))?;
        manifest.table = ObjectRef { object: put.hash, bytes: put.bytes };
        let bytes = self.catalog.encode(&manifest)?;
        check_size("manifest", bytes.len(), limits::MANIFEST_BYTES)?;
        let hash = self.staging.put(|out| out.write_all(&bytes))?.hash;
        Ok((manifest, hash))
    }

    /// Makes what `build` gives for the latest version's number the next one. Built again if somebody
    /// else was faster.
    fn publish(
        mut self,
        parent: Option<u64>,
        mut build: impl FnMut(&mut Self, Option<u64>) -> Result<Hashed, StoreError>,
    ) -> Result<Version, StoreError> {
        self.staging.lock_publishing()?;
        let mut tries = 1;
        loop {
            let latest = self.catalog.objects.numbers(&self.name)?.last().copied();
            let (manifest, hash) = build(&mut self, latest)?;
            let own = self.chunks.values().map(|chunk| chunk.object.as_str());
            let sky = manifest.sky.iter().map(|sky| sky.object.as_str());
            let named = [manifest.table.object.as_str(), hash.as_str()];
            let objects = own.chain(sky).chain(named).collect();
            if let Some(number) = latest
                && let Ok(record) = self.catalog.record(&self.name, number)
                && record.manifest == hash
            {
                self.staging.restore(&objects, number)?;
                return Ok(Version { number, hash, created_us: record.created_us, manifest });
            }
            let number = latest.unwrap_or(0) + 1;
            let record = LogRecord::new(hash.clone(), &self.id, parent, self.kind);
            let created_us = record.created_us;
            match self.staging.publish(&objects, number, &self.catalog.encode(&record)?) {
                Ok(()) => return Ok(Version { number, hash, created_us, manifest }),
                // It may have been this very commit, and the answer was lost.
                Err(StoreError::Conflict { .. })
                    if self.catalog.record(&self.name, number)?.commit.as_ref()
                        == Some(&self.id) =>
                {
                    return Ok(Version { number, hash, created_us, manifest });
                }
                Err(StoreError::Conflict { .. }) if tries < limits::PUBLISH_TRIES => tries += 1,
                Err(error) => return Err(error),
            }
        }
    }

    /// Whether what is stored here fits what is stored already.
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

    /// Whether the record can hold the Gaussians that were put.
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

impl VersionSettings {
    /// # Errors
    /// Names what cannot be used.
    pub(super) fn check(&self) -> Result<(), StoreError> {
        check(Some(&self.profile), self.rig.as_ref(), &self.trajectories)?;
        self.sky.as_ref().map_or(Ok(()), |sky| sky.check(&self.profile))
    }
}

impl VersionChange {
    fn check(&self) -> Result<(), StoreError> {
        let trajectories = self.trajectories.as_deref().unwrap_or_default();
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
        if !names.insert(&*trajectory.name) {
            return Err(StoreError::DuplicateTrajectory { name: trajectory.name.clone() });
        }
    }
    Ok(())
}

fn check_size(what: &'static str, bytes: usize, limit: u64) -> Result<(), StoreError> {
    let bytes = bytes as u64;
    if bytes > limit { Err(StoreError::ManifestSize { what, bytes, limit }) } else { Ok(()) }
}
