//! Angles of 16 centres and their points, for the tests of [`CullBound`].

use fearless_simd::{f32x16, mask32x16, prelude::*};

use crate::cpu::lanes::{Vec3x16, splats};
use crate::cpu::lens::LensPixels;
use crate::unscented::CullBound;
use wildcity_scene::geometry::camera::WIDEST_RAD;

/// Angles in radians, widened by the errors of the approximations here.
pub(super) struct CenterAngles<S: Simd> {
    /// Distance of the centres at the end of the exposure, in metres.
    pub(super) distance_m: f32x16<S>,
    /// Least angle off the axis of the centres during the exposure.
    least: f32x16<S>,
    /// Largest angle between a centre and one of its points.
    spread: f32x16<S>,
    /// Change of this angle by the shutter, if both are exposed at different moments.
    motion: f32x16<S>,
    /// Reach of splats from the images of their centres, in pixels per radian of their points'
    /// spread.
    reach_px_per_rad: f32x16<S>,
    /// Not close to the camera, where these bounds do not hold.
    far: mask32x16<S>,
    /// No point comes near the axis' other end, where the lens is not continued.
    continued: mask32x16<S>,
}

impl<S: Simd> CenterAngles<S> {
    #[inline(always)]
    pub(super) fn new(
        simd: S,
        center_m: Vec3x16<S>,
        sigma_m: f32x16<S>,
        bound: &CullBound,
    ) -> Self {
        let splat = |value: f64| f32x16::splat(simd, value as f32);
        let off_axis2 = center_m.x.mul_add(center_m.x, center_m.y * center_m.y);
        let distance_m = center_m.z.mul_add(center_m.z, off_axis2).sqrt();

        // The angle off the axis is 2 atan t with t = |(x, y)|/(|p| + z). For t up to 1, atan t is
        // t (π/4 + 0.273 (1 - t)) within 0.004; beyond, it is π/2 - atan(1/t).
        let across = off_axis2.sqrt();
        // Exactly behind the camera |p| + z is 0.
        let along = (distance_m + center_m.z).max(splat(1e-30));
        let steep = across.simd_gt(along);
        let low = across.min(along) / across.max(along);
        let flat = low * splat(-0.273).mul_add(low, splat(std::f64::consts::FRAC_PI_4 + 0.273));
        let half = steep.select(splat(std::f64::consts::FRAC_PI_2) - flat, flat);
        let off_axis = half + half;

        // Below s = 1/2, asin s is at most s π/3.
        let third_turn = splat(std::f64::consts::FRAC_PI_3);
        let points_m = splat(3.0_f64.sqrt()) * sigma_m;
        let mut motion = splat(bound.rotation_rad);
        // asin of the points' distance over the least distance bounds their angle from the centre.
        let share;
        let mut far;
        if bound.translation_m > 0.0 {
            let translation_m = splat(bound.translation_m);
            let translation = translation_m / distance_m;
            motion = translation.mul_add(third_turn, motion);
            share = points_m / (distance_m - translation_m);
            far = translation.simd_lt(splat(0.5));
            far &= share.simd_lt(splat(0.5));
        } else {
            share = points_m / distance_m;
            far = share.simd_lt(splat(0.5));
        }
        // 0.01 covers twice the error of 0.004 of atan t, as the angle is 2 atan t.
        let slack = motion + splat(0.01);
        let spread = share * third_turn;
        let most = off_axis + slack + spread + splat(bound.windshield_rad);
        let mut reach_px_per_rad = splat(f64::INFINITY);
        // From the widest cone to the narrowest: the last one that has all points wins.
        for cone in bound.reaches.iter().rev() {
            let within = most.simd_le(splat(cone.rad));
            reach_px_per_rad = within.select(splat(cone.px_per_rad), reach_px_per_rad);
        }
        Self {
            distance_m,
            least: off_axis - slack,
            spread,
            motion,
            reach_px_per_rad,
            far,
            continued: most.simd_lt(splat(WIDEST_RAD)),
        }
    }

    /// The Gaussians that certainly miss the image: the test of [`CullBound`].
    #[inline(always)]
    pub(super) fn surely_unseen(&self, simd: S, bound: &CullBound) -> mask32x16<S> {
        let splat = |value: f64| f32x16::splat(simd, value as f32);
        // The points and the edge of the image may both be refracted, each to the worse side.
        let reach_px = self.reach_px(simd, self.spread + splat(bound.windshield_rad), bound);
        let off_rad = self.least - splat(bound.windshield_rad + bound.image_rad);
        let out = (off_rad * splat(bound.least_px_per_rad)).simd_gt(reach_px);
        self.far & (self.continued & out | self.least.simd_gt(splat(bound.max_center_rad)))
    }

    /// The Gaussians that miss the image, given the images of their centres: the largest number of
    /// pixels per radian bounds the distance of their points' images from there. A windshield
    /// changes the angle between two rays by less than half of it.
    #[inline(always)]
    pub(super) fn beside(
        &self,
        simd: S,
        center_px: LensPixels<S>,
        size_px: [f32; 2],
        bound: &CullBound,
    ) -> mask32x16<S> {
        let widened = f32x16::splat(simd, if bound.windshield_rad > 0.0 { 1.5 } else { 1.0 });
        let reach_px = self.reach_px(simd, (self.spread + self.motion) * widened, bound);
        let [width, height] = splats(simd, size_px);
        // Outside of the image to the left or to the right; negative within it.
        let off_x = (-center_px.x_px).max(center_px.x_px - width);
        let off_y = (-center_px.y_px).max(center_px.y_px - height);
        self.far & self.continued & off_x.max(off_y).simd_gt(reach_px)
    }

    /// Reach of splats from the images of their centres, in pixels, if their points spread by some
    /// angles.
    #[inline(always)]
    fn reach_px(&self, simd: S, spread_rad: f32x16<S>, bound: &CullBound) -> f32x16<S> {
        spread_rad.mul_add(self.reach_px_per_rad, f32x16::splat(simd, bound.blur_px as f32))
    }
}
