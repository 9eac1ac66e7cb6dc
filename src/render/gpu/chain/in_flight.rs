//! Frames in flight: submitted in their turn, and waited for outside of it.

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use parking_lot::Mutex;
use rayon::ThreadPool;
use wgpu::SubmissionIndex;

use super::regions::{DrawInput, PreparedRegion};
use super::{Chain, CurrentFrame, Source, Tally, add_counts, add_time, fits, needs};
use crate::actor_views::ActorViews;
use crate::gpu::device::Device;
use crate::gpu::layout::RASTER_BATCH;
use crate::gpu::partition::{Capacity, PartitionKey, TileRows};
use crate::gpu::rasterize::TileOutput;
use crate::gpu::read_back::{Head, MappedFrame, ReadBackPool};
use crate::gpu::resolve::Outputs;
use crate::{Frame, RenderError};

/// What a frame's turn ends with.
#[derive(Debug)]
pub(in crate::gpu) enum Turn {
    /// The frame is drawn. It did not fit the device at once.
    Drawn(MappedFrame),
    /// The device draws it.
    InFlight(Box<InFlight>),
}

/// What waiting for a frame ends with.
#[derive(Debug)]
pub(in crate::gpu) enum Waited {
    /// The frame is drawn.
    Drawn(MappedFrame),
    /// The buffers were too small for these needs: it must be drawn again.
    Overflowed(Capacity),
}

/// A frame that the device draws.
#[derive(Debug)]
pub(in crate::gpu) struct InFlight {
    pub(in crate::gpu) device: Arc<Device>,
    read_backs: ReadBackPool,
    tally: Arc<Mutex<Tally>>,
    current: CurrentFrame,
    cluster_views: u32,
    submitted: Submitted,
}

/// The stages of a region that the device runs.
#[derive(Debug)]
pub(super) struct Submitted {
    stages: Vec<&'static str>,
    index: SubmissionIndex,
    at: Instant,
}

impl Chain {
    /// Submits a frame. One that does not fit the device at once is drawn here, region by region.
    ///
    /// # Errors
    /// The device fails, or one row of tiles needs more than the device can hold.
    pub(in crate::gpu) fn take_turn(
        &mut self,
        frame: &Frame<'_>,
        outputs: &Outputs,
        cull: &ThreadPool,
    ) -> Result<Turn, RenderError> {
        let rows = TileRows::from_frame(frame);
        // A frame of this kind did not fit at once, and this one would hardly fit either.
        if self.partitions.get(&PartitionKey::from_frame(frame), &rows).len() > 1 {
            return Ok(Turn::Drawn(self.draw(frame, outputs, cull)?));
        }
        let start = Instant::now();
        cull.install(|| self.mirror.make_resident(&self.device, frame.scene))?;
        let actors = ActorViews::new(frame);
        let mut current = self.begin(frame, &actors, outputs)?;
        add_time(&mut current.stats, "prepare", start.elapsed());
        let input = DrawInput { frame, actors: &actors, rows: &rows };
        let prepared = self.prepare_region(input, &rows.all(), cull, &mut current)?;
        let PreparedRegion::Ready(work, tiles) = prepared else {
            return Ok(Turn::Drawn(self.draw(frame, outputs, cull)?));
        };
        let submitted = self.submit_region(Source::Gaussians(&work), tiles, &mut current);
        // An error of this frame must not be reported by another one.
        self.device.check()?;
        Ok(Turn::InFlight(Box::new(InFlight {
            device: self.device.clone(),
            read_backs: self.read_backs.clone(),
            tally: self.tally.clone(),
            cluster_views: work.cluster_views(),
            current,
            submitted,
        })))
    }

    /// Draws a frame whose buffers were too small when it was in flight.
    ///
    /// # Errors
    /// As [`Chain::take_turn`].
    pub(in crate::gpu) fn draw_again(
        &mut self,
        needs: Capacity,
        frame: &Frame<'_>,
        outputs: &Outputs,
        cull: &ThreadPool,
    ) -> Result<MappedFrame, RenderError> {
        self.note_overflow(needs);
        self.draw(frame, outputs, cull)
    }

    /// Makes room for a region, and records and submits its stages.
    pub(super) fn submit_region(
        &mut self,
        source: Source<'_>,
        tiles: Range<u32>,
        current: &mut CurrentFrame,
    ) -> Submitted {
        let start = Instant::now();
        let tiles_per_page = current.read_back.tiles_per_page;
        let output = TileOutput { planes: current.planes, tiles, tiles_per_page };
        self.reserve(&mut current.parameters, source.cluster_views());
        let (stages, index) = self.submit(source, current, &output);
        add_time(&mut current.stats, "record", start.elapsed());
        Submitted { stages, index, at: Instant::now() }
    }
}

impl InFlight {
    /// Waits until the device has drawn the frame.
    ///
    /// # Errors
    /// The device fails, or a tile has more splats than a software device can blend.
    pub(in crate::gpu) fn wait(self) -> Result<Waited, RenderError> {
        let Self { device, read_backs, tally, mut current, cluster_views, submitted } = self;
        let head = submitted.wait(&device, &mut current)?;
        if !fits(&head.counters, &current.parameters) {
            // The next frame that takes these buffers copies into them, which a mapped buffer
            // forbids.
            current.read_back.unmap();
            read_backs.give_back(current.read_back);
            return Ok(Waited::Overflowed(needs(&head.counters)));
        }
        current.count(cluster_views, &head)?;
        {
            let mut tally = tally.lock();
            // The lock ends before the pixels are mapped: the next frame takes it in its turn.
            tally.regions += 1;
            tally.last_frame = current.counts;
        }
        Ok(Waited::Drawn(current.into_mapped(&device, read_backs)?))
    }
}

impl Submitted {
    /// Waits for the region, maps its read-back buffers, and adds the times of its stages.
    pub(super) fn wait(
        self,
        device: &Device,
        current: &mut CurrentFrame,
    ) -> Result<Head, RenderError> {
        current.read_back.map(device, self.index)?;
        device.check()?;
        // After the check: what a failed submission has left in the buffers is not read.
        let head = current.read_back.head(device)?;
        super::record::add_stage_times(
            device,
            &mut current.stats,
            &self.stages,
            &head.timestamps,
            self.at.elapsed(),
        );
        Ok(head)
    }
}

impl CurrentFrame {
    /// Adds the counts of a region that was drawn.
    ///
    /// # Errors
    /// A tile has more splats than a software device can blend.
    pub(super) fn count(&mut self, cluster_views: u32, head: &Head) -> Result<(), RenderError> {
        let most = self.parameters.batch_limit;
        if head.tile_counters.most_batches > most {
            let what = "visible splats in one tile (on a software device)";
            let limit = u64::from(most) * u64::from(RASTER_BATCH);
            return Err(RenderError::TooMany { what, limit });
        }
        add_counts(&mut self.stats, head);
        self.counts.add(cluster_views, head);
        Ok(())
    }
}
