//! The prefix sum that project, sort and bin share.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, module, slot};
use super::layout::{Job, SCAN_BLOCK};
use super::shaders::Shaders;

/// The three kernels, and the sums between them.
#[derive(Debug)]
pub(super) struct Scan {
    reduce: Kernel,
    sums: Kernel,
    apply: Kernel,
    block_sums: Growing,
}

impl Scan {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let module = module(device, shaders, "scan");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        Self {
            reduce: kernel("reduce"),
            sums: kernel("sums"),
            apply: kernel("apply"),
            block_sums: Growing::new(device, "block sums", BufferUsages::STORAGE),
        }
    }

    /// Makes room for sums over `length` elements.
    pub(super) fn reserve(&mut self, device: &Device, length: u64) {
        let blocks = length.div_ceil(u64::from(SCAN_BLOCK)) + 1;
        self.block_sums.reserve(device, 4 * blocks);
    }

    /// The sums of blocks after a run, the total behind them.
    pub(super) fn block_sums(&self) -> &Buffer {
        self.block_sums.buffer()
    }

    /// Replaces the values of a job by what precedes each.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (jobs, job): (&Buffer, u64),
        values: &Buffer,
    ) {
        let groups = Groups::Job(jobs, job);
        let job = slot(jobs, job, size_of::<Job>());
        let sums = self.block_sums.bind();
        let all = [(0, job), (1, values.as_entire_binding()), (2, sums)];
        self.reduce.run(device, pass, groups, &all);
        self.sums.run(device, pass, Groups::Count(1), &[all[0].clone(), all[2].clone()]);
        self.apply.run(device, pass, groups, &all);
    }
}
