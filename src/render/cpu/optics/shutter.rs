//! Rolling shutters, 16 points at a time: what [`crate::View::land`] does, seen from the exposure's end.

use fearless_simd::{f32x16, mask32x16, prelude::*};

use super::sines::sin;
use crate::cpu::lanes::Vec3x16;
use crate::view::ShutterMotion;

/// A shutter that rolls while the camera moves, for many points.
#[derive(Clone, Debug)]
pub(in crate::cpu) struct Shutter {
    share: [f32; 3],
    moved_world_m: [f32; 3],
    moved_m: [f32; 3],
    axis: [f32; 3],
    turned_rad: f32,
}

impl Shutter {
    /// Rounds of the search for the row that sees a point: what needs more is left for f64.
    pub(super) const ROUNDS: u32 = 16;

    /// The search ends when it moves by less than this share of the exposure: 1e-6 of 1 m.
    const STILL: f32 = 1e-6;

    /// Beyond this turn in one exposure, in radians, the sine here does not hold.
    const MOST_RAD: f64 = 1.5;

    /// `None` if the camera turns farther than is accounted for.
    pub(super) fn of(still: &ShutterMotion) -> Option<Self> {
        let ShutterMotion { share, moved_world_m, moved_m, axis, turned_rad } = *still;
        (turned_rad <= Self::MOST_RAD).then(|| Self {
            share: share.map(|value| value as f32),
            moved_world_m: moved_world_m.as_vec3().to_array(),
            moved_m: moved_m.as_vec3().to_array(),
            axis: axis.as_vec3().to_array(),
            turned_rad: turned_rad as f32,
        })
    }

    /// The share of the exposure that is still to come while places of the image, in pixels, are exposed.
    #[inline(always)]
    pub(super) fn share<S: Simd>(&self, simd: S, x: f32x16<S>, y: f32x16<S>) -> f32x16<S> {
        let [a, b, c] = self.share.map(|value| f32x16::splat(simd, value));
        let share = x.mul_add(a, y.mul_add(b, c));
        share.max(f32x16::splat(simd, 0.0)).min(f32x16::splat(simd, 1.0))
    }

    /// Whether two shares are the same moment.
    #[inline(always)]
    pub(super) fn is_still<S: Simd>(simd: S, one: f32x16<S>, other: f32x16<S>) -> mask32x16<S> {
        (one - other).abs().simd_le(f32x16::splat(simd, Self::STILL))
    }

    /// Points of the camera's frame at the exposure's end in its frame while a share is still to come, in
    /// metres.
    #[inline(always)]
    pub(super) fn then<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        share: f32x16<S>,
    ) -> Vec3x16<S> {
        let moved_m = Vec3x16::splat(simd, self.moved_m).mul_add(share, at_end_m);
        moved_m.plus(self.turning(simd, moved_m, share))
    }

    /// How many metres farther along the camera's axis that is.
    #[inline(always)]
    pub(in crate::cpu) fn farther<S: Simd>(
        &self,
        simd: S,
        at_end_m: Vec3x16<S>,
        share: f32x16<S>,
    ) -> f32x16<S> {
        let way_m = self.way(simd, share);
        way_m.z + self.turning(simd, at_end_m.plus(way_m), share).z
    }

    /// How far the camera's centre still has to go, in metres, in its frame at the exposure's end.
    #[inline(always)]
    pub(in crate::cpu) fn way<S: Simd>(&self, simd: S, share: f32x16<S>) -> Vec3x16<S> {
        Vec3x16::splat(simd, self.moved_m).scale(share)
    }

    /// The same in the world's axes.
    #[inline(always)]
    pub(in crate::cpu) fn way_world<S: Simd>(&self, simd: S, share: f32x16<S>) -> Vec3x16<S> {
        Vec3x16::splat(simd, self.moved_world_m).scale(share)
    }

    /// Directions in the camera's frame while a share is still to come, in its frame at the end.
    #[inline(always)]
    pub(super) fn at_end<S: Simd>(
        &self,
        simd: S,
        then: Vec3x16<S>,
        share: f32x16<S>,
    ) -> Vec3x16<S> {
        then.plus(self.turning(simd, then, f32x16::splat(simd, 0.0) - share))
    }

    /// By how much a vector changes from the frame at the end to that while a share is still to come; with
    /// a negative share, the other way.
    #[inline(always)]
    fn turning<S: Simd>(&self, simd: S, v: Vec3x16<S>, share: f32x16<S>) -> Vec3x16<S> {
        let axis = Vec3x16::splat(simd, self.axis);
        let turned_rad = share * f32x16::splat(simd, self.turned_rad);
        let sine = sin(simd, turned_rad);
        let half = sin(simd, turned_rad * f32x16::splat(simd, 0.5));
        let across = axis.cross(v);
        across.scale(sine).plus(axis.cross(across).scale((half + half) * half))
    }
}
