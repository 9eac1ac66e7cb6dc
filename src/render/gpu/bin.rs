//! Stage bin: lists the splats of every tile in order of depth.
//!
//! Binning has two levels. Each splat is listed with the macro tiles of 8 x 4 tiles that it
//! touches, and with one bit for each touched tile, by the same exact test per row of tiles as on
//! the cpu. Such a (splat, macro tile) pair is a touch. The radix sort orders the touches by macro
//! tile: there are a quarter as many of them as (splat, tile) pairs, which are called instances.
//! Then one workgroup per 1,024 touches of a macro tile distributes their splats to its tiles, by
//! transposing a bit matrix.
//!
//! Binning and its sort take half the time and half the bytes of sorting all instances, and produce
//! the same lists. The last part is necessary: when each tile of `rasterize` instead picked its
//! splats from its macro tile's list, the step took longer than with one level, since 32 tiles read
//! every mask. `BENCHMARKS.md` has the numbers.
//!
//! Twin of `render/cpu/bin`; WGSL: `bin`, `sort`, `ranges`, and `expand` in `shaders`.

use wgpu::{BindingResource, CommandEncoder, ComputePass};

use super::device::Device;
use super::growable_buffer::{GrowableBuffer, INTERMEDIATE};
use super::kernel::{Groups, Kernel, module};
use super::layout::{EXPAND_BATCH, MACRO_COLUMNS, MACRO_ROWS, WORKGROUP};
use super::plan::{Plan, job};
use super::project::SplatBuffers;
use super::scan::Scan;
use super::sort::Columns;
use crate::constants::MAX_INSTANCES;

/// The kernels of the stage, and the lists that it writes.
#[derive(Debug)]
pub(super) struct Bin {
    count_touches: Kernel,
    emit_touches: Kernel,
    find_ranges: Kernel,
    count_batches: Kernel,
    count_instances: Kernel,
    list_instances: Kernel,
    /// For each splat, the index of its first touch.
    splat_offsets: GrowableBuffer,
    /// The macro tile of each touch. Of this and the next two, the sort needs two buffers each.
    touch_macro_tiles: [GrowableBuffer; 2],
    /// The splat of each touch.
    touch_splats: [GrowableBuffer; 2],
    /// For each touch, one bit for each touched tile of the macro tile.
    touch_masks: [GrowableBuffer; 2],
    /// Range of each macro tile's touches.
    pub(super) macro_ranges: GrowableBuffer,
    /// For each macro tile, the index of its first batch of touches.
    first_batches: GrowableBuffer,
    /// For each tile of each batch of touches, the index of its first instance.
    batch_offsets: GrowableBuffer,
    /// Range of each tile's instances.
    pub(super) ranges: GrowableBuffer,
    /// The splat of each instance, tile after tile.
    pub(super) instances: GrowableBuffer,
}

/// The sizes for which the stage needs room.
#[derive(Clone, Copy, Debug)]
pub(super) struct BinSizes {
    /// Splats of a region.
    pub(super) splats: u64,
    /// Macro tiles of the frame.
    pub(super) macro_tiles: u32,
    /// Tiles of the frame.
    pub(super) tiles: u32,
    /// Touches of a region.
    pub(super) touches: u64,
    /// Instances of a region.
    pub(super) instances: u64,
}

/// Number of touches and instances that the buffers can hold.
#[derive(Clone, Copy, Debug)]
pub(super) struct BinCapacity {
    pub(super) touches: u32,
    pub(super) instances: u32,
}

impl Bin {
    pub(super) fn new(device: &Device) -> Self {
        let kernel = |name, entry| Kernel::new(device, &module(device, name), entry, &[]);
        let buffer = |label| GrowableBuffer::new(device, label, INTERMEDIATE);
        Self {
            count_touches: kernel("bin", "count"),
            emit_touches: kernel("bin", "emit"),
            find_ranges: kernel("ranges", "main"),
            count_batches: kernel("expand", "batches"),
            count_instances: kernel("expand", "count"),
            list_instances: kernel("expand", "list"),
            splat_offsets: buffer("splat offsets"),
            touch_macro_tiles: [buffer("touch macro tiles"), buffer("touch macro tiles")],
            touch_splats: [buffer("touch splats"), buffer("touch splats")],
            touch_masks: [buffer("touch masks"), buffer("touch masks")],
            macro_ranges: buffer("macro tile ranges"),
            first_batches: buffer("first batches"),
            batch_offsets: buffer("batch offsets"),
            ranges: buffer("ranges"),
            instances: buffer("instances"),
        }
    }

    /// Most instances, and likewise most touches, that a device can hold.
    pub(super) fn limit(device: &Device) -> u64 {
        MAX_INSTANCES.min(device.binding_bytes() / 4)
    }

    /// Makes room. Returns the capacity of the buffers afterwards.
    pub(super) fn reserve(
        &mut self,
        device: &Device,
        scan: &mut Scan,
        sizes: BinSizes,
    ) -> BinCapacity {
        self.splat_offsets.reserve(device, 4 * sizes.splats);
        self.macro_ranges.reserve(device, 8 * u64::from(sizes.macro_tiles));
        self.first_batches.reserve(device, 4 * u64::from(sizes.macro_tiles));
        self.ranges.reserve(device, 8 * u64::from(sizes.tiles));
        self.instances.reserve(device, 4 * sizes.instances);
        let touches = [&mut self.touch_macro_tiles, &mut self.touch_splats, &mut self.touch_masks];
        for buffer in touches.into_iter().flatten() {
            buffer.reserve(device, 4 * sizes.touches);
        }
        let capacity =
            |words: &GrowableBuffer| (words.buffer().size() / 4).min(Self::limit(device)) as u32;
        let touches = capacity(&self.touch_macro_tiles[0]);
        // The last batch of each macro tile may be smaller than the others.
        let batches = u64::from(touches / EXPAND_BATCH) + u64::from(sizes.macro_tiles);
        let batch_tiles = u64::from(MACRO_COLUMNS * MACRO_ROWS) * batches;
        self.batch_offsets.reserve(device, 4 * batch_tiles);
        scan.reserve(device, batch_tiles);
        BinCapacity { touches, instances: capacity(&self.instances) }
    }

    /// Lists the touches of all splats; `sorted` is the index of their buffers that are in order.
    pub(super) fn list_touches(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        plan: &Plan,
        scan: &Scan,
        splats: &SplatBuffers,
        sorted: usize,
    ) {
        let job = plan.job(job::SPLATS);
        let groups = Groups::Job(job);
        let common = [
            (0, plan.frame().as_entire_binding()),
            (1, job.bind()),
            (3, splats.keys[sorted].bind()),
            (4, splats.indices[sorted].bind()),
            (5, splats.shapes.bind()),
            (6, self.splat_offsets.bind()),
        ];
        self.count_touches.run(device, pass, groups, &common);
        scan.run(device, pass, plan.job(job::SPLATS_SCAN), self.splat_offsets.buffer());
        plan.set_touches(device, pass, scan.block_sums());
        let outputs = [
            (2, plan.job(job::TOUCHES).bind()),
            (7, self.touch_macro_tiles[0].bind()),
            (8, self.touch_splats[0].bind()),
            (9, self.touch_masks[0].bind()),
        ];
        let all: Vec<_> = common.into_iter().chain(outputs).collect();
        self.emit_touches.run(device, pass, groups, &all);
    }

    /// The touches, which must be sorted between [`Bin::list_touches`] and [`Bin::list_instances`].
    pub(super) fn touches(&self) -> Columns<'_> {
        Columns {
            keys: &self.touch_macro_tiles,
            values: &self.touch_splats,
            masks: Some(&self.touch_masks),
        }
    }

    /// Lists the splats of all tiles; `sorted` is the index of the buffers of the touches that are
    /// in order.
    pub(super) fn list_instances(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        plan: &Plan,
        scan: &Scan,
        macro_tiles: u32,
        sorted: usize,
    ) {
        // The range of touches of each macro tile.
        let touches = plan.job(job::TOUCHES);
        let frame = (0, plan.frame().as_entire_binding());
        let found = [
            frame.clone(),
            (1, touches.bind()),
            (2, self.touch_macro_tiles[sorted].bind()),
            (3, self.macro_ranges.bind()),
        ];
        self.find_ranges.run(device, pass, Groups::Job(touches), &found);

        // The batches of each macro tile.
        let macro_tile = [frame, (1, self.macro_ranges.bind()), (4, self.first_batches.bind())];
        let groups = Groups::Count(macro_tiles.div_ceil(WORKGROUP));
        self.count_batches.run(device, pass, groups, &macro_tile);
        scan.run(device, pass, plan.job(job::MACRO_TILES), self.first_batches.buffer());
        plan.set_batches(device, pass, scan.block_sums());

        // The number of instances of each tile in each batch.
        let batches = plan.job(job::BATCHES);
        let batch = [
            (2, self.touch_masks[sorted].bind()),
            (5, self.batch_offsets.bind()),
            (6, batches.bind()),
        ];
        let common: Vec<_> = macro_tile.into_iter().chain(batch).collect();
        self.count_instances.run(device, pass, Groups::Job(batches), &common);

        // The list of each tile.
        scan.run(device, pass, plan.job(job::BATCH_TILES), self.batch_offsets.buffer());
        plan.set_instances(device, pass, scan.block_sums());
        let outputs = [
            (3, self.touch_splats[sorted].bind()),
            (7, plan.job(job::INSTANCES).bind()),
            (8, self.ranges.bind()),
            (9, self.instances.bind()),
        ];
        let all: Vec<_> = common.into_iter().chain(outputs).collect();
        self.list_instances.run(device, pass, Groups::Job(batches), &all);
    }

    /// The lists of touches, for `gather.wgsl`; `sorted` is as in [`Bin::list_instances`].
    pub(super) fn touch_resources(&self, sorted: usize) -> [(u32, BindingResource<'_>); 5] {
        [
            (1, self.macro_ranges.bind()),
            (2, self.touch_masks[sorted].bind()),
            (3, self.touch_splats[sorted].bind()),
            (4, self.first_batches.bind()),
            (5, self.batch_offsets.bind()),
        ]
    }

    /// Empties the ranges of all macro tiles and tiles, before [`Bin::list_instances`].
    pub(super) fn clear_ranges(&self, encoder: &mut CommandEncoder) {
        for ranges in [&self.macro_ranges, &self.ranges] {
            encoder.clear_buffer(ranges.buffer(), 0, None);
        }
    }
}
