//! Stage bin: the splats of every tile, from the nearest.
//!
//! In two levels: each splat is listed with the macro tiles of 8 x 4 tiles that it touches, a bit per
//! tile; the radix sort brings these touches, a quarter as many as instances, in order of macro tiles;
//! and then each macro tile hands its splats to its tiles.
//!
//! Twin of `render/cpu/bin.rs`; WGSL: `bin`, `sort`, `ranges` and `expand` in `shaders`.

use wgpu::{Buffer, ComputePass};

use super::device::Device;
use super::growing::{Growing, HANDED_OVER};
use super::kernel::{Groups, Kernel, module, slot};
use super::layout::Job;
use super::plan::{Plan, job};
use super::project::Splats;
use super::scan::Scan;
use super::shaders::Shaders;
use super::sort::Columns;
use crate::constants::MAX_INSTANCES;

/// The stage on the device, and the lists that it leaves.
#[derive(Debug)]
pub(super) struct Bin {
    count_touches: Kernel,
    emit_touches: Kernel,
    ranges_of: Kernel,
    count_instances: Kernel,
    list_instances: Kernel,
    /// Per splat, where its touches go.
    splat_offsets: Growing,
    /// Of each touch, before and after each pass of the sort: the macro tile, ...
    macros: [Growing; 2],
    /// ... the splat, ...
    places: [Growing; 2],
    /// ... and a bit for each of the macro tile's tiles that it touches.
    masks: [Growing; 2],
    /// First and end of each macro tile's touches.
    macro_ranges: Growing,
    /// Per tile, where its instances go.
    tile_offsets: Growing,
    /// First and end of each tile's instances.
    pub(super) ranges: Growing,
    /// The splat of each instance, tile after tile.
    pub(super) instances: Growing,
}

impl Bin {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let kernel = |name, entry| Kernel::new(device, &module(device, shaders, name), entry, &[]);
        let growing = |label| Growing::new(device, label, HANDED_OVER);
        Self {
            count_touches: kernel("bin", "count"),
            emit_touches: kernel("bin", "emit"),
            ranges_of: kernel("ranges", "main"),
            count_instances: kernel("expand", "count"),
            list_instances: kernel("expand", "list"),
            splat_offsets: growing("splat offsets"),
            macros: [growing("touch macros"), growing("touch macros")],
            places: [growing("touch places"), growing("touch places")],
            masks: [growing("touch masks"), growing("touch masks")],
            macro_ranges: growing("macro ranges"),
            tile_offsets: growing("tile offsets"),
            ranges: growing("ranges"),
            instances: growing("instances"),
        }
    }

    /// Most instances, and likewise most touches, that a device can hold.
    pub(super) fn limit(device: &Device) -> u64 {
        MAX_INSTANCES.min(device.binding_bytes() / 4)
    }

    /// Makes room for the offsets and ranges of a frame, for touches and for instances, and tells how
    /// many of the latter two fit then.
    pub(super) fn reserve(
        &mut self,
        device: &Device,
        splats: u64,
        (macros, tiles): (u32, u32),
        (touches, instances): (u64, u64),
    ) -> (u32, u32) {
        self.splat_offsets.reserve(device, 4 * splats);
        self.macro_ranges.reserve(device, 8 * u64::from(macros));
        self.tile_offsets.reserve(device, 4 * u64::from(tiles));
        self.ranges.reserve(device, 8 * u64::from(tiles));
        self.instances.reserve(device, 4 * instances);
        for words in [&mut self.macros, &mut self.places, &mut self.masks].into_iter().flatten() {
            words.reserve(device, 4 * touches);
        }
        let held = |words: &Growing| (words.buffer().size() / 4).min(Self::limit(device)) as u32;
        (held(&self.macros[0]), held(&self.instances))
    }

    /// Lists the touches of all splats; `sorted` tells which of their buffers are in order.
    pub(super) fn touch(
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
            (6, self.splat_offsets.bind()),
        ];
        let groups = Groups::Job(jobs, job::SPLATS);
        self.count_touches.run(device, pass, groups, &common);
        scan.run(device, pass, (jobs, job::SPLATS_SCAN), self.splat_offsets.buffer());
        plan.touches(device, pass, scan.block_sums());
        let emitted = [
            (2, slot(jobs, job::TOUCHES, size_of::<Job>())),
            (7, self.macros[0].bind()),
            (8, self.places[0].bind()),
            (9, self.masks[0].bind()),
        ];
        let all: Vec<_> = common.into_iter().chain(emitted).collect();
        self.emit_touches.run(device, pass, groups, &all);
    }

    /// What is to be sorted between [`Bin::touch`] and [`Bin::expand`].
    pub(super) fn touches(&self) -> Columns<'_> {
        Columns { keys: &self.macros, values: &self.places, masks: Some(&self.masks) }
    }

    /// Lists the splats of all tiles; `sorted` tells which touches are in order.
    pub(super) fn expand(
        &self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (plan, scan): (&Plan, &Scan),
        (macros, sorted): (u32, usize),
    ) {
        let jobs = plan.jobs();
        let frame = (0, plan.frame().as_entire_binding());
        let found = [
            frame.clone(),
            (1, slot(jobs, job::TOUCHES, size_of::<Job>())),
            (2, self.macros[sorted].bind()),
            (3, self.macro_ranges.bind()),
        ];
        self.ranges_of.run(device, pass, Groups::Job(jobs, job::TOUCHES), &found);

        let groups = Groups::Count(macros);
        let counted = [
            frame,
            (1, self.macro_ranges.bind()),
            (2, self.masks[sorted].bind()),
            (4, self.tile_offsets.bind()),
        ];
        let crowd = (8, plan.counters().as_entire_binding());
        self.count_instances.run(
            device,
            pass,
            groups,
            &counted.iter().cloned().chain([crowd]).collect::<Vec<_>>(),
        );
        scan.run(device, pass, (jobs, job::TILES), self.tile_offsets.buffer());
        plan.instances(device, pass, scan.block_sums());
        let listed = [
            (3, self.places[sorted].bind()),
            (5, slot(jobs, job::INSTANCES, size_of::<Job>())),
            (6, self.ranges.bind()),
            (7, self.instances.bind()),
        ];
        let all: Vec<_> = counted.into_iter().chain(listed).collect();
        self.list_instances.run(device, pass, groups, &all);
    }

    /// The buffer that must be zero before [`Bin::expand`].
    pub(super) fn macro_ranges(&self) -> &Buffer {
        self.macro_ranges.buffer()
    }
}
