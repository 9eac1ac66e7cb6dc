//! All stages on one device, in order, for all views of a step: one submission per region of a frame.
//!
//! The device counts what a region needs and draws nothing if its buffers are too small, so nothing is
//! read back in the middle of a frame. The host reads the counters after each submission; it then
//! enlarges the buffers, or splits the region, and draws again (see [`super::partition`]).

mod intermediate;
mod record;

use std::ops::Range;
use std::time::{Duration, Instant};

use rayon::ThreadPool;
use wgpu::{BufferUsages, QuerySet};

use super::bandwidth::FrameCounts;
use super::bin::{Bin, BinCapacity, BinSizes};
use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{TIMESTAMP_BYTES, timestamps};
use super::layout::{Counters, Frame as GpuFrame, RASTER_BATCH};
use super::lens::Lenses;
use super::mirror::Mirror;
use super::partition::{Capacity, PartitionCache, PartitionKey, Region, TileRows};
use super::plan::Plan;
use super::project::{Project, ProjectWork, SplatBuffers};
use super::rasterize::{Rasterize, TileOutput};
use super::read_back::{MappedFrame, ReadBack, ReadBackPool};
use super::resolve::{Outputs, Planes};
use super::scan::Scan;
use super::sort::Sort;
use crate::actor_views::ActorViews;
use crate::stage::{Stage, StageOutputs};
use crate::{Frame, FrameStats, RenderError};

/// Initial room for splats, touches, and instances. Frames that need more enlarge the buffers.
const INITIAL_SPLATS: u64 = 1 << 15;
const INITIAL_TOUCHES: u64 = 1 << 16;
const INITIAL_INSTANCES: u64 = 1 << 17;

/// The renderer on one device.
#[derive(Debug)]
pub(super) struct Chain {
    pub(super) device: Device,
    pub(super) mirror: Mirror,
    plan: Plan,
    scan: Scan,
    project: Project,
    sort: Sort,
    bin: Bin,
    rasterize: Rasterize,
    splats: SplatBuffers,
    lenses: Lenses,
    /// Timestamp queries, if the device has a clock.
    queries: Option<QuerySet>,
    /// Resolved timestamps, before they are copied to the host.
    timestamps: GrowableBuffer,
    read_backs: ReadBackPool,
    /// The largest needs of any region until now.
    high_water: Capacity,
    partitions: PartitionCache,
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

/// The input of a draw.
#[derive(Clone, Copy, Debug)]
struct DrawInput<'a> {
    frame: &'a Frame<'a>,
    actors: &'a ActorViews,
    rows: &'a TileRows,
}

/// A frame that is being drawn.
#[derive(Debug)]
struct CurrentFrame {
    /// The parameters of the region that is drawn now.
    parameters: GpuFrame,
    planes: Planes,
    read_back: ReadBack,
    stats: FrameStats,
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
            retries: 0,
            regions: 0,
            last_frame: FrameCounts::default(),
            device,
        };
        chain.device.check()?;
        Ok(chain)
    }

    /// Draws a frame: at once if it fits the device, otherwise region by region.
    ///
    /// # Errors
    /// The device fails, or one row of tiles needs more than the device can hold.
    pub(super) fn draw(
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
        let key = PartitionKey::of(frame);
        let rows = TileRows::of(frame);
        let input = DrawInput { frame, actors: &actors, rows: &rows };
        let mut remaining = self.partitions.get(&key, &rows);
        remaining.reverse();
        let mut drawn = Vec::with_capacity(remaining.len());
        while let Some(region) = remaining.pop() {
            match self.draw_or_split(input, &region, cull, &mut current)? {
                RegionOutcome::Drawn(needs) => {
                    drawn.push((region, needs));
                    if !remaining.is_empty() {
                        current.read_back.unmap();
                    }
                }
                RegionOutcome::Split(regions) => remaining.extend(regions.into_iter().rev()),
            }
        }
        self.regions += drawn.len() as u64;
        self.partitions.insert(key, drawn, self.limit());
        self.finish(current)
    }

    /// Draws one region of a frame, or splits it if it exceeds a limit of the device. After drawing, the
    /// read-back buffers are mapped.
    fn draw_or_split(
        &mut self,
        input: DrawInput<'_>,
        region: &Region,
        cull: &ThreadPool,
        current: &mut CurrentFrame,
    ) -> Result<RegionOutcome, RenderError> {
        let DrawInput { frame, actors, rows } = input;
        // The tiles of one view.
        let views = rows.views(region);
        let tiles_of = |view: usize| {
            let columns = u64::from(current.parameters.view[view].columns);
            columns * rows.of_view(view, region).len() as u64
        };
        let most_tiles = views.clone().map(tiles_of).max().unwrap_or(0);
        let count = most_tiles.div_ceil(self.device.max_view_tiles());
        if count > 1
            && let Some(regions) = rows.split(region, count)
        {
            return Ok(RegionOutcome::Split(regions));
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
            return Ok(RegionOutcome::Split(regions));
        }
        self.project.upload(&self.device, &work);
        add_time(&mut current.stats, "prepare", start.elapsed());

        // Draw the region. The device counts its needs.
        let tiles = current.parameters.restrict(rows, region);
        let needs = self.draw_region(Source::Gaussians(&work), tiles, current)?;
        let count = needs.min_regions(self.limit());
        if count <= 1 {
            return Ok(RegionOutcome::Drawn(needs));
        }
        let regions = rows.split(region, count).ok_or_else(|| self.too_many(needs))?;
        current.read_back.unmap();
        Ok(RegionOutcome::Split(regions))
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
        self.rasterize.upload_background(&self.device, frame, &outputs.appearances)?;
        let mut parameters = GpuFrame::new(frame.views, frame.profile);
        let background_iterations = self.rasterize.background_iterations();
        parameters.batch_limit = self.device.max_tile_batches(background_iterations);
        let tiles_per_page = self.rasterize.reserve(&self.device, planes, parameters.tiles);
        let mut read_back = self.read_backs.take().unwrap_or_else(|| ReadBack::new(&self.device));
        read_back.reserve(&self.device, planes, parameters.tiles, tiles_per_page);
        self.last_frame = FrameCounts::new(frame, planes, &parameters);
        Ok(CurrentFrame { parameters, planes, read_back, stats: FrameStats::default() })
    }

    /// Returns a frame that is drawn and mapped.
    fn finish(&self, current: CurrentFrame) -> Result<MappedFrame, RenderError> {
        let CurrentFrame { parameters, read_back, stats, .. } = current;
        let pages = read_back.pages(&self.device)?;
        let views = parameters.view[..parameters.views as usize].to_vec();
        Ok(MappedFrame { read_back, pool: self.read_backs.clone(), pages, views, stats })
    }

    /// Draws some tiles. If the buffers are too small, the device draws nothing, and the host tries again with
    /// larger ones. Returns the needs of the region. If that exceeds the limit, the pixels are not valid.
    fn draw_region(
        &mut self,
        source: Source<'_>,
        tiles: Range<u32>,
        current: &mut CurrentFrame,
    ) -> Result<Capacity, RenderError> {
        let tiles_per_page = current.read_back.tiles_per_page;
        let output = TileOutput { planes: current.planes, tiles, tiles_per_page };
        loop {
            // Submit, and wait.
            let start = Instant::now();
            self.reserve(&mut current.parameters, source.cluster_views());
            let (stages, submission) = self.submit(source, current, &output);
            add_time(&mut current.stats, "record", start.elapsed());
            let submitted = Instant::now();
            current.read_back.map(&self.device, submission)?;
            self.device.check()?;
            let (counters, timestamps) = current.read_back.head(&self.device)?;
            let elapsed = submitted.elapsed();
            self.add_stage_times(&mut current.stats, &stages, &timestamps, elapsed);

            // Check whether it fitted.
            let (needs, fits) = self.evaluate(&counters, &current.parameters);
            if fits {
                let most = current.parameters.batch_limit;
                if counters.most_batches > most {
                    let what = "visible splats in one tile (on a software device)";
                    let limit = u64::from(most) * u64::from(RASTER_BATCH);
                    return Err(RenderError::TooMany { what, limit });
                }
                add_counts(&mut current.stats, &counters);
                self.last_frame.add(source.cluster_views(), &counters);
                return Ok(needs);
            }
            if needs.min_regions(self.limit()) > 1 {
                return Ok(needs);
            }
            current.read_back.unmap();
        }
    }

    /// The needs of a region, and whether the buffers could hold it. If they could not, the next call of
    /// [`Chain::reserve`] enlarges them, unless the device has no such buffers.
    fn evaluate(&mut self, counters: &Counters, parameters: &GpuFrame) -> (Capacity, bool) {
        let needs = Capacity {
            splats: counters.splats.into(),
            touches: counters.touches.into(),
            instances: counters.instances.into(),
        };
        let fits = counters.splats <= parameters.splat_capacity
            && counters.touches <= parameters.touch_capacity
            && counters.instances <= parameters.instance_capacity;
        if !fits {
            self.retries += 1;
            tracing::debug!(?needs, "the buffers on the device are too small");
            if needs.min_regions(self.limit()) <= 1 {
                self.high_water = self.high_water.max(needs);
            }
        }
        (needs, fits)
    }

    /// Makes room for the largest needs until now, and writes the capacities to the frame's parameters.
    fn reserve(&mut self, parameters: &mut GpuFrame, cluster_views: u32) {
        let Capacity { splats, touches, instances } = self.high_water;
        let device = &self.device;
        parameters.splat_capacity = self.splats.reserve(device, splats);
        let splats = u64::from(parameters.splat_capacity);
        let GpuFrame { macro_tiles, tiles, .. } = *parameters;
        let sizes = BinSizes { splats, macro_tiles, tiles, touches, instances };
        let BinCapacity { touches, instances } = self.bin.reserve(device, &mut self.scan, sizes);
        parameters.touch_capacity = touches;
        parameters.instance_capacity = instances;
        self.scan.reserve(device, splats.max(cluster_views.into()));
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

/// Adds to the time of a stage.
fn add_time(stats: &mut FrameStats, stage: &'static str, time: Duration) {
    let ms = time.as_secs_f64() * 1e3;
    match stats.stages_ms.iter_mut().find(|(name, _)| *name == stage) {
        Some((_, sum)) => *sum += ms,
        None => stats.stages_ms.push((stage, ms)),
    }
}

/// Adds the counts of a region. A splat that reaches into two bands of a view counts twice.
fn add_counts(stats: &mut FrameStats, counters: &Counters) {
    stats.visible_pairs += u64::from(counters.splats);
    stats.instances += u64::from(counters.instances);
    stats.evaluations += counters.evaluations();
}
