//! All stages on one device, in order, for all views of a step: one submission per region of a
//! frame.
//!
//! The device counts what a region needs and draws nothing if its buffers are too small, so nothing
//! is read back in the middle of a frame. The host reads the counters after each submission; it
//! then enlarges the buffers, or splits the region, and draws again (see [`super::partition`]).
//!
//! A frame that fits is submitted in its turn and waited for outside of it (`in_flight.rs`), so
//! that the next frame is prepared meanwhile. Submissions run in order, so both may use the same
//! intermediate buffers.

mod gradient;
mod in_flight;
mod intermediate;
mod record;
mod regions;

use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use rayon::ThreadPool;
use wgpu::{BufferUsages, QuerySet};

pub(super) use self::in_flight::{InFlight, Turn, Waited};
use super::bandwidth::FrameCounts;
use super::bin::{Bin, BinCapacity, BinSizes};
use super::device::Device;
use super::gradient::GradientStages;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{TIMESTAMP_BYTES, timestamps};
use super::layout::{Counters, Frame as GpuFrame, LONG_TILES};
use super::lens::Lenses;
use super::lidar::SweepKernels;
use super::mirror::Mirror;
use super::partition::{Capacity, PartitionCache};
use super::plan::Plan;
use super::project::{Project, SplatBuffers};
use super::project_work::ProjectWork;
use super::rasterize::Rasterize;
use super::read_back::{Head, MappedFrame, ReadBack, ReadBackPool};
use super::resolve::{Outputs, Planes};
use super::scan::Scan;
use super::sort::Sort;
use super::splat_owners::SplatOwners;
use crate::actor_views::ActorViews;
use crate::lidar::{Sweep, Task};
use crate::stage::{Stage, StageOutputs};
use crate::{Frame, FrameStats, RenderError};

/// Initial room for splats, touches, and instances. Frames that need more enlarge the buffers.
const INITIAL_SPLATS: u64 = 1 << 15;
const INITIAL_TOUCHES: u64 = 1 << 16;
const INITIAL_INSTANCES: u64 = 1 << 17;

/// The renderer on one device.
#[derive(Debug)]
pub(super) struct Chain {
    pub(super) device: Arc<Device>,
    pub(super) mirror: Mirror,
    plan: Plan,
    scan: Scan,
    project: Project,
    sort: Sort,
    bin: Bin,
    rasterize: Rasterize,
    splats: SplatBuffers,
    /// Made with the first frame that has classes.
    splat_owners: Option<SplatOwners>,
    lenses: Lenses,
    /// Timestamp queries, if the device has a clock.
    queries: Option<QuerySet>,
    /// Resolved timestamps, before they are copied to the host.
    timestamps: GrowableBuffer,
    read_backs: ReadBackPool,
    /// The largest needs of any region until now.
    high_water: Capacity,
    partitions: PartitionCache,
    /// Of the last frame that was recorded.
    sorted: Sorted,
    /// Made with the first frame whose gradients are asked for.
    gradient: Option<GradientStages>,
    /// Made with the first sweep.
    sweeps: Option<SweepKernels>,
    /// Frames in flight count, too, while another is in its turn.
    pub(super) tally: Arc<Mutex<Tally>>,
}

/// Which of the two buffers of a sort are in order.
#[derive(Clone, Copy, Debug, Default)]
struct Sorted {
    splats: usize,
    touches: usize,
}

/// Counts of what the device has drawn.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// Number of attempts that drew nothing because buffers were too small.
    pub(super) retries: u64,
    /// Number of regions that were drawn, one for each frame that fits at once.
    pub(super) regions: u64,
    /// The counts of the last frame.
    pub(super) last_frame: FrameCounts,
}

/// The input of a region.
#[derive(Clone, Copy, Debug)]
enum Source<'a> {
    /// Gaussians: all stages must run.
    Gaussians(&'a ProjectWork),
    /// The outputs of another backend's stages: the stages after them must run.
    Stages(&'a StageOutputs),
}

impl Source<'_> {
    /// Whether a stage must still run.
    fn needs(self, stage: Stage) -> bool {
        match self {
            Self::Gaussians(_) => true,
            Self::Stages(outputs) => outputs.last_stage() < stage,
        }
    }

    /// Number of (cluster, view) pairs to project.
    fn cluster_views(self) -> u32 {
        match self {
            Self::Gaussians(work) => work.cluster_views(),
            Self::Stages(_) => 0,
        }
    }
}

/// A frame that is being drawn.
#[derive(Debug)]
struct CurrentFrame {
    /// The parameters of the region that is drawn now.
    parameters: GpuFrame,
    planes: Planes,
    read_back: ReadBack,
    stats: FrameStats,
    counts: FrameCounts,
}

impl Chain {
    /// Compiles the kernels that every frame needs. Gaussians will take up to `mirror_bytes`.
    ///
    /// # Errors
    /// A shader does not compile, or the device is out of memory.
    pub(super) fn new(device: Device, mirror_bytes: u64) -> Result<Self, RenderError> {
        let timestamp_usage = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        let chain = Self {
            mirror: Mirror::new(mirror_bytes),
            plan: Plan::new(&device),
            scan: Scan::new(&device),
            project: Project::new(&device),
            sort: Sort::new(&device),
            bin: Bin::new(&device),
            rasterize: Rasterize::new(&device),
            splats: SplatBuffers::new(&device),
            splat_owners: None,
            lenses: Lenses::default(),
            queries: timestamps(&device),
            timestamps: GrowableBuffer::new(&device, "timestamps", timestamp_usage),
            read_backs: ReadBackPool::default(),
            high_water: Capacity {
                splats: INITIAL_SPLATS.min(SplatBuffers::limit(&device)),
                touches: INITIAL_TOUCHES.min(Bin::limit(&device)),
                instances: INITIAL_INSTANCES.min(Bin::limit(&device)),
            },
            partitions: PartitionCache::default(),
            sorted: Sorted::default(),
            gradient: None,
            sweeps: None,
            tally: Arc::default(),
            device: Arc::new(device),
        };
        // The kernels above report the errors of their shaders to the device only.
        chain.device.check()?;
        Ok(chain)
    }

    /// The sweep of a LiDAR.
    ///
    /// # Errors
    /// The device fails, or is lost meanwhile.
    pub(super) fn sweep(
        &mut self,
        task: &Task<'_>,
        pool: &ThreadPool,
    ) -> Result<Sweep, RenderError> {
        let device = &self.device;
        self.timestamps.reserve(device, TIMESTAMP_BYTES);
        let kernels = self.sweeps.get_or_insert_with(|| SweepKernels::new(device));
        // A shader that does not compile is an error of this sweep, and not of the device's next
        // frame.
        device.check()?;
        kernels.sweep(device, self.timestamps.buffer(), pool, task)
    }

    /// Uploads the data that the whole frame shares, and makes room for its pixels.
    fn begin(
        &mut self,
        frame: &Frame<'_>,
        actors: &ActorViews,
        outputs: &Outputs,
    ) -> Result<CurrentFrame, RenderError> {
        let planes = outputs.planes;
        self.lenses.upload(&self.device, frame, actors);
        self.rasterize.upload_background(&self.device, frame, outputs)?;
        let mut parameters = GpuFrame::new(frame.views, frame.profile);
        let sampled = (0..frame.views.len()).filter(|&view| outputs.sampled.contains(view));
        parameters.sampled = sampled.fold(0, |bits, view| bits | 1 << view);
        let background_iterations = self.rasterize.background_iterations();
        parameters.batch_limit = self.device.max_tile_batches(background_iterations);
        parameters.long_tile_splats = self.device.tuning().long_tile_splats;
        // No more places than tiles: the buffers of long tiles are reserved for as many.
        parameters.long_tiles = LONG_TILES.min(parameters.tiles);
        let tiles_per_page = self.rasterize.reserve(&self.device, planes, parameters.tiles);
        let mut read_back = self.read_backs.take().unwrap_or_else(|| ReadBack::new(&self.device));
        read_back.reserve(&self.device, planes, parameters.tiles, tiles_per_page);
        let counts = FrameCounts::new(frame, planes, &parameters);
        Ok(CurrentFrame { parameters, planes, read_back, stats: FrameStats::default(), counts })
    }

    /// Returns a frame that is drawn and mapped.
    fn finish(&self, current: CurrentFrame) -> Result<MappedFrame, RenderError> {
        self.tally.lock().last_frame = current.counts;
        current.into_mapped(&self.device, self.read_backs.clone())
    }

    /// The needs of a region, and whether the buffers could hold it. If they could not, the next
    /// call of [`Chain::reserve`] enlarges them, unless the device has no such buffers.
    fn evaluate(&mut self, counters: &Counters, parameters: &GpuFrame) -> (Capacity, bool) {
        let needs = needs(counters);
        let fits = fits(counters, parameters);
        if !fits {
            self.note_overflow(needs);
        }
        (needs, fits)
    }

    /// Makes the next call of [`Chain::reserve`] enlarge the buffers, unless the device has none
    /// that are large enough.
    fn note_overflow(&mut self, needs: Capacity) {
        self.tally.lock().retries += 1;
        tracing::debug!(?needs, "the buffers on the device are too small");
        if needs.min_regions(self.limit()) <= 1 {
            self.high_water = self.high_water.max(needs);
        }
    }

    /// Makes room for the largest needs until now, and writes the capacities to the frame's
    /// parameters.
    fn reserve(&mut self, parameters: &mut GpuFrame, cluster_views: u32) {
        let Capacity { splats, touches, instances } = self.high_water;
        let device = &self.device;
        parameters.splat_capacity = self.splats.reserve(device, splats);
        // The buffers may hold more splats than were asked for, and those may all reach stage bin.
        let splats = u64::from(parameters.splat_capacity);
        let GpuFrame { macro_tiles, tiles, .. } = *parameters;
        let sizes = BinSizes { splats, macro_tiles, tiles, touches, instances };
        let BinCapacity { touches, instances } = self.bin.reserve(device, &mut self.scan, sizes);
        parameters.touch_capacity = touches;
        parameters.instance_capacity = instances;
        // Stage project scans the counts of cluster views, and stage bin those of splats.
        self.scan.reserve(device, splats.max(cluster_views.into()));
        // Splats and touches are sorted one after the other in the same buffers.
        self.sort.reserve(device, &mut self.scan, splats.max(touches.into()));
        self.timestamps.reserve(device, TIMESTAMP_BYTES);
    }

    /// Largest needs that the device can hold at once.
    fn limit(&self) -> Capacity {
        let listed = Bin::limit(&self.device);
        Capacity { splats: SplatBuffers::limit(&self.device), touches: listed, instances: listed }
    }

    /// The error for a row of tiles that exceeds the limit.
    fn too_many(&self, needs: Capacity) -> RenderError {
        let limit = self.limit();
        let (what, limit) = if needs.splats > limit.splats {
            ("visible splats in one row of tiles", limit.splats)
        } else {
            ("(Gaussian, tile) pairs in one row of tiles", limit.instances)
        };
        RenderError::TooMany { what, limit }
    }
}

impl CurrentFrame {
    fn into_mapped(self, device: &Device, pool: ReadBackPool) -> Result<MappedFrame, RenderError> {
        let Self { parameters, read_back, stats, .. } = self;
        let pages = read_back.pages(device)?;
        let views = parameters.view[..parameters.views as usize].to_vec();
        Ok(MappedFrame { read_back, pool, pages, views, stats })
    }
}

/// What a submission counted that it needs.
fn needs(counters: &Counters) -> Capacity {
    Capacity {
        splats: counters.splats.into(),
        touches: counters.touches.into(),
        instances: counters.instances.into(),
    }
}

/// Whether the buffers could hold what a submission needs.
fn fits(counters: &Counters, parameters: &GpuFrame) -> bool {
    counters.splats <= parameters.splat_capacity
        && counters.touches <= parameters.touch_capacity
        && counters.instances <= parameters.instance_capacity
}

/// Adds to the time of a stage.
fn add_time(stats: &mut FrameStats, stage: &'static str, time: Duration) {
    let ms = time.as_secs_f64() * 1e3;
    match stats.stages_ms.iter_mut().find(|(name, _)| *name == stage) {
        // A frame of several regions runs each stage several times.
        Some((_, sum)) => *sum += ms,
        None => stats.stages_ms.push((stage, ms)),
    }
}

/// Adds the counts of a region. A splat that reaches into two bands of a view counts twice.
fn add_counts(stats: &mut FrameStats, head: &Head) {
    let Head { counters, tile_counters, .. } = head;
    stats.visible_pairs += u64::from(counters.splats);
    stats.instances += u64::from(counters.instances);
    stats.evaluations += tile_counters.evaluations();
}
