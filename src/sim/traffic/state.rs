//! The states that a step of traffic produces: of each actor and of the ego, at one instant.

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass};

use crate::Ego;

/// The constant properties of an actor.
#[derive(Clone, Debug, PartialEq)]
pub struct ActorSpec {
    /// Name within the scenario, `[a-z0-9._-]+`.
    pub name: String,
    pub class: ActorClass,
    pub box_: ActorBox,
    /// BLAKE3 of its asset, 64 lower-case hex digits. An actor without an asset is not rendered.
    pub asset: Option<String>,
}

/// An actor at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActorState {
    /// Index of the actor's [`ActorSpec`].
    pub index: u16,
    /// Pose of its box in the world.
    pub world_from_actor: Pose,
    /// Velocity of the box's origin along world axes, in m/s.
    pub velocity_mps: DVec3,
    /// Yaw rate about the actor's z axis, in rad/s, positive to the left.
    pub yaw_rate_radps: f64,
    /// Whether it is in the world. An absent actor is neither rendered nor touched; its pose is
    /// meaningless.
    pub present: bool,
}

/// The ego at an instant, as actors and contacts see it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoState {
    /// Pose of the rig in the world.
    pub world_from_rig: Pose,
    /// Velocity of the rig's origin along world axes, in m/s.
    pub velocity_mps: DVec3,
    /// Yaw rate about the rig's z axis, in rad/s, positive to the left.
    pub yaw_rate_radps: f64,
}

/// The box of the ego in its rig's axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoBox {
    pub box_: ActorBox,
    /// From the rig's origin, the middle of the rear axle, forward to the box's centre, in metres.
    pub center_x_m: f64,
}

impl EgoState {
    /// The state of an ego.
    pub fn new(ego: &Ego) -> Self {
        Self {
            world_from_rig: ego.world_from_rig(),
            velocity_mps: ego.velocity_m_s(),
            yaw_rate_radps: ego.yaw_rate_rad_s(),
        }
    }
}

impl Default for EgoBox {
    /// The box of the vehicle that AlpaSim drives.
    fn default() -> Self {
        let box_ = ActorBox { length_m: 5.393, width_m: 2.109, height_m: 1.503 };
        Self { box_, center_x_m: 1.3 }
    }
}

/// One sub-step: at most 10 ms of a step.
#[derive(Clone, Copy, Debug)]
pub struct SubStep<'a> {
    /// Its start, in microseconds since the episode's start.
    pub begin_us: i64,
    /// Its end, in microseconds since the episode's start.
    pub end_us: i64,
    /// The ego at its start and at its end.
    pub ego: [EgoState; 2],
    /// All actors at its start, in order of their index.
    pub before: &'a [ActorState],
    /// All actors at its end, in order of their index.
    pub after: &'a [ActorState],
}
