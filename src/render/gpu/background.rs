//! Backgrounds (skies and colours) and camera appearances (exposures and overlays) on the device.
//! The buffers are created with the first frame that has either, and the shaders compiled then.
//!
//! Twin of `render/cpu/background.rs` and `render/cpu/appearance.rs`; WGSL:
//! `shaders/background.wgsl` and the files that it imports, linked into the variants of
//! `rasterize`.

use std::sync::Arc;

use bytemuck::Zeroable;
use glam::DMat3;
use wgpu::{BindingResource, BufferUsages};

use super::device::Device;
use super::growable_buffer::GrowableBuffer;
use super::layout;
use super::resolve::Outputs;
use crate::samples::SAMPLES;
use crate::{Frame, MAX_VIEWS, RenderError, View};
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::sky::{DrawableSky, InferenceNetwork};

/// Background and appearances of the current frame.
#[derive(Debug)]
pub(super) struct Background {
    /// One [`layout::Background`], which all views share.
    parameters: GrowableBuffer,
    /// Texels of a cube map, or weights of a network.
    sky_values: GrowableBuffer,
    /// A [`layout::CameraAppearance`] for each view.
    appearances: GrowableBuffer,
    /// Pixels of all overlays, one after the other.
    overlay_pixels: GrowableBuffer,
    /// The sky in `sky_values`.
    sky: Option<DrawableSky>,
    /// The overlays in `overlay_pixels`.
    overlays: Vec<Arc<Overlay>>,
    /// Whether a view of the frame has a lens or a rolling shutter.
    has_lenses: bool,
}

/// The variants of `rasterize` for frames with a background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BackgroundShader {
    /// A cube map; all views are static pinholes.
    Map,
    /// A network; all views are static pinholes.
    Network,
    /// A cube map, with lenses or rolling shutters.
    MapLens,
    /// A network, with lenses or rolling shutters.
    NetworkLens,
}

impl Background {
    pub(super) fn new(device: &Device) -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let storage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        Self {
            parameters: GrowableBuffer::new(device, "background", uniform),
            sky_values: GrowableBuffer::new(device, "sky", storage),
            appearances: GrowableBuffer::new(device, "appearances", uniform),
            overlay_pixels: GrowableBuffer::new(device, "overlays", storage),
            sky: None,
            overlays: Vec::new(),
            has_lenses: false,
        }
    }

    /// Uploads the sky and the appearances of a frame. `sky_from_world` rotates directions to the
    /// sky's axes. A sky or overlays that the device already has are not uploaded again.
    ///
    /// # Errors
    /// [`RenderError::TooMany`] if the sky or the overlays are larger than a binding of the device.
    pub(super) fn upload(
        &mut self,
        device: &Device,
        frame: &Frame<'_>,
        sky: DrawableSky,
        sky_from_world: DMat3,
        outputs: &Outputs,
    ) -> Result<(), RenderError> {
        let mut parameters = layout::Background::zeroed();
        for (index, view) in frame.views.iter().enumerate() {
            let rows = if view.is_static_pinhole() {
                // Pixels of the image; the view may be that of their samples.
                let px = if outputs.sampled.contains(index) { SAMPLES as f32 } else { 1.0 };
                view.sky_from_pixel(sky_from_world).map(|[x, y, one]| [x * px, y * px, one])
            } else {
                view.sky_from_camera(sky_from_world)
            };
            parameters.sky_from_pixel[index] = rows.map(|[a, b, c]| [a, b, c, 0.0]);
        }
        match &sky {
            DrawableSky::CubeMap(map) => {
                let [scale, offset] = map.lookup_scale_offset();
                parameters.scale = scale as f32;
                parameters.offset = offset as f32;
                parameters.edge = map.edge() as u32;
            }
            DrawableSky::Network(network) => set_network(&mut parameters, network),
        }
        let limit = device.binding_bytes();
        if sky.bytes() as u64 > limit {
            let what = "bytes of a sky in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        self.has_lenses = !frame.views.iter().all(View::is_static_pinhole);
        if !self.sky.as_ref().is_some_and(|held| held.ptr_eq(&sky)) {
            match &sky {
                DrawableSky::CubeMap(map) => {
                    self.sky_values.fill(device, bytemuck::cast_slice(map.texels()));
                }
                DrawableSky::Network(network) => {
                    self.sky_values.fill(device, bytemuck::cast_slice(&network.weights()));
                }
            }
            self.sky = Some(sky);
        }
        self.parameters.fill(device, bytemuck::bytes_of(&parameters));
        self.upload_appearances(device, &outputs.appearances)
    }

    fn upload_appearances(
        &mut self,
        device: &Device,
        appearances: &[Appearance],
    ) -> Result<(), RenderError> {
        // Zeroed, a view has neither an exposure nor an overlay.
        let mut slots = [layout::CameraAppearance::zeroed(); MAX_VIEWS];
        let mut overlays: Vec<Arc<Overlay>> = Vec::new();
        let mut bytes = 0;
        for (slot, Appearance { exposure, overlay }) in slots.iter_mut().zip(appearances) {
            if let Some(Exposure { matrix, offset }) = exposure {
                let row = |c: usize| {
                    let [r, g, b] = matrix[c].map(|value| value as f32);
                    [r, g, b, offset[c] as f32]
                };
                slot.has_exposure = 1;
                slot.exposure = [row(0), row(1), row(2)];
            }
            if let Some(overlay) = overlay {
                slot.overlay_px = overlay.size_px();
                // The shader counts pixels of four bytes.
                slot.first_overlay = (bytes / 4) as u32;
                bytes += overlay.rgba8().len();
                overlays.push(overlay.clone());
            }
        }
        let limit = device.binding_bytes();
        if bytes as u64 > limit {
            let what = "bytes of overlays in one binding of the GPU";
            return Err(RenderError::TooMany { what, limit });
        }
        self.appearances.fill(device, bytemuck::cast_slice(&slots));
        let is_same = |(one, other): (&Arc<Overlay>, &Arc<Overlay>)| Arc::ptr_eq(one, other);
        let held = &self.overlays;
        // A zip ends with the shorter list, so the lengths are compared, too.
        if overlays.len() != held.len() || !overlays.iter().zip(held).all(is_same) {
            let pixels: Vec<u8> = overlays.iter().flat_map(|o| o.rgba8()).copied().collect();
            self.overlay_pixels.fill(device, &pixels);
            self.overlays = overlays;
        }
        Ok(())
    }

    /// The variant of `rasterize` that the frame needs.
    pub(super) fn shader(&self) -> BackgroundShader {
        match (self.has_network(), self.has_lenses) {
            (false, false) => BackgroundShader::Map,
            (true, false) => BackgroundShader::Network,
            (false, true) => BackgroundShader::MapLens,
            (true, true) => BackgroundShader::NetworkLens,
        }
    }

    /// Whether a view of the frame has a lens or a rolling shutter.
    pub(super) fn has_lenses(&self) -> bool {
        self.has_lenses
    }

    /// The resources of `shaders/background.wgsl`, by binding number.
    pub(super) fn bind(&self) -> [(u32, BindingResource<'_>); 4] {
        [
            (8, self.parameters.bind()),
            (9, self.sky_values.bind()),
            (10, self.appearances.bind()),
            (11, self.overlay_pixels.bind()),
        ]
    }

    /// Most loop iterations that the background takes of a thread. The end of a loop counts as one,
    /// and so does a loop that no thread of a vector enters.
    ///
    /// Inverting a lens takes up to 504 for each of four pixels, and an overlay 5. A network is
    /// evaluated by all threads for each of the tile's 64 groups of four pixels; a layer takes an
    /// iteration for each four of its inputs, and one for each 64 of its outputs.
    pub(super) fn iterations(&self) -> u64 {
        let rays = if self.has_lenses { 4 * 504 + 6 } else { 0 };
        let overlay = 5;
        let sky = match &self.sky {
            Some(DrawableSky::Network(network)) => {
                let width = network.width() as u64;
                let encoded = network.encoded() as u64;
                let outputs_per_thread = width.div_ceil(64);
                let inputs = encoded.div_ceil(4) + (width + encoded).div_ceil(4);
                64 * (10 + outputs_per_thread * (4 + inputs) + width / 4) + 7
            }
            _ => 5,
        };
        rays + sky + overlay
    }

    fn has_network(&self) -> bool {
        matches!(self.sky, Some(DrawableSky::Network(_)))
    }
}

fn set_network(parameters: &mut layout::Background, network: &InferenceNetwork) {
    parameters.width = network.width() as u32;
    parameters.octaves = network.octaves() as u32;
    parameters.encoded = network.encoded() as u32;
    parameters.identity = network.identity().into();
    parameters.skip = network.skip().into();
}
