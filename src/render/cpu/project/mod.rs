//! Stage project: 3D Gaussians become 2D splats on the images of all views, 16 Gaussians at a time.
//!
//! The method is EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian splatting (Kerbl et al.
//! 2023). A static pinhole camera has its projection linearised at each centre ([`pinhole`]). Every
//! other camera (lens distortion, windshield, rolling shutter while it moves) has six points of
//! each Gaussian projected ([`unscented`]). Both produce the same kind of splat ([`splat_block`]).
//! A static pinhole keeps its own path, to the byte: without other cameras in a frame the second
//! path does not run.
//!
//! # Layout
//!
//! Work is cut into units of one view and 16 clusters of one chunk. Threads compute units in any
//! order, and their results are stored in order of (view, global id), so the output does not depend
//! on the schedule.
//!
//! **Splats stay where they were projected.** They lie in pages of 256 splats that one frame leaves
//! to the next. Bin writes 12 bytes for each macro tile of a splat, and sort copies the splats of
//! one macro tile at a time. Copying all of a frame into depth order was no faster to read, and it
//! doubled the memory of a frame.
//!
//! **Every function that a hot loop calls is `#[inline(always)]`.** `fearless_simd` dispatches to
//! an instruction set at run time, on stable Rust. A closure or an iterator adapter that remains a
//! call of its own is compiled without that instruction set. Removing such calls made this stage
//! four times as fast.

mod angles;
pub(in crate::cpu) mod axes;
mod color;
pub(super) mod gradient;
mod jobs;
mod light;
mod pinhole;
mod splat_block;
mod unscented;

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use fearless_simd::{Level, dispatch, prelude::*};
use parking_lot::Mutex;
use prefetch_index::prefetch_index;
use rayon::prelude::*;

use self::jobs::ChunkProjection;
use super::overflow::Overflow;
use super::slabs::{Slab, SlabOfJob};
use crate::layout::{Cutoffs, Splat};
use wildcity_scene::SemanticClass;
use wildcity_scene::chunk::{CLUSTER, LANES, Lanes};

pub(super) use self::jobs::{Job, UNIT_CLUSTERS, with_jobs};

/// Number of blocks by which memory is read ahead. The loads of the block itself would come too
/// late: the processor does not reach the loads of the next block before the computations of the
/// current one.
const AHEAD: usize = 2;

/// Splats of a page.
const PAGE: usize = 1 << PAGE_BITS;
const PAGE_BITS: u32 = 8;

/// 12 KiB of splats. The units of a frame change as the ego moves; pages pass from one unit to
/// another, so memory follows the largest frame and not the sum of each unit's largest size.
type Page = Box<[Splat; PAGE]>;

/// How much is projected.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProjectLimits {
    /// Most places for splats.
    pub(super) most_places: usize,
    /// Whether the classes of splats are kept, too.
    pub(super) classes: bool,
}

/// All splats of a frame.
#[derive(Debug, Default)]
pub(super) struct Projected {
    /// Pages in order of (view, global id); the last page of each unit may be partly filled.
    pages: Vec<Page>,
    units: Vec<Unit>,
    /// Pages of earlier frames that this frame has not used.
    free: Mutex<Vec<Page>>,
}

/// The splats of one view and at most 4,096 Gaussians.
#[derive(Debug)]
pub(super) struct Unit {
    /// Index of the view.
    pub(super) view: usize,
    pub(super) len: usize,
    /// Index of its first page.
    first_page: usize,
    /// The owner of the splats, as in [`Target::instances`](crate::Target::instances).
    pub(super) instance: u16,
    /// The class of the splats whose Gaussians have none, as in
    /// [`Target::semantics`](crate::Target::semantics).
    class: SemanticClass,
    /// The class of each splat: empty if classes are not wanted, or its chunk has none.
    classes: Vec<SemanticClass>,
}

/// What a thread fills with the splats of one unit after the other.
#[derive(Debug, Default)]
struct UnitSplats {
    splats: Vec<Splat>,
    /// The class of each splat, if classes are wanted and the chunk has some.
    classes: Vec<SemanticClass>,
}

/// The splats of a unit after it was projected.
#[derive(Debug, Default)]
struct Filled {
    len: usize,
    pages: Vec<Page>,
    classes: Vec<SemanticClass>,
}

impl Projected {
    /// Projects the Gaussians of all jobs, or only the splats that are in a slab.
    ///
    /// # Errors
    /// [`Overflow`]: there are more places for splats than the limit. Then nothing is projected.
    pub(super) fn project(
        &mut self,
        level: Level,
        jobs: &[Job<'_>],
        cutoffs: &Cutoffs,
        slab: Option<&Slab<'_>>,
        ProjectLimits { most_places, classes }: ProjectLimits,
    ) -> Result<(), Overflow> {
        let Self { pages, units, free } = self;
        // All pages of the previous frame are free again.
        free.get_mut().append(pages);
        units.clear();

        // In parallel: each job fills pages of its own. Views that see the same Gaussians follow
        // each other, so that these are read from memory once.
        let mut order: Vec<usize> = match slab {
            None => (0..jobs.len()).collect(),
            Some(slab) => slab.jobs().collect(),
        };
        order.sort_by_key(|&index| jobs[index].gaussians());
        let used_pages = AtomicUsize::new(0);
        // Rounded down, as a page is taken as a whole.
        let most_pages = most_places >> PAGE_BITS;
        let filled: Vec<Filled> = order
            .par_iter()
            .map_init(UnitSplats::default, |unit, &index| {
                unit.splats.clear();
                unit.classes.clear();
                // The part is drawn again in smaller parts anyway. The sum decides below, so that
                // the order of threads does not matter.
                if used_pages.load(Relaxed) > most_pages {
                    return Filled::default();
                }
                let slab = slab.map(|slab| slab.job(index));
                let job = &jobs[index];
                dispatch!(level, simd => project_unit(simd, job, cutoffs, slab, classes, unit));
                let UnitSplats { splats, classes } = unit;
                // Counted before the pages are filled: at most one unit per thread is too much.
                used_pages.fetch_add(splats.len().div_ceil(PAGE), Relaxed);
                let pages = copy_to_pages(splats, free);
                Filled { len: splats.len(), pages, classes: classes.as_slice().to_vec() }
            })
            .collect();
        // From the order of the schedule back to that of (view, global id). Jobs outside of a slab
        // have no splats.
        let mut by_job: Vec<Filled> = Vec::new();
        by_job.resize_with(jobs.len(), Filled::default);
        for (index, filled) in order.into_iter().zip(filled) {
            by_job[index] = filled;
        }

        // In the order of the jobs: list the pages.
        for (job, filled) in jobs.iter().zip(by_job) {
            let Job { view, instance, class, .. } = *job;
            let Filled { len, pages: mut own, classes } = filled;
            units.push(Unit { view, len, first_page: pages.len(), instance, class, classes });
            pages.append(&mut own);
        }
        if used_pages.into_inner() > most_pages {
            // A part that overflows has no splats; its pages become free with the next call.
            units.clear();
            return Err(Overflow);
        }
        Ok(())
    }

    pub(super) fn len(&self) -> usize {
        self.units.iter().map(|unit| unit.len).sum()
    }

    /// Number of places for splats; the last ones of each unit may be empty.
    pub(super) fn places(&self) -> usize {
        self.pages.len() * PAGE
    }

    /// Memory of the splats and their classes, in bytes.
    pub(super) fn held_bytes(&self) -> u64 {
        let of_classes: usize = self.units.iter().map(|unit| unit.classes.len()).sum();
        (self.places() * size_of::<Splat>() + of_classes) as u64
    }

    /// The places of the splats of consecutive units.
    pub(super) fn places_between(&self, units: Range<usize>) -> Range<usize> {
        let units = &self.units[units];
        let first = units.first().map_or(0, |unit| unit.first_page);
        let end = units.last().map_or(0, |unit| unit.first_page + unit.len.div_ceil(PAGE));
        first << PAGE_BITS..end << PAGE_BITS
    }

    /// The units in order of (view, global id).
    pub(super) fn units(&self) -> &[Unit] {
        &self.units
    }

    /// The place of the first splat of a unit.
    pub(super) fn first_place(&self, unit: &Unit) -> usize {
        unit.first_page << PAGE_BITS
    }

    /// Places and splats of one unit, in order of global ids.
    pub(super) fn unit(&self, unit: &Unit) -> impl Iterator<Item = (u32, &Splat)> {
        let first = (unit.first_page << PAGE_BITS) as u32;
        let pages = &self.pages[unit.first_page..];
        (first..).zip(pages.iter().flat_map(|page| page.iter()).take(unit.len))
    }

    /// The splats of one unit page by page, each with the place of its first: for hot loops.
    pub(super) fn pages(&self, unit: &Unit) -> impl Iterator<Item = (u32, &[Splat])> {
        let pages = (unit.first_page..).zip((0..unit.len).step_by(PAGE));
        pages.map(move |(page, start)| {
            let splats = &self.pages[page][..PAGE.min(unit.len - start)];
            ((page << PAGE_BITS) as u32, splats)
        })
    }

    /// The owner of the splat at a place, as in [`Target::instances`](crate::Target::instances).
    pub(super) fn instance(&self, place: u32) -> u16 {
        self.unit_with(place).instance
    }

    /// The class of the splat at a place, as in [`Target::semantics`](crate::Target::semantics).
    pub(super) fn class(&self, place: u32) -> SemanticClass {
        self.class_in(self.unit_with(place), place)
    }

    /// As [`Projected::class`], of a splat of this unit.
    pub(super) fn class_in(&self, unit: &Unit, place: u32) -> SemanticClass {
        let own = unit.classes.get(place as usize - self.first_place(unit));
        own.map_or(unit.class, |own| own.or(unit.class))
    }

    /// The unit of the splat at a place.
    fn unit_with(&self, place: u32) -> &Unit {
        let page = (place >> PAGE_BITS) as usize;
        // Empty units share their first page with the next unit: the last of them owns the page.
        let after = self.units.partition_point(|unit| unit.first_page <= page);
        &self.units[after - 1]
    }

    /// The splat at a place: the high bits are the page, the low 8 bits the splat of the page.
    #[inline(always)]
    pub(super) fn splat(&self, place: u32) -> &Splat {
        &self.pages[(place >> PAGE_BITS) as usize][place as usize % PAGE]
    }
}

/// Copies splats to free pages, and to new ones when no free page is left.
fn copy_to_pages(splats: &[Splat], free: &Mutex<Vec<Page>>) -> Vec<Page> {
    let wanted = splats.len().div_ceil(PAGE);
    let mut pages = {
        let mut free = free.lock();
        // Only the list is changed under the lock: pages are allocated and filled outside of it.
        let kept = free.len().saturating_sub(wanted);
        free.split_off(kept)
    };
    pages.resize_with(wanted, || Box::new([Splat::default(); PAGE]));
    for (page, splats) in pages.iter_mut().zip(splats.chunks(PAGE)) {
        page[..splats.len()].copy_from_slice(splats);
    }
    pages
}

/// Begins to read a block from memory.
#[inline(always)]
fn prefetch(columns: &[Lanes]) {
    for column in 0..columns.len() {
        prefetch_index(columns, column);
    }
}

/// Projects the visible clusters of a job, one block of 16 Gaussians after the other; of a slab
/// only its splats. `with_classes` keeps the classes of the splats, if the chunk has some.
#[inline(always)]
fn project_unit<S: Simd>(
    simd: S,
    job: &Job<'_>,
    cutoffs: &Cutoffs,
    slab: Option<SlabOfJob<'_>>,
    with_classes: bool,
    UnitSplats { splats, classes }: &mut UnitSplats,
) {
    let own_classes = job.chunk.classes().filter(|_| with_classes);
    let blocks = job.chunk.len().div_ceil(LANES);
    for (k, cluster) in (job.clusters.clone()).zip(&job.chunk.clusters()[job.clusters.clone()]) {
        let may_see = match &slab {
            None => job.projection.may_see(job.chunk, cluster),
            Some(slab) => slab.touches(k),
        };
        if !may_see {
            continue;
        }
        // `keep` looks at the splats of this cluster only.
        let before = splats.len();
        let light = job.light.on(cluster);
        let first = k * CLUSTER / LANES;
        for block in first..(first + CLUSTER / LANES).min(blocks) {
            // The last blocks of a chunk prefetch its last block again.
            let ahead = (block + AHEAD).min(blocks - 1);
            prefetch(job.chunk.lane_group(ahead));
            let columns = job.chunk.lane_group(block);
            let degree = job.chunk.sh_degree();
            let projected = match &job.projection {
                ChunkProjection::Pinhole { chunk_view, .. } => {
                    pinhole::project_block(simd, columns, degree, chunk_view, cutoffs)
                }
                ChunkProjection::Unscented(view) => {
                    unscented::project_block(simd, columns, degree, view, cutoffs)
                }
            };
            if let Some(mut projected) = projected {
                // Before the visible lanes are picked, while the colours are still 16 to a vector.
                light.apply(simd, columns, &mut projected);
                projected.append_visible(splats);
                if let Some(own) = own_classes {
                    projected.append_classes(&own[block * LANES..], classes);
                }
            }
        }
        if let Some(slab) = &slab {
            slab.keep(cutoffs, splats, classes, before);
        }
    }
}
