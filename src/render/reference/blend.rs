//! Stage rasterize by definition: every pixel against every Gaussian, in order of depth.

use glam::{DVec2, DVec3};

use super::project::Splat;
use crate::scene::RenderProfile;

/// What a pixel has gathered.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pixel {
    /// Linear premultiplied colour on black.
    pub(super) rgb: DVec3,
    /// Share of the background that is still seen.
    pub(super) transmittance: f64,
    /// Depth weighted by contribution, in metres.
    pub(super) depth_m: f64,
}

/// One row of pixels, from the left.
///
/// Splats that cannot reach alpha_cut anywhere in the row are set aside first: the same image,
/// twenty times sooner.
pub(super) fn row(splats: &[Splat], row: u32, width: usize, profile: &RenderProfile) -> Vec<Pixel> {
    let y_px = f64::from(row) + 0.5;
    let near_row = |splat: &&Splat| (splat.mean_px.y - y_px).abs() <= splat.reach_px.y + 1e-6;
    let here: Vec<Splat> = splats.iter().filter(near_row).copied().collect();
    (0..width).map(|column| pixel(&here, DVec2::new(column as f64 + 0.5, y_px), profile)).collect()
}

/// Kerbl et al. 2023, eq. 3, with the cap, the cut and the stop of the profile.
fn pixel(splats: &[Splat], at_px: DVec2, profile: &RenderProfile) -> Pixel {
    let mut pixel = Pixel { rgb: DVec3::ZERO, transmittance: 1.0, depth_m: 0.0 };
    for splat in splats {
        let d = at_px - splat.mean_px;
        let power = -0.5 * (splat.conic.x * d.x * d.x + splat.conic.z * d.y * d.y)
            - splat.conic.y * d.x * d.y;
        let alpha = (splat.opacity * power.exp()).min(profile.alpha_cap);
        let touches = alpha >= profile.alpha_cut;
        if !touches {
            continue;
        }
        let after = pixel.transmittance * (1.0 - alpha);
        if after <= profile.stop {
            break;
        }
        let weight = pixel.transmittance * alpha;
        pixel.rgb += weight * splat.rgb;
        pixel.depth_m += weight * splat.depth_m;
        pixel.transmittance = after;
    }
    pixel
}
