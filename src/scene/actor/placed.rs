//! Actors in one frame: Gaussians of an asset at the actor's pose.

use std::sync::Arc;

use glam::{DVec3, Vec3};

use crate::geometry::Pose;
use crate::{Chunk, SemanticClass, ViewSet};

/// The Gaussians of an actor at its pose in one frame.
///
/// The renderer moves the camera and not the Gaussians: a placed chunk is seen by a camera at
/// `world_from_actor⁻¹ world_from_camera`, computed in f64. So covariances, colours that depend on
/// the direction, depths and culling follow from the renderer's ordinary path, and all placements
/// of an asset share its memory.
#[derive(Clone, Debug)]
pub struct PlacedChunk {
    /// The Gaussians, in the actor's axes: its origin is on the ground under the box's centre, x
    /// points forward and z up.
    pub chunk: Arc<Chunk>,
    /// The actor's pose at the end of the exposure.
    pub world_from_actor: Pose,
    /// The actor's pose at the start of the exposure of the views that draw it. The motion in
    /// between is that of [`Pose::interpolate`]. The same as `world_from_actor` for an actor at
    /// rest, or without a rolling shutter.
    pub world_from_actor_at_start: Pose,
    /// Index of the actor, below [`PlacedChunk::MAX_ACTORS`].
    pub actor: u16,
    /// The class of its Gaussians that have none of their own.
    pub class: SemanticClass,
    /// Factor on the Gaussians' linear red, green and blue; 1 leaves them as they are.
    pub tint: [f32; 3],
    /// The shadow that the actor casts on the twin beneath it, in the views that draw this chunk.
    /// An actor of several chunks has it on one of them for each view.
    pub shadow: Option<ContactShadow>,
    /// The views of the frame that draw it: each has its own exposure, and its own level of detail
    /// of an actor.
    pub views: ViewSet,
}

/// The darkening of the ground under an actor: a factor on the colours of the twin's Gaussians,
/// `1 - 1/2 S(x, length) S(y, width) H(z)` at their centres in the actor's axes.
///
/// `S(u, l) = 1 - smoothstep(l/2 - 0.3 m, l/2 + 0.3 m, |u|)` and
/// `H(z) = 1 - smoothstep(0.05 m, 0.3 m, |z|)`. A dark Gaussian in place of the factor would be
/// blended in the order of its centre, so that the road in front of that centre would hide half of
/// it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactShadow {
    /// Length of the actor's box, in metres.
    pub length_m: f32,
    /// Width of the actor's box, in metres.
    pub width_m: f32,
}

impl PlacedChunk {
    /// Most actors of a view.
    pub const MAX_ACTORS: usize = 256;

    /// A chunk at rest, without a class, a tint or a shadow, in all views.
    pub fn at_rest(chunk: Arc<Chunk>, world_from_actor: Pose, actor: u16) -> Self {
        Self {
            chunk,
            world_from_actor,
            world_from_actor_at_start: world_from_actor,
            actor,
            class: SemanticClass::Unlabelled,
            tint: [1.0; 3],
            shadow: None,
            views: ViewSet::ALL,
        }
    }
}

impl ContactShadow {
    /// Share of the light that the ground loses in the middle of the shadow.
    pub const DEPTH: f32 = 0.5;
    /// The shadow fades from this far within the box's outline to as far beyond, in metres.
    pub const FADE_M: f32 = 0.3;
    /// Up to this height, the whole shadow falls on a Gaussian, in metres.
    pub const GROUND_M: f32 = 0.05;
    /// From this height on, none of it does, in metres.
    pub const TOP_M: f32 = 0.3;

    /// Half the size of the box outside of which the factor is 1, along the actor's axes, in
    /// metres.
    pub fn reach_m(&self) -> Vec3 {
        Vec3::new(
            0.5 * self.length_m + Self::FADE_M,
            0.5 * self.width_m + Self::FADE_M,
            Self::TOP_M,
        )
    }

    /// The factor at a point in the actor's axes, in metres.
    pub fn factor(&self, at_m: DVec3) -> f64 {
        let outside = |half_m: f32, at_m: f64| {
            // Widen before the arithmetic: edges computed in f32 would move the fade by a rounding
            // error, and the reference backend computes in f64.
            let [fade_m, half_m] = [Self::FADE_M, half_m].map(f64::from);
            1.0 - smoothstep(half_m - fade_m, half_m + fade_m, at_m.abs())
        };
        // Three shares from 0 to 1; the product is the share of the shadow that falls on this
        // point.
        let along = outside(0.5 * self.length_m, at_m.x);
        let across = outside(0.5 * self.width_m, at_m.y);
        let [ground_m, top_m] = [Self::GROUND_M, Self::TOP_M].map(f64::from);
        // Below the ground counts like above it: the surface of a reconstructed road scatters to
        // both sides of z = 0.
        let above = 1.0 - smoothstep(ground_m, top_m, at_m.z.abs());
        1.0 - f64::from(Self::DEPTH) * along * across * above
    }
}

/// 0 up to `from`, 1 from `to` on, and `t² (3 - 2 t)` between them, where t runs from 0 to 1.
fn smoothstep(from: f64, to: f64, x: f64) -> f64 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHADOW: ContactShadow = ContactShadow { length_m: 4.0, width_m: 2.0 };

    #[test]
    fn a_shadow_halves_the_ground_beneath_and_ends_beside_and_above() {
        let factor = |x: f64, y: f64, z: f64| SHADOW.factor(DVec3::new(x, y, z));
        assert_eq!(factor(0.0, 0.0, 0.0), 0.5);
        // Within 2.0 - 0.3 m and 1.0 - 0.3 m of the centre and below 0.05 m, all three shares are
        // 1.
        assert_eq!(factor(1.6, -0.6, 0.04), 0.5);
        // On the outline the fade is half way: 1 - 0.5 * 0.5 = 0.75. The tolerance is for 0.3,
        // which f32 does not hold exactly.
        assert!((factor(2.0, 0.0, 0.0) - 0.75).abs() < 1e-6, "{}", factor(2.0, 0.0, 0.0));
        assert!((factor(0.0, 1.0, 0.0) - 0.75).abs() < 1e-6);
        for outside in [factor(2.31, 0.0, 0.0), factor(0.0, -1.31, 0.0), factor(0.0, 0.0, 0.31)] {
            assert_eq!(outside, 1.0);
        }
        assert_eq!(factor(0.0, 0.0, -0.31), 1.0);
    }
}
