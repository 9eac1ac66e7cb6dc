//! Which side of the ego was hit, and whether the ego is at fault.

use glam::DVec2;

use super::footprint::Footprint;

/// A speed up to this is standing, in m/s (NAVSIM, `stopped_speed_threshold`).
pub const STANDING_MPS: f64 = 0.05;

/// A direction that is more than this off the heading is behind, in radians: 150°, as in NAVSIM.
pub const BEHIND_RAD: f64 = 150.0 * std::f64::consts::PI / 180.0;

/// Kinds of contact, in the order in which they are asked for (nuPlan's and NAVSIM's names).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CollisionType {
    StoppedEgo,
    /// The other stood, or is an object.
    StoppedTrack,
    /// The other is behind the ego.
    ActiveRear,
    /// The ego's front line touches the other.
    ActiveFront,
    /// None of the above.
    ActiveLateral,
}

/// The state at the contact, on which the fault depends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FaultInput {
    pub ego: Footprint,
    /// The ego's reference point: its rear axle, in metres.
    pub ego_origin_m: DVec2,
    /// The ego's velocity, in m/s.
    pub ego_velocity_mps: DVec2,
    pub other: Footprint,
    /// The other's velocity, in m/s.
    pub other_velocity_mps: DVec2,
    /// Whether the other moves by itself: a vehicle, a bicycle or a pedestrian.
    pub other_is_agent: bool,
}

/// Where the ego's corners lie in the lanes of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LanePosition {
    /// Corners lie in several lanes, and no lane holds all four.
    pub in_multiple_lanes: bool,
    /// A corner lies outside the drivable area.
    pub off_drivable: bool,
}

impl CollisionType {
    /// The kind of a contact.
    ///
    /// Source: NAVSIM 0a380a9, `pdm_scorer_utils.py` `get_collision_type`.
    pub fn classify(input: &FaultInput) -> Self {
        if input.ego_velocity_mps.length() <= STANDING_MPS {
            return Self::StoppedEgo;
        }
        let stands = input.other_velocity_mps.length() <= STANDING_MPS;
        if stands || !input.other_is_agent {
            return Self::StoppedTrack;
        }
        let bearing = input.bearing_rad();
        if bearing > BEHIND_RAD {
            return Self::ActiveRear;
        }
        if input.ego.front_line().touches(&input.other) {
            return Self::ActiveFront;
        }
        Self::ActiveLateral
    }

    /// The name in records: `stopped_ego`, `active_front` ..
    pub fn name(self) -> &'static str {
        match self {
            Self::StoppedEgo => "stopped_ego",
            Self::StoppedTrack => "stopped_track",
            Self::ActiveRear => "active_rear",
            Self::ActiveFront => "active_front",
            Self::ActiveLateral => "active_lateral",
        }
    }

    /// NAVSIM's rule: whether a contact of this kind is the ego's fault. A lateral one is only if
    /// the ego was not in a lane of its own.
    pub fn is_at_fault_in(self, lanes: LanePosition) -> bool {
        match self {
            // The ego was hit: it stood, or the other came from behind.
            Self::StoppedEgo | Self::ActiveRear => false,
            Self::StoppedTrack | Self::ActiveFront => true,
            Self::ActiveLateral => lanes.in_multiple_lanes || lanes.off_drivable,
        }
    }
}

impl FaultInput {
    /// The angle between the ego's heading and the line from its origin to the other's centre, in
    /// [0, π].
    pub fn bearing_rad(&self) -> f64 {
        let to_other = self.other.center_m - self.ego_origin_m;
        let ahead_m = self.ego.forward.dot(to_other);
        let aside_m = self.ego.left().dot(to_other);
        aside_m.atan2(ahead_m).abs()
    }
}

/// `wildcity.fault@1`: NAVSIM's rule with the other's speed at the contact (NAVSIM takes that of
/// its first frame). Without a map, a lateral contact is the ego's fault if the ego closes faster
/// along `normal`, the unit vector from the ego to the other, than the other does.
pub fn is_ego_at_fault(input: &FaultInput, normal: DVec2, lanes: Option<LanePosition>) -> bool {
    match (CollisionType::classify(input), lanes) {
        // `normal` points to the other, so the ego closes by `v_ego · n` and the other by
        // `-v_other · n`.
        (CollisionType::ActiveLateral, None) => {
            input.ego_velocity_mps.dot(normal) > -input.other_velocity_mps.dot(normal)
        }
        // Kinds other than the lateral one do not depend on the lanes, so the default decides
        // nothing.
        (kind, lanes) => kind.is_at_fault_in(lanes.unwrap_or_default()),
    }
}
