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
/// Number of points of a corner's arc that are tested against the lanes.
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
    pub fn new(shape: &EgoShape, sample: &EgoSample) -> Self {
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

    /// Points of its outline, in metres: five of each corner's arc, 22.5 degrees apart, and those
    /// of the sides between, no farther apart than `spacing_m`.
    pub fn outline_m(&self, spacing_m: f64) -> Vec<DVec2> {
        let centers_m = self.core.corners_m();
        let arcs = (0..4 * ARC_POINTS).map(|k| {
            let center_m = centers_m[k / ARC_POINTS];
            // The signs of the corner's direction turn one formula into four.
            let out = center_m - self.core.center_m;
            let along = self.core.forward * out.dot(self.core.forward).signum();
            let aside = self.core.left() * out.dot(self.core.left()).signum();
            let angle_rad = FRAC_PI_2 * (k % ARC_POINTS) as f64 / (ARC_POINTS - 1) as f64;
            center_m + self.radius_m * (angle_rad.cos() * along + angle_rad.sin() * aside)
        });
        let Footprint { center_m, forward, length_m, width_m } = self.core;
        let left = self.core.left();
        // The vector along each side, and the vector from the centre to its middle.
        // A side of the core, moved outwards by the radius, is a side of the rounded box.
        let along = [length_m * forward, (0.5 * width_m + self.radius_m) * left];
        let across = [width_m * left, (0.5 * length_m + self.radius_m) * forward];
        let sides = [along, across].into_iter().flat_map(|[way_m, out_m]| {
            // `spacing_m` above the side gives one interval, and no point between the arcs.
            let count = (way_m.length() / spacing_m).ceil() as usize;
            let shares = (1..count).map(move |k| k as f64 / count as f64 - 0.5);
            shares.flat_map(move |share| [-1.0, 1.0].map(|sign| share * way_m + sign * out_m))
        });
        arcs.chain(sides.map(|from_center_m| center_m + from_center_m)).collect()
    }

    /// Largest distance of its points from its centre, in metres.
    pub fn reach_m(&self) -> f64 {
        0.5 * self.outline.length_m.hypot(self.outline.width_m)
    }

    /// Whether a point lies in the box.
    pub fn holds(&self, point_m: DVec2) -> bool {
        // The rounded box is all points within the radius of its core.
        self.core.distance_to_m(point_m) <= self.radius_m
    }

    /// The distance from another box, in metres; 0 if they touch.
    pub fn distance_m(&self, other: &Footprint) -> f64 {
        (self.core.distance_m(other) - self.radius_m).max(0.0)
    }

    /// Its box before the corners are rounded.
    pub fn outline(&self) -> &Footprint {
        &self.outline
    }
}
