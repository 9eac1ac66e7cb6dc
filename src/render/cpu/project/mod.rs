//! Stage project: 3D Gaussians become 2D splats on the images of all views, 16 Gaussians at a time.
//!
//! The method is EWA splatting (Zwicker et al. 2001) as used by 3D Gaussian splatting (Kerbl et al. 2023). A
//! static pinhole camera has its projection linearised at each centre ([`pinhole`]). Every other camera (lens
//! distortion, windshield, rolling shutter while it moves) has six points of each Gaussian projected
//! ([`unscented`]). Both produce the same kind of splat ([`splat_block`]). A static pinhole keeps its own
//! path, to the byte: without other cameras in a frame nothing of the second path runs.
//!
//! # Layout
//!
//! Work is cut into units of one view and 16 clusters of one chunk. Threads compute units in any order, and
//! their results are stored in order of (view, global id), so the output does not depend on the schedule.
//!
//! **Splats stay where they were projected.** They lie in pages of 256 splats that one frame leaves to the
//! next. Bin writes 12 bytes for each macro tile of a splat, and sort copies the splats of one macro tile at a time. Copying all
//! of a frame into depth order was no faster to read, and it doubled the memory of a frame.
//!
//! **Every function that a hot loop calls is `#[inline(always)]`.** `fearless_simd` dispatches to an
//! instruction set at run time, on stable Rust. A closure or an iterator adapter that remains a call of its
//! own is compiled without that instruction set. Removing such calls made this stage four times as fast.

mod angles;
mod axes;
mod color;
mod light;
mod pinhole;
mod splat_block;
mod unscented;

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use fearless_simd::{Level, dispatch, prelude::*};
use glam::DVec3;
use parking_lot::Mutex;
use prefetch_index::prefetch_index;
use rayon::prelude::*;

use self::light::Light;
use self::unscented::UnscentedChunkView;
use super::lens::LensProjection;
use super::overflow::Overflow;
use super::slabs::{Slab, SlabOfJob};
use crate::actor_views::ActorViews;
use crate::layout::{ChunkShadow, ChunkView, Cutoffs, Frustum, Splat};
use crate::unscented::UnscentedView;
use crate::{FIRST_ACTOR_INSTANCE, Frame, TWIN_INSTANCE, View};
use wildcity_scene::Chunk;
use wildcity_scene::chunk::{CLUSTER, Cluster, LANES, Lanes};

/// Clusters of a unit: 4,096 Gaussians take about 100 µs, long enough to outweigh scheduling them.
const UNIT_CLUSTERS: usize = 16;

/// How many blocks ahead memory is read. The loads of the block itself would come too late: the processor cannot see
/// past the computations of one block to the loads of the next.
const AHEAD: usize = 2;

/// Splats of a page.
const PAGE: usize = 1 << PAGE_BITS;
const PAGE_BITS: u32 = 8;

/// 12 KiB of splats. The units of a frame change as the ego moves; pages pass from one unit to another, so
/// memory follows the largest frame and not the sum of each unit's largest size.
type Page = Box<[Splat; PAGE]>;

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
    /// Number of splats.
    pub(super) len: usize,
    /// Index of its first page.
    first_page: usize,
    /// Whose splats they are, as in [`Target::instances`](crate::Target::instances).
    pub(super) instance: u16,
}

/// A view that is not a static pinhole.
struct NonPinholeView<'a> {
    unscented: UnscentedView<'a>,
    /// The lens for 16 points at a time; `None` where only the f64 path describes it.
    lens: Option<LensProjection>,
}

/// What one thread computes at a time: becomes one [`Unit`].
pub(super) struct Job<'a> {
    view: usize,
    chunk: &'a Chunk,
    clusters: Range<usize>,
    projection: ChunkProjection<'a>,
    light: Light<'a>,
    /// As of [`Unit`].
    instance: u16,
}

impl Job<'_> {
    /// Which Gaussians it projects: the address of their chunk, and the first cluster. Only the schedule depends on it.
    fn gaussians(&self) -> (usize, usize) {
        (std::ptr::from_ref(self.chunk).addr(), self.clusters.start)
    }

    /// The clusters that the view may see: the number of each in the chunk, and
    /// bounds of the depths of their centres, in metres.
    pub(super) fn visible_clusters(&self) -> impl Iterator<Item = (usize, [f64; 2])> {
        self.clusters.clone().filter_map(|number| {
            let cluster = &self.chunk.clusters()[number];
            let is_seen = self.projection.may_see(self.chunk, cluster);
            is_seen.then(|| (number, self.projection.depths_m(cluster)))
        })
    }
}

/// Runs `work` with the jobs of a frame: one for each unit that a view may see, in order of (view, global id).
pub(super) fn with_jobs<R>(frame: &Frame<'_>, work: impl FnOnce(&[Job<'_>]) -> R) -> R {
    // What is the same for all chunks of a view or of an actor.
    let non_pinhole: Vec<Option<NonPinholeView<'_>>> =
        frame.views.iter().map(|view| NonPinholeView::new(view, frame)).collect();
    let actor_views = ActorViews::new(frame);
    let from_actors = non_pinhole_from_actors(frame, &actor_views, &non_pinhole);
    let shadows = ChunkShadow::by_chunk(frame.scene);
    let mut jobs = Vec::new();
    for (index, non_pinhole) in non_pinhole.iter().enumerate() {
        add_twin(index, frame, non_pinhole.as_ref(), &shadows, &mut jobs);
        let from_actors = from_actors.get(index).map_or(&[][..], Vec::as_slice);
        add_actors(index, frame, actor_views.of(index), from_actors, &mut jobs);
    }
    work(&jobs)
}

/// What the jobs of one chunk in one view share.
#[derive(Clone, Copy)]
struct JobOwner<'a> {
    view: usize,
    light: Light<'a>,
    instance: u16,
}

/// How one view projects the Gaussians of one chunk.
#[derive(Clone, Copy)]
#[allow(clippy::large_enum_variant, reason = "nearly all are the large one")]
enum ChunkProjection<'a> {
    /// A static pinhole camera: linearised at each centre.
    Pinhole { chunk_view: ChunkView, frustum: Frustum },
    /// A lens, a windshield, or a rolling shutter: the unscented transform.
    Unscented(UnscentedChunkView<'a>),
}

impl Projected {
    /// Projects the Gaussians of all jobs, or those splats of them that are in a slab.
    ///
    /// # Errors
    /// [`Overflow`]: there are more than `most_places` places for splats. Nothing is projected then.
    pub(super) fn project(
        &mut self,
        level: Level,
        jobs: &[Job<'_>],
        cutoffs: &Cutoffs,
        slab: Option<&Slab<'_>>,
        most_places: usize,
    ) -> Result<(), Overflow> {
        let Self { pages, units, free } = self;
        free.get_mut().append(pages);
        units.clear();

        // In parallel: each job fills pages of its own. Views that see the same Gaussians follow each other, so that
        // these are read from memory once.
        let mut order: Vec<usize> = match slab {
            None => (0..jobs.len()).collect(),
            Some(slab) => slab.jobs().collect(),
        };
        order.sort_by_key(|&index| jobs[index].gaussians());
        let used_pages = AtomicUsize::new(0);
        let most_pages = most_places >> PAGE_BITS;
        let filled: Vec<(usize, Vec<Page>)> = order
            .par_iter()
            .map_init(Vec::new, |splats, &index| {
                splats.clear();
                if used_pages.load(Relaxed) > most_pages {
                    return (0, Vec::new());
                }
                let slab = slab.map(|slab| slab.of_job(index));
                dispatch!(level, simd => project_unit(simd, &jobs[index], cutoffs, slab, splats));
                used_pages.fetch_add(splats.len().div_ceil(PAGE), Relaxed);
                (splats.len(), copy_to_pages(splats, free))
            })
            .collect();
        let mut by_job: Vec<(usize, Vec<Page>)> = vec![(0, Vec::new()); jobs.len()];
        for (index, filled) in order.into_iter().zip(filled) {
            by_job[index] = filled;
        }

        // In the order of the jobs: list the pages.
        for (job, (len, mut filled)) in jobs.iter().zip(by_job) {
            let Job { view, instance, .. } = *job;
            units.push(Unit { view, len, first_page: pages.len(), instance });
            pages.append(&mut filled);
        }
        if used_pages.into_inner() > most_pages {
            units.clear();
            return Err(Overflow);
        }
        Ok(())
    }

    /// Number of splats.
    pub(super) fn len(&self) -> usize {
        self.units.iter().map(|unit| unit.len).sum()
    }

    /// Number of places for splats; the last ones of each unit may be empty.
    pub(super) fn places(&self) -> usize {
        self.pages.len() * PAGE
    }

    /// The units in order of (view, global id).
    pub(super) fn units(&self) -> &[Unit] {
        &self.units
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

    /// Whose splat is at a place, as in [`Target::instances`](crate::Target::instances).
    pub(super) fn instance(&self, place: u32) -> u16 {
        let page = (place >> PAGE_BITS) as usize;
        let after = self.units.partition_point(|unit| unit.first_page <= page);
        self.units[after - 1].instance
    }

    /// The splat at a place: the high bits are the page, the low 8 bits the splat of the page.
    #[inline(always)]
    pub(super) fn splat(&self, place: u32) -> &Splat {
        &self.pages[(place >> PAGE_BITS) as usize][place as usize % PAGE]
    }
}

impl<'a> NonPinholeView<'a> {
    /// `None` for a static pinhole.
    fn new(view: &'a View, frame: &Frame<'_>) -> Option<Self> {
        let unscented = UnscentedView::new(view, frame.profile)?;
        Some(Self { unscented, lens: LensProjection::new(view) })
    }

    /// The same camera elsewhere, or in other motion.
    fn moved<'b>(&self, view: &'b View) -> NonPinholeView<'b> {
        let lens = self.lens.as_ref().and_then(|lens| lens.moved(view));
        NonPinholeView { unscented: self.unscented.moved(view), lens }
    }
}

impl<'a> ChunkProjection<'a> {
    /// How a view projects a chunk. Both are in the same axes: the world's, or those of an actor.
    fn new(
        view: &View,
        chunk: &Chunk,
        non_pinhole: Option<&'a NonPinholeView<'a>>,
        frame: &Frame<'_>,
    ) -> Self {
        match non_pinhole {
            Some(NonPinholeView { unscented, lens }) => Self::Unscented(UnscentedChunkView::new(
                view,
                chunk,
                frame.profile,
                unscented,
                lens.as_ref(),
            )),
            None => Self::Pinhole {
                chunk_view: ChunkView::new(view, chunk, frame.profile),
                frustum: Frustum::new(view, chunk, frame.profile),
            },
        }
    }

    /// Whether a Gaussian of the cluster can touch the image; `true` when in doubt.
    #[inline(always)]
    fn may_see(&self, chunk: &Chunk, cluster: &Cluster) -> bool {
        let Cluster { min_m, max_m, sigma_m, .. } = *cluster;
        match self {
            Self::Pinhole { frustum, .. } => frustum.may_see(min_m, max_m, sigma_m),
            Self::Unscented(view) => view.may_see(chunk.origin_m(), min_m, max_m, sigma_m),
        }
    }

    /// Bounds of the depths of all centres in a cluster, in metres. They allow for rounding errors of 1e-5.
    fn depths_m(&self, cluster: &Cluster) -> [f64; 2] {
        let Cluster { min_m, max_m, .. } = *cluster;
        let center_m = (0.5 * (min_m + max_m)).as_dvec3();
        let half_m = (0.5 * (max_m - min_m)).as_dvec3();
        let [depth_m, reach_m] = match self {
            Self::Pinhole {
                chunk_view: ChunkView { forward: [x, y, z, offset_m], .. }, ..
            } => {
                let forward = DVec3::new(*x, *y, *z);
                [forward.dot(center_m) + offset_m, forward.abs().dot(half_m)]
            }
            Self::Unscented(view) => view.depth_m(center_m, half_m.length()),
        };
        let slack_m = 1e-5 * (depth_m.abs() + reach_m + center_m.length()) + 1e-6;
        [depth_m - reach_m - slack_m, depth_m + reach_m + slack_m]
    }
}

/// Copies splats to free pages, and to new ones when no free page is left.
fn copy_to_pages(splats: &[Splat], free: &Mutex<Vec<Page>>) -> Vec<Page> {
    let wanted = splats.len().div_ceil(PAGE);
    let mut pages = {
        let mut free = free.lock();
        let kept = free.len().saturating_sub(wanted);
        free.split_off(kept)
    };
    pages.resize_with(wanted, || Box::new([Splat::default(); PAGE]));
    for (page, splats) in pages.iter_mut().zip(splats.chunks(PAGE)) {
        page[..splats.len()].copy_from_slice(splats);
    }
    pages
}

/// The views from actors' axes that are no static pinholes. What depends on the lens is taken from `own`, the frame's
/// own views.
fn non_pinhole_from_actors<'a>(
    frame: &Frame<'_>,
    actor_views: &'a ActorViews,
    own: &[Option<NonPinholeView<'_>>],
) -> Vec<Vec<Option<NonPinholeView<'a>>>> {
    let of_view = |(relative, own): (&'a [View], &Option<NonPinholeView<'_>>)| {
        // A static pinhole has no lens yet, and sees actors in motion through its rolling shutter.
        let mut first: Option<NonPinholeView<'a>> = None;
        let mut views = Vec::with_capacity(relative.len());
        for view in relative {
            views.push(match (own, &first) {
                _ if view.is_static_pinhole() => None,
                (Some(own), _) => Some(own.moved(view)),
                (None, Some(first)) => Some(first.moved(view)),
                (None, None) => {
                    first = NonPinholeView::new(view, frame);
                    first.as_ref().map(|first| first.moved(view))
                }
            });
        }
        views
    };
    actor_views.all().zip(own).map(of_view).collect()
}

/// Adds the jobs of one view and the twin, in order of global ids. A unit that a view cannot see has no job; it costs
/// one visibility test per cluster.
fn add_twin<'a>(
    index: usize,
    frame: &Frame<'a>,
    non_pinhole: Option<&'a NonPinholeView<'a>>,
    shadows: &'a [Vec<ChunkShadow>],
    jobs: &mut Vec<Job<'a>>,
) {
    for (number, chunk) in frame.scene.chunks.iter().enumerate() {
        let projection = ChunkProjection::new(&frame.views[index], chunk, non_pinhole, frame);
        let light = match shadows.get(number).map_or(&[][..], Vec::as_slice) {
            [] => Light::AsStored,
            shadows => Light::Shadowed(shadows),
        };
        let owner = JobOwner { view: index, light, instance: TWIN_INSTANCE };
        add_jobs(owner, projection, chunk, jobs);
    }
}

/// Adds the jobs of one view and all actors, in order of global ids. `relative` are the view from the axes of each
/// actor.
fn add_actors<'a>(
    index: usize,
    frame: &Frame<'a>,
    relative: &[View],
    non_pinhole: &'a [Option<NonPinholeView<'a>>],
    jobs: &mut Vec<Job<'a>>,
) {
    for ((placed, view), non_pinhole) in frame.scene.placed.iter().zip(relative).zip(non_pinhole) {
        let projection = ChunkProjection::new(view, &placed.chunk, non_pinhole.as_ref(), frame);
        let light = match placed.tint {
            [1.0, 1.0, 1.0] => Light::AsStored,
            tint => Light::Tinted(tint),
        };
        let instance = FIRST_ACTOR_INSTANCE + placed.actor;
        let owner = JobOwner { view: index, light, instance };
        add_jobs(owner, projection, &placed.chunk, jobs);
    }
}

/// Adds the jobs of one view and one chunk.
fn add_jobs<'a>(
    JobOwner { view, light, instance }: JobOwner<'a>,
    projection: ChunkProjection<'a>,
    chunk: &'a Chunk,
    jobs: &mut Vec<Job<'a>>,
) {
    let visible = |clusters: &Range<usize>| {
        let mut clusters = chunk.clusters()[clusters.clone()].iter();
        clusters.any(|cluster| projection.may_see(chunk, cluster))
    };
    let count = chunk.clusters().len();
    let ranges = (0..count).step_by(UNIT_CLUSTERS).map(|k| k..(k + UNIT_CLUSTERS).min(count));
    let job = |clusters| Job { view, chunk, clusters, projection, light, instance };
    jobs.extend(ranges.filter(visible).map(job));
}

/// Begins to read a block from memory.
#[inline(always)]
fn prefetch(columns: &[Lanes]) {
    for column in 0..columns.len() {
        prefetch_index(columns, column);
    }
}

/// Projects the visible clusters of a job, one block of 16 Gaussians after the other; of a slab only its splats.
#[inline(always)]
fn project_unit<S: Simd>(
    simd: S,
    job: &Job<'_>,
    cutoffs: &Cutoffs,
    slab: Option<SlabOfJob<'_>>,
    splats: &mut Vec<Splat>,
) {
    let blocks = job.chunk.len().div_ceil(LANES);
    for (k, cluster) in (job.clusters.clone()).zip(&job.chunk.clusters()[job.clusters.clone()]) {
        let may_see = match &slab {
            None => job.projection.may_see(job.chunk, cluster),
            Some(slab) => slab.touches(k),
        };
        if !may_see {
            continue;
        }
        let before = splats.len();
        let light = job.light.on(cluster);
        let first = k * CLUSTER / LANES;
        for block in first..(first + CLUSTER / LANES).min(blocks) {
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
                light.apply(simd, columns, &mut projected);
                projected.append_visible(splats);
            }
        }
        if let Some(slab) = &slab {
            slab.keep(cutoffs, splats, before);
        }
    }
}
