//! A GPU for tests. Lavapipe counts as one, so every machine can have one and no test skips.

use wildcity::render::gpu::shaders::Shaders;
use wildcity::render::gpu::{AdapterChoice, Gpu, GpuError};

/// The best device of this machine.
pub(crate) fn gpu() -> Gpu {
    gpu_with(Shaders::default())
}

/// The same with other shaders.
pub(crate) fn gpu_with(shaders: Shaders) -> Gpu {
    opened(Gpu::with_shaders(&AdapterChoice::Best, 0, shaders))
}

/// The same with smaller bindings.
pub(crate) fn gpu_with_binding_limit(binding_bytes: u64) -> Gpu {
    opened(Gpu::with_binding_limit(&AdapterChoice::Best, 0, binding_bytes))
}

fn opened(gpu: Result<Gpu, GpuError>) -> Gpu {
    gpu.unwrap_or_else(|error| {
        panic!(
            "{error}\n(the GPU's tests need a Vulkan driver: apt-get install mesa-vulkan-drivers)"
        )
    })
}
