//! All stages on one device, in order, for all views of a step: one submission per frame.

mod handover;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use wgpu::{BufferUsages, BufferView, MapMode, PollType, QuerySet, SubmissionIndex};

use super::bin::Bin;
use super::device::Device;
use super::growing::Growing;
use super::kernel::{Recorder, TICKS_BYTES, clock};
use super::layout::{Counters, Frame as GpuFrame, FrameView};
use super::mirror::Mirror;
use super::plan::{Counts, Plan, job};
use super::project::{Project, Splats, Work};
use super::rasterize::Rasterize;
use super::resolve::Planes;
use super::scan::Scan;
use super::shaders::Shaders;
use super::sort::{Columns, Sort};
use super::traffic::FrameWork;
use crate::render::constants::{DEPTH_BITS, TILE_PX};
use crate::render::layout::Cutoffs;
use crate::render::stage::{Between, Stage};
use crate::render::{Frame, FrameStats, RenderError};

/// How long a frame may take on the device before it counts as lost.
const FRAME_TIMEOUT: Duration = Duration::from_secs(60);

/// Room for splats, touches and instances to begin with; what a frame needs beyond makes it grow.
const FIRST_SPLATS: u64 = 1 << 15;
const FIRST_TOUCHES: u64 = 1 << 16;
const FIRST_INSTANCES: u64 = 1 << 17;

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
    splats: Splats,
    clock: Option<QuerySet>,
    /// Resolved ticks, on their way to the host.
    ticks: Growing,
    /// Read-back buffers that nobody reads.
    ring: Vec<ReadBack>,
    /// The most that any frame needed.
    high_water: Needs,
    /// Frames that were drawn again in larger buffers.
    pub(super) retries: u64,
    pub(super) last: FrameWork,
}

#[derive(Clone, Copy, Debug)]
struct Needs {
    splats: u64,
    touches: u64,
    instances: u64,
}

/// What a frame begins with.
#[derive(Clone, Copy, Debug)]
enum Source<'a> {
    /// Gaussians: all stages are to be run.
    Gaussians(&'a Work),
    /// What another backend did: the stages after it.
    Between(&'a Between),
}

impl Source<'_> {
    /// Whether a stage is still to be run.
    fn leaves(self, stage: Stage) -> bool {
        match self {
            Self::Gaussians(_) => true,
            Self::Between(between) => between.through() < stage,
        }
    }

    /// Clusters in views.
    fn items(self) -> u32 {
        match self {
            Self::Gaussians(work) => work.items(),
            Self::Between(_) => 0,
        }
    }
}

/// Where a frame reaches the host. A step's images are copied out of one while the next step fills
/// another.
#[derive(Debug)]
pub(super) struct ReadBack {
    /// Counters, then ticks.
    head: Growing,
    pages: Vec<Growing>,
}

/// A frame that is done, in mapped memory.
#[derive(Debug)]
pub(super) struct Drawn {
    read_back: ReadBack,
    /// Pixels, page by page.
    pub(super) pages: Vec<BufferView>,
    pub(super) tiles_per_page: u32,
    pub(super) views: Vec<FrameView>,
    pub(super) stats: FrameStats,
}

impl Chain {
    /// Compiles what every frame needs.
    ///
    /// # Errors
    /// A shader does not compile, or memory is out.
    pub(super) fn new(device: Device, shaders: &Shaders) -> Result<Self, RenderError> {
        let chain = Self {
            mirror: Mirror::default(),
            plan: Plan::new(&device, shaders),
            scan: Scan::new(&device, shaders),
            project: Project::new(&device, shaders),
            sort: Sort::new(&device, shaders),
            bin: Bin::new(&device, shaders),
            rasterize: Rasterize::new(&device, shaders),
            splats: Splats::new(&device),
            clock: clock(&device),
            ticks: Growing::new(
                &device,
                "ticks",
                BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
            ),
            ring: Vec::new(),
            high_water: Needs {
                splats: FIRST_SPLATS,
                touches: FIRST_TOUCHES,
                instances: FIRST_INSTANCES,
            },
            retries: 0,
            last: FrameWork::default(),
            device,
        };
        chain.device.check()?;
        Ok(chain)
    }

    /// Draws a frame, again in larger buffers where they were too small: the device never drops
    /// what does not fit, it draws nothing then.
    ///
    /// # Errors
    /// The device fails, or the frame needs more than it can hold.
    pub(super) fn draw(&mut self, frame: &Frame<'_>, planes: Planes) -> Result<Drawn, RenderError> {
        let start = Instant::now();
        self.mirror.hold(&self.device, frame.scene);
        let work = Work::new(frame, &self.mirror);
        self.project.upload(&self.device, &work);
        self.draw_from(Source::Gaussians(&work), frame, planes, start)
    }

    fn draw_from(
        &mut self,
        source: Source<'_>,
        frame: &Frame<'_>,
        planes: Planes,
        start: Instant,
    ) -> Result<Drawn, RenderError> {
        let prepare_ms = start.elapsed().as_secs_f64() * 1e3;
        let mut gpu_frame = GpuFrame::new(frame.views, &Cutoffs::new(frame.profile));
        let tiles_per_page = self.rasterize.reserve(&self.device, planes, gpu_frame.tiles);
        let mut read_back = self.ring.pop().unwrap_or_else(|| ReadBack::new(&self.device));
        read_back.reserve(&self.device, planes, gpu_frame.tiles, tiles_per_page);
        loop {
            self.reserve(&mut gpu_frame, source.items());
            let stages = self.submit(source, &gpu_frame, (planes, tiles_per_page), &read_back);
            let (stages, submission) = stages;
            read_back.map(&self.device, submission)?;
            self.device.check()?;
            let (counters, ticks) = read_back.head()?;
            if self.is_enough(&counters, &gpu_frame)? {
                let pages = read_back.pages()?;
                self.last = frame_work(frame, planes, source, &gpu_frame, &counters);
                let stats = self.stats(&counters, prepare_ms, &stages, &ticks, start.elapsed());
                let views = gpu_frame.view[..frame.views.len()].to_vec();
                return Ok(Drawn { read_back, pages, tiles_per_page, views, stats });
            }
            read_back.unmap();
            self.retries += 1;
            tracing::debug!(
                splats = counters.splats,
                touches = counters.touches,
                instances = counters.instances,
                "drawn again"
            );
        }
    }

    /// Takes a frame's memory back for another one.
    pub(super) fn recycle(&mut self, drawn: Drawn) {
        let Drawn { read_back, pages, .. } = drawn;
        // A buffer stays mapped for as long as a view of it lives.
        drop(pages);
        read_back.unmap();
        self.ring.push(read_back);
    }

    fn reserve(&mut self, frame: &mut GpuFrame, items: u32) {
        let Needs { splats, touches, instances } = self.high_water;
        let (device, scan) = (&self.device, &mut self.scan);
        frame.splat_capacity = self.splats.reserve(device, splats);
        let (splats, tiles) = (u64::from(frame.splat_capacity), (frame.macros, frame.tiles));
        (frame.touch_capacity, frame.instance_capacity) =
            self.bin.reserve(device, splats, tiles, (touches, instances));
        scan.reserve(device, splats.max(items.max(frame.tiles).into()));
        self.sort.reserve(device, scan, splats.max(frame.touch_capacity.into()));
        self.ticks.reserve(device, TICKS_BYTES);
    }

    /// Whether everything fitted; if not, the high water rises to what it takes.
    fn is_enough(&mut self, counters: &Counters, frame: &GpuFrame) -> Result<bool, RenderError> {
        let splats = Splats::limit(&self.device);
        let listed = Bin::limit(&self.device);
        let checks = [
            ("visible splats", counters.splats, splats),
            ("(Gaussian, macro tile) pairs", counters.touches, listed),
            ("(Gaussian, tile) pairs", counters.instances, listed),
        ];
        for (what, needed, limit) in checks {
            if u64::from(needed) > limit {
                return Err(RenderError::TooMany { what, limit });
            }
        }
        let Needs { splats, touches, instances } = &mut self.high_water;
        let checks = [
            (counters.splats, splats, frame.splat_capacity),
            (counters.touches, touches, frame.touch_capacity),
            (counters.instances, instances, frame.instance_capacity),
        ];
        let mut is_enough = true;
        for (needed, high_water, capacity) in checks {
            *high_water = u64::from(needed).max(*high_water);
            is_enough &= needed <= capacity;
        }
        Ok(is_enough)
    }

    fn submit(
        &mut self,
        source: Source<'_>,
        frame: &GpuFrame,
        (planes, per_page): (Planes, u32),
        read_back: &ReadBack,
    ) -> (Vec<&'static str>, SubmissionIndex) {
        let mut recorder = Recorder::new(&self.device, self.clock.clone());
        self.record(&mut recorder, source, frame, Stage::Bin);
        let Self { device, plan, splats, bin, .. } = self;

        let mut pass = recorder.stage("rasterize");
        let output = (planes, frame.tiles, per_page);
        self.rasterize.run(device, &mut pass, plan, (splats, bin), output);
        drop(pass);

        let stages = recorder.finish_stages(self.ticks.buffer());
        let encoder = &mut recorder.encoder;
        let head = read_back.head.buffer();
        encoder.copy_buffer_to_buffer(plan.counters(), 0, head, 0, size_of::<Counters>() as u64);
        encoder.copy_buffer_to_buffer(self.ticks.buffer(), 0, head, TICKS_OFFSET, TICKS_BYTES);
        self.rasterize.copy(encoder, &read_back.pages, planes, (frame.tiles, per_page));
        let submission = device.queue.submit([recorder.encoder.finish()]);
        (stages, submission)
    }

    /// Records the stages up to `last` that the source leaves to be run. Returns which of the buffers
    /// that the sort of splats goes to and fro between are in order.
    fn record(
        &mut self,
        recorder: &mut Recorder,
        source: Source<'_>,
        frame: &GpuFrame,
        last: Stage,
    ) -> usize {
        let is_due = |stage| stage <= last && source.leaves(stage);
        let counts = match source {
            Source::Gaussians(work) => Counts { items: work.items(), ..Counts::default() },
            Source::Between(between) => self.fill(between),
        };
        let Self { device, plan, scan, splats, .. } = self;
        let (device, plan, scan) = (&*device, &*plan, &*scan);
        plan.start(device, frame, &counts);

        if let Source::Gaussians(work) = source {
            let mut pass = recorder.stage("project");
            self.project.run(device, &mut pass, (work, &self.mirror), (plan, scan), splats);
        }

        let mut sorted = 0;
        if is_due(Stage::Sort) {
            let mut pass = recorder.stage("sort");
            let jobs = (plan.jobs(), job::SPLATS_SORT, job::SPLATS_DIGITS);
            let depth_bits = DEPTH_BITS + bits(frame.views - 1);
            let data = Columns { keys: &splats.keys, values: &splats.places, masks: None };
            sorted = self.sort.run(device, &mut pass, scan, jobs, data, depth_bits);
        }

        if is_due(Stage::Bin) {
            recorder.encoder.clear_buffer(self.bin.macro_ranges(), 0, None);
            let mut pass = recorder.stage("bin");
            self.bin.touch(device, &mut pass, (plan, scan), (splats, sorted));
            drop(pass);

            let mut pass = recorder.stage("tile sort");
            let jobs = (plan.jobs(), job::TOUCHES_SORT, job::TOUCHES_DIGITS);
            // The number after the last macro tile occurs too.
            let (data, macro_bits) = (self.bin.touches(), bits(frame.macros));
            let touches = self.sort.run(device, &mut pass, scan, jobs, data, macro_bits);
            drop(pass);

            let mut pass = recorder.stage("expand");
            self.bin.expand(device, &mut pass, (plan, scan), (frame.macros, touches));
        }
        sorted
    }

    fn stats(
        &self,
        counters: &Counters,
        prepare_ms: f64,
        stages: &[&'static str],
        ticks: &[u64],
        whole: Duration,
    ) -> FrameStats {
        let mut stages_ms = vec![("prepare", prepare_ms)];
        match self.device.tick_ns() {
            Some(tick_ns) => {
                let spans = stages.iter().zip(ticks.chunks_exact(2));
                stages_ms.extend(spans.map(|(name, tick)| {
                    let ticks = tick[1].saturating_sub(tick[0]);
                    (*name, ticks as f64 * f64::from(tick_ns) * 1e-6)
                }));
            }
            None => stages_ms.push(("device", whole.as_secs_f64() * 1e3 - prepare_ms)),
        }
        FrameStats {
            stages_ms,
            visible_pairs: counters.splats.into(),
            instances: counters.instances.into(),
            evaluations: u64::from(counters.batches)
                * u64::from(super::layout::RASTER_BATCH)
                * u64::from(TILE_PX * TILE_PX),
        }
    }
}

fn frame_work(
    frame: &Frame<'_>,
    planes: Planes,
    source: Source<'_>,
    gpu_frame: &GpuFrame,
    counters: &Counters,
) -> FrameWork {
    FrameWork {
        sh_degree: frame.scene.sh_degree(),
        views: gpu_frame.views,
        pixels: frame.views.iter().map(|view| view.camera.pixels() as u64).sum(),
        planes: planes.tile_bytes() / u64::from(4 * TILE_PX * TILE_PX),
        tiles: gpu_frame.tiles.into(),
        macros: gpu_frame.macros.into(),
        clusters: source.items().into(),
        splats: counters.splats.into(),
        touches: counters.touches.into(),
        instances: counters.instances.into(),
        batches: counters.batches.into(),
    }
}

/// Where the ticks lie behind the counters.
const TICKS_OFFSET: u64 = 256;

impl ReadBack {
    fn new(device: &Device) -> Self {
        Self { head: Self::buffer(device, "counters read back"), pages: Vec::new() }
    }

    fn buffer(device: &Device, label: &'static str) -> Growing {
        Growing::new(device, label, BufferUsages::MAP_READ | BufferUsages::COPY_DST)
    }

    fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32, per_page: u32) {
        self.head.reserve(device, TICKS_OFFSET + TICKS_BYTES);
        let firsts = (0..tiles).step_by(per_page as usize);
        self.pages.resize_with(firsts.len(), || Self::buffer(device, "pixels read back"));
        for (page, first) in self.pages.iter_mut().zip(firsts) {
            page.reserve(device, planes.tile_bytes() * u64::from(per_page.min(tiles - first)));
        }
    }

    /// Waits for a submission, and maps everything.
    fn map(&self, device: &Device, submission: SubmissionIndex) -> Result<(), RenderError> {
        let failed = Arc::new(AtomicBool::new(false));
        for growing in self.all() {
            let failed = Arc::clone(&failed);
            growing.buffer().slice(..).map_async(MapMode::Read, move |result| {
                failed.fetch_or(result.is_err(), Relaxed);
            });
        }
        let wait =
            PollType::Wait { submission_index: Some(submission), timeout: Some(FRAME_TIMEOUT) };
        let polled = device.device.poll(wait);
        device.check()?;
        polled.map_err(|error| device.failed(error.to_string()))?;
        match failed.load(Relaxed) {
            true => Err(device.failed("its memory could not be read".to_owned())),
            false => Ok(()),
        }
    }

    fn head(&self) -> Result<(Counters, Vec<u64>), RenderError> {
        let view = view(&self.head)?;
        let counters = bytemuck::pod_read_unaligned(&view[..size_of::<Counters>()]);
        let ticks = &view[TICKS_OFFSET as usize..(TICKS_OFFSET + TICKS_BYTES) as usize];
        Ok((counters, ticks.chunks_exact(8).map(bytemuck::pod_read_unaligned).collect()))
    }

    fn pages(&self) -> Result<Vec<BufferView>, RenderError> {
        self.pages.iter().map(view).collect()
    }

    fn unmap(&self) {
        self.all().for_each(|growing| growing.buffer().unmap());
    }

    fn all(&self) -> impl Iterator<Item = &Growing> {
        std::iter::once(&self.head).chain(&self.pages)
    }
}

fn view(growing: &Growing) -> Result<BufferView, RenderError> {
    growing
        .buffer()
        .slice(..)
        .get_mapped_range()
        .map_err(|error| RenderError::Device { device: String::new(), reason: error.to_string() })
}

/// Bits of a number.
fn bits(number: u32) -> u32 {
    u32::BITS - number.leading_zeros()
}
