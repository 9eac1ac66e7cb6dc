//! Packs the Gaussians of whole cells into chunk objects: the blocks of many cells in parallel,
//! level by level.

use std::collections::BTreeSet;
use std::io;
use std::ops::Range;

use rayon::prelude::*;

use wildcity_scene::chunk::{CellRun, Partition};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::ChunkEntry;
use wildcity_scene::record::Clamped;
use wildcity_scene::{Chunk, Gaussians, RecordFormat, lod};

use super::StoreError;
use super::backend::Staging;
use super::chunk_file::{self, ChunkHeader, LevelOfBlock, PackedSection};

/// The smallest batch of Gaussians that is packed in parallel: enough to occupy all cores, and few
/// compared with a scene.
const BATCH_GAUSSIANS: usize = 1 << 16;

/// From this number of Gaussians on, a block is packed while no other is: its levels take about 200
/// bytes for each, and dense captures have millions in a block.
const LARGE_BLOCK: usize = 1 << 18;

/// The sections of a block, and counts of the values that the record could not hold of level 0.
type Packed = (Vec<PackedSection>, Clamped);

/// How Gaussians are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StorageOptions {
    /// The record format, which decides the number of bits per Gaussian.
    pub record: RecordFormat,
    /// Whether levels of detail are made.
    pub levels: bool,
}

impl Default for StorageOptions {
    fn default() -> Self {
        Self { record: RecordFormat::default(), levels: true }
    }
}

/// Gaussians by cell, and how those cells are stored.
#[derive(Debug)]
pub(super) struct CellPacker<'a> {
    gaussians: &'a Gaussians,
    storage: StorageOptions,
    cells: Vec<CellRun>,
    order: Vec<u32>,
}

impl<'a> CellPacker<'a> {
    /// Sorts Gaussians into cells, and keeps only the cells of `only`, if given.
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

    /// Number of Gaussians in the cells.
    pub(super) fn gaussians(&self) -> u64 {
        self.cells.iter().map(|run| run.run.len() as u64).sum()
    }

    /// Writes an object for each cell. Returns the chunks in order, and counts of the values that
    /// the record could not hold. `progress` gets the number of Gaussians written, from 0, and in
    /// all.
    pub(super) fn put(
        &self,
        staging: &mut dyn Staging,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<(Vec<ChunkEntry>, Clamped), StoreError> {
        let total = self.gaussians();
        progress(0, total);
        let mut clamped = Clamped::default();
        let mut done = 0;
        let mut chunks = Vec::with_capacity(self.cells.len());
        let mut rest = &self.cells[..];
        // A batch bounds the memory: its packed sections are held, and not those of the whole
        // scene.
        while !rest.is_empty() {
            let (batch, after) = rest.split_at(batch_cells(rest));
            rest = after;

            // The blocks of all cells of the batch, in parallel.
            let blocks: Vec<(&CellRun, &(u8, Range<usize>))> = batch
                .iter()
                .flat_map(|cell| cell.blocks.iter().map(move |block| (cell, block)))
                .collect();
            let packed = self.pack_blocks(&blocks);
            let packed = packed.map_err(StoreError::io("compress for", staging.dir()))?;

            // Their objects, one after the other.
            let mut packed = packed.into_iter();
            for cell in batch {
                let mut sections = Vec::new();
                // The results are in the order of `blocks`, cell by cell.
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

    /// All levels of some blocks, in order. Small ones are packed in parallel. Of large ones, there
    /// is one in memory at a time; its Gaussians are merged in parallel.
    fn pack_blocks(&self, blocks: &[(&CellRun, &(u8, Range<usize>))]) -> io::Result<Vec<Packed>> {
        let is_small = |block: &(&CellRun, &(u8, Range<usize>))| block.1.1.len() < LARGE_BLOCK;
        let mut packed = Vec::with_capacity(blocks.len());
        for some in blocks.chunk_by(|a, b| is_small(a) && is_small(b)) {
            let some = some.par_iter().map(|(cell, (block, run))| {
                self.pack_block(cell, *block, &self.order[run.clone()])
            });
            packed.extend(some.collect::<io::Result<Vec<_>>>()?);
        }
        Ok(packed)
    }

    /// All levels of one block, and counts of the values that the record could not hold of level 0.
    fn pack_block(&self, cell: &CellRun, block: u8, order: &[u32]) -> io::Result<Packed> {
        let StorageOptions { record, levels } = self.storage;
        let sh_degree = self.gaussians.sh_degree;
        let mut full = Chunk::new(cell.cell, cell.origin_m, sh_degree, order.len());
        for &index in order {
            full.push(&cell.record(self.gaussians, index as usize));
        }
        let indices = order.iter().map(|&index| index as usize);
        let full = full.with_classes(self.gaussians.select_classes(indices));
        let mut clamped = Clamped::default();
        let mut packed = vec![chunk_file::pack(
            &full,
            LevelOfBlock { block, level: 0, error_m: 0.0 },
            record,
            &mut clamped,
        )?];
        if levels {
            let coarser = lod::levels(&full);
            drop(full);
            for (level, lod::Level { error_m, chunk }) in (1..).zip(coarser) {
                // Not counted: merged Gaussians are approximations anyway.
                let lost = &mut Clamped::default();
                let level = LevelOfBlock { block, level, error_m };
                packed.push(chunk_file::pack(&chunk, level, record, lost)?);
            }
        }
        Ok((packed, clamped))
    }

    fn put_chunk(
        &self,
        staging: &mut dyn Staging,
        cell: &CellRun,
        packed: Vec<PackedSection>,
    ) -> Result<ChunkEntry, StoreError> {
        let CellRun { cell, origin_m, ref run, .. } = *cell;
        // Set by the closure, whose own result is only whether writing succeeded.
        let mut sections = Vec::new();
        let mut bounds = Bounds::EMPTY;
        let header = ChunkHeader {
            cell,
            origin_m,
            sh_degree: self.gaussians.sh_degree,
            record: self.storage.record,
            classes: self.gaussians.classes.is_some(),
        };
        let stored = staging.put(Box::new(|out| {
            (sections, bounds) = chunk_file::write(out, &header, packed)?;
            Ok(())
        }))?;
        Ok(ChunkEntry {
            cell,
            object: stored.hash,
            count: run.len() as u64,
            bytes: stored.bytes,
            bounds,
            origin_m,
            classes: header.classes,
            sections,
        })
    }
}

/// Number of the next cells that are packed in parallel.
fn batch_cells(cells: &[CellRun]) -> usize {
    let mut gaussians = 0;
    let few = cells.iter().take_while(|cell| {
        gaussians += cell.run.len();
        gaussians < BATCH_GAUSSIANS
    });
    // The cell that reaches the limit is the last of the batch: at least one, however large it is.
    cells.len().min(few.count() + 1)
}
