//! Stage rasterize: blends each tile's splats, and writes the pixels that were asked for.
//!
//! Twin of `render/cpu/rasterize.rs`; WGSL: `shaders/rasterize.wgsl`, `shaders/resolve.wgsl`.

use std::ops::Range;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use wgpu::{
    BindingResource, Buffer, BufferBinding, BufferSize, BufferUsages, CommandEncoder, ComputePass,
    ShaderModule,
};

use super::behind::Behind;
use super::bin::Bin;
use super::device::Device;
use super::growing::Growing;
use super::kernel::{Groups, Kernel, SLOT_BYTES, module, slot};
use super::layout::Span;
use super::lens::Lenses;
use super::plan::Plan;
use super::project::Splats;
use super::resolve::Planes;
use super::shaders::Shaders;
use crate::{Frame, RenderError};
use wildcity_scene::appearance::Appearance;
use wildcity_scene::sky::{CubeMap, DrawableSky};

/// The stage on the device, and its output.
#[derive(Debug)]
pub(super) struct Rasterize {
    module: ShaderModule,
    /// By the planes that are wanted, compiled when first asked for.
    kernels: [Option<Kernel>; Planes::VARIANTS],
    /// For frames with something behind the Gaussians, or cameras that change colours; made with the
    /// first of them.
    behind: Option<Behind>,
    /// What is behind the Gaussians of the latter alone.
    black: Option<Arc<CubeMap>>,
    /// Whether the frame at hand is one.
    has_behind: bool,
    shaders: Shaders,
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
            behind: None,
            black: None,
            has_behind: false,
            shaders: shaders.clone(),
            spans: Growing::new(device, "tile spans", uniform),
            pages: Vec::new(),
        }
    }

    /// Sends what is behind a frame's Gaussians to the device, and what its cameras make of colours, if
    /// there is either; `appearances` is empty if they all record what is there.
    ///
    /// # Errors
    /// The sky cannot be drawn as the profile asks, or is larger than a binding.
    pub(super) fn hold_behind(
        &mut self,
        device: &Device,
        frame: &Frame<'_>,
        appearances: &[Appearance],
    ) -> Result<(), RenderError> {
        let behind = match frame.background()? {
            None if !appearances.is_empty() => {
                let black =
                    self.black.get_or_insert_with(|| Arc::new(CubeMap::uniform(DVec3::ZERO)));
                Some((DrawableSky::CubeMap(black.clone()), DMat3::IDENTITY))
            }
            behind => behind,
        };
        self.has_behind = behind.is_some();
        let Some(drawn) = behind else { return Ok(()) };
        let held = self.behind.get_or_insert_with(|| Behind::new(device));
        held.hold(device, frame, drawn, appearances)
    }

    /// Iterations of loops that what is behind the Gaussians takes of a thread, at most.
    pub(super) fn iterations_behind(&self) -> u64 {
        let behind = self.behind.as_ref().filter(|_| self.has_behind);
        behind.map_or(0, Behind::iterations)
    }

    /// Makes room for the pixels of all tiles. Returns how many tiles a page holds.
    pub(super) fn reserve(&mut self, device: &Device, planes: Planes, tiles: u32) -> u32 {
        let tile_bytes = planes.tile_bytes();
        let per_page = (device.binding_bytes() / tile_bytes).min(u64::from(u32::MAX)) as u32;
        for (page, tiles) in pages(&(0..tiles), per_page) {
            if page == self.pages.len() {
                let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
                self.pages.push(Growing::new(device, "pixels", usage));
            }
            self.pages[page].reserve(device, tile_bytes * tiles.len() as u64);
        }
        per_page
    }

    /// Blends some tiles.
    pub(super) fn run(
        &mut self,
        device: &Device,
        pass: &mut ComputePass<'_>,
        plan: &Plan,
        (splats, bin, lenses): (&Splats, &Bin, &Lenses),
        (planes, tiles, per_page): (Planes, &Range<u32>, u32),
    ) {
        let (kernel, of_behind) = match self.behind.as_mut().filter(|_| self.has_behind) {
            Some(behind) => {
                let lenses = if behind.is_bent() { lenses.bind() } else { None };
                let (kernel, resources) = behind.kernel(device, &self.shaders, planes);
                (kernel, resources.into_iter().chain(lenses).collect())
            }
            None => {
                let module = &self.module;
                let kernel = self.kernels[planes.variant()].get_or_insert_with(|| {
                    Kernel::new(device, module, "main", &planes.constants())
                });
                (&*kernel, Vec::new())
            }
        };
        let spans = pages(tiles, per_page).map(|(_, tiles)| {
            let mut slot = [0; SLOT_BYTES as usize / 4];
            slot[..2].copy_from_slice(&[tiles.start, tiles.len() as u32]);
            slot
        });
        self.spans.fill(device, bytemuck::cast_slice(&spans.collect::<Vec<_>>()));
        for (index, (page, tiles)) in pages(tiles, per_page).enumerate() {
            let [first, bytes] = place(planes, &tiles, per_page);
            let pixels = BufferBinding {
                buffer: self.pages[page].buffer(),
                // Of 1 KiB or more each, so that a binding may start at any tile.
                offset: first,
                size: BufferSize::new(bytes),
            };
            let mut all = vec![
                (0, plan.frame().as_entire_binding()),
                (1, slot(self.spans.buffer(), index as u64, size_of::<Span>())),
                (2, bin.ranges.bind()),
                (3, bin.instances.bind()),
                (4, splats.shapes.bind()),
                (5, splats.colors.bind()),
                (6, plan.counters().as_entire_binding()),
                (7, BindingResource::Buffer(pixels)),
            ];
            all.extend(of_behind.iter().cloned());
            kernel.run(device, pass, Groups::Count(tiles.len() as u32), &all);
        }
    }

    /// Copies the pixels of some tiles to where the host can read them, page by page.
    pub(super) fn copy(
        &self,
        encoder: &mut CommandEncoder,
        to: &[Growing],
        (planes, tiles, per_page): (Planes, &Range<u32>, u32),
    ) {
        for (page, tiles) in pages(tiles, per_page) {
            let [first, bytes] = place(planes, &tiles, per_page);
            let (from, to): (&Buffer, &Buffer) = (self.pages[page].buffer(), to[page].buffer());
            encoder.copy_buffer_to_buffer(from, first, to, first, bytes);
        }
    }
}

/// The pages that hold some tiles, and which of the tiles each holds.
pub(super) fn pages(
    tiles: &Range<u32>,
    per_page: u32,
) -> impl Iterator<Item = (usize, Range<u32>)> {
    let Range { start, end } = *tiles;
    (start / per_page..end.div_ceil(per_page)).map(move |page| {
        let first = page * per_page;
        (page as usize, start.max(first)..end.min(first.saturating_add(per_page)))
    })
}

/// Where the pixels of some tiles start on their page, and how many bytes they are.
fn place(planes: Planes, tiles: &Range<u32>, per_page: u32) -> [u64; 2] {
    [tiles.start % per_page, tiles.len() as u32].map(|tiles| planes.tile_bytes() * u64::from(tiles))
}
