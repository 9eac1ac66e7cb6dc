//! Tiles with long lists, which have a kernel of their own in stage rasterize. WGSL:
//! `shaders/long_tiles.wgsl`, `shaders/rasterize_long.wgsl`.
//!
//! A tile where a road meets the horizon has tens of thousands of splats. Blended like the others
//! it takes most of the stage's time while the rest of the device is idle. So the tiles with long
//! lists are started first, by four times as many threads each, and the others run beside them: no
//! buffer is written by one of the two kernels and used by the other, so that wgpu puts no barrier
//! between them. A third kernel then makes pixels of their sums.

use wgpu::{BindingResource, BufferUsages, ComputePass};

use super::bin::Bin;
use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::kernel::{Groups, Kernel, LazyShader, module};
use super::layout::{LONG_TILE_WORDS, LONG_TILES, WORKGROUP};
use super::plan::{Plan, job};
use super::project::SplatBuffers;
use super::resolve::Planes;

/// The kernels, and the tiles with their sums.
#[derive(Debug)]
pub(super) struct LongTiles {
    find: Kernel,
    /// By whether depth, and whether owners are wanted.
    blend: LazyShader<Kernel, 4>,
    tiles: GrowableBuffer,
    /// For each tile of the frame, its place in `tiles`, plus 1; or 0.
    places: GrowableBuffer,
    sums: GrowableBuffer,
}

impl LongTiles {
    pub(super) fn new(device: &Device) -> Self {
        let buffer = |label| GrowableBuffer::new(device, label, BufferUsages::STORAGE);
        Self {
            find: Kernel::new(device, &module(device, "long_tiles"), "main", &[]),
            blend: LazyShader::new("rasterize_long").with_module(device),
            tiles: buffer("long tiles"),
            places: buffer("places of long tiles"),
            sums: buffer("sums of long tiles"),
        }
    }

    /// Makes room for a frame with this number of tiles.
    pub(super) fn reserve(&mut self, device: &Device, tiles: u32) {
        // Further long tiles have no place here, and are blended as those with short lists.
        let most = u64::from(LONG_TILES.min(tiles));
        self.tiles.reserve(device, 4 * most);
        self.places.reserve(device, 4 * u64::from(tiles));
        self.sums.reserve(device, 4 * u64::from(LONG_TILE_WORDS) * most);
    }

    /// Finds the tiles with long lists among all `tiles` of a frame, and blends them.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        (plan, splats, bin): (&Plan, &SplatBuffers, &Bin),
        tiles: u32,
        planes: Planes,
    ) {
        let long_job = plan.job(job::LONG_TILES);
        let frame = (0, plan.frame().as_entire_binding());
        let found = [
            frame.clone(),
            (1, long_job.bind()),
            (2, bin.ranges.bind()),
            (3, self.tiles.bind()),
            (4, self.places.bind()),
        ];
        self.find.run(device, pass, Groups::Count(tiles.div_ceil(WORKGROUP)), &found);

        let wants = [planes.has_depth(), planes.has_owners()];
        // Each combination of the two constants is a kernel of its own, numbered from 0 to 3.
        let variant = usize::from(wants[0]) + 2 * usize::from(wants[1]);
        let blend = self.blend.variant(device, variant, |module| {
            let flags = [("DEPTH", wants[0]), ("OWNERS", wants[1])];
            let constants = flags.map(|(name, on)| (name, f64::from(u8::from(on))));
            Kernel::new(device, module, "main", &constants)
        });
        let resources = [
            frame,
            (1, self.tiles.bind()),
            (2, bin.ranges.bind()),
            (3, bin.instances.bind()),
            (4, splats.shapes.bind()),
            (5, splats.colors.bind()),
            (6, self.sums.bind()),
            (7, self.places.bind()),
        ];
        // The host does not know how many tiles are long: `find` has counted them into the job.
        blend.run(device, pass, Groups::Job(long_job), &resources);
    }

    /// The tiles' places, as a resource of `rasterize.wgsl`.
    pub(super) fn bind_places(&self) -> (u32, BindingResource<'_>) {
        (15, self.places.bind())
    }

    /// The tiles' sums, as a resource of `rasterize.wgsl`.
    pub(super) fn bind_sums(&self) -> (u32, BindingResource<'_>) {
        (16, self.sums.bind())
    }
}
