//! Stage bin: the tiles of every splat, from the nearest, and then tile after tile.
//!
//! Twin of `render/cpu/bin.rs`; WGSL: `shaders/bin.wgsl`, `shaders/sort.wgsl`, `shaders/ranges.wgsl`.

use wgpu::{Buffer, ComputePass};

use super::device::Device;
use super::growing::{Growing, HANDED_OVER};
use super::kernel::{Groups, Kernel, module, slot};
use super::layout::Job;
use super::plan::{Plan, job};
use super::project::Splats;
use super::scan::Scan;
use super::shaders::Shaders;
use crate::render::constants::MAX_INSTANCES;

/// The stage on the device, and the instances that it leaves.
#[derive(Debug)]
pub(super) struct Bin {
    count: Kernel,
    emit: Kernel,
    ranges_of: Kernel,
    /// Per splat, where its instances go.
    offsets: Growing,
    /// Tile of each instance, before and after each pass of the sort.
    pub(super) tiles: [Growing; 2],
    /// Splat of each instance.
    pub(super) places: [Growing; 2],
    /// First and end of each tile's instances.
    pub(super) ranges: Growing,
}

impl Bin {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let kernel = |name, entry| Kernel::new(device, &module(device, shaders, name), entry, &[]);
        let growing = |label| Growing::new(device, label, HANDED_OVER);
        Self {
            count: kernel("bin", "count"),
            emit: kernel("bin", "emit"),
            ranges_of: kernel("ranges", "main"),
            offsets: growing("splat offsets"),
            tiles: [growing("instance tiles"), growing("instance tiles")],
            places: [growing("instance places"), growing("instance places")],
            ranges: growing("ranges"),
        }
    }

    /// Most instances that a device can hold.
    pub(super) fn limit(device: &Device) -> u64 {
        MAX_INSTANCES.min(device.binding_bytes() / 4)
    }

    /// Makes room for the offsets of splats, for instances and for ranges of tiles, and tells how
    /// many instances fit then.
    pub(super) fn reserve(
        &mut self,
        device: &Device,
        splats: u64,
        instances: u64,
        tiles: u32,
    ) -> u32 {
        self.offsets.reserve(device, 4 * splats);
        self.ranges.reserve(device, 8 * u64::from(tiles));
        for words in self.tiles.iter_mut().chain(&mut self.places) {
            words.reserve(device, 4 * instances);
        }
        // A total of 2^32 - 1 stands for more, which no buffer holds.
        (self.tiles[0].buffer().size() / 4).min(u64::from(u32::MAX) - 1) as u32
    }

    /// Lists the tiles of all splats; `sorted` tells which of their buffers are in order.
    pub(super) fn run(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (plan, scan): (&Plan, &Scan),
        (splats, sorted): (&Splats, usize),
    ) {
        let jobs = plan.jobs();
        let common = [
            (0, plan.frame().as_entire_binding()),
            (1, slot(jobs, job::SPLATS, size_of::<Job>())),
            (3, splats.keys[sorted].bind()),
            (4, splats.places[sorted].bind()),
            (5, splats.shapes.bind()),
            (6, self.offsets.bind()),
        ];
        let groups = Groups::Job(jobs, job::SPLATS);
        self.count.run(device, pass, groups, &common);
        scan.run(device, pass, (jobs, job::SPLATS_SCAN), self.offsets.buffer());
        plan.instances(device, pass, scan.block_sums());
        let emitted = [
            (2, slot(jobs, job::INSTANCES, size_of::<Job>())),
            (7, self.tiles[0].bind()),
            (8, self.places[0].bind()),
        ];
        let all: Vec<_> = common.into_iter().chain(emitted).collect();
        self.emit.run(device, pass, groups, &all);
    }

    /// Finds each tile's part of the sorted instances.
    pub(super) fn ranges(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        plan: &Plan,
        sorted: usize,
    ) {
        let all = [
            (0, plan.frame().as_entire_binding()),
            (1, slot(plan.jobs(), job::INSTANCES, size_of::<Job>())),
            (2, self.tiles[sorted].bind()),
            (3, self.ranges.bind()),
        ];
        self.ranges_of.run(device, pass, Groups::Job(plan.jobs(), job::INSTANCES), &all);
    }

    /// The buffer that must be zero before [`Bin::ranges`].
    pub(super) fn ranges_buffer(&self) -> &Buffer {
        self.ranges.buffer()
    }
}
