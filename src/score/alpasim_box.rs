//! The ego's box, as AlpaSim tests it.
//!
//! Source: NVlabs/alpasim 3032e0c, `src/wizard/configs/base_config.yaml`.

use std::f64::consts::FRAC_PI_2;

use glam::DVec2;

use wildcity_sim::contact::Footprint;

use super::record::{EgoSample, EgoShape};

/// Share of the rig's box that is tested.
const BOX_SHARE: f64 = 0.98;
/// Radius of its corners, as a share of the lesser side.
const CORNER_SHARE: f64 = 0.25;
/// Points of a corner's arc at which it is held against the lanes.
const ARC_POINTS: usize = 5;

/// The ego as AlpaSim tests it: 2 % smaller, with rounded corners.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoundedBox {
    outline: Footprint,
    /// The box whose points are all within `radius_m` of the rounded one.
    core: Footprint,
    radius_m: f64,
}

impl RoundedBox {
    /// The box of an ego at a sample.
    pub fn of(shape: &EgoShape, sample: &EgoSample) -> Self {
        let full = shape.footprint(sample);
        let length_m = BOX_SHARE * full.length_m;
        let width_m = BOX_SHARE * full.width_m;
        let radius_m = CORNER_SHARE * length_m.min(width_m);
        let outline = Footprint { length_m, width_m, ..full };
        let core = Footprint {
            length_m: length_m - 2.0 * radius_m,
            width_m: width_m - 2.0 * radius_m,
            ..full
        };
        Self { outline, core, radius_m }
    }

    /// Its centre, in metres.
    pub fn center_m(&self) -> DVec2 {
        self.outline.center_m
    }

    /// Points of its outline, in metres: five of each corner's arc, 22.5 degrees apart.
    pub fn outline_m(&self) -> [DVec2; 4 * ARC_POINTS] {
        let centers_m = self.core.corners_m();
        std::array::from_fn(|k| {
            let center_m = centers_m[k / ARC_POINTS];
            let out = center_m - self.core.center_m;
            let along = self.core.forward * out.dot(self.core.forward).signum();
            let aside = self.core.left() * out.dot(self.core.left()).signum();
            let angle_rad = FRAC_PI_2 * (k % ARC_POINTS) as f64 / (ARC_POINTS - 1) as f64;
            center_m + self.radius_m * (angle_rad.cos() * along + angle_rad.sin() * aside)
        })
    }

    /// Its distance from another box, in metres; 0 if they touch.
    pub fn distance_m(&self, other: &Footprint) -> f64 {
        (self.core.distance_m(other) - self.radius_m).max(0.0)
    }

    /// Its box before the corners are rounded.
    pub fn outline(&self) -> &Footprint {
        &self.outline
    }
}
