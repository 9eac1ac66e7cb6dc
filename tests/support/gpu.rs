//! A GPU for tests. Lavapipe, a software device, counts as one, so that every machine can run the
//! tests and none is skipped.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::ops::Deref;
use std::process::Output;
use std::sync::{Mutex, Once, PoisonError};

use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{AdapterChoice, Gpu, GpuError, MemoryLimits, Tuning};
use wildcity_render::gradient::Differentiate;
use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_render::{Backend, Frame, FrameStats, OnViewDone, RenderError, Target};
use wildcity_scene::{RenderProfile, Scene};

/// The best device of this machine.
pub(crate) fn gpu() -> Watched {
    gpu_with(Shaders::default())
}

/// A device of choice, with this number of threads.
pub(crate) fn gpu_on(choice: &AdapterChoice, threads: usize) -> Watched {
    watched(|| Gpu::new(choice, threads))
}

/// The best device with other shaders.
pub(crate) fn gpu_with(shaders: Shaders) -> Watched {
    watched(|| Gpu::with_shaders(&AdapterChoice::Best, 0, shaders))
}

/// The best device with other shaders, and a choice of kernels.
pub(crate) fn gpu_with_tuning(shaders: Shaders, tuning: Tuning) -> Watched {
    watched(|| Gpu::with_tuning(&AdapterChoice::Best, 0, shaders, tuning))
}

/// Limits that allow bindings of this many bytes.
pub(crate) fn bindings(binding_bytes: u64) -> MemoryLimits {
    MemoryLimits { binding_bytes, ..MemoryLimits::default() }
}

/// The best device with limits on its memory.
pub(crate) fn gpu_with_limits(limits: MemoryLimits) -> Watched {
    watched(|| Gpu::with_limits(&AdapterChoice::Best, 0, limits))
}

fn watched(open: impl FnOnce() -> Result<Gpu, GpuError>) -> Watched {
    static LISTEN: Once = Once::new();
    LISTEN.call_once(|| {
        log::set_logger(&Listener).unwrap();
        log::set_max_level(log::LevelFilter::Warn);
    });
    Watched(Some(open().unwrap_or_else(|error| {
        panic!(
            "{error}\n(the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers)"
        )
    })))
}

/// A backend that fails its test if wgpu or its validation logs a warning or an error. With
/// `WGPU_VALIDATION=1` that includes Vulkan's validation layer, if it is installed. The GPU is
/// dropped before the log is checked, so that messages about objects that outlive their device
/// count, too.
#[derive(Debug)]
pub(crate) struct Watched(Option<Gpu>);

impl Deref for Watched {
    type Target = Gpu;

    fn deref(&self) -> &Gpu {
        self.0.as_ref().expect("dropped with its watch")
    }
}

impl Backend for Watched {
    fn name(&self) -> &'static str {
        self.deref().name()
    }

    fn detail(&self) -> String {
        self.deref().detail()
    }

    fn threads(&self) -> usize {
        self.deref().threads()
    }

    fn frames_in_flight(&self) -> usize {
        self.deref().frames_in_flight()
    }

    fn as_differentiate(&self) -> Option<&dyn Differentiate> {
        self.deref().as_differentiate()
    }

    fn render(
        &self,
        frame: &Frame<'_>,
        targets: &mut [Target<'_>],
        finished: OnViewDone<'_>,
    ) -> Result<FrameStats, RenderError> {
        self.deref().render(frame, targets, finished)
    }

    fn sweep(
        &self,
        scene: &Scene,
        profile: &RenderProfile,
        view: &LidarView,
    ) -> Result<Sweep, RenderError> {
        self.deref().sweep(scene, profile, view)
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        drop(self.0.take());
        let said = SAID.lock().unwrap_or_else(PoisonError::into_inner);
        if !std::thread::panicking() {
            assert!(said.is_empty(), "in this test or one beside it:\n{}", said.join("\n"));
        }
    }
}

/// Asserts that another process succeeded and printed neither a warning nor an error.
pub(crate) fn assert_quiet(output: &Output) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let is_bad = |line: &&str| {
        let line = line.to_lowercase();
        ["warn", "error", "validation", "vuid"].iter().any(|word| line.contains(word))
    };
    assert_eq!(said.lines().find(is_bad), None, "{said}");
}

/// Warnings and errors of the tests of this process.
static SAID: Mutex<Vec<String>> = Mutex::new(Vec::new());

struct Listener;

impl log::Log for Listener {
    fn enabled(&self, metadata: &log::Metadata<'_>) -> bool {
        metadata.level() <= log::Level::Warn
    }

    fn log(&self, record: &log::Record<'_>) {
        if self.enabled(record.metadata()) {
            let line = format!("{} {}: {}", record.level(), record.target(), record.args());
            SAID.lock().unwrap_or_else(PoisonError::into_inner).push(line);
        }
    }

    fn flush(&self) {}
}
