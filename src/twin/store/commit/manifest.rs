//! The manifest of a version: what was put, or a base with what was put in place of its own.

use std::collections::BTreeMap;

use wildcity_scene::Manifest;
use wildcity_scene::manifest::ObjectRef;

use crate::limits;
use crate::store::settings::{VersionChange, VersionSettings};
use crate::store::{StoreError, chunk_file};

use super::Commit;

/// A manifest and its hash.
pub(super) struct HashedManifest {
    pub(super) manifest: Manifest,
    /// 64 lower-case hex digits.
    pub(super) hash: String,
}

impl Commit {
    /// A manifest with the cells that were put, and no others. Its table is not written yet.
    pub(super) fn new_manifest(
        &mut self,
        settings: VersionSettings,
    ) -> Result<Manifest, StoreError> {
        let VersionSettings { profile, rig, trajectories, sky, geo, twin_from_capture, provenance } =
            settings;
        Ok(Manifest {
            format: Manifest::FORMAT,
            twin: self.name.clone(),
            profile,
            // If nothing was put, there is no degree to keep.
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
    pub(super) fn merge(
        &mut self,
        mut manifest: Manifest,
        change: &VersionChange,
    ) -> Result<Manifest, StoreError> {
        // The chunks of a version have one degree and one record format, which its manifest states.
        self.check_field("sh_degree", self.sh_degree, manifest.sh_degree)?;
        self.check_field("record", Some(self.storage.record), manifest.record)?;
        let VersionChange { profile, rig, trajectories, sky, geo, provenance } = change.clone();
        // Kept for the comparison below, which only an edit needs.
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
        // By (y, x), the order of a manifest's chunks. What was put takes the place of the old
        // cell.
        let own = manifest.chunks.into_iter().map(|chunk| ([chunk.cell[1], chunk.cell[0]], chunk));
        let mut chunks: BTreeMap<_, _> = own.collect();
        chunks.retain(|cell, _| !self.removed.contains(cell));
        chunks.extend(self.chunks.clone());
        manifest.chunks = chunks.into_values().collect();
        match provenance {
            Some(provenance) => manifest.provenance = provenance,
            // An edit that changes nothing makes no version, so it keeps the note.
            None if edited.as_ref() == Some(&manifest) => {}
            None => manifest.provenance = manifest.provenance.for_edit(),
        }
        Ok(manifest)
    }

    /// Writes the table and the manifest.
    pub(super) fn put_manifest(
        &mut self,
        mut manifest: Manifest,
    ) -> Result<HashedManifest, StoreError> {
        let Manifest { chunks, sh_degree, record, .. } = &manifest;
        let table = chunk_file::table(chunks, *sh_degree, *record)
            .map_err(StoreError::io("encode a table for", self.catalog.dir()))?;
        // Checked before it is written, because no reader would accept it.
        check_size("table", table.len(), limits::TABLE_BYTES)?;
        let stored = self.staging.put(Box::new(|out| out.write_all(&table)))?;
        manifest.table = ObjectRef { object: stored.hash, bytes: stored.bytes };
        let bytes = self.catalog.encode(&manifest)?;
        check_size("manifest", bytes.len(), limits::MANIFEST_BYTES)?;
        let hash = self.staging.put(Box::new(|out| out.write_all(&bytes)))?.hash;
        Ok(HashedManifest { manifest, hash })
    }
}

fn check_size(what: &'static str, bytes: usize, limit: u64) -> Result<(), StoreError> {
    let bytes = bytes as u64;
    if bytes > limit { Err(StoreError::ManifestSize { what, bytes, limit }) } else { Ok(()) }
}
