//! Exposure and overlay of one camera: the second part of stage resolve, for cameras that have
//! them.

use fearless_simd::{f32x16, prelude::*};

use super::lanes::{Vec3x16, splats};
use super::resolve::{TilePixels, TileSums, block_corner};
use crate::constants::BLOCK_PX;
use wildcity_scene::appearance::{Appearance, Exposure, Overlay};
use wildcity_scene::chunk::LANES;

/// Applies exposure, then the overlay, to the colours of the pixels of a tile.
#[inline(always)]
pub(super) fn apply<S: Simd>(
    simd: S,
    appearance: &Appearance,
    pixels: &TilePixels,
    sums: &mut TileSums,
) {
    let at_px = pixels.at_px;
    for &block in pixels.blocks {
        let load = |c: usize| f32x16::load_array_ref(simd, &sums.rgb[c][block]);
        let mut rgb = Vec3x16 { x: load(0), y: load(1), z: load(2) };
        // The order is that of the camera: the sensor's exposure, then what lies over the image.
        if let Some(exposure) = &appearance.exposure {
            rgb = expose(simd, exposure, rgb);
        }
        if let Some(overlay) = &appearance.overlay {
            let [left, top] = block_corner(block);
            rgb = blend_overlay(simd, overlay, [at_px[0] + left, at_px[1] + top], rgb);
        }
        rgb.x.store_array(&mut sums.rgb[0][block]);
        rgb.y.store_array(&mut sums.rgb[1][block]);
        rgb.z.store_array(&mut sums.rgb[2][block]);
    }
}

/// `matrix rgb + offset`.
#[inline(always)]
fn expose<S: Simd>(simd: S, exposure: &Exposure, rgb: Vec3x16<S>) -> Vec3x16<S> {
    let mut exposed = [f32x16::splat(simd, 0.0); 3];
    for (c, channel) in exposed.iter_mut().enumerate() {
        let [r, g, b] = exposure.matrix[c];
        let [r, g, b, offset] =
            splats(simd, [r as f32, g as f32, b as f32, exposure.offset[c] as f32]);
        *channel = r.mul_add(rgb.x, g.mul_add(rgb.y, b.mul_add(rgb.z, offset)));
    }
    let [x, y, z] = exposed;
    Vec3x16 { x, y, z }
}

/// Blends the overlay over the block with its top left pixel at `at_px`:
/// `(1 - alpha) rgb + alpha color`.
#[inline(always)]
fn blend_overlay<S: Simd>(
    simd: S,
    overlay: &Overlay,
    at_px: [u32; 2],
    rgb: Vec3x16<S>,
) -> Vec3x16<S> {
    let [width, height] = overlay.size_px();
    let mut over = [[0.0; LANES]; 4];
    for lane in 0..LANES as u32 {
        let x = at_px[0] + lane % BLOCK_PX;
        let y = at_px[1] + lane / BLOCK_PX;
        // The last tiles of a row or column reach beyond the image.
        if x < width && y < height {
            let first = 4 * (y as usize * width as usize + x as usize);
            let pixel = &overlay.rgba8()[first..first + 4];
            for (channel, &value) in over.iter_mut().zip(pixel) {
                channel[lane as usize] = f32::from(value);
            }
        }
    }
    let splat = |value: f32| f32x16::splat(simd, value);
    // Lanes outside of the image have alpha 0 and remain as they are.
    let load = |c: usize| f32x16::load_array_ref(simd, &over[c]) * splat(1.0 / 255.0);
    let alpha = load(3);
    let color = Vec3x16 { x: load(0), y: load(1), z: load(2) };
    rgb.mul_add(splat(1.0) - alpha, color.scale(alpha))
}
