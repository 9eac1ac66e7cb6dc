//! The images that a loss is a function of, and its derivatives by them as the device reads them.

use rayon::prelude::*;

use crate::Target;
use crate::constants::TILE_PX;
use crate::gpu::layout::FrameView;
use crate::gpu::resolve::Pixels;
use crate::gradient::GaussianImages;

/// Pixels of a tile.
const PLANE: usize = (TILE_PX * TILE_PX) as usize;

/// Values of a tile: planes of the derivatives by red, green, blue and the sum of depths, and of
/// what the image as a whole changes of the loss.
pub(super) const TILE_DERIVATIVES: usize = 5 * PLANE;

/// The images of a view.
pub(in crate::gpu) fn images(pixels: &Pixels<'_>, view: &FrameView, depth: bool) -> GaussianImages {
    let count = view.size_px.iter().map(|&px| px as usize).product::<usize>();
    let mut rgba = vec![0.0; 4 * count];
    let mut depth_m = vec![0.0; if depth { count } else { 0 }];
    let mut target = Target {
        rgba: Some(&mut rgba),
        depth_m: depth.then_some(&mut depth_m),
        ..Target::default()
    };
    pixels.copy_to(view, false, &mut target);
    let (colors, _) = rgba.as_chunks::<4>();
    // The device divides by the opacity.
    depth_m.iter_mut().zip(colors).for_each(|(depth_m, color)| *depth_m *= color[3]);
    GaussianImages {
        rgb: colors.iter().flat_map(|color| [color[0], color[1], color[2]]).collect(),
        opacity: colors.iter().map(|color| color[3]).collect(),
        depth_sum_m: depth_m,
    }
}

/// The derivatives by the pixels of all tiles, view by view. Beyond an image they are 0.
pub(in crate::gpu) fn pack(
    views: &[FrameView],
    images: &[GaussianImages],
    by_images: &[GaussianImages],
) -> Vec<f32> {
    let mut all = Vec::new();
    for ((view, images), by) in views.iter().zip(images).zip(by_images) {
        let first = all.len();
        let tiles = (view.columns * (view.rows[1] - view.rows[0])) as usize;
        all.resize(first + tiles * TILE_DERIVATIVES, 0.0);
        all[first..].par_chunks_mut(TILE_DERIVATIVES).enumerate().for_each(|(tile, values)| {
            pack_tile(view, tile, images, by, values);
        });
    }
    all
}

fn pack_tile(
    view: &FrameView,
    tile: usize,
    images: &GaussianImages,
    by: &GaussianImages,
    values: &mut [f32],
) {
    let [width, height] = view.size_px.map(|px| px as usize);
    let columns = view.columns as usize;
    let edge = TILE_PX as usize;
    let left = tile % columns * edge;
    let top = tile / columns * edge;
    // A tile begins within the image, so neither difference wraps around.
    for y in 0..edge.min(height - top) {
        for x in 0..edge.min(width - left) {
            let pixel = (top + y) * width + left + x;
            let at = y * edge + x;
            let transmittance = 1.0 - images.opacity[pixel];
            // Opacity is 1 - T, so a derivative by it is one by T with the other sign.
            let mut whole = -transmittance * by.opacity[pixel];
            for channel in 0..3 {
                let by_channel = by.rgb[3 * pixel + channel];
                values[channel * PLANE + at] = by_channel;
                whole += images.rgb[3 * pixel + channel] * by_channel;
            }
            if let Some(by_depth) = by.depth_sum_m.get(pixel) {
                values[3 * PLANE + at] = *by_depth;
                whole += images.depth_sum_m[pixel] * by_depth;
            }
            values[4 * PLANE + at] = whole;
        }
    }
}
