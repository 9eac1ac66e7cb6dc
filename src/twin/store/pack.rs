//! Packs the Gaussians of whole cells into chunk objects: the blocks of many cells in parallel,
//! level by level.

use std::borrow::Cow;
use std::collections::{BTreeSet, VecDeque};
use std::io;
use std::ops::Range;

use rayon::prelude::*;

use wildcity_scene::chunk::{CellRun, Partition};
use wildcity_scene::geometry::Bounds;
use wildcity_scene::manifest::ChunkEntry;
use wildcity_scene::record::{Clamped, PART_GAUSSIANS};
use wildcity_scene::{Chunk, Gaussians, RecordFormat, lod, sh};

use super::StoreError;
use super::backend::Staging;
use super::chunk_file::{self, ChunkHeader, LevelOfBlock, PackedSection};

/// The smallest batch of Gaussians that is packed in parallel: enough to occupy all cores, and few
/// compared with a scene.
const BATCH_GAUSSIANS: usize = 1 << 16;

/// From this number of Gaussians on, a block is packed while no other is: its levels take about 100
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
    sh_degree: u8,
    has_classes: bool,
    storage: StorageOptions,
    cells: Vec<CellRun>,
    gaussians: Source<'a>,
}

/// Where the Gaussians of blocks come from.
#[derive(Debug)]
enum Source<'a> {
    /// The caller's, and their indices, cell after cell.
    Kept(&'a Gaussians, Vec<u32>),
    /// Those of each block that is still to be packed, in order.
    Consumed(VecDeque<Vec<Gaussians>>),
}

/// The Gaussians of a block, part by part.
enum BlockParts<'a> {
    Kept(&'a Gaussians, &'a [u32]),
    Consumed(Vec<Gaussians>),
}

/// A block that is to be packed.
struct BlockToPack<'a> {
    cell: &'a CellRun,
    block: u8,
    count: usize,
    parts: BlockParts<'a>,
}

impl<'a> CellPacker<'a> {
    /// Sorts Gaussians into cells, and keeps only the cells of `only`, if given. Memory of
    /// Gaussians that are not the caller's is freed as they are packed.
    pub(super) fn new(
        gaussians: Cow<'a, Gaussians>,
        storage: StorageOptions,
        only: Option<&BTreeSet<[i32; 2]>>,
    ) -> Self {
        let Partition { mut cells, order } = Partition::new(&gaussians.means_m);
        // `order` keeps the indices of all cells, because the runs of those that stay are ranges of
        // it.
        cells.retain(|run| only.is_none_or(|only| only.contains(&run.cell)));
        let sh_degree = gaussians.sh_degree;
        let has_classes = gaussians.classes.is_some();
        let gaussians = match gaussians {
            Cow::Borrowed(gaussians) => Source::Kept(gaussians, order),
            // Split into blocks at once, so that the memory of each is freed as it is packed.
            Cow::Owned(gaussians) => Source::Consumed(by_block(gaussians, &cells, &order)),
        };
        Self { sh_degree, has_classes, storage, cells, gaussians }
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
        mut self,
        staging: &mut dyn Staging,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<(Vec<ChunkEntry>, Clamped), StoreError> {
        let total = self.gaussians();
        progress(0, total);
        let mut clamped = Clamped::default();
        let mut done = 0;
        let mut chunks = Vec::with_capacity(self.cells.len());
        let cells = std::mem::take(&mut self.cells);
        let mut rest = &cells[..];
        // A batch bounds the memory: its packed sections are held, and not those of the whole
        // scene.
        while !rest.is_empty() {
            let (batch, after) = rest.split_at(batch_cells(rest));
            rest = after;

            // The blocks of all cells of the batch, in parallel.
            let packed =
                self.pack_blocks(batch).map_err(StoreError::io("compress for", staging.dir()))?;

            // Their objects, one after the other.
            let mut results = packed.into_iter();
            for cell in batch {
                let mut sections = Vec::new();
                // The results are in the order of `blocks`, cell by cell.
                for (block, lost) in results.by_ref().take(cell.blocks.len()) {
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

    /// All levels of the blocks of some cells, in order. Small blocks are packed in parallel. Of
    /// large ones, there is one in memory at a time; its Gaussians are merged in parallel.
    fn pack_blocks(&mut self, cells: &[CellRun]) -> io::Result<Vec<Packed>> {
        let Self { sh_degree, storage, .. } = *self;
        let runs = cells.iter().flat_map(|cell| cell.blocks.iter().map(move |it| (cell, it)));
        let parts: Vec<BlockParts<'_>> = match &mut self.gaussians {
            Source::Kept(gaussians, order) => {
                let kept = |(_, (_, run)): (_, &(u8, Range<usize>))| {
                    BlockParts::Kept(gaussians, &order[run.clone()])
                };
                runs.clone().map(kept).collect()
            }
            Source::Consumed(blocks) => {
                // Batches come in the order of the blocks, so this batch's blocks are in front.
                blocks.drain(..runs.clone().count()).map(BlockParts::Consumed).collect()
            }
        };
        let blocks = runs.zip(parts).map(|((cell, (block, run)), parts)| BlockToPack {
            cell,
            block: *block,
            count: run.len(),
            parts,
        });
        let mut packed = Vec::new();
        let mut small = Vec::new();
        let pack_small = |small: &mut Vec<BlockToPack<'_>>, packed: &mut Vec<Packed>| {
            let blocks = std::mem::take(small).into_par_iter();
            let all = blocks.map(|block| block.pack(sh_degree, storage));
            packed.extend(all.collect::<io::Result<Vec<_>>>()?);
            Ok::<_, io::Error>(())
        };
        for block in blocks {
            if block.count < LARGE_BLOCK {
                small.push(block);
                continue;
            }
            // The small blocks before it go first, so that the results stay in the order of the
            // blocks.
            pack_small(&mut small, &mut packed)?;
            packed.push(block.pack(sh_degree, storage)?);
        }
        pack_small(&mut small, &mut packed)?;
        Ok(packed)
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
            sh_degree: self.sh_degree,
            record: self.storage.record,
            classes: self.has_classes,
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

impl BlockToPack<'_> {
    /// All levels of the block, and counts of the values that the record could not hold of level 0.
    fn pack(self, sh_degree: u8, storage: StorageOptions) -> io::Result<Packed> {
        let StorageOptions { record, levels } = storage;
        let block = self.block;
        let full = self.chunk(sh_degree);
        let mut clamped = Clamped::default();
        let mut packed = vec![chunk_file::pack(
            &full,
            LevelOfBlock { block, level: 0, error_m: 0.0 },
            record,
            &mut clamped,
        )?];
        if levels {
            for (level, lod::Level { error_m, chunk }) in (1..).zip(lod::levels(&full)) {
                // Not counted: merged Gaussians are approximations anyway.
                let lost = &mut Clamped::default();
                let level = LevelOfBlock { block, level, error_m };
                packed.push(chunk_file::pack(&chunk, level, record, lost)?);
            }
        }
        Ok((packed, clamped))
    }

    /// Its Gaussians at full detail. Each part is dropped as it is added.
    fn chunk(self, sh_degree: u8) -> Chunk {
        let Self { cell, count, parts, .. } = self;
        let mut full = Chunk::new(cell.cell, cell.origin_m, sh_degree, count);
        match parts {
            BlockParts::Kept(gaussians, order) => {
                for &index in order {
                    full.push(&cell.record(gaussians, index as usize));
                }
                let indices = order.iter().map(|&index| index as usize);
                full.with_classes(gaussians.select_classes(indices))
            }
            BlockParts::Consumed(parts) => {
                let mut classes = Vec::new();
                for part in parts {
                    for index in 0..part.len() {
                        full.push(&cell.record(&part, index));
                    }
                    classes.extend(part.classes.unwrap_or_default());
                }
                // All parts have classes or none has, as the scene.
                let has_classes = !classes.is_empty();
                full.with_classes(has_classes.then_some(classes))
            }
        }
    }
}

/// The Gaussians of each block of some cells, in parts of at most [`PART_GAUSSIANS`]. One column is
/// sorted at a time, so that no more than one is in memory twice.
fn by_block(gaussians: Gaussians, cells: &[CellRun], order: &[u32]) -> VecDeque<Vec<Gaussians>> {
    let Gaussians { sh_degree, means_m, quats_wxyz, ln_scales, logit_opacities, sh, classes } =
        gaussians;
    let runs: Vec<&Range<usize>> =
        cells.iter().flat_map(|cell| cell.blocks.iter().map(|(_, run)| run)).collect();
    let indices: Vec<&[u32]> =
        runs.iter().flat_map(|run| order[(*run).clone()].chunks(PART_GAUSSIANS)).collect();
    let empty = || Gaussians { sh_degree, ..Gaussians::default() };
    let mut parts: Vec<Gaussians> = indices.iter().map(|_| empty()).collect();
    sort_column(&mut parts, &indices, means_m, |part| &mut part.means_m);
    sort_column(&mut parts, &indices, quats_wxyz, |part| &mut part.quats_wxyz);
    sort_column(&mut parts, &indices, ln_scales, |part| &mut part.ln_scales);
    sort_column(&mut parts, &indices, logit_opacities, |part| &mut part.logit_opacities);
    if let Some(classes) = classes {
        sort_column(&mut parts, &indices, classes, |part| part.classes.insert(Vec::new()));
    }
    // Unlike the other columns, this one has many values for each Gaussian.
    let stride = 3 * sh::coefficients(sh_degree);
    for (part, indices) in parts.iter_mut().zip(&indices) {
        part.sh.reserve_exact(stride * indices.len());
        for &index in *indices {
            part.sh.extend_from_slice(&sh[stride * index as usize..][..stride]);
        }
    }
    let mut parts = parts.into_iter();
    // `indices` has the parts of each run one after the other, in the order of the runs.
    let of_run =
        |run: &&Range<usize>| parts.by_ref().take(run.len().div_ceil(PART_GAUSSIANS)).collect();
    runs.iter().map(of_run).collect()
}

/// Sorts a column into parts, by the indices of each. On one thread, which also packs large blocks:
/// what another one allocates is not used again by this one after it was freed.
fn sort_column<T: Copy>(
    parts: &mut [Gaussians],
    indices: &[&[u32]],
    column: Vec<T>,
    of_part: impl Fn(&mut Gaussians) -> &mut Vec<T>,
) {
    for (part, indices) in parts.iter_mut().zip(indices) {
        *of_part(part) = indices.iter().map(|&index| column[index as usize]).collect();
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
