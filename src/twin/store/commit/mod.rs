//! Making a version: cells are written one after the other, invisible to readers, and then
//! published at once.

mod manifest;
mod publish;

use std::borrow::Cow;
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
use super::log::CommitKind;
use super::pack::{CellPacker, StorageOptions};
use super::{Catalog, StoreError, Version};

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
    /// Cells of the base that the version does not have, as (y, x).
    removed: BTreeSet<[i32; 2]>,
}

/// The result of one [`Commit::put`].
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCells {
    /// A chunk for each cell, in order of (cell y, cell x).
    pub chunks: Vec<ChunkEntry>,
    /// Number of Gaussians in cells that were not to be stored.
    pub left_out: u64,
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
            removed: BTreeSet::new(),
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
    /// Before anything is written: a Gaussian that cannot be used, [`StoreError::Scattered`], a
    /// cell that was put before, an SH degree other than that of an earlier part. Otherwise what
    /// could not be written; nothing of this call is part of the version then.
    pub fn put(
        &mut self,
        gaussians: &Gaussians,
        only: Option<&BTreeSet<[i32; 2]>>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<StoredCells, StoreError> {
        self.put_all(Cow::Borrowed(gaussians), only, progress)
    }

    /// As [`Commit::put`]. Memory of Gaussians that are not the caller's is freed as they are
    /// written.
    ///
    /// # Errors
    /// As [`Commit::put`].
    pub(super) fn put_all(
        &mut self,
        gaussians: Cow<'_, Gaussians>,
        only: Option<&BTreeSet<[i32; 2]>>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<StoredCells, StoreError> {
        validate::check(&gaussians, &Field::twin_name).map_err(IngestError::from)?;
        let sh_degree = gaussians.sh_degree;
        let count = gaussians.len() as u64;
        // The first part decides the degree; this one is compared with it.
        self.check_field("sh_degree", Some(sh_degree), self.sh_degree.unwrap_or(sh_degree))?;
        let packer = CellPacker::new(gaussians, self.storage, only);
        check_density(packer.cells().count(), packer.gaussians())?;
        if let Some(cell) = packer.cells().find(|&[x, y]| self.chunks.contains_key(&[y, x])) {
            return Err(StoreError::DuplicateCell { name: self.name.clone(), cell });
        }
        // If this fails, the commit has changed in nothing: what was written is staged, but not
        // named.
        // No underflow: the packer has a part of these Gaussians.
        let left_out = count - packer.gaussians();
        let (chunks, clamped) = packer.put(&mut *self.staging, progress)?;
        self.sh_degree = Some(sh_degree);
        self.clamped.merge(&clamped);
        let by_cell = |chunk: &ChunkEntry| ([chunk.cell[1], chunk.cell[0]], chunk.clone());
        self.chunks.extend(chunks.iter().map(by_cell));
        Ok(StoredCells { left_out, chunks })
    }

    /// Puts the chunks of a manifest as they are, which `read` gives, in place of Gaussians.
    pub(super) fn put_chunks(
        &mut self,
        manifest: &Manifest,
        read: &mut dyn FnMut(&ChunkEntry) -> Result<Vec<u8>, StoreError>,
    ) -> Result<(), StoreError> {
        self.sh_degree = Some(manifest.sh_degree);
        for chunk in &manifest.chunks {
            let bytes = read(chunk)?;
            self.staging.put(Box::new(|out| out.write_all(&bytes)))?;
            self.chunks.insert([chunk.cell[1], chunk.cell[0]], chunk.clone());
        }
        Ok(())
    }

    /// Leaves cells of the base out of a version that [`Commit::change`] makes, but for those that
    /// are put.
    pub(super) fn remove(&mut self, cells: &BTreeSet<[i32; 2]>) {
        self.removed.extend(cells.iter().map(|[x, y]| [*y, *x]));
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

    /// Sets the recorded images of the version: those of [`Commit::put_views`], those of another
    /// version of the twin, or none. Otherwise [`Commit::change`] keeps those of its base, and
    /// [`Commit::replace`] has none.
    pub fn set_views(&mut self, views: Option<ViewsRef>) {
        self.views = Some(views);
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
        // Only of the cells that were put: a change is judged by what it adds.
        let gaussians = self.chunks.values().map(|chunk| chunk.count).sum::<u64>();
        match self.clamped.worst() {
            Some((field, count)) if count as f64 > limits::CLAMPED_SHARE * gaussians as f64 => {
                Err(StoreError::Clamped { record: self.storage.record, field, count, gaussians })
            }
            _ => Ok(()),
        }
    }
}
