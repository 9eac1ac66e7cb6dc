//! All stages on one device, in order, for all views of a step: one submission per frame.

mod handover;

use std::ops::Range;
use std::time::{Duration, Instant};

use rayon::ThreadPool;
use wgpu::{BufferUsages, QuerySet, SubmissionIndex};

use super::bin::Bin;
use super::device::Device;
use super::growing::Growing;
use super::kernel::{Recorder, TICKS_BYTES, clock};
use super::layout::{Counters, Frame as GpuFrame, RASTER_BATCH};
use super::lens::Lenses;
use super::mirror::Mirror;
use super::parts::{Cuts, Needs, Rows, Subject};
use super::plan::{Counts, Plan, job};
use super::project::{Project, Splats, Work};
use super::rasterize::Rasterize;
use super::read_back::{Drawn, ReadBack, Ring, TICKS_OFFSET};
use super::resolve::{Planes, Wanted};
use super::scan::Scan;
use super::shaders::Shaders;
use super::sort::{Columns, Sort};
use super::traffic::FrameCounts;
use crate::constants::{DEPTH_BITS, TILE_PX};
use crate::layout::Cutoffs;
use crate::stage::{Stage, StageOutputs};
use crate::{Frame, FrameStats, RenderError};

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
    lenses: Lenses,
    clock: Option<QuerySet>,
    /// Resolved ticks, on their way to the host.
    ticks: Growing,
    ring: Ring,
    /// The most that any part of a frame needed.
    high_water: Needs,
    /// How frames are cut that do not fit.
    cuts: Cuts,
    /// Attempts that drew nothing, since buffers were too small.
    pub(super) retries: u64,
    /// Parts that frames were drawn in.
    pub(super) regions: u64,
    /// What the last frame counted.
    pub(super) last_frame: FrameCounts,
}

/// What a frame begins with.
#[derive(Clone, Copy, Debug)]
enum Source<'a> {
    /// Gaussians: all stages are to be run.
    Gaussians(&'a Work),
    /// What another backend did: the stages after it.
    StageOutputs(&'a StageOutputs),
}

impl Source<'_> {
    /// Whether a stage is still to be run.
    fn leaves(self, stage: Stage) -> bool {
        match self {
            Self::Gaussians(_) => true,
            Self::StageOutputs(between) => between.last_stage() < stage,
        }
    }

    /// Clusters in views.
    fn items(self) -> u32 {
        match self {
            Self::Gaussians(work) => work.items(),
            Self::StageOutputs(_) => 0,
        }
    }
}

impl Chain {
    /// Compiles what every frame needs; Gaussians will take up to `mirror_bytes`.
    ///
    /// # Errors
    /// A shader does not compile, or memory is out.
    pub(super) fn new(
        device: Device,
        shaders: &Shaders,
        mirror_bytes: u64,
    ) -> Result<Self, RenderError> {
        let chain = Self {
            mirror: Mirror::new(mirror_bytes),
            plan: Plan::new(&device, shaders),
            scan: Scan::new(&device, shaders),
            project: Project::new(&device, shaders),
            sort: Sort::new(&device, shaders),
            bin: Bin::new(&device, shaders),
            rasterize: Rasterize::new(&device, shaders),
            splats: Splats::new(&device),
            lenses: Lenses::default(),
            clock: clock(&device),
            ticks: Growing::new(
                &device,
                "ticks",
                BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
            ),
            ring: Ring::default(),
            // Nothing is made for a crowd: it is bounded alone.
            high_water: Needs {
                crowd: 0,
                splats: FIRST_SPLATS.min(Splats::limit(&device)),
                touches: FIRST_TOUCHES.min(Bin::limit(&device)),
                instances: FIRST_INSTANCES.min(Bin::limit(&device)),
            },
            cuts: Cuts::default(),
            retries: 0,
            regions: 0,
            last_frame: FrameCounts::default(),
            device,
        };
        chain.device.check()?;
        Ok(chain)
    }

    /// Draws a frame: at once if it fits, part by part if it does not.
    ///
    /// # Errors
    /// The device fails, or one row of tiles needs more than it can hold.
    pub(super) fn draw(
        &mut self,
        frame: &Frame<'_>,
        wanted: &Wanted,
        cull: &ThreadPool,
    ) -> Result<Drawn, RenderError> {
        let planes = wanted.planes;
        let start = Instant::now();
        cull.install(|| self.mirror.hold(&self.device, frame.scene))?;
        let (mut gpu_frame, read_back) = self.begin(frame, wanted)?;
        let mut stats = FrameStats::default();
        add(&mut stats, "prepare", start.elapsed());
        let (subject, rows) = (Subject::of(frame), Rows::of(frame));
        let mut rest = self.cuts.recall(&subject, &rows);
        // From the end, so that pieces can take the place of what they are pieces of.
        rest.reverse();
        let mut drawn = Vec::with_capacity(rest.len());
        while let Some(part) = rest.pop() {
            let views = rows.views(&part);
            let columns = |view: usize| u64::from(gpu_frame.view[view].columns);
            let tiles =
                views.clone().map(|view| columns(view) * rows.of_view(view, &part).len() as u64);
            let pieces = tiles.max().unwrap_or(0).div_ceil(self.device.view_tiles());
            if pieces > 1
                && let Some(cut) = rows.cut(&part, pieces)
            {
                rest.extend(cut.into_iter().rev());
                continue;
            }
            let start = Instant::now();
            let work = cull.install(|| Work::new(frame, views.clone(), &self.mirror));
            let limit = Project::limit(&self.device);
            let pieces = u64::from(work.items()).div_ceil(limit);
            if pieces > 1 {
                // Clusters are culled against whole views: bands of one would have as many.
                let cut = if views.len() > 1 { rows.cut(&part, pieces) } else { None };
                let what = "clusters of 256 Gaussians before one camera";
                let cut = cut.ok_or(RenderError::TooMany { what, limit })?;
                rest.extend(cut.into_iter().rev());
                continue;
            }
            self.project.upload(&self.device, &work);
            add(&mut stats, "prepare", start.elapsed());
            let tiles = gpu_frame.restrict(&rows, &part);
            let output = (planes, &tiles, read_back.tiles_per_page);
            let source = Source::Gaussians(&work);
            let needs = self.draw_part(source, &mut gpu_frame, output, &read_back, &mut stats)?;
            let pieces = needs.pieces(self.limit());
            if pieces <= 1 {
                drawn.push((part, needs));
            } else {
                let cut = rows.cut(&part, pieces).ok_or_else(|| self.too_many(needs))?;
                rest.extend(cut.into_iter().rev());
            }
            if !rest.is_empty() {
                read_back.unmap();
            }
        }
        self.regions += drawn.len() as u64;
        self.cuts.remember(subject, drawn, self.limit());
        self.finish(read_back, &gpu_frame, stats)
    }

    /// Makes room for the pixels of a frame, of which nothing is drawn yet.
    fn begin(
        &mut self,
        frame: &Frame<'_>,
        wanted: &Wanted,
    ) -> Result<(GpuFrame, ReadBack), RenderError> {
        let planes = wanted.planes;
        self.lenses.hold(&self.device, frame);
        self.rasterize.hold_behind(&self.device, frame, &wanted.appearances)?;
        let gpu_frame = GpuFrame::new(frame.views, &Cutoffs::new(frame.profile));
        let tiles_per_page = self.rasterize.reserve(&self.device, planes, gpu_frame.tiles);
        let mut read_back = self.ring.take().unwrap_or_else(|| ReadBack::new(&self.device));
        read_back.reserve(&self.device, planes, gpu_frame.tiles, tiles_per_page);
        self.last_frame = FrameCounts::new(frame, planes, &gpu_frame);
        Ok((gpu_frame, read_back))
    }

    /// Hands out a frame of which everything is drawn and mapped.
    fn finish(
        &self,
        read_back: ReadBack,
        frame: &GpuFrame,
        stats: FrameStats,
    ) -> Result<Drawn, RenderError> {
        let pages = read_back.pages(&self.device)?;
        let views = frame.view[..frame.views as usize].to_vec();
        Ok(Drawn { read_back, ring: self.ring.clone(), pages, views, stats })
    }

    /// Draws one part, again in larger buffers where they were too small: the device never drops
    /// what does not fit, it draws nothing then. Returns what the part needs: where that is above
    /// the limit, nothing was drawn that counts.
    fn draw_part(
        &mut self,
        source: Source<'_>,
        frame: &mut GpuFrame,
        output: Output<'_>,
        read_back: &ReadBack,
        stats: &mut FrameStats,
    ) -> Result<Needs, RenderError> {
        loop {
            let start = Instant::now();
            self.reserve(frame, source.items());
            let (stages, submission) = self.submit(source, frame, output, read_back);
            add(stats, "record", start.elapsed());
            let submitted = Instant::now();
            read_back.map(&self.device, submission)?;
            self.device.check()?;
            let (counters, ticks) = read_back.head(&self.device)?;
            self.time(stats, &stages, &ticks, submitted.elapsed());
            let (needs, fits) = self.learn(&counters, frame);
            if fits {
                let limit = self.device.tile_splats(self.rasterize.iterations_behind());
                if u64::from(counters.most_batches) * u64::from(RASTER_BATCH) > limit {
                    let what = "visible splats in one tile (of a device in software)";
                    return Err(RenderError::TooMany { what, limit });
                }
                count(stats, &counters);
                self.last_frame.add(source.items(), &counters);
                return Ok(needs);
            }
            if needs.pieces(self.limit()) > 1 {
                return Ok(needs);
            }
            read_back.unmap();
        }
    }

    /// What was needed, and whether it was there; if not, it will be the next time, unless no buffer
    /// of the device is that large.
    fn learn(&mut self, counters: &Counters, frame: &GpuFrame) -> (Needs, bool) {
        let needs = Needs {
            splats: counters.splats.into(),
            touches: counters.touches.into(),
            instances: counters.instances.into(),
            crowd: counters.most_touches.into(),
        };
        let fits = counters.splats <= frame.splat_capacity
            && counters.touches <= frame.touch_capacity
            && counters.instances <= frame.instance_capacity
            && needs.crowd <= self.limit().crowd;
        if !fits {
            self.retries += 1;
            tracing::debug!(?needs, "not enough room on the device");
            if needs.pieces(self.limit()) <= 1 {
                self.high_water = self.high_water.max(needs);
            }
        }
        (needs, fits)
    }

    fn reserve(&mut self, frame: &mut GpuFrame, items: u32) {
        let Needs { splats, touches, instances, .. } = self.high_water;
        let (device, scan) = (&self.device, &mut self.scan);
        frame.splat_capacity = self.splats.reserve(device, splats);
        let (splats, tiles) = (u64::from(frame.splat_capacity), (frame.macros, frame.tiles));
        (frame.touch_capacity, frame.instance_capacity) =
            self.bin.reserve(device, splats, tiles, (touches, instances));
        scan.reserve(device, splats.max(items.max(frame.tiles).into()));
        self.sort.reserve(device, scan, splats.max(frame.touch_capacity.into()));
        self.ticks.reserve(device, TICKS_BYTES);
    }

    /// The most that the device holds at once.
    fn limit(&self) -> Needs {
        let listed = Bin::limit(&self.device);
        Needs {
            splats: Splats::limit(&self.device),
            touches: listed,
            instances: listed,
            crowd: self.device.macro_touches(),
        }
    }

    fn too_many(&self, needs: Needs) -> RenderError {
        let limit = self.limit();
        let (what, limit) = if needs.splats > limit.splats {
            ("visible splats in one row of tiles", limit.splats)
        } else if needs.crowd > limit.crowd {
            ("visible splats in eight tiles (of a device in software)", limit.crowd)
        } else {
            ("(Gaussian, tile) pairs in one row of tiles", limit.instances)
        };
        RenderError::TooMany { what, limit }
    }

    fn submit(
        &mut self,
        source: Source<'_>,
        frame: &GpuFrame,
        output: Output<'_>,
        read_back: &ReadBack,
    ) -> (Vec<&'static str>, SubmissionIndex) {
        let mut recorder = Recorder::new(&self.device, self.clock.clone());
        self.record(&mut recorder, source, frame, Stage::Bin);
        let Self { device, plan, splats, bin, lenses, .. } = self;

        let mut pass = recorder.stage("rasterize");
        self.rasterize.run(device, &mut pass, plan, (splats, bin, lenses), output);
        drop(pass);

        let stages = recorder.finish_stages(self.ticks.buffer());
        let encoder = &mut recorder.encoder;
        let head = read_back.head.buffer();
        encoder.copy_buffer_to_buffer(plan.counters(), 0, head, 0, size_of::<Counters>() as u64);
        encoder.copy_buffer_to_buffer(self.ticks.buffer(), 0, head, TICKS_OFFSET, TICKS_BYTES);
        self.rasterize.copy(encoder, &read_back.pages, output);
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
            Source::StageOutputs(between) => self.fill(between),
        };
        let Self { device, plan, scan, splats, lenses, .. } = self;
        let (device, plan, scan) = (&*device, &*plan, &*scan);
        plan.start(device, frame, &counts);

        if let Source::Gaussians(work) = source {
            let mut pass = recorder.stage("project");
            self.project.run(
                device,
                &mut pass,
                (work, &self.mirror),
                (plan, scan),
                (splats, lenses),
            );
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

    /// Adds what the device took, by its own clock if it has one.
    fn time(
        &self,
        stats: &mut FrameStats,
        stages: &[&'static str],
        ticks: &[u64],
        whole: Duration,
    ) {
        let Some(tick_ns) = self.device.tick_ns() else {
            add(stats, "device", whole);
            return;
        };
        for (stage, tick) in stages.iter().zip(ticks.chunks_exact(2)) {
            let ns = tick[1].saturating_sub(tick[0]) as f64 * f64::from(tick_ns);
            add(stats, stage, Duration::from_nanos(ns as u64));
        }
    }
}

/// The planes of the output, the tiles that are drawn, and how many of them a page holds.
type Output<'a> = (Planes, &'a Range<u32>, u32);

/// Adds to the time of a stage.
fn add(stats: &mut FrameStats, stage: &'static str, time: Duration) {
    let ms = time.as_secs_f64() * 1e3;
    match stats.stages_ms.iter_mut().find(|(name, _)| *name == stage) {
        Some((_, sum)) => *sum += ms,
        None => stats.stages_ms.push((stage, ms)),
    }
}

/// Adds the counts of a part. What reaches into two bands of a view counts twice.
fn count(stats: &mut FrameStats, counters: &Counters) {
    let evaluations_per_batch = u64::from(RASTER_BATCH * TILE_PX * TILE_PX);
    stats.visible_pairs += u64::from(counters.splats);
    stats.instances += u64::from(counters.instances);
    stats.evaluations += u64::from(counters.batches) * evaluations_per_batch;
}

/// Bits of a number.
fn bits(number: u32) -> u32 {
    u32::BITS - number.leading_zeros()
}
