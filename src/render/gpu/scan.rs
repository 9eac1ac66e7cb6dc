//! The prefix sum that the stages project, sort, and bin share. WGSL: `shaders/scan.wgsl`.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, JobRef, Kernel, module};
use super::layout::SCAN_BLOCK;

/// The three kernels, and the block sums that they exchange.
#[derive(Debug)]
pub(super) struct Scan {
    reduce: Kernel,
    sums: Kernel,
    apply: Kernel,
    block_sums: GrowableBuffer,
}

impl Scan {
    pub(super) fn new(device: &Device) -> Self {
        let module = module(device, "scan");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        Self {
            reduce: kernel("reduce"),
            sums: kernel("sums"),
            apply: kernel("apply"),
            block_sums: GrowableBuffer::new(device, "block sums", BufferUsages::STORAGE),
        }
    }

    /// Makes room for sums over `length` elements.
    pub(super) fn reserve(&mut self, device: &Device, length: u64) {
        // One more for the total.
        let blocks = length.div_ceil(u64::from(SCAN_BLOCK)) + 1;
        self.block_sums.reserve(device, 4 * blocks);
    }

    /// After a run: the exclusive prefix sums of the blocks, then the total.
    pub(super) fn block_sums(&self) -> &Buffer {
        self.block_sums.buffer()
    }

    /// Replaces the first `job.length` values by their exclusive prefix sums.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        job: JobRef<'_>,
        values: &Buffer,
    ) {
        let groups = Groups::Job(job);
        let length = (0, job.bind());
        let sums = (2, self.block_sums.bind());
        let all = [length.clone(), (1, values.as_entire_binding()), sums.clone()];
        self.reduce.run(device, pass, groups, &all);
        self.sums.run(device, pass, Groups::Count(1), &[length, sums]);
        self.apply.run(device, pass, groups, &all);
    }
}
