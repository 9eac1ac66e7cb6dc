//! What is behind the Gaussians and what cameras make of it, on the device: made with the first frame
//! that has either.
//!
//! Twin of `render/cpu/{behind,appearance}.rs`; WGSL: `shaders/behind.wgsl` and what it imports, linked into
//! `rasterize`.

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
use crate::{Frame, MAX_VIEWS, RenderError, View};
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::sky::{DrawableSky, InferenceNetwork};

/// What is behind the Gaussians of the frame at hand.
#[derive(Debug)]
pub(super) struct Behind {
    views: Growing,
    values: Growing,
    seen: Growing,
    overlays: Growing,
    /// What the device holds of skies, and of overlays, one behind the other.
    held: Option<DrawableSky>,
    held_overlays: Vec<Arc<Overlay>>,
    /// Which of the variants the frame takes.
    variant: usize,
    variants: [Variant; VARIANTS.len()],
}

/// The stage with one kind of sky and of views, compiled when first asked for.
#[derive(Debug, Default)]
struct Variant {
    module: Option<ShaderModule>,
    /// By the planes that are wanted.
    kernels: [Option<Kernel>; Planes::VARIANTS],
}

/// A map or a network; and each with lenses or rolling shutters.
const VARIANTS: [&str; 4] =
    ["rasterize_map", "rasterize_network", "rasterize_map_bent", "rasterize_network_bent"];

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
            held_overlays: Vec::new(),
            variant: 0,
            variants: Default::default(),
        }
    }

    /// Sends what is behind a frame to the device; a sky or overlays that are there already are not sent
    /// again.
    ///
    /// # Errors
    /// It is larger than a binding of the device.
    pub(super) fn hold(
        &mut self,
        device: &Device,
        frame: &Frame<'_>,
        (drawn, axes): (DrawableSky, DMat3),
        appearances: &[Appearance],
    ) -> Result<(), RenderError> {
        let mut behind = layout::Behind::zeroed();
        for (slot, view) in behind.sky_from_pixel.iter_mut().zip(frame.views) {
            let rows = match view.is_static_pinhole() {
                true => view.sky_from_pixel(axes),
                false => view.sky_from_camera(axes),
            };
            *slot = rows.map(|[a, b, c]| [a, b, c, 0.0]);
        }
        match &drawn {
            DrawableSky::CubeMap(map) => {
                let [scale, offset] = map.lookup_scale_offset();
                (behind.scale, behind.offset) = (scale as f32, offset as f32);
                behind.edge = map.edge() as u32;
            }
            DrawableSky::Network(network) => set_network(&mut behind, network),
        }
        let limit = device.binding_bytes();
        if drawn.bytes() as u64 > limit {
            let what = "bytes of a sky in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        let has_bent = !frame.views.iter().all(View::is_static_pinhole);
        let has_network = matches!(drawn, DrawableSky::Network(_));
        self.variant = usize::from(has_network) + 2 * usize::from(has_bent);
        if !self.held.as_ref().is_some_and(|held| held.ptr_eq(&drawn)) {
            match &drawn {
                DrawableSky::CubeMap(map) => {
                    self.values.fill(device, bytemuck::cast_slice(map.texels()))
                }
                DrawableSky::Network(network) => {
                    self.values.fill(device, bytemuck::cast_slice(&network.weights()));
                }
            }
            self.held = Some(drawn);
        }
        self.views.fill(device, bytemuck::bytes_of(&behind));
        self.see(device, appearances)
    }

    /// Sends what cameras make of colours.
    fn see(&mut self, device: &Device, appearances: &[Appearance]) -> Result<(), RenderError> {
        let mut seen = [layout::Seen::zeroed(); MAX_VIEWS];
        let mut overlays: Vec<Arc<Overlay>> = Vec::new();
        let mut bytes = 0;
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
                seen.first_overlay = (bytes / 4) as u32;
                bytes += overlay.rgba8().len();
                overlays.push(overlay.clone());
            }
        }
        let limit = device.binding_bytes();
        if bytes as u64 > limit {
            let what = "bytes of overlays in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        self.seen.fill(device, bytemuck::cast_slice(&seen));
        let same = |(one, other): (&Arc<Overlay>, &Arc<Overlay>)| Arc::ptr_eq(one, other);
        let held = &self.held_overlays;
        if overlays.len() != held.len() || !overlays.iter().zip(held).all(same) {
            let pixels: Vec<u8> = overlays.iter().flat_map(|o| o.rgba8()).copied().collect();
            self.overlays.fill(device, &pixels);
            self.held_overlays = overlays;
        }
        Ok(())
    }

    /// The kernel that draws it, and its resources beside those of `rasterize`.
    pub(super) fn kernel(
        &mut self,
        device: &Device,
        shaders: &Shaders,
        planes: Planes,
    ) -> (&Kernel, [(u32, BindingResource<'_>); 4]) {
        let Variant { module: compiled, kernels } = &mut self.variants[self.variant];
        let name = VARIANTS[self.variant];
        let module = compiled.get_or_insert_with(|| module(device, shaders, name));
        let kernel = kernels[planes.variant()]
            .get_or_insert_with(|| Kernel::new(device, module, "main", &planes.constants()));
        let resources = [
            (8, self.views.bind()),
            (9, self.values.bind()),
            (10, self.seen.bind()),
            (11, self.overlays.bind()),
        ];
        (kernel, resources)
    }

    /// Iterations of loops that it takes of a thread, at most: four pixels' way back through a lens, 40 and
    /// 26 each, and of a network all of a tile's 64 times four, four inputs each.
    pub(super) fn iterations(&self) -> u64 {
        let look = if self.is_bent() { 4 * (1 + 40 + 26) } else { 0 };
        let sky = match &self.held {
            Some(DrawableSky::Network(network)) => {
                let (width, encoded) = (network.width() as u64, network.encoded() as u64);
                let rows = width.div_ceil(64);
                let hidden = rows * (2 + encoded.div_ceil(4) + (width + encoded).div_ceil(4));
                64 * (1 + hidden + width / 4 + 3)
            }
            _ => 4,
        };
        look + sky
    }

    /// Whether the frame has views of lenses or rolling shutters.
    pub(super) fn is_bent(&self) -> bool {
        self.variant >= 2
    }
}

fn set_network(behind: &mut layout::Behind, network: &InferenceNetwork) {
    let sizes = [network.width(), network.octaves(), network.encoded()];
    [behind.width, behind.octaves, behind.encoded] = sizes.map(|size| size as u32);
    (behind.identity, behind.skip) = (network.identity().into(), network.skip().into());
}
