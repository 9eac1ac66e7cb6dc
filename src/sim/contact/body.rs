//! A footprint with its heights.

use glam::{DVec2, DVec3};

use wildcity_scene::ActorBox;
use wildcity_scene::geometry::Pose;

use super::footprint::Footprint;

/// A box in the world: a footprint, and the heights that it reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    pub footprint: Footprint,
    /// Lowest height, in metres.
    pub bottom_m: f64,
    /// Greatest height, in metres.
    pub top_m: f64,
}

impl Body {
    /// The box of a pose (`world_from_actor`, or `world_from_rig`), whose centre is `center_x_m`
    /// ahead of the pose's origin: 0 for an actor. The box stands upright: the tilt of a pose on a
    /// slope moves its centre but leaves its outline as it is.
    pub fn new(world_from_body: &Pose, size: &ActorBox, center_x_m: f64) -> Self {
        // A pose that looks straight up has no heading; any does then.
        let forward =
            (world_from_body.rotation * DVec3::X).truncate().try_normalize().unwrap_or(DVec2::X);
        let center = world_from_body.transform_point(DVec3::new(center_x_m, 0.0, 0.0));
        let footprint = Footprint {
            center_m: center.truncate(),
            forward,
            length_m: size.length_m,
            width_m: size.width_m,
        };
        // An actor's origin and a rig's origin are on the ground, so the box reaches from there up.
        Self { footprint, bottom_m: center.z, top_m: center.z + size.height_m }
    }

    /// Whether the heights of two boxes overlap. A bridge and the street below it do not.
    pub fn is_level_with(&self, other: &Self) -> bool {
        // Closed intervals, as for the outline: boxes that only touch in height are level.
        self.bottom_m <= other.top_m && other.bottom_m <= self.top_m
    }

    /// Whether the boxes touch.
    pub fn touches(&self, other: &Self) -> bool {
        self.is_level_with(other) && self.footprint.touches(&other.footprint)
    }
}
