//! What a device can do at most, measured: copying memory, and multiplying and adding. WGSL:
//! `shaders/roofline.wgsl`.

use std::time::Instant;

use wgpu::{BindingResource, BufferUsages, MapMode, PollType, QuerySet};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, Recorder, TICKS_BYTES, clock, module};
use super::layout::{Span, WORKGROUP};
use super::shaders::Shaders;
use crate::RenderError;

/// Bytes that are copied: five times the cache of a large card, if a binding holds as many.
const COPY_BYTES: u64 = 256 << 20;
/// Workgroups that multiply: 62 for each of the 132 multiprocessors of a large card, which holds 8 of 256
/// threads at a time.
const GROUPS: u32 = 1 << 13;
/// Multiply-adds of a round of a thread.
const ROUND: u64 = 64;
/// A run of at least as many seconds is long enough to be timed.
const LONG_S: f64 = 5e-3;
/// The best of as many runs counts.
const RUNS: usize = 5;

/// What a device can do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roofline {
    /// Bytes read and written per second by a copy that no cache holds.
    pub bytes_per_s: f64,
    /// f32 multiply-adds per second.
    pub multiply_adds_per_s: f64,
}

impl Roofline {
    /// Measures a device, in about a second.
    ///
    /// # Errors
    /// The device fails.
    pub(super) fn measure(device: &Device, shaders: &Shaders) -> Result<Self, RenderError> {
        let module = module(device, shaders, "roofline");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        let bytes = COPY_BYTES.min(device.binding_bytes());
        let storage = BufferUsages::STORAGE;
        let [source, copied] =
            ["copy source", "copy"].map(|label| device.buffer(label, bytes, storage));
        let buffers = [(0, source.as_entire_binding()), (1, copied.as_entire_binding())];
        let stopwatch = Stopwatch::new(device);

        let groups = Groups::Count(((bytes / 16) as u32).div_ceil(WORKGROUP));
        let copy_s = stopwatch.best(device, &kernel("copy"), groups, &buffers)?;

        let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let mut rounds = Growing::new(device, "rounds", usage);
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
        Ok(Self { bytes_per_s: 2.0 * bytes as f64 / copy_s, multiply_adds_per_s })
    }
}

/// Times kernels by the device's own clock, or by the host's where it has none.
struct Stopwatch {
    clock: Option<QuerySet>,
    ticks: Growing,
    read_back: Growing,
}

impl Stopwatch {
    fn new(device: &Device) -> Self {
        let resolved = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        let mapped = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let mut ticks = Growing::new(device, "ticks", resolved);
        let mut read_back = Growing::new(device, "ticks read back", mapped);
        ticks.reserve(device, TICKS_BYTES);
        read_back.reserve(device, TICKS_BYTES);
        Self { clock: clock(device), ticks, read_back }
    }

    /// Seconds of the fastest of several runs.
    fn best(
        &self,
        device: &Device,
        kernel: &Kernel,
        groups: Groups<'_>,
        resources: &[(u32, BindingResource<'_>)],
    ) -> Result<f64, RenderError> {
        let mut best_s = f64::INFINITY;
        for _ in 0..RUNS {
            let mut recorder = Recorder::new(device, self.clock.clone());
            kernel.run(device, &mut recorder.stage("roofline"), groups, resources);
            recorder.finish_stages(self.ticks.buffer());
            let (ticks, read_back) = (self.ticks.buffer(), self.read_back.buffer());
            recorder.encoder.copy_buffer_to_buffer(ticks, 0, read_back, 0, TICKS_BYTES);
            let start = Instant::now();
            device.queue.submit([recorder.encoder.finish()]);
            // Whether it worked is told by `get_mapped_range`.
            read_back.slice(..).map_async(MapMode::Read, |_| {});
            let polled = device.device.poll(PollType::wait_indefinitely());
            let host_s = start.elapsed().as_secs_f64();
            device.check()?;
            polled.map_err(|error| device.failed(error.to_string()))?;
            let view = read_back.slice(..).get_mapped_range();
            let view = view.map_err(|error| device.failed(error.to_string()))?;
            let [first, last] = [0, 8].map(|at| bytemuck::pod_read_unaligned(&view[at..at + 8]));
            let ticks = u64::saturating_sub(last, first) as f64;
            drop(view);
            read_back.unmap();
            let device_s = device.tick_ns().map(|tick_ns| ticks * f64::from(tick_ns) * 1e-9);
            best_s = best_s.min(device_s.filter(|&s| s > 0.0).unwrap_or(host_s));
        }
        Ok(best_s)
    }
}
