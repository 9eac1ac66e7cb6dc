//! A footprint with its heights.

use glam::{DVec2, DVec3};

use wildcity_scene::geometry::Pose;

use super::footprint::Footprint;

/// The size of a box, and where it stands in its frame (x forward, z up, origin on the ground).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodySize {
    /// Length, width and height, in metres.
    pub size_m: DVec3,
    /// The centre of the box ahead of the frame's origin, in metres: 0 for actors, above 0 for an ego whose
    /// origin is under its rear axle.
    pub center_x_m: f64,
}

/// A box in the world: a footprint, and the heights that it reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Seen from above.
    pub footprint: Footprint,
    /// Lowest height, in metres.
    pub bottom_m: f64,
    /// Greatest height, in metres.
    pub top_m: f64,
}

impl Body {
    /// The box of a pose (`world_from_actor`, or `world_from_rig`). It stands upright: the tilt of a pose on a
    /// slope moves its centre but leaves its outline as it is.
    pub fn new(world_from_body: &Pose, size: &BodySize) -> Self {
        let forward = world_from_body.rotation * DVec3::X;
        // A pose that looks straight up has no heading; any does then.
        let forward = forward.truncate().try_normalize().unwrap_or(DVec2::X);
        let center = world_from_body.transform_point(DVec3::new(size.center_x_m, 0.0, 0.0));
        let footprint = Footprint {
            center_m: center.truncate(),
            forward,
            length_m: size.size_m.x,
            width_m: size.size_m.y,
        };
        Self { footprint, bottom_m: center.z, top_m: center.z + size.size_m.z }
    }

    /// Whether the heights of two boxes overlap. A bridge and the street below it do not.
    pub fn is_level_with(&self, other: &Self) -> bool {
        self.bottom_m <= other.top_m && other.bottom_m <= self.top_m
    }

    /// Whether the boxes touch.
    pub fn touches(&self, other: &Self) -> bool {
        self.is_level_with(other) && self.footprint.touches(&other.footprint)
    }
}
