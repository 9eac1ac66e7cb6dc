//! What the device decides for itself in mid-frame: how much the next stages have to do.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, module};
use super::layout::{
    Counters, DIGITS, Frame, Job, JobSlot, MAX_GROUPS, SCAN_BLOCK, SORT_BLOCK, WORKGROUP,
};
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

/// What there is before the first stage of a frame runs; what the device finds for itself is zero.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    /// Clusters in views.
    pub(super) items: u32,
    /// Splats that another backend projected.
    pub(super) splats: u32,
    /// Instances that another backend binned.
    pub(super) instances: u32,
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

    /// Starts a frame.
    pub(super) fn start(&self, device: &Device, frame: &Frame, counts: &Counts) {
        let Counts { items, splats, instances } = *counts;
        let mut jobs: [JobSlot; job::COUNT] = bytemuck::Zeroable::zeroed();
        for (slot, length, per_group) in [
            (job::ITEMS, items, SCAN_BLOCK),
            (job::SPLATS, splats, WORKGROUP),
            (job::SPLATS_SCAN, splats, SCAN_BLOCK),
            (job::SPLATS_SORT, splats, SORT_BLOCK),
            (job::SPLATS_DIGITS, DIGITS * splats.div_ceil(SORT_BLOCK), SCAN_BLOCK),
            (job::TILES, frame.tiles, SCAN_BLOCK),
        ] {
            jobs[slot as usize].job = job(length, per_group);
        }
        let counters = Counters { splats, instances, ..bytemuck::Zeroable::zeroed() };
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

/// As `plan.wgsl` folds groups into two dimensions.
fn job(length: u32, per_group: u32) -> Job {
    let groups = length.div_ceil(per_group);
    let rows = groups.div_ceil(MAX_GROUPS).max(1);
    Job { length, groups: [groups.div_ceil(rows), rows, 1] }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use naga::{Expression, Literal};

    use super::job;

    #[test]
    fn slots_are_the_shaders() {
        let rust = BTreeMap::from([
            ("ITEMS", job::ITEMS),
            ("SPLATS", job::SPLATS),
            ("SPLATS_SCAN", job::SPLATS_SCAN),
            ("SPLATS_SORT", job::SPLATS_SORT),
            ("SPLATS_DIGITS", job::SPLATS_DIGITS),
            ("TOUCHES", job::TOUCHES),
            ("TOUCHES_SORT", job::TOUCHES_SORT),
            ("TOUCHES_DIGITS", job::TOUCHES_DIGITS),
            ("TILES", job::TILES),
            ("INSTANCES", job::INSTANCES),
            ("JOB_COUNT", job::COUNT as u64),
        ]);
        // The shader's own, without those that it imports.
        let shader = include_str!("../../../shaders/plan.wgsl");
        let own = shader.lines().filter(|line| line.starts_with("const "));
        let module = naga::front::wgsl::parse_str(&own.collect::<String>()).unwrap();
        let wgsl = module.constants.iter().map(|(_, constant)| {
            let name = constant.name.as_deref().unwrap();
            match module.global_expressions[constant.init] {
                Expression::Literal(Literal::U32(value)) => (name, u64::from(value)),
                ref other => panic!("{name} is {other:?}"),
            }
        });
        assert_eq!(wgsl.collect::<BTreeMap<_, _>>(), rust);
    }
}
