//! What is behind the Gaussians and what cameras make of it, on the device: made with the first frame
//! that has either.
//!
//! Twin of `render/cpu/{behind,appearance}.rs`; WGSL: `shaders/{behind,sky_map,appearance}.wgsl`,
//! linked into `rasterize`.

use std::sync::Arc;

use bytemuck::Zeroable;
use glam::DMat3;
use wgpu::{BindingResource, BufferUsages, ShaderModule};

use super::device::Device;
use super::growing::Growing;
use super::kernel::{Kernel, module};
use super::layout;
use super::resolve::Planes;
use super::shaders::Shaders;
use crate::render::{Frame, MAX_VIEWS, RenderError};
use crate::scene::appearance::{Appearance, Exposure};
use crate::scene::sky::{CubeMap, Drawn};

/// What is behind the Gaussians of the frame at hand.
#[derive(Debug)]
pub(super) struct Behind {
    views: Growing,
    values: Growing,
    seen: Growing,
    overlays: Growing,
    /// Whose values the device holds.
    held: Option<Arc<CubeMap>>,
    module: Option<ShaderModule>,
    kernels: [Option<Kernel>; Planes::VARIANTS],
}

impl Behind {
    pub(super) fn new(device: &Device) -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        Self {
            views: Growing::new(device, "behind", uniform),
            values: Growing::new(device, "sky", storage),
            seen: Growing::new(device, "appearances", uniform),
            overlays: Growing::new(device, "overlays", storage),
            held: None,
            module: None,
            kernels: [const { None }; Planes::VARIANTS],
        }
    }

    /// Sends what is behind a frame to the device; a sky that is there already is not sent again.
    ///
    /// # Errors
    /// It is larger than a binding of the device.
    pub(super) fn hold(
        &mut self,
        device: &Device,
        frame: &Frame<'_>,
        (drawn, axes): (Drawn, DMat3),
        appearances: &[Appearance],
    ) -> Result<(), RenderError> {
        let mut behind = layout::Behind::zeroed();
        for (slot, view) in behind.sky_from_pixel.iter_mut().zip(frame.views) {
            *slot = view.sky_from_pixel(axes).map(|[a, b, c]| [a, b, c, 0.0]);
        }
        let Drawn::Map(map) = drawn else { return Err(RenderError::ExactSky { backend: "gpu" }) };
        let [scale, offset] = map.look_up();
        (behind.scale, behind.offset) = (scale as f32, offset as f32);
        behind.edge = map.edge() as u32;
        let limit = device.binding_bytes();
        if map.bytes() as u64 > limit {
            let what = "bytes of a sky in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        if !self.held.as_ref().is_some_and(|held| Arc::ptr_eq(held, &map)) {
            self.values.fill(device, bytemuck::cast_slice(map.texels()));
            self.held = Some(map);
        }
        self.views.fill(device, bytemuck::bytes_of(&behind));
        self.see(device, appearances)
    }

    /// Sends what cameras make of colours.
    fn see(&mut self, device: &Device, appearances: &[Appearance]) -> Result<(), RenderError> {
        let (mut seen, mut pixels) = ([layout::Seen::zeroed(); MAX_VIEWS], Vec::new());
        for (seen, Appearance { exposure, overlay }) in seen.iter_mut().zip(appearances) {
            if let Some(Exposure { matrix, offset }) = exposure {
                let row = |c: usize| {
                    let [r, g, b] = matrix[c].map(|value| value as f32);
                    [r, g, b, offset[c] as f32]
                };
                (seen.exposed, seen.exposure) = (1, [row(0), row(1), row(2)]);
            }
            if let Some(overlay) = overlay {
                seen.overlay_px = overlay.size_px();
                seen.first_overlay = (pixels.len() / 4) as u32;
                pixels.extend_from_slice(overlay.rgba8());
            }
        }
        let limit = device.binding_bytes();
        if pixels.len() as u64 > limit {
            let what = "bytes of overlays in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        self.seen.fill(device, bytemuck::cast_slice(&seen));
        self.overlays.fill(device, &pixels);
        Ok(())
    }

    /// The kernel that draws it, and its resources beside those of `rasterize`.
    pub(super) fn kernel(
        &mut self,
        device: &Device,
        shaders: &Shaders,
        planes: Planes,
    ) -> (&Kernel, [(u32, BindingResource<'_>); 4]) {
        let module = self.module.get_or_insert_with(|| module(device, shaders, "rasterize_sky"));
        let kernel = self.kernels[planes.variant()]
            .get_or_insert_with(|| Kernel::new(device, module, "main", &planes.constants()));
        let resources = [
            (8, self.views.bind()),
            (9, self.values.bind()),
            (10, self.seen.bind()),
            (11, self.overlays.bind()),
        ];
        (kernel, resources)
    }
}
