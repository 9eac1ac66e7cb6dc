//! Stage rasterize: blends each tile's splats, and writes the pixels that were asked for.
//!
//! Twin of `render/cpu/rasterize.rs`; WGSL: `shaders/rasterize.wgsl`, `shaders/resolve.wgsl`.

use wgpu::{Buffer, BufferUsages, CommandEncoder, ComputePass, ShaderModule};

use super::bin::Bin;
use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, SLOT_BYTES, module, slot};
use super::layout::Span;
use super::plan::Plan;
use super::project::Splats;
use super::resolve::Planes;
use super::shaders::Shaders;

/// The stage on the device, and its output.
#[derive(Debug)]
pub(super) struct Rasterize {
    module: ShaderModule,
    /// By the planes that are wanted, compiled when first asked for.
    kernels: [Option<Kernel>; Planes::VARIANTS],
    spans: Growing,
    /// Pixels, tile after tile, page after page.
    pages: Vec<Growing>,
}

impl Rasterize {
    pub(super) fn new(device: &Device, shaders: &Shaders) -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        Self {
            module: module(device, shaders, "rasterize"),
            kernels: [const { None }; Planes::VARIANTS],
            spans: Growing::new(device, "tile spans", uniform),
            pages: Vec::new(),
        }
    }

    /// Makes room for the pixels of all tiles. Returns how many tiles a page holds.
    pub(super) fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32) -> u32 {
        let tile_bytes = planes.tile_bytes();
        let per_page = (device.binding_bytes() / tile_bytes).min(u64::from(u32::MAX)) as u32;
        let mut spans = Vec::new();
        for first in (0..tiles).step_by(per_page as usize) {
            let count = per_page.min(tiles - first);
            let mut slot = [0; SLOT_BYTES as usize / 4];
            slot[..2].copy_from_slice(&[first, count]);
            spans.push(slot);
            if self.pages.len() < spans.len() {
                let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
                self.pages.push(Growing::new(device, "pixels", usage));
            }
            self.pages[spans.len() - 1].reserve(device, tile_bytes * u64::from(count));
        }
        self.spans.fill(device, bytemuck::cast_slice(&spans));
        per_page
    }

    /// Blends all tiles.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        plan: &Plan,
        (splats, bin): (&Splats, &Bin),
        (planes, tiles, per_page): (Planes, u32, u32),
    ) {
        let module = &self.module;
        let kernel = self.kernels[planes.variant()]
            .get_or_insert_with(|| Kernel::new(device, module, "main", &planes.constants()));
        for (page, first) in (0..tiles).step_by(per_page as usize).enumerate() {
            let all = [
                (0, plan.frame().as_entire_binding()),
                (1, slot(self.spans.buffer(), page as u64, size_of::<Span>())),
                (2, bin.ranges.bind()),
                (3, bin.instances.bind()),
                (4, splats.shapes.bind()),
                (5, splats.colors.bind()),
                (6, plan.counters().as_entire_binding()),
                (7, self.pages[page].bind()),
            ];
            kernel.run(device, pass, Groups::Count(per_page.min(tiles - first)), &all);
        }
    }

    /// Copies the pixels to where the host can read them, page by page.
    pub(super) fn copy(
        &self,
        encoder: &mut CommandEncoder,
        to: &[Growing],
        planes: Planes,
        (tiles, per_page): (u32, u32),
    ) {
        for (page, first) in (0..tiles).step_by(per_page as usize).enumerate() {
            let bytes = planes.tile_bytes() * u64::from(per_page.min(tiles - first));
            let (from, to): (&Buffer, &Buffer) = (self.pages[page].buffer(), to[page].buffer());
            encoder.copy_buffer_to_buffer(from, 0, to, 0, bytes);
        }
    }
}
