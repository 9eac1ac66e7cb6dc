//! A GPU for tests. Lavapipe counts as one, so every machine can have one and no test skips.

use wildcity::render::gpu::shaders::Shaders;
use wildcity::render::gpu::{AdapterChoice, Gpu};

/// The best device of this machine.
pub(crate) fn gpu() -> Gpu {
    gpu_with(Shaders::default())
}

/// The same with other shaders.
pub(crate) fn gpu_with(shaders: Shaders) -> Gpu {
    Gpu::with_shaders(&AdapterChoice::Best, 0, shaders).unwrap_or_else(|error| {
        panic!(
            "{error}\n(the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers)"
        )
    })
}
