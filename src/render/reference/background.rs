//! The background by definition: the sky is evaluated for each pixel, never looked up in a map.

use glam::{DVec2, DVec3};

use super::blend::Pixel;
use crate::{Frame, View};
use wildcity_scene::sky::SKY_CUT;

/// Adds the sky, or the profile's background if there is none, to one row of pixels.
pub(super) fn add(frame: &Frame<'_>, view: &View, row: u32, pixels: &mut [Pixel]) {
    for (column, pixel) in pixels.iter_mut().enumerate() {
        let at_px = DVec2::new(column as f64 + 0.5, f64::from(row) + 0.5);
        let Some(ray) = view.ray_world(at_px) else { continue };
        // The cut is a part of the definition, since all backends omit the sky there.
        if pixel.transmittance >= SKY_CUT {
            let background = match &frame.scene.sky {
                Some(sky) => sky.rgb(ray),
                None => DVec3::from_array(frame.profile.background),
            };
            pixel.rgb += pixel.transmittance * background;
        }
    }
}
