//! The gpu backend: WGSL compute shaders in `shaders/`, one per stage, run by wgpu on Vulkan. Each
//! stage is the twin of the cpu backend's stage of the same name.
//!
//! The backend is deterministic: sorts are stable, the floating-point sums of a pixel are always
//! added in the same order, and operations that threads execute in any order commute. Nothing is
//! read back in the middle of a frame: a frame that does not fit its buffers is drawn again in
//! larger ones, and one that does not fit the device is drawn region by region
//! (`gpu/partition.rs`).
//!
//! # Frames in flight
//!
//! A frame is prepared, recorded and submitted in its turn, in the order of the calls
//! (`gpu/tickets.rs`). It is waited for, copied out, hashed and encoded outside of its turn, while
//! the next frames have theirs. The device has at most two of them, so that it finds the next frame
//! in its queue when one is done (`gpu/slots.rs`). A frame whose buffers were too small, or that
//! does not fit the device at once, is drawn in one turn.
//!
//! The engine runs a render thread for each frame in flight ([`Backend::frames_in_flight`]), more
//! of them on a machine with more cores. Preparing runs on the caller's thread, and culling in a
//! thread pool of its own. A rayon thread that waits takes up other work of its pool; if that were
//! the next frame, it would wait for this one, which waits for it.
//!
//! A sweep of a LiDAR takes one turn from the search for candidates to its returns.

mod background;
mod bandwidth;
mod bin;
mod chain;
mod device;
mod discarded;
mod gradient;
mod growable_buffer;
mod kernel;
pub mod layout;
mod lens;
mod lidar;
mod long_tiles;
mod mirror;
mod partition;
mod plan;
mod project;
mod project_work;
mod rasterize;
mod read_back;
mod resolve;
mod roofline;
mod scan;
pub mod shaders;
mod slots;
mod sort;
mod splat_owners;
mod tickets;
mod tuning;
mod turns;

use std::time::Instant;

use parking_lot::Mutex;
use rayon::ThreadPool;
use rayon::prelude::*;
use wgpu::{Adapter, AdapterInfo};

pub use bandwidth::FrameCounts;
pub use device::{AdapterChoice, DeviceInfo, DeviceTotals, GpuError, NO_DEVICE, devices};
pub use roofline::Roofline;
pub use tuning::{Scatter, Tuning};

use self::chain::Chain;
use self::device::Device;
use self::discarded::Discarded;
use self::lidar::SweepKernels;
use self::read_back::MappedFrame;
use self::resolve::{Outputs, Pixels};
use self::shaders::Shaders;
use self::slots::Slots;
use self::tickets::TicketQueue;
use super::cpu;
use super::stage::{Stage, StageOutputs};
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use crate::gradient::Differentiate;
use crate::lidar::{LidarView, Sweep, Task};
use crate::limits;
use crate::samples::SampledViews;
use wildcity_scene::geometry::Lidar;
use wildcity_scene::{RenderProfile, Scene};

/// The backend that draws on a device of wgpu, and opens it again after a failure.
#[derive(Debug)]
pub struct Gpu {
    choice: AdapterChoice,
    /// Opens more devices, for [`Gpu::another`].
    adapter: Adapter,
    /// The device and its driver. A backend never changes to another device.
    info: AdapterInfo,
    /// Most bytes of its bindings.
    binding_bytes: u64,
    shaders: Shaders,
    limits: MemoryLimits,
    /// Which kernels run, if that was chosen.
    tuning: Option<Tuning>,
    /// Copies images to their targets, and runs the callbacks of finished views.
    deliver: ThreadPool,
    /// Culls clusters, and finds candidates of LiDARs. It has its own pool, so that a frame that is
    /// drawn does not wait for one that is encoded.
    cull: ThreadPool,
    queue: TicketQueue,
    /// The frames that the device has.
    slots: Slots,
    /// Empty after the device has failed; the next frame opens it again.
    chain: Mutex<Option<Chain>>,
    discarded: Discarded,
}

/// Limits of the use of a device's memory, if less than all of it may be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Most bytes of resident Gaussians; the least recently drawn chunks are evicted beyond it.
    pub mirror_bytes: u64,
    /// Most bytes of a binding, at least `limits::BINDING_BYTES_MIN`. Frames that need more are
    /// drawn region by region.
    pub binding_bytes: u64,
}

impl Default for MemoryLimits {
    /// No limits except the device's own.
    fn default() -> Self {
        Self { mirror_bytes: u64::MAX, binding_bytes: u64::MAX }
    }
}

/// The memory of a device, and the counts of its work since it was opened.
#[derive(Clone, Debug, PartialEq)]
pub struct GpuUsage {
    pub name: String,
    /// Bytes of resident Gaussians.
    pub mirror_bytes: u64,
    /// Bytes of all buffers, if the allocator counts them.
    pub allocated_bytes: Option<u64>,
    /// Attempts that drew nothing because buffers were too small.
    pub retries: u64,
    /// Regions that were drawn: one for each frame that fits at once.
    pub regions: u64,
    /// Counts of the last frame.
    pub last_frame: FrameCounts,
    /// Numbers of pipelines, buffers, and dispatches.
    pub totals: DeviceTotals,
}

impl Gpu {
    /// Opens a device. `threads` is the number of threads that copy images out of its memory; 0
    /// means one per core.
    ///
    /// # Errors
    /// There is no such device, or a shader cannot be compiled for it.
    pub fn new(choice: &AdapterChoice, threads: usize) -> Result<Self, GpuError> {
        Self::open(choice, threads, Shaders::default(), MemoryLimits::default(), None)
    }

    /// As [`Gpu::new`] with other shaders: for tests that break a shader and check that it is
    /// detected.
    ///
    /// # Errors
    /// As [`Gpu::new`].
    pub fn with_shaders(
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
    ) -> Result<Self, GpuError> {
        Self::open(choice, threads, shaders, MemoryLimits::default(), None)
    }

    /// As [`Gpu::new`] with limits on the device's memory.
    ///
    /// # Errors
    /// As [`Gpu::new`].
    pub fn with_limits(
        choice: &AdapterChoice,
        threads: usize,
        limits: MemoryLimits,
    ) -> Result<Self, GpuError> {
        Self::open(choice, threads, Shaders::default(), limits, None)
    }

    /// As [`Gpu::with_shaders`] with a choice of kernels: for tests of those that the device would
    /// not run.
    ///
    /// # Errors
    /// As [`Gpu::new`].
    pub fn with_tuning(
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
        tuning: Tuning,
    ) -> Result<Self, GpuError> {
        Self::open(choice, threads, shaders, MemoryLimits::default(), Some(tuning))
    }

    fn open(
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
        limits: MemoryLimits,
        tuning: Option<Tuning>,
    ) -> Result<Self, GpuError> {
        if threads > limits::RENDER_THREADS {
            let limit = limits::RENDER_THREADS;
            let reason = format!("{threads} are too many; 0 to {limit} are allowed");
            return Err(GpuError::Threads { reason });
        }
        let limits = MemoryLimits {
            binding_bytes: limits.binding_bytes.max(limits::BINDING_BYTES_MIN),
            ..limits
        };
        let device = Device::open(choice, &shaders, limits.binding_bytes, tuning)?;
        Self::with_device(device, choice, threads, shaders, limits, tuning)
    }

    /// A device of the same adapter, that has rendered nothing yet. Adapters are not looked for
    /// again, which takes time, and for which a driver may print a warning each time.
    ///
    /// # Errors
    /// The driver does not open it.
    pub fn another(&self) -> Result<Self, GpuError> {
        let Self { adapter, shaders, limits, tuning, .. } = self;
        let device = Device::on(adapter.clone(), shaders, limits.binding_bytes, *tuning)?;
        let threads = self.cull.current_num_threads();
        Self::with_device(device, &self.choice, threads, shaders.clone(), *limits, *tuning)
    }

    fn with_device(
        device: Device,
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
        limits: MemoryLimits,
        tuning: Option<Tuning>,
    ) -> Result<Self, GpuError> {
        let pool = |name: &'static str| {
            let builder = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = builder.thread_name(move |i| format!("{name}-{i}")).build();
            pool.map_err(|error| GpuError::Threads { reason: error.to_string() })
        };
        Ok(Self {
            choice: choice.clone(),
            adapter: device.adapter.clone(),
            info: device.info.clone(),
            binding_bytes: device.binding_bytes(),
            limits,
            tuning,
            deliver: pool("deliver")?,
            cull: pool("cull")?,
            queue: TicketQueue::default(),
            slots: Slots::default(),
            chain: Mutex::new(Some(Chain::new(device, limits.mirror_bytes)?)),
            discarded: Discarded::default(),
            shaders,
        })
    }

    /// The memory and the counts of the device; `None` while it is lost.
    pub fn usage(&self) -> Option<GpuUsage> {
        let slot = self.chain.lock();
        let chain = slot.as_ref()?;
        let tally = chain.tally.lock();
        Some(GpuUsage {
            name: chain.device.info.name.clone(),
            mirror_bytes: chain.mirror.bytes(),
            allocated_bytes: chain.device.allocated_bytes(),
            retries: tally.retries,
            regions: tally.regions,
            last_frame: tally.last_frame,
            totals: chain.device.totals(),
        })
    }

    /// Whether the device's bindings can hold a sweep; if not, the cpu backend's code computes it.
    fn can_hold(&self, lidar: &Lidar) -> bool {
        SweepKernels::fit(self.binding_bytes, lidar)
    }

    /// Measures the device's peak rates, in about a second.
    ///
    /// # Errors
    /// The device fails, or is lost.
    pub fn roofline(&self) -> Result<Roofline, RenderError> {
        let lost = || RenderError::Device {
            device: "the GPU".to_owned(),
            reason: "it was lost in the previous frame".to_owned(),
        };
        let chain = self.chain.lock();
        Roofline::measure(&chain.as_ref().ok_or_else(lost)?.device)
    }

    /// Renders the rest of a frame after the stages that another backend has run.
    ///
    /// # Errors
    /// As [`Backend::render`]; also if the frame does not fit the device at once.
    pub fn resume(
        &self,
        done: &StageOutputs,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.render_with(frame, targets, finished, |drawn, outputs| {
            self.in_turn(|chain| chain.resume(done, drawn, outputs))
        })
    }

    /// Runs the stages up to and including `last`, from the beginning or after those whose outputs
    /// are `done`, and reads their outputs: for tests that compare stages.
    ///
    /// # Errors
    /// As [`Gpu::resume`].
    pub fn run_through(
        &self,
        frame: &Frame<'_>,
        done: Option<&StageOutputs>,
        last: Stage,
    ) -> Result<StageOutputs, RenderError> {
        frame.check_views()?;
        let sampled = SampledViews::new(frame);
        let frame = &sampled.frame(frame);
        self.in_turn(|chain| chain.run_through(frame, done, last, &self.cull))
    }

    /// Draws a frame with `draw`, which gets it with the views of the samples, and copies its
    /// pixels to the targets.
    fn render_with(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
        draw: impl FnOnce(&Frame<'_>, &Outputs) -> Result<MappedFrame, RenderError>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        frame.check_splats(self.name())?;
        let sampled = SampledViews::new(frame);
        let outputs = Outputs::from_targets(targets, sampled.sampled);
        // Draw on this thread: a thread of a pool that waits may take up another frame of that
        // pool.
        let drawn = draw(&sampled.frame(frame), &outputs)?;

        // Copy the pixels. Other frames can be drawn meanwhile.
        let start = Instant::now();
        let words: Result<Vec<&[u32]>, _> =
            drawn.pages.iter().map(|page| bytemuck::try_cast_slice(page)).collect();
        // Memory that a driver has not aligned is an error of the device, and no panic.
        let words = words.map_err(|error| RenderError::Device {
            device: "the GPU".to_owned(),
            reason: format!("its memory cannot be read: {error}"),
        })?;
        let pixels = Pixels {
            pages: &words,
            tiles_per_page: drawn.tiles_per_page(),
            planes: outputs.planes,
        };
        self.deliver.install(|| {
            let views = drawn.views.par_iter().zip(targets.par_iter_mut()).enumerate();
            // One view per task, so that a finished view is handed on before the others are.
            views.with_max_len(1).for_each(|(index, (view, target))| {
                pixels.copy_to(view, outputs.sampled.contains(index), target);
                target.finish(&frame.views[index]);
                finished(index, target);
            });
        });
        let mut stats = drawn.stats.clone();
        stats.stages_ms.push(("deliver", start.elapsed().as_secs_f64() * 1e3));
        drawn.recycle();
        Ok(stats)
    }
}

impl Backend for Gpu {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn detail(&self) -> String {
        let AdapterInfo { name, driver, driver_info, .. } = &self.info;
        format!("{name}, {driver} {driver_info}")
    }

    fn threads(&self) -> usize {
        self.deliver.current_num_threads()
    }

    fn frames_in_flight(&self) -> usize {
        limits::gpu_frames(self.threads())
    }

    fn has_idle_cores(&self) -> bool {
        true
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
        self.render_with(frame, targets, finished, |drawn, outputs| self.draw(drawn, outputs))
    }

    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        let task = Task::new(scene, profile, view)?;
        if self.can_hold(&view.lidar) {
            self.in_turn(|chain| chain.sweep(&task, &self.cull))
        } else {
            Ok(self.deliver.install(|| cpu::lidar::best_sweep(&task)))
        }
    }

    fn sweep_bytes(&self, lidar: &Lidar) -> u64 {
        if self.can_hold(lidar) {
            SweepKernels::host_bytes(lidar, self.cull.current_num_threads())
        } else {
            cpu::lidar::most_bytes(lidar, self.threads())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::View;
    use wildcity_scene::geometry::camera::Pinhole;
    use wildcity_scene::geometry::{Camera, Pose};
    use wildcity_scene::{RenderProfile, Scene};

    #[test]
    fn a_lost_device_fails_its_frame_and_not_the_next() {
        let mut gpu = Gpu::new(&AdapterChoice::Best, 1)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers");
        let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 8.0, cy: 8.0 };
        let views = [View::new(Camera::from_pinhole(16, 16, pinhole), Pose::IDENTITY)];
        let scene = Scene::default();
        let profile = RenderProfile::default();
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let render = |gpu: &Gpu| {
            let mut image = vec![77; 3 * 256];
            let target = Target { rgb8: Some(&mut image), ..Target::default() };
            gpu.render(&frame, &mut [target], &|_, _| {}).map(|_| image[0])
        };
        let lose = |gpu: &Gpu| {
            gpu.chain.lock().as_ref().unwrap().device.device.destroy();
        };
        assert_eq!(render(&gpu), Ok(0));
        lose(&gpu);
        let lost = render(&gpu);
        assert!(matches!(lost, Err(RenderError::Device { .. })), "{lost:?}");
        assert_eq!(gpu.usage(), None);
        assert_eq!(render(&gpu), Ok(0));
        // It is lost again, and now another device takes its place.
        gpu.info.name = "the previous device".to_owned();
        lose(&gpu);
        assert!(render(&gpu).is_err());
        let error = render(&gpu).unwrap_err().to_string();
        assert!(error.contains("in its place is"), "{error}");
    }
}
