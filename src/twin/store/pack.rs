//! Gaussians of whole cells become chunk objects: the blocks of many cells at once, level by level.

use std::collections::BTreeSet;
use std::io;
use std::ops::Range;

use rayon::prelude::*;

use wildcity_scene::chunk::{CellRun, Partition};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::ChunkEntry;
use wildcity_scene::record::Clamped;
use wildcity_scene::{Chunk, Gaussians, RecordFormat, lod};

use super::chunk_file::{self, PackedSection};
use super::objects::Staging;
use super::{StorageOptions, StoreError};

/// Gaussians whose blocks are made at once, at least: enough for all cores, few beside a scene.
const TOGETHER: usize = 1 << 16;

/// Gaussians by cell, and how those cells are stored.
#[derive(Debug)]
pub(super) struct CellPacker<'a> {
    gaussians: &'a Gaussians,
    storage: StorageOptions,
    cells: Vec<CellRun>,
    order: Vec<u32>,
}

impl<'a> CellPacker<'a> {
    /// Sorts Gaussians into cells, and leaves out all but those that are asked for.
    pub(super) fn new(
        gaussians: &'a Gaussians,
        storage: StorageOptions,
        only: Option<&BTreeSet<[i32; 2]>>,
    ) -> Self {
        let Partition { mut cells, order } = Partition::new(&gaussians.means_m);
        cells.retain(|run| only.is_none_or(|only| only.contains(&run.cell)));
        Self { gaussians, storage, cells, order }
    }

    /// The cells in order.
    pub(super) fn cells(&self) -> impl Iterator<Item = [i32; 2]> + '_ {
        self.cells.iter().map(|run| run.cell)
    }

    /// Gaussians in the cells.
    pub(super) fn gaussians(&self) -> u64 {
        self.cells.iter().map(|run| run.run.len() as u64).sum()
    }

    /// Writes an object for each cell. Returns them in order, and what the record could not hold.
    /// `progress` gets Gaussians written and Gaussians in all.
    pub(super) fn put(
        &self,
        staging: &mut Staging,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<(Vec<ChunkEntry>, Clamped), StoreError> {
        let total = self.gaussians();
        let (mut clamped, mut done) = (Clamped::default(), 0);
        let mut chunks = Vec::with_capacity(self.cells.len());
        let mut rest = &self.cells[..];
        while !rest.is_empty() {
            let (together, after) = rest.split_at(together(rest));
            rest = after;
            let blocks: Vec<(&CellRun, &(u8, Range<usize>))> = together
                .iter()
                .flat_map(|cell| cell.blocks.iter().map(move |block| (cell, block)))
                .collect();
            let packed = blocks.into_par_iter().map(|(cell, (block, run))| {
                self.pack_block(cell, *block, &self.order[run.clone()])
            });
            let packed = packed.collect::<io::Result<Vec<_>>>();
            let packed = packed.map_err(StoreError::io("compress for", staging.dir()))?;
            let mut packed = packed.into_iter();
            for cell in together {
                let mut sections = Vec::new();
                for (block, lost) in packed.by_ref().take(cell.blocks.len()) {
                    sections.extend(block);
                    clamped.merge(&lost);
                }
                chunks.push(self.put_chunk(staging, cell, sections)?);
                done += cell.run.len() as u64;
                progress(done, total);
            }
        }
        Ok((chunks, clamped))
    }

    /// All levels of one block, and what its record could not hold of level 0.
    fn pack_block(
        &self,
        cell: &CellRun,
        block: u8,
        order: &[u32],
    ) -> io::Result<(Vec<PackedSection>, Clamped)> {
        let StorageOptions { record, levels } = self.storage;
        let sh_degree = self.gaussians.sh_degree;
        let mut full = Chunk::new(cell.cell, cell.origin_m, sh_degree, order.len());
        for &index in order {
            full.push(&cell.record(self.gaussians, index as usize));
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
        &self,
        staging: &mut Staging,
        cell: &CellRun,
        packed: Vec<PackedSection>,
    ) -> Result<ChunkEntry, StoreError> {
        let CellRun { cell, origin_m, ref run, .. } = *cell;
        let (sh_degree, record): (u8, RecordFormat) =
            (self.gaussians.sh_degree, self.storage.record);
        let (mut sections, mut bounds) = (Vec::new(), Bounds::EMPTY);
        let put = staging.put(|out| {
            (sections, bounds) =
                chunk_file::write(out, (cell, origin_m), sh_degree, record, packed)?;
            Ok(())
        })?;
        let (object, bytes, count) = (put.hash, put.bytes, run.len() as u64);
        Ok(ChunkEntry { cell, object, count, bytes, bounds, origin_m, sections })
    }
}

/// How many of the next cells are made at once.
fn together(cells: &[CellRun]) -> usize {
    let mut gaussians = 0;
    let few = cells.iter().take_while(|cell| {
        gaussians += cell.run.len();
        gaussians < TOGETHER
    });
    cells.len().min(few.count() + 1)
}
