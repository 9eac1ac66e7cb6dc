//! The search for the moment at which a rolling shutter exposes a point, 16 points at a time.
//!
//! The image row decides when a point is exposed, that decides where the camera is, and that
//! decides the row. In terms of the fraction r of the exposure that remains, the row's fraction
//! minus r is 0 at the moment that is sought. The secant method finds it. Where there is no secant
//! yet, or it is not that of a slow motion over the image, the slope is that of a point at rest on
//! the image or of the centre. The row's fraction is not clamped to the exposure, so that it is
//! smooth; r is.
//!
//! **The last step is taken on the image.** With two places on the image at two moments, the place
//! at a third one is that of the line through both. On a path that turns by a share a of itself in
//! the whole exposure, the line is off by at most a times the movement between the two times the
//! remaining step. Where that is below [`MAX_ERROR_PX`], the lens is not applied again. The search
//! for a point begins at the moment of its Gaussian's centre, with the centre's slope.

use fearless_simd::{f32x16, mask32x16, prelude::*};

use super::shutter::SimdShutter;
use super::{LensPixels, LensProjection};
use crate::cpu::lanes::{Vec3x16, splats};

/// Largest error of the last step, in pixels.
const MAX_ERROR_PX: f32 = 1.0 / 8192.0;

/// The search ends when the fraction changes by at most this: 1e-6 of 1 m of motion.
const CONVERGED: f32 = 1e-6;

/// Steps below this do not give a usable slope, because f32 rounds places on the image.
const LEAST_STEP: f32 = 1e-5;

/// Most projections after the first one. Points that need more are left to the f64 path.
const ROUNDS: u32 = 16;

/// Moments of the exposure at which 16 points are seen.
#[derive(Clone, Copy)]
pub(in crate::cpu) struct Moment<S: Simd> {
    /// The fraction of the exposure that remains then: 0 without a rolling shutter.
    pub(in crate::cpu) remaining: f32x16<S>,
    /// Change of (the row's fraction - remaining) with the remaining fraction.
    slope: f32x16<S>,
    /// A bound of how much the paths of points on the image turn, as a share of themselves.
    turn: f32x16<S>,
}

/// Image points, and when they are exposed.
#[derive(Clone, Copy)]
pub(in crate::cpu) struct ExposedPixels<S: Simd> {
    pub(in crate::cpu) pixels: LensPixels<S>,
    pub(in crate::cpu) moment: Moment<S>,
}

impl<S: Simd> Moment<S> {
    /// The end of the exposure, for points at a distance from the camera in metres.
    #[inline(always)]
    fn end(simd: S, shutter: &SimdShutter, distance_m: f32x16<S>) -> Self {
        // At rest on the image the row's fraction does not change, and minus r has the slope -1.
        let [zero, minus_one] = splats(simd, [0.0, -1.0]);
        Self { remaining: zero, slope: minus_one, turn: shutter.turn(simd, distance_m) }
    }

    /// Without a rolling shutter.
    #[inline(always)]
    fn only(simd: S) -> Self {
        let [zero, minus_one] = splats(simd, [0.0, -1.0]);
        Self { remaining: zero, slope: minus_one, turn: zero }
    }
}

impl LensProjection {
    /// Projects points of the camera's frame at the end of the exposure, at a distance in metres.
    ///
    /// A point for which the search does not converge, or that is not within the field, has a
    /// negative margin. The search does not wait for points that are not `wanted`.
    #[inline(always)]
    pub(in crate::cpu) fn project<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        distance_m: f32x16<S>,
        wanted: mask32x16<S>,
    ) -> ExposedPixels<S> {
        let Some(shutter) = &self.shutter else {
            let pixels = self.project_static(simd, at_end_m);
            return ExposedPixels { pixels, moment: Moment::only(simd) };
        };
        let end = Moment::end(simd, shutter, distance_m);
        self.search(simd, shutter, at_end_m, &end, wanted)
    }

    /// Projects points near others that are exposed at `moment`, given in the camera's frame at
    /// that moment. As [`Self::project`]. It is not inlined: few Gaussians need it, and inlining
    /// takes the compiler a fifth of this package's time.
    #[inline(always)]
    pub(in crate::cpu) fn project_near<S: Simd>(
        &self,
        simd: S,
        then_m: Vec3x16<S>,
        moment: &Moment<S>,
        wanted: mask32x16<S>,
    ) -> LensPixels<S> {
        simd.vectorize(
            #[inline(always)]
            || match &self.shutter {
                None => self.project_static(simd, then_m),
                Some(shutter) => self.search(simd, shutter, then_m, moment, wanted).pixels,
            },
        )
    }

    #[inline(always)]
    fn search<S: Simd>(
        &self,
        simd: S,
        shutter: &SimdShutter,
        then_m: Vec3x16<S>,
        from: &Moment<S>,
        wanted: mask32x16<S>,
    ) -> ExposedPixels<S> {
        let splat = |value: f32| f32x16::splat(simd, value);
        let zero = splat(0.0);
        // The motion at the first moment; later ones differ by a rotation about the same axis.
        let motion_m = shutter.motion(simd, from.remaining);
        let mut remaining = from.remaining;
        // Values of the previous round; without one there is no secant.
        let mut step = zero;
        let [mut x_px, mut y_px, mut off] = [zero; 3];
        let mut round = 0;
        loop {
            let moved_m = match round {
                0 => then_m,
                _ => shutter.later(simd, then_m, motion_m, remaining - from.remaining),
            };
            let next = self.project_static(simd, moved_m);
            let next_off = shutter.unclamped_remaining_at(simd, next.x_px, next.y_px) - remaining;

            // The slope of the secant. A point at rest on the image has -1.
            // In the first round the step is 0 and the quotient no number, so that `slow` is false.
            let secant = (next_off - off) / step;
            let slow = secant.simd_ge(splat(-2.0))
                & secant.simd_le(splat(-0.3))
                & step.abs().simd_gt(splat(LEAST_STEP));
            let slope = slow.select(secant, from.slope);

            // The remaining step, and the error if it is taken on the image.
            // Newton's step to the zero of (row's fraction - r), kept within the exposure.
            let last = within_exposure(simd, remaining - next_off / slope) - remaining;
            let moved_x = next.x_px - x_px;
            let moved_y = next.y_px - y_px;
            let error_px = moved_x.abs().max(moved_y.abs()) * from.turn * last.abs();
            let done = (slow & error_px.simd_le(splat(MAX_ERROR_PX)))
                | last.abs().simd_le(splat(CONVERGED));
            // A point that has left the field is not waited for: the f64 path takes it.
            let decided = done | !next.margin.simd_ge(zero) | !wanted;
            if round == ROUNDS || decided.all_true() {
                // The line through the last two places, at the moment after the last step.
                // Without a secant the step is below the convergence limit, and the last
                // place is the result.
                let share = slow.select(last / step, zero);
                let pixels = LensPixels {
                    x_px: moved_x.mul_add(share, next.x_px),
                    y_px: moved_y.mul_add(share, next.y_px),
                    margin: done.select(next.margin, splat(-1.0)),
                    ..next
                };
                let remaining = slow.select(remaining + last, remaining);
                return ExposedPixels { pixels, moment: Moment { remaining, slope, ..*from } };
            }
            LensPixels { x_px, y_px, .. } = next;
            off = next_off;
            step = last;
            remaining += last;
            round += 1;
        }
    }
}

/// The nearest moment of the exposure.
#[inline(always)]
fn within_exposure<S: Simd>(simd: S, remaining: f32x16<S>) -> f32x16<S> {
    let [zero, one] = splats(simd, [0.0, 1.0]);
    remaining.max(zero).min(one)
}
