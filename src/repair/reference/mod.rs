//! Warps recorded images into a view by depth (roles `reference_warped`, `reference_valid`).
//!
//! A pixel of the view is unprojected by its rendered depth to a point, and the point is projected
//! into each reference. The reference fits if the point is within its image and the depth that was
//! rendered there equals that of the point to within 0.2 m + 5 %. Of the references that fit, the
//! one that sees the point from the most similar direction gives the colour. Pixels that no
//! reference has seen stay black, and are not valid.
//!
//! The source of the references does not matter. All arithmetic is f32 after the poses were
//! subtracted, without fused operations, so the same input gives the same bytes on every processor.

mod cache;
mod lanes;
mod projection;
mod rays;
mod warp;

pub use cache::{DEFAULT_BYTES, ReferenceCache, ReferenceKey};
pub use projection::Projection;
pub use rays::Rays;
pub use warp::{Reference, WarpTarget, Warped, overlaps, warp};

use crate::image::Image;
use crate::resample::{Kernel, resample};
use crate::roles;

/// Pixels with less opacity than this have no depth.
pub const LEAST_OPACITY: f32 = 0.5;

/// Resamples an image to another size by Lanczos 3, for the role `reference`.
pub fn resized(image: &Image, width: usize, height: usize) -> Image {
    if [image.width, image.height] == [width, height] {
        return image.clone();
    }
    let planes = resample(&roles::rgb(image), height, width, Kernel::Lanczos3);
    let mut rgb8 = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        for x in 0..width {
            // The cast saturates where Lanczos overshoots.
            rgb8.extend([0, 1, 2].map(|channel| planes.at(channel, y, x).round() as u8));
        }
    }
    Image { width, height, rgb8 }
}

/// A depth map as [`warp`] needs it: in metres, and 0 where the opacity is below [`LEAST_OPACITY`].
pub fn opaque_depth(depth_m: &[f32], opacity: &[f32]) -> Vec<f32> {
    // Below it the depth is a mean of a faint surface and of what lies behind it.
    let opaque =
        |(depth_m, opacity): (&f32, &f32)| if *opacity >= LEAST_OPACITY { *depth_m } else { 0.0 };
    depth_m.iter().zip(opacity).map(opaque).collect()
}
