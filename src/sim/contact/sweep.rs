//! When two footprints that move at constant velocity, without turning, overlap.

use glam::DVec2;

use super::footprint::{Footprint, TOUCH_M};

/// A footprint and its velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moving {
    /// The box at time zero.
    pub footprint: Footprint,
    /// Its velocity, in m/s.
    pub velocity_mps: DVec2,
}

/// The times at which two boxes overlap, in seconds from now, as [first, last]; the past is
/// negative. `None` if they never do. Boxes that overlap and do not move against each other do so
/// from -infinity to infinity.
///
/// On each axis, the distance of the centres is linear in time, so the boxes overlap on it within
/// one interval. They overlap while they do on all four axes: the intersection of these intervals,
/// in closed form.
pub fn overlap_s(a: &Moving, b: &Moving) -> Option<[f64; 2]> {
    let apart_m = b.footprint.center_m - a.footprint.center_m;
    let closing_mps = b.velocity_mps - a.velocity_mps;
    let mut first_s = f64::NEG_INFINITY;
    let mut last_s = f64::INFINITY;
    for axis in a.footprint.axes_with(&b.footprint) {
        // Along an axis the boxes overlap while `|along + rate t| <= reach`. This is an interval of
        // t.
        let along_m = apart_m.dot(axis);
        let rate_mps = closing_mps.dot(axis);
        let reach_m = a.footprint.radius_m(axis) + b.footprint.radius_m(axis) + TOUCH_M;
        // Slower than 1e-12 m/s is a rounding error of velocities of 1e3 m/s, and moves nothing in
        // an hour.
        if rate_mps.abs() < 1e-12 {
            // The distance on this axis is constant: it separates the boxes at all times, or at
            // none.
            if along_m.abs() > reach_m {
                return None;
            }
            continue;
        }
        let times_s = [(-reach_m - along_m) / rate_mps, (reach_m - along_m) / rate_mps];
        // A negative rate swaps the two ends of the interval.
        first_s = first_s.max(times_s[0].min(times_s[1]));
        last_s = last_s.min(times_s[0].max(times_s[1]));
    }
    (first_s <= last_s).then_some([first_s, last_s])
}

/// The time until two boxes touch, in seconds; 0 if they do now, `None` if they never will. Without
/// a velocity against each other there is no such time.
pub fn time_to_contact_s(a: &Moving, b: &Moving) -> Option<f64> {
    let [first_s, last_s] = overlap_s(a, b)?;
    // An overlap that has begun is a contact now. One that has ended is past.
    (last_s >= 0.0).then_some(first_s.max(0.0))
}
