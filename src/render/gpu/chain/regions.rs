//! Drawing a frame region by region in its turn: one that does not fit the device at once, or whose
//! buffers were too small.

use std::ops::Range;
use std::time::Instant;

use rayon::ThreadPool;

use super::{Chain, CurrentFrame, Source, add_time};
use crate::actor_views::ActorViews;
use crate::gpu::partition::{Capacity, PartitionKey, Region, TileRows};
use crate::gpu::project::Project;
use crate::gpu::project_work::ProjectWork;
use crate::gpu::read_back::MappedFrame;
use crate::gpu::resolve::Outputs;
use crate::{Frame, RenderError};

/// The input of a draw.
#[derive(Clone, Copy, Debug)]
pub(super) struct DrawInput<'a> {
    pub(super) frame: &'a Frame<'a>,
    pub(super) actors: &'a ActorViews,
    pub(super) rows: &'a TileRows,
}

/// A region before it is submitted.
#[derive(Debug)]
pub(super) enum PreparedRegion {
    /// The clusters to project, and the tiles to draw.
    Ready(ProjectWork, Range<u32>),
    /// It does not fit the device. These regions must be drawn instead.
    Split(Vec<Region>),
}

/// The outcome of drawing a region.
#[derive(Debug)]
enum RegionOutcome {
    /// It was drawn, and needed this much.
    Drawn(Capacity),
    /// It does not fit the device. These regions must be drawn instead.
    Split(Vec<Region>),
}

impl Chain {
    /// Draws a frame: at once if it fits the device, otherwise region by region.
    ///
    /// # Errors
    /// The device fails, or one row of tiles needs more than the device can hold.
    pub(in crate::gpu) fn draw(
        &mut self,
        frame: &Frame<'_>,
        outputs: &Outputs,
        cull: &ThreadPool,
    ) -> Result<MappedFrame, RenderError> {
        let start = Instant::now();
        cull.install(|| self.mirror.make_resident(&self.device, frame.scene))?;
        let actors = ActorViews::new(frame);
        let mut current = self.begin(frame, &actors, outputs)?;
        add_time(&mut current.stats, "prepare", start.elapsed());

        // The regions that remain, in reverse order, so that the parts of a region take its place.
        let key = PartitionKey::from_frame(frame);
        let rows = TileRows::from_frame(frame);
        let input = DrawInput { frame, actors: &actors, rows: &rows };
        let mut remaining = self.partitions.get(&key, &rows);
        remaining.reverse();
        let mut drawn = Vec::with_capacity(remaining.len());
        while let Some(region) = remaining.pop() {
            match self.draw_or_split(input, &region, cull, &mut current)? {
                RegionOutcome::Drawn(needs) => {
                    drawn.push((region, needs));
                    if !remaining.is_empty() {
                        // The next region copies into the same buffers; those of the last one stay
                        // mapped.
                        current.read_back.unmap();
                    }
                }
                // The parts are popped next, so pixels and counts are those of the order of rows.
                RegionOutcome::Split(regions) => remaining.extend(regions.into_iter().rev()),
            }
        }
        self.tally.lock().regions += drawn.len() as u64;
        self.partitions.insert(key, drawn, self.limit());
        self.finish(current)
    }

    /// Draws one region of a frame, or splits it if it exceeds a limit of the device. After
    /// drawing, the read-back buffers are mapped.
    fn draw_or_split(
        &mut self,
        input: DrawInput<'_>,
        region: &Region,
        cull: &ThreadPool,
        current: &mut CurrentFrame,
    ) -> Result<RegionOutcome, RenderError> {
        let (work, tiles) = match self.prepare_region(input, region, cull, current)? {
            PreparedRegion::Split(regions) => return Ok(RegionOutcome::Split(regions)),
            PreparedRegion::Ready(work, tiles) => (work, tiles),
        };
        // The device counts its needs.
        let needs = self.draw_region(Source::Gaussians(&work), tiles, current)?;
        let count = needs.min_regions(self.limit());
        if count <= 1 {
            return Ok(RegionOutcome::Drawn(needs));
        }
        let regions = input.rows.split(region, count).ok_or_else(|| self.too_many(needs))?;
        // The pixels of a region that was too large are not valid.
        current.read_back.unmap();
        Ok(RegionOutcome::Split(regions))
    }

    /// Culls the clusters of a region and uploads what it needs, or splits it if it exceeds a limit
    /// that the host knows.
    pub(super) fn prepare_region(
        &mut self,
        input: DrawInput<'_>,
        region: &Region,
        cull: &ThreadPool,
        current: &mut CurrentFrame,
    ) -> Result<PreparedRegion, RenderError> {
        let DrawInput { frame, actors, rows } = input;
        // The tiles of one view.
        let views = rows.views(region);
        let tiles_of = |view: usize| {
            let columns = u64::from(current.parameters.view[view].columns);
            columns * rows.for_view(view, region).len() as u64
        };
        let most_tiles = views.clone().map(tiles_of).max().unwrap_or(0);
        let count = most_tiles.div_ceil(self.device.max_view_tiles());
        if count > 1
            && let Some(regions) = rows.split(region, count)
        {
            return Ok(PreparedRegion::Split(regions));
        }

        // The clusters that the host does not cull.
        let start = Instant::now();
        let work = cull.install(|| ProjectWork::new(frame, views.clone(), actors, &self.mirror));
        let limit = Project::limit(&self.device);
        let count = u64::from(work.cluster_views()).div_ceil(limit);
        if count > 1 {
            // Clusters are culled against whole views: bands of one view would have as many.
            let regions = if views.len() > 1 { rows.split(region, count) } else { None };
            let what = "clusters of 256 Gaussians in one view";
            let regions = regions.ok_or(RenderError::TooMany { what, limit })?;
            return Ok(PreparedRegion::Split(regions));
        }
        self.project.upload(&self.device, &work);
        add_time(&mut current.stats, "prepare", start.elapsed());

        let tiles = current.parameters.restrict(rows, region);
        Ok(PreparedRegion::Ready(work, tiles))
    }

    /// Draws some tiles. If the buffers are too small, the device draws nothing, and the host tries
    /// again with larger ones. Returns the needs of the region. If that exceeds the limit, the
    /// pixels are not valid.
    pub(super) fn draw_region(
        &mut self,
        source: Source<'_>,
        tiles: Range<u32>,
        current: &mut CurrentFrame,
    ) -> Result<Capacity, RenderError> {
        loop {
            let submitted = self.submit_region(source, tiles.clone(), current);
            let head = submitted.wait(&self.device, current)?;
            let (needs, fits) = self.evaluate(&head.counters, &current.parameters);
            if fits {
                current.count(source.cluster_views(), &head)?;
                return Ok(needs);
            }
            if needs.min_regions(self.limit()) > 1 {
                return Ok(needs);
            }
            current.read_back.unmap();
        }
    }
}
