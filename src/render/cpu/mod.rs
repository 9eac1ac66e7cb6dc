//! The embedded default: f32, SIMD chosen at run time, all cores.
//!
//! Deterministic: what runs in parallel writes to places that do not depend on the schedule, and
//! every pixel adds its splats in one order. Scratch buffers live from frame to frame.

mod appearance;
mod behind;
mod bent;
mod bin;
mod handover;
mod lanes;
mod optics;
mod project;
mod rasterize;
mod resolve;
mod sort;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use fearless_simd::Level;
use rayon::ThreadPool;

use crate::limits;

use self::behind::Behind;
use super::layout::Cutoffs;
use super::stage::{Stage, StageOutputs};
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};

/// The f32 backend.
#[derive(Debug)]
pub struct Cpu {
    pool: ThreadPool,
    level: Level,
    scratch: Mutex<Scratch>,
}

/// Instruction sets that can be asked for; the best one that the machine has is the default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Simd {
    /// The best of the machine.
    #[default]
    Best,
    /// Sixteen lanes.
    Avx512,
    /// Eight lanes, with fused multiply-add.
    Avx2,
    /// Four lanes, without fused multiply-add.
    Sse42,
}

/// Why the backend could not be made.
#[derive(Debug, thiserror::Error)]
pub enum CpuError {
    /// The machine lacks the instruction set asked for.
    #[error("this machine has no {0:?}")]
    NoSuchSimd(Simd),
    /// More threads than any machine has cores.
    #[error("{threads} render threads; 0 to {} are accepted", limits::RENDER_THREADS)]
    TooManyThreads {
        /// How many were asked for.
        threads: usize,
    },
    /// The threads could not be started.
    #[error("cannot start the render threads: {0}")]
    Threads(rayon::ThreadPoolBuildError),
}

/// What a frame leaves behind for the next one to fill again.
#[derive(Debug, Default)]
struct Scratch {
    projected: project::Projected,
    sorted: sort::Sorted,
    bins: bin::Bins,
}

impl Cpu {
    /// A backend with threads of its own: `threads`, or one per core if 0.
    ///
    /// # Errors
    /// The machine lacks the instruction set, or the threads; or there are too many of them.
    pub fn new(threads: usize, simd: Simd) -> Result<Self, CpuError> {
        if threads > limits::RENDER_THREADS {
            return Err(CpuError::TooManyThreads { threads });
        }
        let best = Level::new();
        let level = match simd {
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
        let level = level.ok_or(CpuError::NoSuchSimd(simd))?;
        let name = |i| format!("render-{i}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build();
        let pool = pool.map_err(CpuError::Threads)?;
        Ok(Self { pool, level, scratch: Mutex::default() })
    }

    /// Runs the stages up to and including `last`, for another backend to go on or to compare with.
    ///
    /// # Errors
    /// The views are none or too many, or there are too many instances.
    pub fn run_through(
        &self,
        frame: &Frame<'_>,
        last: Stage,
    ) -> Result<(StageOutputs, FrameStats), RenderError> {
        frame.check_views()?;
        frame.check_splats(self.name())?;
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        let scratch = &mut *scratch;
        let cutoffs = Cutoffs::new(frame.profile);
        self.pool.install(|| {
            let mut stats = FrameStats::default();
            scratch.run(self.level, frame, &cutoffs, last, &mut stats)?;
            let mut clock = Clock::start();
            let between = handover::between(scratch, last, &cutoffs);
            clock.stage("hand over", &mut stats);
            Ok((between, stats))
        })
    }
}

impl Scratch {
    /// Runs the stages up to `last`. Each fills its part from the start, so what a frame before left
    /// there, or a panic, does no harm.
    fn run(
        &mut self,
        level: Level,
        frame: &Frame<'_>,
        cutoffs: &Cutoffs,
        last: Stage,
        stats: &mut FrameStats,
    ) -> Result<(), RenderError> {
        let Self { projected, sorted, bins } = self;
        let mut clock = Clock::start();
        projected.project(level, frame, cutoffs);
        clock.stage("project", stats);
        stats.visible_pairs = projected.len() as u64;
        if last >= Stage::Sort {
            sorted.sort(projected, cutoffs);
            clock.stage("sort", stats);
        }
        if last >= Stage::Bin {
            bins.bin(level, projected, sorted, frame.views, cutoffs)?;
            clock.stage("bin", stats);
            stats.instances = bins.instances() as u64;
        }
        Ok(())
    }
}

impl Backend for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn detail(&self) -> String {
        // Four lanes have no fused multiply-add, so instruction sets differ in the last bit.
        let token = format!("{:?}", self.level);
        token.split('(').next().unwrap_or_default().to_owned()
    }

    fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        frame.check_splats(self.name())?;
        // Outside of the pool: baking waits for threads, and one that waits for its own pool may take up
        // other work there.
        let behind = Behind::of(frame)?;
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        let scratch = &mut *scratch;
        let cutoffs = Cutoffs::new(frame.profile);
        self.pool.install(|| {
            let mut stats = FrameStats::default();
            scratch.run(self.level, frame, &cutoffs, Stage::Bin, &mut stats)?;
            let mut clock = Clock::start();
            let Scratch { projected, bins, .. } = scratch;
            let (views, behind) = (frame.views, &*behind);
            let input = rasterize::Input { projected, bins, views, behind, cutoffs: &cutoffs };
            stats.evaluations = rasterize::rasterize(self.level, input, targets, finished);
            clock.stage("rasterize", &mut stats);
            Ok(stats)
        })
    }
}

struct Clock {
    start: Instant,
}

impl Clock {
    fn start() -> Self {
        Self { start: Instant::now() }
    }

    /// What has passed since the last stage is this one's.
    fn stage(&mut self, name: &'static str, stats: &mut FrameStats) {
        let now = Instant::now();
        stats.stages_ms.push((name, (now - self.start).as_secs_f64() * 1e3));
        self.start = now;
    }
}
