//! The cpu backend, the default: f32, SIMD chosen at run time, all cores.
//!
//! | module | what it does |
//! |---|---|
//! | `project`, `bin`, `sort`, `rasterize`, `resolve` | the stages |
//! | `background`, `appearance` | parts of the stage resolve |
//! | `drawing`, `part` | run the stages within the memory limit, for all views or for parts of a frame |
//! | `slabs`, `unfinished` | split a view that exceeds the limit into ranges of depth, and keep sums between them |
//! | `overflow` | why a part of a frame was not drawn |
//! | `batch`, `blend` | match the splats of a tile with its blocks, and blend them |
//! | `lens` | lenses, windshields and rolling shutters for SIMD |
//! | `lidar` | sweeps of LiDARs |
//! | `lanes`, `math` | SIMD vectors and elementary functions |
//! | `export` | outputs of the stages for another backend |
//! | `gradient`, `blend_gradient`, `project::gradient` | the stages backwards, for training |
//!
//! The images are deterministic: parallel work writes to places that do not depend on the schedule,
//! and every pixel adds its splats in one order. Scratch buffers are kept from frame to frame.
//! Their size is bounded: views that together exceed the bound are rendered one half after the
//! other, and a single view that exceeds it in slabs of depths.

mod appearance;
mod background;
mod batch;
mod bin;
mod blend;
mod blend_gradient;
mod drawing;
mod export;
mod gradient;
mod lanes;
mod lens;
pub(crate) mod lidar;
mod math;
mod overflow;
mod part;
mod project;
mod rasterize;
mod resolve;
mod slabs;
mod sort;
mod unfinished;

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Instant;

use fearless_simd::Level;
use parking_lot::{Mutex, MutexGuard};
use rayon::ThreadPool;

use crate::gradient::Differentiate;
use crate::lidar::{LidarView, Sweep, Task};
use crate::limits;

use self::background::Background;
use self::drawing::{Drawing, Stages};
use self::overflow::PartError;
use self::part::FramePart;
use super::layout::Cutoffs;
use super::samples::SampledViews;
use super::stage::{Stage, StageOutputs};
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target, View};
use wildcity_scene::geometry::Lidar;
use wildcity_scene::{RenderProfile, Scene};

/// The backend that draws in f32 with vector instructions, on threads of its own.
#[derive(Debug)]
pub struct Cpu {
    main: Lane,
    /// For frames that are rendered while the main lane is busy; `None` if its threads cannot be
    /// started.
    side: OnceLock<Option<Lane>>,
    level: Level,
    /// Most bytes of the main lane's intermediate buffers.
    lane_bytes: AtomicU64,
}

/// Threads and buffers for one frame at a time. With threads of its own, a frame gets its share of
/// the cores; tasks of two frames in one pool would wait for each other.
#[derive(Debug)]
struct Lane {
    pool: ThreadPool,
    scratch: Mutex<Scratch>,
}

/// A lane that renders a frame.
struct BusyLane<'a> {
    pool: &'a ThreadPool,
    scratch: MutexGuard<'a, Scratch>,
    /// Most bytes of its intermediate buffers.
    most_bytes: u64,
}

/// Instruction sets that can be requested; the default is the best one of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Simd {
    /// The best one of the machine.
    #[default]
    Best,
    Avx512,
    /// Eight lanes, with fused multiply-add.
    Avx2,
    /// Four lanes, without fused multiply-add.
    Sse42,
}

/// Why the backend could not be created.
#[derive(Debug, thiserror::Error)]
pub enum CpuError {
    /// The machine lacks the requested instruction set.
    #[error("this machine has no {0:?}")]
    NoSuchSimd(Simd),
    /// More threads than [`limits::RENDER_THREADS`].
    #[error("{threads} render threads; 0 to {} are accepted", limits::RENDER_THREADS)]
    TooManyThreads { threads: usize },
    /// The threads could not be started.
    #[error("cannot start the render threads: {0}")]
    Threads(rayon::ThreadPoolBuildError),
}

/// The side lane may use 1/4 of the main lane's buffer memory.
const SIDE_LANE_DIVISOR: u64 = 4;

/// Buffers that each frame fills anew.
#[derive(Debug, Default)]
struct Scratch {
    projected: project::Projected,
    bins: bin::Bins,
    rasterizer: rasterize::Scratches,
    gradient: gradient::Buffers,
}

impl Cpu {
    /// A backend with its own thread pool of `threads` threads, or one per core if 0.
    ///
    /// # Errors
    /// The machine lacks the instruction set, the threads cannot be started, or there are too many
    /// of them.
    pub fn new(threads: usize, simd: Simd) -> Result<Self, CpuError> {
        if threads > limits::RENDER_THREADS {
            return Err(CpuError::TooManyThreads { threads });
        }
        // A level is only made from the detected one: its existence proves that the machine has it.
        let best = Level::new();
        let supported = match simd {
            Simd::Best => Some(best),
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => best.as_avx512().map(Level::Avx512),
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => best.as_avx2().map(Level::Avx2),
            #[cfg(target_arch = "x86_64")]
            Simd::Sse42 => best.as_sse4_2().map(Level::Sse4_2),
            #[cfg(not(target_arch = "x86_64"))]
            _ => None,
        };
        let level = supported.ok_or(CpuError::NoSuchSimd(simd))?;
        let main = Lane::new(threads, "render").map_err(CpuError::Threads)?;
        let lane_bytes = AtomicU64::new(limits::LANE_BYTES);
        Ok(Self { main, side: OnceLock::new(), level, lane_bytes })
    }

    /// A lane that is free, or the main one as soon as it is.
    fn lane(&self) -> BusyLane<'_> {
        let most_bytes = self.lane_bytes.load(Relaxed);
        // The main lane first: it has four times the memory.
        if let Some(free) = self.main.try_take(most_bytes) {
            return free;
        }
        let threads = self.main.pool.current_num_threads();
        // Made when two frames first meet. A failure is remembered as well, and such frames wait.
        let lane = self.side.get_or_init(|| Lane::new(threads, "render-side").ok());
        let side = lane.as_ref().and_then(|lane| lane.try_take(most_bytes / SIDE_LANE_DIVISOR));
        side.unwrap_or_else(|| self.main.take(most_bytes))
    }

    /// Runs the stages up to and including `last`, and returns their outputs, for another backend
    /// to continue from or to compare with.
    ///
    /// # Errors
    /// No view, too many views, a profile with exact rays, or too many (Gaussian, tile) pairs.
    pub fn run_through(
        &self,
        frame: &Frame<'_>,
        last: Stage,
    ) -> Result<(StageOutputs, FrameStats), RenderError> {
        frame.check_views()?;
        frame.check_splats(self.name())?;
        // The lane's limit does not apply: a comparison needs the outputs of all views at once.
        let BusyLane { pool, mut scratch, .. } = self.lane();
        let scratch = &mut *scratch;
        let cutoffs = Cutoffs::new(frame.profile);
        let sampled = SampledViews::new(frame);
        let frame = &sampled.frame(frame);
        pool.install(|| {
            let mut stats = FrameStats::default();
            // The other backend may be asked for classes, too.
            let classes = true;
            let stages = Stages {
                level: self.level,
                frame,
                cutoffs: &cutoffs,
                most_bytes: u64::MAX,
                classes,
            };
            match project::with_jobs(frame, 0, |jobs| {
                stages.run(scratch, jobs, None, last, &mut stats)
            }) {
                Err(PartError::Render(error)) => return Err(error),
                // With a limit of u64::MAX no part overflows.
                Ok(()) | Err(PartError::Overflow) => {}
            }
            let outputs = export::stage_outputs(scratch, last, &cutoffs, &mut stats);
            Ok((outputs, stats))
        })
    }
}

impl Lane {
    fn new(threads: usize, name: &'static str) -> Result<Self, rayon::ThreadPoolBuildError> {
        let name = move |i| format!("{name}-{i}");
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build()?;
        Ok(Self { pool, scratch: Mutex::default() })
    }

    fn try_take(&self, most_bytes: u64) -> Option<BusyLane<'_>> {
        let scratch = self.scratch.try_lock()?;
        Some(BusyLane { pool: &self.pool, scratch, most_bytes })
    }

    fn take(&self, most_bytes: u64) -> BusyLane<'_> {
        BusyLane { pool: &self.pool, scratch: self.scratch.lock(), most_bytes }
    }
}

impl Backend for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn detail(&self) -> String {
        // SSE4.2 has no fused multiply-add, so instruction sets differ in the last bit.
        let token = format!("{:?}", self.level);
        token.split('(').next().unwrap_or_default().to_owned()
    }

    fn threads(&self) -> usize {
        self.main.pool.current_num_threads()
    }

    fn renders_beside(&self) -> bool {
        true
    }

    fn limit_frame_bytes(&self, bytes: u64) {
        // Clamped and not refused: with less, slabs are not worth their search, and the largest
        // frames need no more.
        let accepted_bytes = bytes.clamp(limits::LANE_BYTES_MIN, limits::LANE_BYTES);
        self.lane_bytes.store(accepted_bytes, Relaxed);
    }

    fn frame_bytes(&self, views: &[View], profile: &RenderProfile) -> u64 {
        let sums_bytes = drawing::sums_bytes(views, profile);
        drawing::most_held_bytes(self.lane_bytes.load(Relaxed), sums_bytes, self.threads())
    }

    fn bytes_beside(&self, views: &[View], profile: &RenderProfile) -> u64 {
        let most_bytes = self.lane_bytes.load(Relaxed) / SIDE_LANE_DIVISOR;
        let sums_bytes = drawing::sums_bytes(views, profile);
        drawing::most_held_bytes(most_bytes, sums_bytes, self.threads())
    }

    fn as_differentiate(&self) -> Option<&dyn Differentiate> {
        Some(self)
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        frame.check_splats(self.name())?;
        // Outside of the pool: baking a sky waits for other threads, and a thread that waits within
        // its own rayon pool may start unrelated work of the pool.
        let backgrounds = Background::from_frame(frame)?;
        let BusyLane { pool, mut scratch, most_bytes } = self.lane();
        let scratch = &mut *scratch;
        let cutoffs = Cutoffs::new(frame.profile);
        let sampled = SampledViews::new(frame);
        pool.install(|| {
            let part = FramePart {
                frame: sampled.frame(frame),
                shown: frame.views,
                backgrounds: &backgrounds,
                first_view: 0,
            };
            let stats = FrameStats::default();
            let mut drawing = Drawing {
                level: self.level,
                cutoffs: &cutoffs,
                most_bytes,
                scratch,
                finished,
                stats,
            };
            let drawn = drawing.draw(part, targets);
            let stats = drawing.stats;
            // What one unusual frame has allocated must not stay allocated, beyond a part
            // of the limit.
            scratch.bins.trim(most_bytes / 2);
            scratch.rasterizer.trim(most_bytes / 4);
            drawn.map(|()| stats)
        })
    }

    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        let BusyLane { pool, .. } = self.lane();
        let task = Task::new(scene, profile, view)?;
        Ok(pool.install(|| lidar::sweep(self.level, &task)))
    }

    fn sweep_bytes(&self, lidar: &Lidar) -> u64 {
        lidar::most_bytes(lidar, self.threads())
    }
}

/// Wall time of consecutive stages.
struct StageTimer {
    start: Instant,
}

impl StageTimer {
    fn start() -> Self {
        Self { start: Instant::now() }
    }

    /// Adds the time since the end of the previous stage.
    fn finish(&mut self, name: &'static str, stats: &mut FrameStats) {
        let ms = self.lap_ms();
        Self::add(name, ms, stats);
    }

    /// Adds the times of two stages that alternate, given the time of each in all threads: they
    /// share the wall time in this proportion.
    fn finish_both(&mut self, stages: [(&'static str, u64); 2], stats: &mut FrameStats) {
        let ms = self.lap_ms();
        let total: u64 = stages.iter().map(|(_, ns)| ns).sum();
        for (name, ns) in stages {
            // At least 1, so that a frame without any work does not divide by 0.
            Self::add(name, ms * ns as f64 / total.max(1) as f64, stats);
        }
    }

    /// The time since the end of the previous stage, which ends now.
    fn lap_ms(&mut self) -> f64 {
        let before = std::mem::replace(&mut self.start, Instant::now());
        (self.start - before).as_secs_f64() * 1e3
    }

    fn add(name: &'static str, ms: f64, stats: &mut FrameStats) {
        match stats.stages_ms.iter_mut().find(|(stage, _)| *stage == name) {
            Some((_, sum_ms)) => *sum_ms += ms,
            None => stats.stages_ms.push((name, ms)),
        }
    }
}
