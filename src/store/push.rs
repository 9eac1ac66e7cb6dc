//! Committing a version: check everything, write the objects, and then the log's record.

use std::collections::BTreeSet;
use std::time::{SystemTime, UNIX_EPOCH};

use glam::{DMat3, DQuat, DVec3};

use crate::config;
use crate::geometry::Bounds;
use crate::ingest;
use crate::scene::chunk::{CellRun, Partition};
use crate::scene::manifest::{ChunkEntry, Provenance};
use crate::scene::rig::is_name;
use crate::scene::{Gaussians, Manifest, RenderProfile, Rig, Trajectory};

use super::catalog::Record;
use super::objects::Staging;
use super::{Catalog, StoreError, Version, chunk_file, recover};

/// What a new version of a twin consists of.
#[derive(Clone, Debug)]
pub struct NewVersion<'a> {
    /// The twin's name, `[a-z0-9._-]+`; a new one makes a new twin.
    pub name: &'a str,
    /// The Gaussians, in metres along the twin's axes.
    pub gaussians: &'a Gaussians,
    /// How they must be rendered.
    pub profile: RenderProfile,
    /// The vehicle that recorded them.
    pub rig: Option<Rig>,
    /// Recorded drives.
    pub trajectories: Vec<Trajectory>,
    /// Where they come from.
    pub provenance: Provenance,
}

impl Catalog {
    /// Writes a version and makes it the latest, all or nothing; waits for a running commit of the
    /// same twin. The same content as the latest version's is that version: no new one is made.
    /// `progress` gets Gaussians written and Gaussians in all.
    ///
    /// # Errors
    /// Names what cannot be accepted, before anything is written; or what could not be written,
    /// and then nothing of it is left. [`StoreError::NotSynced`] alone means that the version is
    /// there, but might not be after a power cut.
    pub fn commit(
        &self,
        new: NewVersion<'_>,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Version, StoreError> {
        new.check()?;
        recover::clean(self)?;
        let mut staging = self.objects.stage(new.name)?;
        let manifest = Manifest {
            format: Manifest::FORMAT,
            twin: new.name.to_owned(),
            profile: new.profile,
            sh_degree: new.gaussians.sh_degree,
            chunks: put_chunks(&mut staging, new.gaussians, progress)?,
            rig: new.rig,
            trajectories: new.trajectories,
            provenance: new.provenance,
        };
        let bytes = self.encode(&manifest)?;
        if bytes.len() as u64 > config::MANIFEST_BYTES {
            let (bytes, limit) = (bytes.len() as u64, config::MANIFEST_BYTES);
            return Err(StoreError::ManifestSize { bytes, limit });
        }
        let hash = staging.put(|out| out.write_all(&bytes))?.hash;

        let latest = self.objects.numbers(new.name)?.last().copied();
        if let Some(number) = latest
            && let Ok(record) = self.record(new.name, number)
            && record.manifest == hash
        {
            staging.restore(number)?;
            return Ok(Version { number, hash, created_us: record.created_us, manifest });
        }
        let number = latest.unwrap_or(0) + 1;
        let record = Record { manifest: hash, created_us: now_us() };
        staging.publish(number, &self.encode(&record)?)?;
        let Record { manifest: hash, created_us } = record;
        Ok(Version { number, hash, created_us, manifest })
    }

    /// JSON with the fields in the order of the type: the same content, the same bytes.
    fn encode(&self, content: &impl serde::Serialize) -> Result<Vec<u8>, StoreError> {
        serde_json::to_vec(content).map_err(|e| StoreError::io("encode for", self.dir())(e.into()))
    }
}

impl NewVersion<'_> {
    fn check(&self) -> Result<(), StoreError> {
        if !is_name(self.name) {
            return Err(StoreError::Name { name: self.name.to_owned() });
        }
        ingest::validate::check(self.gaussians, &ingest::validate::Field::twin_name)?;
        self.profile.check()?;
        if let Some(rig) = &self.rig {
            rig.check()?;
        }
        let mut names = BTreeSet::new();
        for trajectory in &self.trajectories {
            trajectory.check()?;
            if !names.insert(&*trajectory.name) {
                return Err(StoreError::TrajectoryName { name: trajectory.name.clone() });
            }
        }
        Ok(())
    }
}

fn put_chunks(
    staging: &mut Staging,
    gaussians: &Gaussians,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Vec<ChunkEntry>, StoreError> {
    let Partition { cells, order } = Partition::new(&gaussians.means_m);
    let total = order.len() as u64;
    let mut done = 0;
    let mut entries = Vec::with_capacity(cells.len());
    for cell in &cells {
        entries.push(put_chunk(staging, gaussians, cell, &order[cell.run.clone()], &mut || {
            done += 1;
            if done % PROGRESS_EVERY == 0 || done == total {
                progress(done, total);
            }
        })?);
    }
    Ok(entries)
}

/// Gaussians between two reports of progress.
const PROGRESS_EVERY: u64 = 16_384;

fn put_chunk(
    staging: &mut Staging,
    gaussians: &Gaussians,
    cell: &CellRun,
    order: &[u32],
    written: &mut dyn FnMut(),
) -> Result<ChunkEntry, StoreError> {
    let put = staging.put(|out| chunk_file::write(out, cell, gaussians, order, &mut *written))?;
    let mut bounds = Bounds::EMPTY;
    for &index in order {
        let index = index as usize;
        bounds.add(DVec3::from_array(gaussians.means_m[index]), reach_m(gaussians, index));
    }
    Ok(ChunkEntry {
        cell: cell.cell,
        object: put.hash,
        count: order.len() as u64,
        bytes: put.bytes,
        bounds,
    })
}

/// Half-size of the box around 3 standard deviations, in metres: per axis `3 sqrt(cov_ii)`, where
/// `cov = R S Sᵀ Rᵀ`, so `cov_ii` is the squared length of row i of `R S`.
fn reach_m(gaussians: &Gaussians, index: usize) -> DVec3 {
    let [w, x, y, z] = gaussians.quats_wxyz[index].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = DVec3::from_array(gaussians.ln_scales[index].map(|ln| f64::from(ln).exp()));
    let rows = (rotation * DMat3::from_diagonal(scale)).transpose();
    3.0 * DVec3::new(rows.x_axis.length(), rows.y_axis.length(), rows.z_axis.length())
}

fn now_us() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
}
