//! Lenses beyond the end of their field, where they are continued linearly in the angle
//! ([`Camera::project_extrapolated`](wildcity_scene::geometry::Camera::project_extrapolated)).

use fearless_simd::{f32x16, prelude::*};

use crate::cpu::math::atan2;

/// The distance from the principal point beyond an angle off the axis: a line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tangent {
    /// `tan(θ/2)` where the line begins.
    begin: f32,
    /// The distance at the start of the line.
    radius: f32,
    /// The change of the distance per radian.
    per_rad: f32,
}

impl Tangent {
    /// The tangent of half of [`WIDEST_RAD`](wildcity_scene::geometry::camera::WIDEST_RAD).
    const WIDEST: f32 = 5.797_884;

    /// A line that begins at an angle off the axis, with the distance there and its change per
    /// radian.
    pub(super) fn new(begin_rad: f64, radius: f64, per_rad: f64) -> Self {
        let begin = (0.5 * begin_rad).tan() as f32;
        Self { begin, radius: radius as f32, per_rad: per_rad as f32 }
    }

    /// Distances at angles with `t = tan(θ/2)`, beyond the start of the line.
    ///
    /// With u the tangent of half the angle from the start, that half has the sine `u/√(1 + u²)`
    /// and the cosine `1/√(1 + u²)`.
    #[inline(always)]
    pub(super) fn radius<S: Simd>(&self, simd: S, t: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let one = splat(1.0);
        // tan(a - b) = (tan a - tan b)/(1 + tan a tan b), for half angles.
        let u = (t - splat(self.begin)) / t.mul_add(splat(self.begin), one);
        let cosine = one / u.mul_add(u, one).sqrt();
        let half_rad = atan2(simd, u * cosine, cosine);
        (half_rad + half_rad).mul_add(splat(self.per_rad), splat(self.radius))
    }

    /// The change per radian.
    #[inline(always)]
    pub(super) fn per_rad(&self) -> f32 {
        self.per_rad
    }

    /// Not below 0 up to the widest angle; below 0 for a NaN.
    #[inline(always)]
    pub(super) fn margin<S: Simd>(simd: S, t: f32x16<S>) -> f32x16<S> {
        let widest = f32x16::splat(simd, Self::WIDEST);
        // A select, since the difference with a NaN is a NaN and `margin >= 0` must be false.
        t.simd_le(widest).select(widest - t, f32x16::splat(simd, -1.0))
    }

    /// Lower bound of the angle by which `t = tan(θ/2)` is beyond the start of the line, in
    /// radians: below 0 before it. `dt/dθ` is `(1 + t²)/2`.
    #[inline(always)]
    pub(super) fn past_begin_rad<S: Simd>(&self, simd: S, t: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let rise = t.mul_add(t, splat(1.0));
        (t - splat(self.begin)) * splat(2.0) / rise
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};
    use wildcity_scene::geometry::camera::WIDEST_RAD;

    #[test]
    fn a_line_is_straight_in_the_angle() {
        // A line from 300 px at 1.2 rad, with 250 px per radian. At its end, 700 px, f32
        // resolves 6e-5 px.
        let tangent = Tangent::new(1.2, 300.0, 250.0);
        for step in 0..=100 {
            let rad = 1.2 + (WIDEST_RAD - 1e-4 - 1.2) * f64::from(step) / 100.0;
            let t = (0.5 * rad).tan() as f32;
            let [radius, margin, past_rad] = dispatch!(Level::new(), simd => {
                let t = f32x16::splat(simd, t);
                [tangent.radius(simd, t), Tangent::margin(simd, t), tangent.past_begin_rad(simd, t)]
                    .map(|value| f64::from(value.to_array()[0]))
            });
            let line = 300.0 + 250.0 * (rad - 1.2);
            assert!((radius - line).abs() < 5e-4, "{rad} rad: {radius} instead of {line}");
            assert!(margin >= 0.0, "{rad} rad");
            // A lower bound: dt/dtheta at the end of the interval is the largest within it.
            assert!(past_rad <= rad - 1.2 + 1e-5, "{rad} rad: {past_rad}");
        }
        let beyond = dispatch!(Level::new(), simd => {
            let t = (0.5 * WIDEST_RAD + 1e-4).tan() as f32;
            Tangent::margin(simd, f32x16::splat(simd, t)).to_array()[0]
        });
        assert!(beyond < 0.0);
    }
}
