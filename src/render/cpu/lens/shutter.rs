//! Rolling shutters, 16 points at a time: [`crate::View::project_extrapolated`] as seen from the
//! end of the exposure.
//!
//! Everything is relative to the camera's frame at the end of the exposure, so that f32 holds only
//! the small motion during one exposure. "Remaining" is the fraction of the exposure that is still
//! to come when a row is exposed: 1 for the first row, 0 for the last.

use fearless_simd::{f32x16, prelude::*};

use crate::cpu::lanes::{Vec3x16, splats};
use crate::cpu::math::sin;
use crate::view::ShutterMotion;

/// A shutter that rolls while the camera moves, for many points.
#[derive(Clone, Debug)]
pub(in crate::cpu) struct SimdShutter {
    remaining: [f32; 3],
    translation_world_m: [f32; 3],
    translation_m: [f32; 3],
    axis: [f32; 3],
    rotation_rad: f32,
    /// Whether the camera rotates by more than the rounding error of f32.
    rotates: bool,
}

impl SimdShutter {
    /// The largest rotation during one exposure, in radians, for which [`sin`] is accurate.
    const MAX_ROTATION_RAD: f64 = 1.5;

    /// `None` if the camera rotates by more than [`Self::MAX_ROTATION_RAD`] during the exposure.
    pub(super) fn new(motion: &ShutterMotion) -> Option<Self> {
        let ShutterMotion { remaining, translation_world_m, translation_m, axis, rotation_rad } =
            *motion;
        (rotation_rad <= Self::MAX_ROTATION_RAD).then(|| Self {
            remaining: remaining.map(|value| value as f32),
            translation_world_m: translation_world_m.as_vec3().to_array(),
            translation_m: translation_m.as_vec3().to_array(),
            axis: axis.as_vec3().to_array(),
            rotation_rad: rotation_rad as f32,
            // 1e-9 rad are 1e-7 m at 100 m, far below what f32 resolves there.
            rotates: rotation_rad > 1e-9,
        })
    }

    /// The remaining fraction when places of the image, in pixels, are exposed.
    #[inline(always)]
    pub(super) fn remaining_at<S: Simd>(
        &self,
        simd: S,
        x_px: f32x16<S>,
        y_px: f32x16<S>,
    ) -> f32x16<S> {
        let remaining = self.unclamped_remaining_at(simd, x_px, y_px);
        remaining.max(f32x16::splat(simd, 0.0)).min(f32x16::splat(simd, 1.0))
    }

    /// The remaining fraction without the limits of the exposure.
    #[inline(always)]
    pub(super) fn unclamped_remaining_at<S: Simd>(
        &self,
        simd: S,
        x_px: f32x16<S>,
        y_px: f32x16<S>,
    ) -> f32x16<S> {
        let [a, b, c] = splats(simd, self.remaining);
        x_px.mul_add(a, y_px.mul_add(b, c))
    }

    /// Change of the remaining fraction per pixel along x and along y.
    pub(super) fn remaining_per_px(&self) -> [f32; 2] {
        let [a, b, _] = self.remaining;
        [a, b]
    }

    /// The camera's rotation during the exposure, in radians.
    pub(super) fn rotation_rad(&self) -> f32 {
        self.rotation_rad
    }

    /// The motion of a point in the camera's frame, in metres per unit of the remaining fraction.
    /// `then_m` is its place in that frame while `remaining` remains.
    ///
    /// The place is `R(r) (p + r t)` with the rotation R by `r ω` about the axis k, so that its
    /// derivative is `ω k × place + R t`.
    #[inline(always)]
    pub(super) fn velocity<S: Simd>(
        &self,
        simd: S,
        then_m: Vec3x16<S>,
        remaining: f32x16<S>,
    ) -> Vec3x16<S> {
        let axis = Vec3x16::splat(simd, self.axis);
        let rotated_m = self.motion(simd, remaining);
        axis.cross(then_m).mul_add(f32x16::splat(simd, self.rotation_rad), rotated_m)
    }

    /// A bound of how much the path of a point on the image turns during the exposure, as a share
    /// of itself, by the point's distance from the camera in metres: how far the camera moves by
    /// the least distance, and how far it rotates. Infinite close to the camera.
    #[inline(always)]
    pub(super) fn turn<S: Simd>(&self, simd: S, distance_m: f32x16<S>) -> f32x16<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let [x, y, z] = self.translation_m;
        // A point at a distance d is seen under an angle that changes by at most the motion over
        // the least distance.
        let moved_m = splat((x * x + y * y + z * z).sqrt());
        let turn = moved_m / (distance_m - moved_m);
        let far = distance_m.simd_gt(splat(1.5) * moved_m);
        far.select(turn, splat(f32::INFINITY)) + splat(self.rotation_rad)
    }

    /// The camera's motion in its frame while a fraction remains, in metres per unit of that.
    #[inline(always)]
    pub(super) fn motion<S: Simd>(&self, simd: S, remaining: f32x16<S>) -> Vec3x16<S> {
        self.rotated(simd, Vec3x16::splat(simd, self.translation_m), remaining)
    }

    /// Points of the camera's frame at some moment in its frame when more of the exposure remains,
    /// `by` in units of it. `motion_m` is [`Self::motion`] at that moment.
    #[inline(always)]
    pub(super) fn later<S: Simd>(
        &self,
        simd: S,
        then_m: Vec3x16<S>,
        motion_m: Vec3x16<S>,
        by: f32x16<S>,
    ) -> Vec3x16<S> {
        // Rotations about the same axis may be exchanged.
        self.rotated(simd, motion_m.mul_add(by, then_m), by)
    }

    /// Vectors of the camera's frame at the end of the exposure, in its frame while a fraction
    /// remains.
    #[inline(always)]
    pub(in crate::cpu) fn rotated<S: Simd>(
        &self,
        simd: S,
        v: Vec3x16<S>,
        remaining: f32x16<S>,
    ) -> Vec3x16<S> {
        // Most cameras only translate, and two sines of 16 values cost more than the branch.
        if self.rotates { v.plus(self.rotation_change(simd, v, remaining)) } else { v }
    }

    /// Points of the camera's frame at the end of the exposure, in its frame while a fraction
    /// remains, in metres.
    #[inline(always)]
    pub(super) fn to_exposure_frame<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        remaining: f32x16<S>,
    ) -> Vec3x16<S> {
        let moved_m = Vec3x16::splat(simd, self.translation_m).mul_add(remaining, at_end_m);
        self.rotated(simd, moved_m, remaining)
    }

    /// The difference of the camera-space z of points while a fraction remains and at the end, in
    /// metres.
    #[inline(always)]
    pub(in crate::cpu) fn z_change<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        remaining: f32x16<S>,
    ) -> f32x16<S> {
        let translation_m = self.translation(simd, remaining);
        if !self.rotates {
            return translation_m.z;
        }
        translation_m.z + self.rotation_change(simd, at_end_m.plus(translation_m), remaining).z
    }

    /// The remaining motion of the camera's centre, in metres, in its frame at the end of the
    /// exposure.
    #[inline(always)]
    pub(in crate::cpu) fn translation<S: Simd>(&self, simd: S, remaining: f32x16<S>) -> Vec3x16<S> {
        Vec3x16::splat(simd, self.translation_m).scale(remaining)
    }

    /// The remaining motion of the camera's centre in world axes.
    #[inline(always)]
    pub(in crate::cpu) fn translation_world<S: Simd>(
        &self,
        simd: S,
        remaining: f32x16<S>,
    ) -> Vec3x16<S> {
        Vec3x16::splat(simd, self.translation_world_m).scale(remaining)
    }

    /// Directions in the camera's frame while a fraction remains, in its frame at the end.
    #[inline(always)]
    pub(super) fn direction_to_end_frame<S: Simd>(
        &self,
        simd: S,
        direction: Vec3x16<S>,
        remaining: f32x16<S>,
    ) -> Vec3x16<S> {
        // The inverse of a rotation is the one by the opposite angle.
        self.rotated(simd, direction, f32x16::splat(simd, 0.0) - remaining)
    }

    /// The change of a vector by rotation, from the frame at the end to the frame while a fraction
    /// remains; with a negative fraction, the other way.
    ///
    /// Rodrigues' formula without the vector itself: `sin θ (k × v) + (1 - cos θ) k × (k × v)`,
    /// with `1 - cos θ = 2 sin²(θ/2)`, which does not cancel for small angles.
    #[inline(always)]
    fn rotation_change<S: Simd>(&self, simd: S, v: Vec3x16<S>, remaining: f32x16<S>) -> Vec3x16<S> {
        let axis = Vec3x16::splat(simd, self.axis);
        let angle_rad = remaining * f32x16::splat(simd, self.rotation_rad);
        // The angle is at most MAX_ROTATION_RAD = 1.5, just within a quarter turn.
        let sine = sin(simd, angle_rad);
        let half = sin(simd, angle_rad * f32x16::splat(simd, 0.5));
        let across = axis.cross(v);
        across.scale(sine).plus(axis.cross(across).scale((half + half) * half))
    }
}
