//! Largest sizes, counts and times.

use std::time::Duration;

/// Bytes of a manifest.
pub const MAX_MANIFEST_BYTES: u64 = 1 << 20;
/// Bytes of all files of a model: three times a Difix in f32.
pub const MAX_MODEL_BYTES: u64 = 12 << 30;
/// Files of a model.
pub const MAX_FILES: usize = 16;
/// Inputs of a model.
pub const MAX_INPUTS: usize = 16;
/// Width or height of an image, in pixels.
pub const MAX_SIDE_PX: usize = 16_384;
/// Largest `size.multiple_of` of a manifest, in pixels.
pub const MAX_MULTIPLE_PX: u32 = 256;
/// Largest `outputs[0].scale` of a manifest.
pub const MAX_SCALE: u32 = 4;
/// Values of a constant input: a prompt of 77 x 1024 and some room.
pub const MAX_CONSTANT_VALUES: usize = 1 << 20;
/// Largest `timeout_ms` of a manifest: ten minutes.
pub const MAX_TIMEOUT_MS: u64 = 600_000;
/// Threads of the cpu provider.
pub const MAX_THREADS: usize = 64;
/// Time to build a session. TensorRT compiles for minutes.
pub const LOAD_TIMEOUT: Duration = Duration::from_secs(1200);
/// Time between the request to stop a run and its end. The runtime looks at the request between two
/// nodes of the graph.
pub const STOP_TIMEOUT: Duration = Duration::from_secs(10);
/// Runs that may exceed `timeout_ms` before a model is withdrawn.
pub const MAX_TIMEOUTS: u32 = 10;
/// Side of the largest image that the halo is searched in, in pixels.
pub const MAX_HALO_PROBE_PX: usize = 512;
