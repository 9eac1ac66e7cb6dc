//! Flicker: the difference between an image and the one before it, brought into its view.

use std::sync::Arc;

use wildcity_render::View;
use wildcity_repair::Image;
use wildcity_repair::reference::{Projection, Rays, Reference, WarpTarget, warp};

/// What flicker is measured by: depths, which are those of the rendered images whatever is done to their pixels.
pub(super) struct FlickerPair<'a> {
    /// This frame and the one before it.
    pub(super) views: [&'a View; 2],
    /// Their depth in metres, 0 where there is none ([`wildcity_repair::reference::opaque_depth`]).
    pub(super) depth_m: [&'a [f32]; 2],
    pub(super) projection: &'a Arc<Projection>,
    pub(super) rays: &'a Rays,
}

impl FlickerPair<'_> {
    /// The flicker of two images; `None` if no pixel of the earlier one is in the later one.
    pub(super) fn of(&self, [now, before]: [&[u8]; 2]) -> Option<f64> {
        let [view, view_before] = self.views;
        let width = view.camera.width_px as usize;
        let height = view.camera.height_px as usize;
        let earlier = Reference {
            image: Image { width, height, rgb8: before.to_vec() },
            depth_m: self.depth_m[1].to_vec(),
            projection: self.projection.clone(),
            world_from_camera: view_before.world_from_camera,
        };
        let shutter = view.rolling_shutter.as_ref();
        let target = WarpTarget {
            camera: &view.camera,
            rays: self.rays,
            world_from_camera: view.world_from_camera,
            shutter: shutter.map(|shutter| (shutter.direction, shutter.world_from_camera_first)),
            depth_m: self.depth_m[0],
        };
        let warped = warp(&target, &[Arc::new(earlier)]);
        flicker(now, &warped.image.rgb8, &warped.valid)
    }
}

/// Mean abs(R_t - W(R_t-1)) over the channels of the pixels where W is valid (above 0): two images of 8 bits,
/// `[height, width, 3]`, as values from 0 to 1. `None` if no pixel is valid.
pub fn flicker(now: &[u8], before_in_view: &[u8], valid: &[f32]) -> Option<f64> {
    let mut sum = 0_u64;
    let mut count = 0_u64;
    let pixels = now.chunks_exact(3).zip(before_in_view.chunks_exact(3));
    for ((now, before), _) in pixels.zip(valid).filter(|(_, valid)| **valid > 0.0) {
        sum += now.iter().zip(before).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
        count += 3;
    }
    (count > 0).then(|| sum as f64 / (255.0 * count as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_valid_pixels_count() {
        let now = [10, 20, 30, 255, 255, 255];
        let before = [13, 20, 24, 0, 0, 0];
        let value = flicker(&now, &before, &[1.0, 0.0]).unwrap();
        assert!((value - 9.0 / (3.0 * 255.0)).abs() < 1e-12, "{value}");
        assert_eq!(flicker(&now, &before, &[0.0, 0.0]), None);
        let both = flicker(&now, &before, &[1.0, 1.0]).unwrap();
        assert!((both - (9.0 + 765.0) / (6.0 * 255.0)).abs() < 1e-12, "{both}");
    }
}
