//! Roofline of a device: its peak rates of copying memory and of multiply-adds, measured. WGSL:
//! `shaders/roofline.wgsl`.

use std::time::Instant;

use wgpu::{BindingResource, BufferUsages, MapMode, PollType, QuerySet};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, Kernel, Recorder, TIMESTAMP_BYTES, module, timestamps};
use super::layout::{Span, WORKGROUP};
use crate::RenderError;

/// Bytes that are copied, or fewer if a binding holds less: five times the cache of a large
/// graphics card.
const COPY_BYTES: u64 = 256 << 20;
/// Workgroups of the multiply-add kernel: 62 for each of the 132 multiprocessors of a large
/// graphics card, each of which holds 8 workgroups of 256 threads at a time.
const GROUPS: u32 = 1 << 13;
/// Multiply-adds of a thread per round.
const ROUND: u64 = 64;
/// Shortest run, in seconds, that is timed accurately enough.
const LONG_S: f64 = 5e-3;
/// Number of runs, of which the fastest counts.
const RUNS: usize = 5;

/// Peak rates of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roofline {
    /// Bytes read plus bytes written per second, by a copy that does not fit the cache.
    pub bytes_per_s: f64,
    /// f32 multiply-adds per second.
    pub multiply_adds_per_s: f64,
}

impl Roofline {
    /// Measures a device, in about a second.
    ///
    /// # Errors
    /// The device fails.
    pub(super) fn measure(device: &Device) -> Result<Self, RenderError> {
        let module = module(device, "roofline");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        let bytes = COPY_BYTES.min(device.binding_bytes());
        let storage = BufferUsages::STORAGE;
        let [source, copied] =
            ["copy source", "copy"].map(|label| device.buffer(label, bytes, storage));
        let buffers = [(0, source.as_entire_binding()), (1, copied.as_entire_binding())];
        let stopwatch = Stopwatch::new(device);

        let groups = Groups::Count(((bytes / 16) as u32).div_ceil(WORKGROUP));
        let copy_s = stopwatch.best(device, &kernel("copy"), groups, &buffers)?;

        // More rounds until a run is long enough.
        let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let mut rounds = GrowableBuffer::new(device, "rounds", usage);
        let multiply_add = kernel("multiply_add");
        let mut count = 1;
        let multiply_adds_per_s = loop {
            rounds.fill(device, bytemuck::bytes_of(&Span { first: 0, count }));
            let all = [buffers[1].clone(), (2, rounds.bind())];
            let groups = Groups::Count(GROUPS);
            let seconds = stopwatch.best(device, &multiply_add, groups, &all)?;
            if seconds >= LONG_S || count >= 1 << 20 {
                let threads = u64::from(GROUPS * WORKGROUP);
                break (threads * ROUND * u64::from(count)) as f64 / seconds;
            }
            count *= 4;
        };
        // Each byte is read once and written once.
        Ok(Self { bytes_per_s: 2.0 * bytes as f64 / copy_s, multiply_adds_per_s })
    }
}

/// Times kernels by the device's clock, or by the host's if the device has none.
struct Stopwatch {
    queries: Option<QuerySet>,
    timestamps: GrowableBuffer,
    read_back: GrowableBuffer,
}

impl Stopwatch {
    fn new(device: &Device) -> Self {
        let resolved = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        let mapped = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let mut timestamps_buffer = GrowableBuffer::new(device, "timestamps", resolved);
        let mut read_back = GrowableBuffer::new(device, "timestamps read back", mapped);
        timestamps_buffer.reserve(device, TIMESTAMP_BYTES);
        read_back.reserve(device, TIMESTAMP_BYTES);
        Self { queries: timestamps(device), timestamps: timestamps_buffer, read_back }
    }

    /// Seconds of the fastest of [`RUNS`] runs.
    fn best(
        &self,
        device: &Device,
        kernel: &Kernel,
        groups: Groups<'_>,
        resources: &[(u32, BindingResource<'_>)],
    ) -> Result<f64, RenderError> {
        let mut best_s = f64::INFINITY;
        for _ in 0..RUNS {
            let mut recorder = Recorder::new(device, self.queries.clone());
            kernel.run(device, &mut recorder.stage("roofline"), groups, resources);
            let timestamps = self.timestamps.buffer();
            let read_back = self.read_back.buffer();
            recorder.finish_stages(timestamps);
            recorder.encoder.copy_buffer_to_buffer(timestamps, 0, read_back, 0, TIMESTAMP_BYTES);
            let start = Instant::now();
            device.queue.submit([recorder.encoder.finish()]);
            // `get_mapped_range` reports whether mapping succeeded.
            read_back.slice(..).map_async(MapMode::Read, |_| {});
            let polled = device.device.poll(PollType::wait_indefinitely());
            let host_s = start.elapsed().as_secs_f64();
            device.check()?;
            polled.map_err(|error| device.failed(error.to_string()))?;
            let mapped = read_back.slice(..).get_mapped_range();
            let view = mapped.map_err(|error| device.failed(error.to_string()))?;
            let [first, last] = [0, 8].map(|at| bytemuck::pod_read_unaligned(&view[at..at + 8]));
            let ticks = u64::saturating_sub(last, first) as f64;
            // A buffer cannot be unmapped while a view of it exists.
            drop(view);
            read_back.unmap();
            let device_s = device.tick_ns().map(|tick_ns| ticks * f64::from(tick_ns) * 1e-9);
            // A run within one tick of the device's clock is timed by the host.
            best_s = best_s.min(device_s.filter(|&s| s > 0.0).unwrap_or(host_s));
        }
        Ok(best_s)
    }
}
