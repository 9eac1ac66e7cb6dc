//! Committing a version: check everything, write the objects, and then the log's record.

use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::time::{SystemTime, UNIX_EPOCH};

use rayon::prelude::*;

use crate::config;
use crate::geometry::Bounds;
use crate::ingest;
use crate::scene::chunk::{CellRun, Partition};
use crate::scene::manifest::{ChunkEntry, ObjectRef, Provenance};
use crate::scene::record::Clamped;
use crate::scene::rig::is_name;
use crate::scene::{Chunk, Gaussians, Manifest, Record, RenderProfile, Rig, Trajectory, lod};

use super::catalog::LogRecord;
use super::chunk_file::Packed;
use super::objects::{Put, Staging};
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
    /// How they are stored.
    pub storage: Storage,
}

/// How Gaussians are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Storage {
    /// In how many bits.
    pub record: Record,
    /// Whether levels of detail are made, too.
    pub levels: bool,
}

impl Default for Storage {
    fn default() -> Self {
        Self { record: Record::default(), levels: true }
    }
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
        let chunks = put_chunks(&mut staging, &new, progress)?;
        let (sh_degree, record) = (new.gaussians.sh_degree, new.storage.record);
        let table = chunk_file::table(&chunks, sh_degree, record)
            .map_err(StoreError::io("encode a table for", self.dir()))?;
        check_size("table", table.len(), config::TABLE_BYTES)?;
        let Put { hash: object, bytes } = staging.put(|out| out.write_all(&table))?;
        let manifest = Manifest {
            format: Manifest::FORMAT,
            twin: new.name.to_owned(),
            profile: new.profile,
            sh_degree,
            record,
            table: ObjectRef { object, bytes },
            chunks,
            rig: new.rig,
            trajectories: new.trajectories,
            provenance: new.provenance,
        };
        let bytes = self.encode(&manifest)?;
        check_size("manifest", bytes.len(), config::MANIFEST_BYTES)?;
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
        let record = LogRecord { manifest: hash, created_us: now_us() };
        staging.publish(number, &self.encode(&record)?)?;
        let LogRecord { manifest: hash, created_us } = record;
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

/// Gaussians whose blocks are made at once, at least: enough for all cores, few beside a scene.
const TOGETHER: usize = 1 << 16;

fn put_chunks(
    staging: &mut Staging,
    new: &NewVersion<'_>,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Vec<ChunkEntry>, StoreError> {
    let Partition { cells, order } = Partition::new(&new.gaussians.means_m);
    let total = order.len() as u64;
    let mut clamped = Clamped::default();
    let mut chunks = Vec::with_capacity(cells.len());
    let mut first = 0;
    while first < cells.len() {
        let start = cells[first].run.start;
        let more = cells[first..].iter().take_while(|cell| cell.run.end - start < TOGETHER).count();
        let together = &cells[first..cells.len().min(first + more + 1)];
        let blocks: Vec<(&CellRun, &(u8, Range<usize>))> =
            together.iter().flat_map(|cell| cell.blocks.iter().map(move |b| (cell, b))).collect();
        let packed = blocks
            .into_par_iter()
            .map(|(cell, (block, run))| pack_block(new, cell, *block, &order[run.clone()]));
        let packed = packed.collect::<io::Result<Vec<_>>>();
        let mut packed = packed.map_err(StoreError::io("compress for", staging.dir()))?.into_iter();
        for cell in together {
            let own = packed.by_ref().take(cell.blocks.len());
            let mut sections = Vec::new();
            for (block, lost) in own {
                sections.extend(block);
                clamped.merge(&lost);
            }
            chunks.push(put_chunk(staging, new, cell, sections)?);
            progress(cell.run.end as u64, total);
        }
        first += together.len();
    }
    match clamped.worst() {
        Some((field, count)) if count as f64 > config::CLAMPED_SHARE * total as f64 => {
            let record = new.storage.record;
            Err(StoreError::Clamped { record, field, count, gaussians: total })
        }
        _ => Ok(chunks),
    }
}

/// All levels of one block, and what its record could not hold of level 0.
fn pack_block(
    new: &NewVersion<'_>,
    cell: &CellRun,
    block: u8,
    order: &[u32],
) -> io::Result<(Vec<Packed>, Clamped)> {
    let Storage { record, levels } = new.storage;
    let sh_degree = new.gaussians.sh_degree;
    let mut full = Chunk::new(cell.cell, cell.origin_m, sh_degree, order.len());
    for &index in order {
        full.push(&cell.record(new.gaussians, index as usize));
    }
    let mut clamped = Clamped::default();
    let mut packed = vec![chunk_file::pack(&full, [block, 0], 0.0, record, &mut clamped)?];
    if levels {
        for (level, lod::Level { error_m, chunk }) in (1..).zip(lod::levels(&full)) {
            let lost = &mut Clamped::default();
            packed.push(chunk_file::pack(&chunk, [block, level], error_m, record, lost)?);
        }
    }
    Ok((packed, clamped))
}

fn put_chunk(
    staging: &mut Staging,
    new: &NewVersion<'_>,
    cell: &CellRun,
    packed: Vec<Packed>,
) -> Result<ChunkEntry, StoreError> {
    let CellRun { cell, origin_m, ref run, .. } = *cell;
    let (sh_degree, record) = (new.gaussians.sh_degree, new.storage.record);
    let (mut sections, mut bounds) = (Vec::new(), Bounds::EMPTY);
    let put = staging.put(|out| {
        (sections, bounds) = chunk_file::write(out, (cell, origin_m), sh_degree, record, packed)?;
        Ok(())
    })?;
    let (object, bytes, count) = (put.hash, put.bytes, run.len() as u64);
    Ok(ChunkEntry { cell, object, count, bytes, bounds, origin_m, sections })
}

fn check_size(what: &'static str, bytes: usize, limit: u64) -> Result<(), StoreError> {
    let bytes = bytes as u64;
    if bytes > limit { Err(StoreError::ManifestSize { what, bytes, limit }) } else { Ok(()) }
}

fn now_us() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
}
