//! The flicker of rendered and repaired images: the previous one is warped into the view by
//! rendered depth.

use std::sync::Arc;

use wildcity_render::View;
use wildcity_render::compare::flicker::flicker;
use wildcity_repair::Image;
use wildcity_repair::reference::{Projection, Rays, Reference, WarpTarget, warp};

/// Two frames in a row. Their depth is that of the rendered images, also if the pixels are
/// repaired.
pub(super) struct FlickerPair<'a> {
    /// This frame and the previous one.
    pub(super) views: [&'a View; 2],
    /// Their depth in metres, 0 where there is none ([`wildcity_repair::reference::opaque_depth`]).
    pub(super) depth_m: [&'a [f32]; 2],
    pub(super) projection: &'a Arc<Projection>,
    pub(super) rays: &'a Rays,
}

impl FlickerPair<'_> {
    /// The flicker of two images; `None` if no pixel of the earlier one is in the later one.
    pub(super) fn flicker(&self, [now, before]: [&[u8]; 2]) -> Option<f64> {
        let [view, view_before] = self.views;
        let width = view.camera.width_px as usize;
        let height = view.camera.height_px as usize;
        // The earlier frame as the only reference of the later one: the warp is that of repair.
        let earlier = Reference {
            image: Image { width, height, rgb8: before.to_vec() },
            depth_m: self.depth_m[1].to_vec(),
            projection: self.projection.clone(),
            world_from_camera: view_before.world_from_camera,
        };
        // The shutter of the later view only: the earlier image is taken as exposed at its end.
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
