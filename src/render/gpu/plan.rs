//! The amount of work of each stage, which the device computes itself, so that nothing is read back
//! in the middle of a frame. WGSL: `shaders/plan.wgsl`.

use wgpu::{Buffer, BufferUsages, ComputePass};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, JobRef, Kernel, fold_groups, module};
use super::layout::{
    Counters, DIGITS, Frame, Job, JobSlot, SCAN_BLOCK, SORT_BLOCK, TileCounters, WORKGROUP,
};

/// Slots of the jobs; `plan.wgsl` has the same numbers.
pub(super) mod job {
    pub(crate) const CLUSTER_VIEWS: u64 = 0;
    pub(crate) const SPLATS: u64 = 1;
    pub(crate) const SPLATS_SCAN: u64 = 2;
    pub(crate) const SPLATS_SORT: u64 = 3;
    pub(crate) const SPLATS_DIGITS: u64 = 4;
    pub(crate) const TOUCHES: u64 = 5;
    pub(crate) const TOUCHES_SORT: u64 = 6;
    pub(crate) const TOUCHES_DIGITS: u64 = 7;
    pub(crate) const MACRO_TILES: u64 = 8;
    pub(crate) const BATCHES: u64 = 9;
    pub(crate) const BATCH_TILES: u64 = 10;
    pub(crate) const INSTANCES: u64 = 11;
    /// Tiles with long lists; `long_tiles.wgsl` counts them.
    pub(crate) const LONG_TILES: u64 = 12;
    pub(crate) const COUNT: usize = 13;
}

/// Counts that are known before the first stage of a frame runs; those that the device computes are
/// zero.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    /// (Cluster, view) pairs to project.
    pub(super) cluster_views: u32,
    /// Splats that another backend projected.
    pub(super) splats: u32,
    /// Instances that another backend binned.
    pub(super) instances: u32,
}

/// The parameters of a frame, its counters, and the jobs of its stages.
#[derive(Debug)]
pub(super) struct Plan {
    splats: Kernel,
    touches: Kernel,
    batches: Kernel,
    instances: Kernel,
    frame: GrowableBuffer,
    jobs: GrowableBuffer,
    counters: GrowableBuffer,
    tile_counters: GrowableBuffer,
}

impl Plan {
    pub(super) fn new(device: &Device) -> Self {
        let module = module(device, "plan");
        let kernel = |entry| Kernel::new(device, &module, entry, &[]);
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let mut plan = Self {
            splats: kernel("splats"),
            touches: kernel("touches"),
            batches: kernel("batches"),
            instances: kernel("instances"),
            frame: GrowableBuffer::new(
                device,
                "frame",
                BufferUsages::UNIFORM | BufferUsages::COPY_DST,
            ),
            jobs: GrowableBuffer::new(device, "jobs", storage | BufferUsages::INDIRECT),
            counters: GrowableBuffer::new(device, "counters", storage | BufferUsages::COPY_SRC),
            tile_counters: GrowableBuffer::new(
                device,
                "tile counters",
                storage | BufferUsages::COPY_SRC,
            ),
        };
        plan.frame.reserve(device, size_of::<Frame>() as u64);
        plan.jobs.reserve(device, (job::COUNT * size_of::<JobSlot>()) as u64);
        plan
    }

    /// Writes the parameters of a frame, and resets counters and jobs.
    pub(super) fn start(&self, device: &Device, frame: &Frame, counts: &Counts) {
        let Counts { cluster_views, splats, instances } = *counts;
        let mut jobs: [JobSlot; job::COUNT] = bytemuck::Zeroable::zeroed();
        // Splats are counted here only if another backend has projected them; otherwise these
        // lengths are 0 until the device sets them.
        for (slot, length, per_group) in [
            (job::CLUSTER_VIEWS, cluster_views, SCAN_BLOCK),
            (job::SPLATS, splats, WORKGROUP),
            (job::SPLATS_SCAN, splats, SCAN_BLOCK),
            (job::SPLATS_SORT, splats, SORT_BLOCK),
            // A counter for each digit of each block of keys.
            (job::SPLATS_DIGITS, DIGITS * splats.div_ceil(SORT_BLOCK), SCAN_BLOCK),
            (job::MACRO_TILES, frame.macro_tiles, SCAN_BLOCK),
        ] {
            jobs[slot as usize].job = job(length, per_group);
        }
        // `long_tiles.wgsl` counts up from no tiles, in one row of workgroups.
        jobs[job::LONG_TILES as usize].job = Job { length: 0, groups: [0, 1, 1] };
        let counters = Counters { splats, instances, ..bytemuck::Zeroable::zeroed() };
        let write = |to: &GrowableBuffer, bytes| device.queue.write_buffer(to.buffer(), 0, bytes);
        write(&self.frame, bytemuck::bytes_of(frame));
        write(&self.jobs, bytemuck::bytes_of(&jobs));
        write(&self.counters, bytemuck::bytes_of(&counters));
        let tile_counters: TileCounters = bytemuck::Zeroable::zeroed();
        write(&self.tile_counters, bytemuck::bytes_of(&tile_counters));
    }

    pub(super) fn frame(&self) -> &Buffer {
        self.frame.buffer()
    }

    /// The job in one of the slots of [`job`].
    pub(super) fn job(&self, slot: u64) -> JobRef<'_> {
        JobRef { jobs: self.jobs.buffer(), slot }
    }

    pub(super) fn counters(&self) -> &Buffer {
        self.counters.buffer()
    }

    /// The counters of stage rasterize.
    pub(super) fn tile_counters(&self) -> &Buffer {
        self.tile_counters.buffer()
    }

    /// Sets the jobs that depend on the number of splats, after the prefix sum over the visible
    /// splats of the cluster views.
    pub(super) fn set_splats(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.splats, device, pass, sums);
    }

    /// Sets the jobs that depend on the number of touches, after the prefix sum over the splats'
    /// touches.
    pub(super) fn set_touches(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.touches, device, pass, sums);
    }

    /// Sets the jobs that depend on the number of batches, after the prefix sum over the batches of
    /// macro tiles.
    pub(super) fn set_batches(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        let buffers = [(1, self.jobs.bind()), (2, sums.as_entire_binding())];
        self.batches.run(device, pass, Groups::Count(1), &buffers);
    }

    /// Sets the job that depends on the number of instances, after the prefix sum over the tiles'
    /// splats.
    pub(super) fn set_instances(&self, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        self.run(&self.instances, device, pass, sums);
    }

    fn run(&self, kernel: &Kernel, device: &Device, pass: &mut ComputePass<'_>, sums: &Buffer) {
        let buffers = [self.frame(), self.jobs.buffer(), sums, self.counters()];
        let all = [0, 1, 2, 3].map(|k| (k, buffers[k as usize].as_entire_binding()));
        kernel.run(device, pass, Groups::Count(1), &all);
    }
}

/// A job of `length` elements, `per_group` per workgroup, as `job` in `plan.wgsl` computes it.
fn job(length: u32, per_group: u32) -> Job {
    Job { length, groups: fold_groups(length.div_ceil(per_group)) }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use naga::{Expression, Literal};

    use super::job;

    #[test]
    fn slots_have_the_same_numbers_in_the_shader() {
        let rust = BTreeMap::from([
            ("CLUSTER_VIEWS", job::CLUSTER_VIEWS),
            ("SPLATS", job::SPLATS),
            ("SPLATS_SCAN", job::SPLATS_SCAN),
            ("SPLATS_SORT", job::SPLATS_SORT),
            ("SPLATS_DIGITS", job::SPLATS_DIGITS),
            ("TOUCHES", job::TOUCHES),
            ("TOUCHES_SORT", job::TOUCHES_SORT),
            ("TOUCHES_DIGITS", job::TOUCHES_DIGITS),
            ("MACRO_TILES", job::MACRO_TILES),
            ("BATCHES", job::BATCHES),
            ("BATCH_TILES", job::BATCH_TILES),
            ("INSTANCES", job::INSTANCES),
            ("LONG_TILES", job::LONG_TILES),
            ("JOB_COUNT", job::COUNT as u64),
        ]);
        // The constants that the file itself declares, without those of the files that it imports.
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
