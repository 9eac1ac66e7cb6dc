//! What the device decides for itself in mid-frame: how much the next stages have to do.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, module};
use super::layout::{Counters, Frame, Job, JobSlot, SCAN_BLOCK};
use super::shaders::Shaders;

/// Slots of the jobs, as `plan.wgsl` names them.
pub(super) mod job {
    pub(crate) const ITEMS: u64 = 0;
    pub(crate) const SPLATS: u64 = 1;
    pub(crate) const SPLATS_SCAN: u64 = 2;
    pub(crate) const SPLATS_SORT: u64 = 3;
    pub(crate) const SPLATS_DIGITS: u64 = 4;
    pub(crate) const TOUCHES: u64 = 5;
    pub(crate) const TOUCHES_SORT: u64 = 6;
    pub(crate) const TOUCHES_DIGITS: u64 = 7;
    pub(crate) const TILES: u64 = 8;
    pub(crate) const INSTANCES: u64 = 9;
    pub(crate) const COUNT: usize = 10;
}

/// What a frame is, what it counts, and what is to do.
#[derive(Debug)]
pub(super) struct Plan {
    splats: Kernel,
    touches: Kernel,
    instances: Kernel,
    frame: Growing,
    jobs: Growing,
    counters: Growing,
}

impl Plan {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let module = module(device, shaders, "plan");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let mut plan = Self {
            splats: kernel("splats"),
            touches: kernel("touches"),
            instances: kernel("instances"),
            frame: Growing::new(device, "frame", BufferUsages::UNIFORM | BufferUsages::COPY_DST),
            jobs: Growing::new(device, "jobs", storage | BufferUsages::INDIRECT),
            counters: Growing::new(device, "counters", storage | BufferUsages::COPY_SRC),
        };
        plan.frame.reserve(device, size_of::<Frame>() as u64);
        plan.jobs.reserve(device, (job::COUNT * size_of::<JobSlot>()) as u64);
        plan
    }

    /// Starts a frame of this many items.
    pub(super) fn start(&self, device: &Device, frame: &Frame, items: u32) {
        let mut jobs: [JobSlot; job::COUNT] = bytemuck::Zeroable::zeroed();
        for (slot, length) in [(job::ITEMS, items), (job::TILES, frame.tiles)] {
            // At most 2^24 tiles, and 2^27 items of 8 B: one dimension holds their groups.
            let groups = [length.div_ceil(SCAN_BLOCK), 1, 1];
            jobs[slot as usize].job = Job { length, groups };
        }
        let counters: Counters = bytemuck::Zeroable::zeroed();
        let write = |to: &Growing, bytes| device.queue.write_buffer(to.buffer(), 0, bytes);
        write(&self.frame, bytemuck::bytes_of(frame));
        write(&self.jobs, bytemuck::bytes_of(&jobs));
        write(&self.counters, bytemuck::bytes_of(&counters));
    }

    pub(super) fn frame(&self) -> &Buffer {
        self.frame.buffer()
    }

    pub(super) fn jobs(&self) -> &Buffer {
        self.jobs.buffer()
    }

    pub(super) fn counters(&self) -> &Buffer {
        self.counters.buffer()
    }

    /// After the items' visible splats were summed up.
    pub(super) fn splats(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.splats, device, pass, sums);
    }

    /// After the splats' macro tiles were summed up.
    pub(super) fn touches(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.touches, device, pass, sums);
    }

    /// After the tiles' splats were summed up.
    pub(super) fn instances(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.instances, device, pass, sums);
    }

    fn run(&self, kernel: &Kernel, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        let buffers = [self.frame(), self.jobs(), sums, self.counters()];
        let all = [0, 1, 2, 3].map(|k| (k, buffers[k as usize].as_entire_binding()));
        kernel.run(device, pass, Groups::Count(1), &all);
    }
}
