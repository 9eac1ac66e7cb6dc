//! Contact with the twin's own Gaussians: `wildcity.static@1`.
//!
//! HUGSIM counts Gaussians, but a count depends on how densely a scene was trained. The area of
//! their largest cross-sections does not: splitting a Gaussian in four of half the size leaves it
//! as it was.

use std::f64::consts::PI;

use glam::DVec3;

/// Least opacity of a Gaussian that counts.
pub const SOLID_OPACITY: f64 = 0.5;
/// How much smaller than the ego's box the tested box is on each side, in metres, because the edge
/// of a surface is blurred.
pub const SIDE_MARGIN_M: f64 = 0.1;
/// Height above the ground from which Gaussians count, in metres: kerbs are driven over.
pub const GROUND_MARGIN_M: f64 = 0.3;
/// Area that is always free, in m²: a few floaters.
pub const FREE_AREA_M2: f64 = 0.05;

/// A Gaussian of the twin in the axes of the ego's box: x forward and y left of its centre, z above
/// the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolidPoint {
    /// Its centre, in metres.
    pub mean_m: DVec3,
    /// Its standard deviations, in metres, in any order.
    pub sigma_m: DVec3,
    /// Its opacity, 0 to 1.
    pub opacity: f64,
}

/// The area of Gaussians in the ego's box that counts as a contact.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StaticLimit {
    /// The largest area of Gaussians inside the ego's box on the recorded drives near by, in m²; 0
    /// if there is none. The recorded car drove there, so this much area is no obstacle.
    pub most_on_drive_m2: f64,
}

impl SolidPoint {
    /// Opacity times the area of the ellipse of its two longest axes, in m².
    pub fn area_m2(&self) -> f64 {
        let [a, b, c] = self.sigma_m.to_array();
        // The product of the two longest is the largest product of two.
        let longest = (a * b).max(a * c).max(b * c);
        self.opacity * PI * longest
    }

    /// Whether it counts for a box of length, width and height, in metres.
    pub fn is_in(&self, size_m: DVec3) -> bool {
        self.opacity >= SOLID_OPACITY && is_in_tested_box(self.mean_m, size_m)
    }
}

/// Whether a centre in the axes of the ego's box lies in the part of the box that is tested.
pub(super) fn is_in_tested_box(mean_m: DVec3, size_m: DVec3) -> bool {
    let DVec3 { x, y, z } = mean_m;
    // The box is symmetric in x and y, but its height counts from the ground: z has its own range.
    let within_length = x.abs() <= 0.5 * size_m.x - SIDE_MARGIN_M;
    let within_width = y.abs() <= 0.5 * size_m.y - SIDE_MARGIN_M;
    let within_height = (GROUND_MARGIN_M..=size_m.z).contains(&z);
    within_length && within_width && within_height
}

/// The area of the Gaussians in a box of length, width and height (metres), in m².
pub fn solid_area_m2(points: impl IntoIterator<Item = SolidPoint>, size_m: DVec3) -> f64 {
    points.into_iter().filter(|point| point.is_in(size_m)).map(|point| point.area_m2()).sum()
}

impl StaticLimit {
    /// The largest area without contact, in m².
    pub fn area_m2(&self) -> f64 {
        FREE_AREA_M2.max(2.0 * self.most_on_drive_m2)
    }

    /// Whether an area is a contact.
    pub fn is_exceeded_by(&self, area_m2: f64) -> bool {
        area_m2 > self.area_m2()
    }
}
