//! Tests of the gpu backend against the other backends, on any Vulkan device; lavapipe is enough.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/gpu.rs"]
mod gpu;
#[path = "../support/gradient_cases.rs"]
mod gradient_cases;
#[path = "../support/images.rs"]
mod images;
#[allow(dead_code, reason = "the tests of the other backends use another part of it")]
#[path = "../support/lenses.rs"]
mod lenses;
#[path = "../support/lidars.rs"]
mod lidars;
#[path = "../support/actors.rs"]
mod placed;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/scene_files.rs"]
mod scene_files;
#[path = "../support/skies.rs"]
mod skies;
#[path = "../support/streets.rs"]
mod streets;
#[path = "../support/truths.rs"]
mod truths;
#[path = "../support/vectors.rs"]
mod vectors;

mod actors;
mod automatic;
mod cameras;
mod definition;
mod determinism;
mod encoding;
mod frames_in_flight;
mod gradients;
mod lidar;
mod memory_growth;
mod mirror;
mod mutations;
mod parity;
mod regions;
mod samples;
mod sky;
mod stages;
mod tuning;
mod twins;

use std::sync::{Arc, Mutex, PoisonError, Weak};

use wildcity_render::compare::gaussians;

/// The best device with the shaders as they are and without limits. Tests that run at the same time
/// share it: software Vulkan takes seconds to compile the kernels of a lens, and two tests that
/// start together would each compile them.
fn shared_gpu() -> Arc<gpu::Watched> {
    static SHARED: Mutex<Weak<gpu::Watched>> = Mutex::new(Weak::new());
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    shared.upgrade().unwrap_or_else(|| {
        let opened = Arc::new(gpu::gpu());
        *shared = Arc::downgrade(&opened);
        opened
    })
}
