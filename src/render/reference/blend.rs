//! Stage rasterize by definition: every pixel against every splat, from front to back.

use glam::{DVec2, DVec3};

use super::project::Splat;
use crate::samples::most_frequent;
use wildcity_scene::{RenderProfile, SemanticClass};

/// Accumulated values of a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pixel {
    /// Linear premultiplied colour on black.
    pub(super) rgb: DVec3,
    /// Share of the background that is visible.
    pub(super) transmittance: f64,
    /// Depth weighted by contribution, in metres.
    pub(super) depth_m: f64,
    /// The owner of the splat that brought the transmittance to a half or less; 0 if none has.
    pub(super) instance: u16,
    /// The class of that splat.
    pub(super) class: SemanticClass,
}

/// One row of pixels, from the left.
///
/// Splats that reach alpha_cut nowhere in the row are left out first: the image is the same, and
/// takes a twentieth of the time.
pub(super) fn row(splats: &[Splat], row: u32, width: usize, profile: &RenderProfile) -> Vec<Pixel> {
    let y_px = f64::from(row) + 0.5;
    // A splat's box contains all places where it reaches the cut.
    let near_row = |splat: &&Splat| reaches(splat.mean_px.y - y_px, splat.reach_px.y);
    let here: Vec<Splat> = splats.iter().filter(near_row).copied().collect();
    (0..width).map(|column| pixel(&here, DVec2::new(column as f64 + 0.5, y_px), profile)).collect()
}

/// A row of pixels with 2 x 2 samples each, from the rows of their samples.
pub(super) fn means(upper: &[Pixel], lower: &[Pixel]) -> Vec<Pixel> {
    let rows = upper.chunks_exact(2).zip(lower.chunks_exact(2));
    rows.map(|(upper, lower)| Pixel::mean([upper[0], upper[1], lower[0], lower[1]])).collect()
}

/// Whether a splat may reach alpha_cut at this distance along one axis.
fn reaches(distance_px: f64, reach_px: f64) -> bool {
    distance_px.abs() <= reach_px + 1e-6
}

/// One pixel: Kerbl et al. 2023, eq. 3, with the cap, the cut and the stop of the profile.
fn pixel(splats: &[Splat], at_px: DVec2, profile: &RenderProfile) -> Pixel {
    let mut pixel = Pixel::EMPTY;
    for splat in splats {
        let d = at_px - splat.mean_px;
        // As in the row: the image is the same, and most exponential functions are left out.
        if !reaches(d.x, splat.reach_px.x) {
            continue;
        }
        // -q/2 with the inverse covariance (xx, xy, yy).
        let power = -0.5 * (splat.conic.x * d.x * d.x + splat.conic.z * d.y * d.y)
            - splat.conic.y * d.x * d.y;
        if !pixel.add(splat.opacity * power.exp(), splat, profile) {
            break;
        }
    }
    pixel
}

impl Pixel {
    /// Before any splat is blended.
    pub(super) const EMPTY: Self = Self {
        rgb: DVec3::ZERO,
        transmittance: 1.0,
        depth_m: 0.0,
        instance: 0,
        class: SemanticClass::None,
    };

    /// The mean of a pixel's samples; its owner is that of most.
    fn mean(samples: [Self; 4]) -> Self {
        let mean = |value: fn(&Self) -> f64| samples.iter().map(value).sum::<f64>() / 4.0;
        Self {
            rgb: samples.iter().map(|sample| sample.rgb).sum::<DVec3>() / 4.0,
            transmittance: mean(|sample| sample.transmittance),
            depth_m: mean(|sample| sample.depth_m),
            instance: most_frequent(samples.map(|sample| sample.instance)),
            class: most_frequent(samples.map(|sample| sample.class)),
        }
    }

    /// Blends the next splat, with its alpha before the cap. Returns false if the pixel stops
    /// before it.
    pub(super) fn add(&mut self, alpha: f64, splat: &Splat, profile: &RenderProfile) -> bool {
        let alpha = alpha.min(profile.alpha_cap);
        // Negated comparison: a NaN does not touch.
        let touches = alpha >= profile.alpha_cut;
        if !touches {
            return true;
        }
        let after = self.transmittance * (1.0 - alpha);
        // The splat that would end the pixel is not blended itself (Kerbl et al. 2023).
        if after <= profile.stop {
            return false;
        }
        let weight = self.transmittance * alpha;
        self.rgb += weight * splat.rgb;
        self.depth_m += weight * splat.depth_m;
        if self.transmittance > 0.5 && after <= 0.5 {
            self.instance = splat.instance;
            self.class = splat.class;
        }
        self.transmittance = after;
        true
    }
}
