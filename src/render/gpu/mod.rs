//! The wgpu backend: one WGSL file per stage in `shaders/`, twin of the cpu backend.
//!
//! Deterministic: sorts are stable, sums of floats keep one order per pixel, and what threads do in
//! any order commutes. Nothing is read back in mid-frame: a frame that does not fit its buffers is
//! drawn again in larger ones, and one that does not fit the device is drawn part by part.

mod behind;
mod bin;
mod chain;
mod device;
mod growing;
mod kernel;
pub mod layout;
mod lens;
mod mirror;
mod parts;
mod plan;
mod project;
mod rasterize;
mod read_back;
mod resolve;
mod roofline;
mod scan;
pub mod shaders;
mod sort;
mod traffic;
mod turns;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::ThreadPool;
use rayon::prelude::*;
use wgpu::AdapterInfo;

pub use device::{AdapterChoice, DeviceInfo, DeviceTotals, GpuError, devices};
pub use roofline::Roofline;
pub use traffic::FrameCounts;

use self::chain::Chain;
use self::device::Device;
use self::read_back::Drawn;
use self::resolve::{Pixels, Wanted};
use self::shaders::Shaders;
use self::turns::Turns;
use super::stage::{Stage, StageOutputs};
use super::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use crate::limits;

/// The wgpu backend.
#[derive(Debug)]
pub struct Gpu {
    choice: AdapterChoice,
    /// The device and its driver, the same for as long as the backend lives.
    info: AdapterInfo,
    shaders: Shaders,
    limits: MemoryLimits,
    /// Delivers images, and runs what `finished` does with them.
    deliver: ThreadPool,
    /// Culls clusters: threads of its own, so that a frame that is drawn does not wait for one that
    /// is encoded.
    cull: ThreadPool,
    turns: Turns,
    /// Gone after the device failed, and made again by the next frame.
    chain: Mutex<Option<Chain>>,
}

/// How much of a device is used, where that is less than what it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryLimits {
    /// Bytes of resident Gaussians: what was not drawn for longest goes when there would be more.
    pub mirror_bytes: u64,
    /// Bytes that a binding may hold; below `limits::BINDING_BYTES_MIN` it is that. Frames that need
    /// more are drawn part by part.
    pub binding_bytes: u64,
}

impl Default for MemoryLimits {
    /// What the device has.
    fn default() -> Self {
        Self { mirror_bytes: u64::MAX, binding_bytes: u64::MAX }
    }
}

/// What a device holds and has done since it was opened.
#[derive(Clone, Debug, PartialEq)]
pub struct GpuUsage {
    /// The adapter's name.
    pub name: String,
    /// Bytes of resident Gaussians.
    pub mirror_bytes: u64,
    /// Bytes of all buffers, if the driver's memory is counted.
    pub allocated_bytes: Option<u64>,
    /// Attempts at drawing that drew nothing, since buffers were too small.
    pub retries: u64,
    /// Parts that frames were drawn in: one for each that fits.
    pub regions: u64,
    /// What the last frame counted.
    pub last_frame: FrameCounts,
    /// Pipelines, buffers and dispatches so far.
    pub totals: DeviceTotals,
}

impl Gpu {
    /// Opens a device. `threads` copy images out of its memory; 0 for one per core.
    ///
    /// # Errors
    /// There is no such device, or it cannot do what the stages need.
    pub fn new(choice: &AdapterChoice, threads: usize) -> Result<Self, GpuError> {
        Self::open(choice, threads, Shaders::default(), MemoryLimits::default())
    }

    /// The same with other shaders: for tests that break one and see that it is noticed.
    ///
    /// # Errors
    /// As [`Gpu::new`].
    pub fn with_shaders(
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
    ) -> Result<Self, GpuError> {
        Self::open(choice, threads, shaders, MemoryLimits::default())
    }

    /// The same with less of the device than it has.
    ///
    /// # Errors
    /// As [`Gpu::new`].
    pub fn with_limits(
        choice: &AdapterChoice,
        threads: usize,
        limits: MemoryLimits,
    ) -> Result<Self, GpuError> {
        Self::open(choice, threads, Shaders::default(), limits)
    }

    fn open(
        choice: &AdapterChoice,
        threads: usize,
        shaders: Shaders,
        limits: MemoryLimits,
    ) -> Result<Self, GpuError> {
        if threads > limits::RENDER_THREADS {
            let limit = limits::RENDER_THREADS;
            let reason = format!("{threads} are too many; 0 to {limit} are accepted");
            return Err(GpuError::Threads { reason });
        }
        let limits = MemoryLimits {
            binding_bytes: limits.binding_bytes.max(limits::BINDING_BYTES_MIN),
            ..limits
        };
        let device = Device::open(choice, limits.binding_bytes)?;
        let pool = |name: &'static str| {
            let builder = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = builder.thread_name(move |i| format!("{name}-{i}")).build();
            pool.map_err(|error| GpuError::Threads { reason: error.to_string() })
        };
        let (deliver, cull) = (pool("deliver")?, pool("cull")?);
        Ok(Self {
            choice: choice.clone(),
            info: device.info.clone(),
            limits,
            deliver,
            cull,
            turns: Turns::default(),
            chain: Mutex::new(Some(Chain::new(device, &shaders, limits.mirror_bytes)?)),
            shaders,
        })
    }

    /// What the device holds; `None` while it is lost.
    pub fn usage(&self) -> Option<GpuUsage> {
        let chain = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
        chain.as_ref().map(|chain| GpuUsage {
            name: chain.device.info.name.clone(),
            mirror_bytes: chain.mirror.bytes(),
            allocated_bytes: chain.device.allocated_bytes(),
            retries: chain.retries,
            regions: chain.regions,
            last_frame: chain.last_frame,
            totals: chain.device.totals(),
        })
    }

    /// Measures what the device can do at most, in about a second.
    ///
    /// # Errors
    /// The device fails, or is lost.
    pub fn roofline(&self) -> Result<Roofline, RenderError> {
        let chain = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
        let lost = || RenderError::Device {
            device: "the GPU".to_owned(),
            reason: "it was lost by the frame before".to_owned(),
        };
        Roofline::measure(&chain.as_ref().ok_or_else(lost)?.device, &self.shaders)
    }

    /// Renders the rest of a frame after the stages that another backend did.
    ///
    /// # Errors
    /// As [`Backend::render`]; and what is handed over must fit the device at once.
    pub fn resume(
        &self,
        between: &StageOutputs,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.render_with(frame, targets, finished, |chain, wanted| {
            chain.resume(between, frame, wanted)
        })
    }

    /// Runs the stages up to and including `last`, from the beginning or after what is `done`, and
    /// reads what they leave: for tests that compare stages. Normal frames read nothing in mid-frame.
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
        self.in_turn(|chain| chain.run_through(frame, done, last, &self.cull))
    }

    /// Does something on the device, which is opened again if it was lost. The device is free for
    /// the next one when this returns.
    fn in_turn<T>(
        &self,
        work: impl FnOnce(&mut Chain) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let _turn = self.turns.wait();
        let mut slot = self.chain.lock().unwrap_or_else(|poisoned| {
            // Someone panicked in mid-frame: memory may be half-written, so begin anew.
            self.chain.clear_poison();
            let mut slot = poisoned.into_inner();
            discard(slot.take());
            slot
        });
        let chain = match &mut *slot {
            Some(chain) => chain,
            None => {
                let failed =
                    |reason| RenderError::Device { device: self.info.name.clone(), reason };
                let device = Device::open(&self.choice, self.limits.binding_bytes);
                let device = device.map_err(|error| failed(error.to_string()))?;
                // Another one would draw other bytes, and nobody has asked for it.
                if device.info != self.info {
                    let reason = format!("it was lost, and in its place is {}", device.info.name);
                    return Err(failed(reason));
                }
                tracing::info!(device = device.info.name, "the GPU is opened again");
                slot.insert(Chain::new(device, &self.shaders, self.limits.mirror_bytes)?)
            }
        };
        let done = work(chain);
        // Whatever else it was, memory may be half-written: begin anew.
        if let Err(RenderError::Device { .. }) = done {
            discard(slot.take());
        }
        done
    }

    /// Draws a frame, and delivers its pixels.
    fn render_with(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
        draw: impl FnOnce(&mut Chain, &Wanted) -> Result<Drawn, RenderError>,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        frame.check_splats(self.name())?;
        let wanted = Wanted::of(targets);
        let planes = wanted.planes;
        let ms = |since: Instant| since.elapsed().as_secs_f64() * 1e3;
        let asked = Instant::now();
        // Not in a pool: a thread that waits for its own pool may take up another frame there.
        let (drawn, wait_ms) = self.in_turn(|chain| {
            let wait_ms = ms(asked);
            Ok((draw(chain, &wanted)?, wait_ms))
        })?;
        let start = Instant::now();
        let words: Result<Vec<&[u32]>, _> =
            drawn.pages.iter().map(|page| bytemuck::try_cast_slice(page)).collect();
        let words = words.map_err(|error| RenderError::Device {
            device: "the GPU".to_owned(),
            reason: format!("its memory cannot be read: {error}"),
        })?;
        let pixels = Pixels { pages: &words, tiles_per_page: drawn.tiles_per_page(), planes };
        self.deliver.install(|| {
            let views = drawn.views.par_iter().zip(targets.par_iter_mut()).enumerate();
            views.with_max_len(1).for_each(|(index, (view, target))| {
                pixels.deliver(view, target);
                target.finish(&frame.views[index]);
                finished(index, target);
            });
        });
        let mut stats = drawn.stats.clone();
        stats.stages_ms.insert(0, ("wait", wait_ms));
        stats.stages_ms.push(("deliver", ms(start)));
        drawn.recycle();
        Ok(stats)
    }
}

/// Lets go of a device that failed, without waiting for it: a driver that hangs would hold up everyone.
fn discard(chain: Option<Chain>) {
    if chain.is_some() {
        std::thread::spawn(move || drop(chain));
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
        limits::GPU_FRAMES
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.render_with(frame, targets, finished, |chain, wanted| {
            chain.draw(frame, wanted, &self.cull)
        })
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
        let (scene, profile) = (Scene::default(), RenderProfile::default());
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let render = |gpu: &Gpu| {
            let mut image = vec![77; 3 * 256];
            let target = Target { rgb8: Some(&mut image), ..Target::default() };
            gpu.render(&frame, &mut [target], &|_, _| {}).map(|_| image[0])
        };
        let lose = |gpu: &Gpu| {
            gpu.chain.lock().unwrap().as_ref().unwrap().device.device.destroy();
        };
        assert_eq!(render(&gpu), Ok(0));
        lose(&gpu);
        let lost = render(&gpu);
        assert!(matches!(lost, Err(RenderError::Device { .. })), "{lost:?}");
        assert_eq!(gpu.usage(), None);
        assert_eq!(render(&gpu), Ok(0));
        // Lost again, and now another device is in its place.
        gpu.info.name = "the card that was there before".to_owned();
        lose(&gpu);
        assert!(render(&gpu).is_err());
        let error = render(&gpu).unwrap_err().to_string();
        assert!(error.contains("in its place is"), "{error}");
    }
}
