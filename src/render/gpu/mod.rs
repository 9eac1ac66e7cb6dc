//! The wgpu backend: one WGSL file per stage in `shaders/`, twin of the cpu backend.
//!
//! Deterministic: sorts are stable, sums of floats keep one order per pixel, and what threads do in
//! any order commutes. Nothing is read back in mid-frame: a frame that does not fit its buffers is
//! drawn again in larger ones.

mod bin;
mod chain;
mod device;
mod growing;
mod kernel;
pub mod layout;
mod mirror;
mod plan;
mod project;
mod rasterize;
mod resolve;
mod roofline;
mod scan;
pub mod shaders;
mod sort;
mod traffic;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::ThreadPool;
use rayon::prelude::*;
use wgpu::AdapterInfo;

pub use device::{AdapterChoice, DeviceInfo, GpuError, devices};
pub use roofline::Roofline;
pub use traffic::FrameWork;

use self::chain::{Chain, Drawn};
use self::device::Device;
use self::resolve::{Pixels, Planes};
use self::shaders::Shaders;
use super::stage::{Between, Stage};
use super::{Backend, Finished, Frame, FrameStats, RenderError, Target};

/// The wgpu backend.
#[derive(Debug)]
pub struct Gpu {
    choice: AdapterChoice,
    /// The device and its driver.
    detail: String,
    shaders: Shaders,
    pool: ThreadPool,
    /// Gone after the device failed, and made again by the next frame.
    chain: Mutex<Option<Chain>>,
}

/// What a device holds and has done since it was opened.
#[derive(Clone, Debug, PartialEq)]
pub struct GpuUse {
    /// The adapter's name.
    pub name: String,
    /// Bytes of resident Gaussians.
    pub mirror_bytes: u64,
    /// Frames that were drawn again, since their buffers were too small.
    pub retries: u64,
    /// What the last frame counted.
    pub last: FrameWork,
}

impl Gpu {
    /// Opens a device. `threads` copy images out of its memory; 0 for one per core.
    ///
    /// # Errors
    /// There is no such device, or it cannot do what the stages need.
    pub fn new(choice: &AdapterChoice, threads: usize) -> Result<Self, GpuError> {
        Self::with_shaders(choice, threads, Shaders::default())
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
        let name = |i| format!("gpu-{i}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build();
        let pool = pool.map_err(|error| GpuError::Threads { reason: error.to_string() })?;
        let device = Device::open(choice)?;
        let AdapterInfo { name, driver, driver_info, .. } = &device.info;
        let detail = format!("{name}, {driver} {driver_info}");
        let chain = Mutex::new(Some(Chain::new(device, &shaders)?));
        Ok(Self { choice: choice.clone(), detail, shaders, pool, chain })
    }

    /// What the device holds; `None` while it is lost.
    pub fn usage(&self) -> Option<GpuUse> {
        let chain = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
        chain.as_ref().map(|chain| GpuUse {
            name: chain.device.info.name.clone(),
            mirror_bytes: chain.mirror.bytes(),
            retries: chain.retries,
            last: chain.last,
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
    /// As [`Backend::render`].
    pub fn go_on(
        &self,
        between: &Between,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.render_with(frame, targets, finished, |chain, planes| {
            chain.go_on(between, frame, planes)
        })
    }

    /// Runs the stages up to and including `last`, from the beginning or after what is `done`, and
    /// reads what they leave: for tests that compare stages. Normal frames read nothing in mid-frame.
    ///
    /// # Errors
    /// As [`Backend::render`].
    pub fn through(
        &self,
        frame: &Frame<'_>,
        done: Option<&Between>,
        last: Stage,
    ) -> Result<Between, RenderError> {
        frame.check_views()?;
        self.pool.install(|| self.on_device(|chain| chain.through(frame, done, last)))
    }

    /// Does something on the device, which is opened again if it was lost.
    fn on_device<T>(
        &self,
        work: impl FnOnce(&mut Chain) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let mut slot = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
        let chain = match &mut *slot {
            Some(chain) => chain,
            None => {
                let device = Device::open(&self.choice).map_err(|error| RenderError::Device {
                    device: "the GPU".to_owned(),
                    reason: error.to_string(),
                })?;
                tracing::info!(device = device.info.name, "the GPU is opened again");
                slot.insert(Chain::new(device, &self.shaders)?)
            }
        };
        let done = work(chain);
        // Whatever else it was, memory may be half-written: begin anew.
        if let Err(RenderError::Device { .. }) = done {
            *slot = None;
        }
        done
    }

    /// Draws a frame, and delivers its pixels.
    fn render_with(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
        draw: impl FnOnce(&mut Chain, Planes) -> Result<Drawn, RenderError> + Send,
    ) -> Result<FrameStats, RenderError> {
        frame.check(targets)?;
        let planes = Planes::of(targets);
        self.pool.install(|| {
            let drawn = self.on_device(|chain| draw(chain, planes))?;
            // From here on the device is free for another session's step.
            let start = Instant::now();
            let words: Result<Vec<&[u32]>, _> =
                drawn.pages.iter().map(|page| bytemuck::try_cast_slice(page)).collect();
            let words = words.map_err(|error| RenderError::Device {
                device: "the GPU".to_owned(),
                reason: format!("its memory cannot be read: {error}"),
            })?;
            let pixels = Pixels { pages: &words, tiles_per_page: drawn.tiles_per_page, planes };
            let views = drawn.views.par_iter().zip(targets.par_iter_mut()).enumerate();
            views.with_max_len(1).for_each(|(index, (view, target))| {
                pixels.deliver(view, target);
                finished(index, target);
            });
            let mut stats = drawn.stats.clone();
            stats.stages_ms.push(("deliver", start.elapsed().as_secs_f64() * 1e3));
            let mut chain = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(chain) = &mut *chain {
                chain.recycle(drawn);
            }
            Ok(stats)
        })
    }
}

impl Backend for Gpu {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn detail(&self) -> String {
        self.detail.clone()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: Finished<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.render_with(frame, targets, finished, |chain, planes| chain.draw(frame, planes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::Pinhole;
    use crate::geometry::{Camera, Pose};
    use crate::render::View;
    use crate::scene::{RenderProfile, Scene};

    #[test]
    fn a_lost_device_fails_its_frame_and_not_the_next() {
        let gpu = Gpu::new(&AdapterChoice::Best, 1)
            .expect("the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers");
        let pinhole = Pinhole { fx: 10.0, fy: 10.0, cx: 8.0, cy: 8.0 };
        let camera = Camera { width_px: 16, height_px: 16, pinhole };
        let views = [View { camera, world_from_camera: Pose::IDENTITY }];
        let (scene, profile) = (Scene::default(), RenderProfile::default());
        let frame = Frame { scene: &scene, profile: &profile, views: &views };
        let mut image = vec![77; 3 * 256];
        let mut render = || {
            let target = Target { rgb8: Some(&mut image), ..Target::default() };
            gpu.render(&frame, &mut [target], &|_, _| {}).map(|_| image[0])
        };
        assert_eq!(render(), Ok(0));
        gpu.chain.lock().unwrap().as_ref().unwrap().device.device.destroy();
        let lost = render();
        assert!(matches!(lost, Err(RenderError::Device { .. })), "{lost:?}");
        assert_eq!(gpu.usage(), None);
        assert_eq!(render(), Ok(0));
    }
}
