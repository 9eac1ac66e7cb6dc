//! The embedded default: f32, SIMD chosen at run time, all cores.
//!
//! Deterministic: what runs in parallel writes to places that do not depend on the schedule, and
//! every pixel adds its splats in one order. Scratch buffers live from frame to frame.

mod bin;
mod lanes;
mod project;
mod rasterize;
mod resolve;
mod sort;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use fearless_simd::Level;
use rayon::ThreadPool;

use crate::config;

use super::layout::Cutoffs;
use super::{Backend, Finished, Frame, FrameStats, RenderError, Target};

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
    #[error("{threads} render threads; 0 to {} are accepted", config::RENDER_THREADS)]
    TooManyThreads {
        /// How many were asked for.
        threads: usize,
    },
    /// The threads could not be started.
    #[error("cannot start the render threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
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
        if threads > config::RENDER_THREADS {
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
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build()?;
        Ok(Self { pool, level, scratch: Mutex::default() })
    }
}

impl Backend for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        // Every stage fills its scratch from the start, so a panic elsewhere left nothing harmful.
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        let Scratch { projected, sorted, bins } = &mut *scratch;
        let (level, cutoffs) = (self.level, Cutoffs::new(frame.profile));
        self.pool.install(|| {
            let mut clock = Clock { start: Instant::now(), stages_ms: Vec::with_capacity(4) };
            projected.project(level, frame, &cutoffs);
            clock.stage("project");
            sorted.sort(projected, &cutoffs);
            clock.stage("sort");
            bins.bin(level, projected, sorted, frame.views, &cutoffs)?;
            clock.stage("bin");
            let views = frame.views;
            let input = rasterize::Input { projected, bins, views, cutoffs: &cutoffs };
            let evaluations = rasterize::rasterize(level, input, targets, finished);
            clock.stage("rasterize");
            Ok(FrameStats {
                stages_ms: clock.stages_ms,
                visible_pairs: sorted.len() as u64,
                instances: bins.instances() as u64,
                evaluations,
            })
        })
    }
}

struct Clock {
    start: Instant,
    stages_ms: Vec<(&'static str, f64)>,
}

impl Clock {
    fn stage(&mut self, name: &'static str) {
        let now = Instant::now();
        self.stages_ms.push((name, (now - self.start).as_secs_f64() * 1e3));
        self.start = now;
    }
}
