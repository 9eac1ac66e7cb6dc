//! The vehicle ahead: the nearest box in the corridor of an actor's course.

use glam::DVec3;

use super::course::{Course, flat};
use super::state::{ActorSpec, ActorState, EgoBox, EgoState};

/// Above the rounding of distances in a city, in metres.
const SLACK_M: f64 = 1e-6;

/// A box on the ground that an actor may have to follow.
#[derive(Clone, Copy, Debug)]
pub(super) struct LeadCandidate {
    /// Index of the actor; `None` for the ego.
    pub(super) actor: Option<u16>,
    /// Middle of the box on the ground, in metres.
    pub(super) center_m: DVec3,
    /// Horizontal direction of its length; a unit vector, or zero for a box that points up.
    forward: DVec3,
    half_length_m: f64,
    half_width_m: f64,
    height_m: f64,
    pub(super) velocity_mps: DVec3,
    /// Yaw rate, in rad/s.
    pub(super) yaw_rate_radps: f64,
}

/// The vehicle, or the end of a course, that an actor follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lead {
    /// From the actor's front to the lead's rear along the course, in metres; below 0 if they
    /// overlap.
    pub(super) gap_m: f64,
    /// The lead's speed along the course, in m/s.
    pub(super) speed_mps: f64,
}

/// Where an actor looks for a lead.
#[derive(Clone, Copy, Debug)]
pub(super) struct Corridor {
    /// Station of the actor, in metres.
    pub(super) station_m: f64,
    /// The right and the left edge, in metres to the left of the course.
    pub(super) edges_m: [f64; 2],
    /// Half of the actor's length, in metres.
    pub(super) half_length_m: f64,
    /// Height of the actor, in metres.
    pub(super) height_m: f64,
    /// Length of the corridor ahead of the actor's centre, in metres.
    pub(super) ahead_m: f64,
}

impl LeadCandidate {
    pub(super) fn from_actor(spec: &ActorSpec, state: &ActorState) -> Self {
        let pose = state.world_from_actor;
        Self {
            actor: Some(state.index),
            center_m: pose.position_m,
            forward: flat(pose.rotation * DVec3::X).normalize_or_zero(),
            half_length_m: 0.5 * spec.box_.length_m,
            half_width_m: 0.5 * spec.box_.width_m,
            height_m: spec.box_.height_m,
            velocity_mps: state.velocity_mps,
            yaw_rate_radps: state.yaw_rate_radps,
        }
    }

    /// The body of an actor, or of the ego; `None` if it is absent.
    pub(super) fn find(bodies: &[Self], actor: Option<usize>) -> Option<&Self> {
        // The ego is first, and the actors follow in order of their indices.
        let index = bodies.binary_search_by_key(&actor, |body| body.actor.map(usize::from));
        index.ok().map(|index| &bodies[index])
    }

    /// Horizontal direction of its length.
    pub(super) fn forward(&self) -> DVec3 {
        self.forward
    }

    /// Half of its extent along a horizontal direction, in metres.
    pub(super) fn half_extent_m(&self, axis: DVec3) -> f64 {
        let left = DVec3::Z.cross(self.forward);
        self.half_length_m * self.forward.dot(axis).abs() + self.half_width_m * left.dot(axis).abs()
    }

    /// The distance between two boxes in the horizontal plane, in metres; 0 if they overlap.
    pub(super) fn gap_m(&self, other: &Self) -> f64 {
        let inside = self.overlaps(other);
        if inside {
            return 0.0;
        }
        // As for footprints: the nearest pair of two separate convex shapes has a corner.
        let corners = self.corners_m().map(|corner_m| other.distance_m(corner_m));
        let others = other.corners_m().map(|corner_m| self.distance_m(corner_m));
        corners.into_iter().chain(others).fold(f64::INFINITY, f64::min)
    }

    fn corners_m(&self) -> [DVec3; 4] {
        let left = DVec3::Z.cross(self.forward);
        [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(|(along, across)| {
            self.center_m
                + along * self.half_length_m * self.forward
                + across * self.half_width_m * left
        })
    }

    /// The distance of a point from the box in the horizontal plane, in metres.
    fn distance_m(&self, point_m: DVec3) -> f64 {
        let offset = point_m - self.center_m;
        let left = DVec3::Z.cross(self.forward);
        let along_m = (offset.dot(self.forward).abs() - self.half_length_m).max(0.0);
        let across_m = (offset.dot(left).abs() - self.half_width_m).max(0.0);
        along_m.hypot(across_m)
    }

    /// Whether two boxes overlap in the horizontal plane: no axis of either separates them.
    fn overlaps(&self, other: &Self) -> bool {
        let between = other.center_m - self.center_m;
        let axes = [self.forward, other.forward].map(|axis| [axis, DVec3::Z.cross(axis)]);
        axes.into_iter().flatten().all(|axis| {
            // Below and not equal: boxes that touch do not overlap.
            between.dot(axis).abs() < self.half_extent_m(axis) + other.half_extent_m(axis)
        })
    }

    pub(super) fn from_ego(ego: &EgoState, ego_box: &EgoBox) -> Self {
        let pose = ego.world_from_rig;
        let ahead_m = pose.rotation * (ego_box.center_x_m * DVec3::X);
        Self {
            actor: None,
            center_m: pose.position_m + ahead_m,
            forward: flat(pose.rotation * DVec3::X).normalize_or_zero(),
            half_length_m: 0.5 * ego_box.box_.length_m,
            half_width_m: 0.5 * ego_box.box_.width_m,
            height_m: ego_box.box_.height_m,
            velocity_mps: ego.velocity_mps,
            yaw_rate_radps: ego.yaw_rate_radps,
        }
    }
}

/// The nearest candidate ahead in the corridor. Of equally near ones it is the slowest, so that
/// their order cannot matter.
///
/// Most candidates are refused by the box of the corridor. The others are tested by rising distance
/// until none that is left can be nearer.
pub(super) fn lead_ahead(
    course: &Course,
    corridor: &Corridor,
    own: u16,
    bodies: &[LeadCandidate],
) -> Option<Lead> {
    let own_m = course.point_m(corridor.station_m);
    let [right_m, left_m] = corridor.edges_m;
    let to_m = corridor.station_m + corridor.ahead_m;
    let aside_m = right_m.abs().max(left_m.abs());
    let extent = course.extent(corridor.station_m, to_m);
    // The least gap that each may have, and the body with its reach.
    let mut near: Vec<(f64, &LeadCandidate, f64)> = Vec::new();
    for body in bodies.iter().filter(|body| body.actor != Some(own)) {
        // A box that is farther away than the corridor is long cannot be in it.
        let reach_m = aside_m + body.half_length_m.hypot(body.half_width_m);
        let farthest_m = corridor.ahead_m + reach_m;
        // Squares, because this test is made for every pair of actors in every sub-step.
        let way_m = body.center_m - own_m;
        if way_m.length_squared() > farthest_m * farthest_m {
            continue;
        }
        // Nor one that is farther from the box of the corridor than its reach, with a slack for
        // the rounding of both distances.
        if flat(extent.away_m(body.center_m)).length_squared() > reach_m * reach_m + SLACK_M {
            continue;
        }
        // The way along the course is at least the straight way to the place beside the body,
        // which is within its reach.
        let half_diagonal_m = body.half_length_m.hypot(body.half_width_m);
        let least_m =
            flat(way_m).length() - reach_m - half_diagonal_m - corridor.half_length_m - SLACK_M;
        near.push((least_m, body, reach_m));
    }
    near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let mut lead: Option<Lead> = None;
    for (least_m, body, reach_m) in near {
        if lead.is_some_and(|lead| lead.gap_m < least_m) {
            break;
        }
        let Some(found) = found_in(course, corridor, body, reach_m, to_m) else { continue };
        let is_nearer =
            lead.is_none_or(|lead| (found.gap_m, found.speed_mps) < (lead.gap_m, lead.speed_mps));
        if is_nearer {
            lead = Some(found);
        }
    }
    lead
}

/// A candidate as a lead, if it is ahead in the corridor.
fn found_in(
    course: &Course,
    corridor: &Corridor,
    body: &LeadCandidate,
    reach_m: f64,
    to_m: f64,
) -> Option<Lead> {
    let station_m = course.first_within(body.center_m, reach_m, corridor.station_m, to_m)?;
    // From the first place within reach to its end: the nearest place of the body lies in between.
    let beside = course.nearest_between(body.center_m, station_m, station_m + 2.0 * reach_m);
    if beside.station_m <= corridor.station_m {
        return None;
    }
    let pose = course.at(beside.station_m);
    // A bridge above is not in the way.
    let above_m = body.center_m.z - pose.position_m.z;
    // The boxes stand on their z, so they overlap in height if neither begins above the other's
    // roof.
    if above_m >= corridor.height_m || above_m <= -body.height_m {
        return None;
    }
    // The extents of the turned box along and across the course.
    let ahead = flat(pose.rotation * DVec3::X).normalize_or_zero();
    let cos = body.forward.dot(ahead).abs();
    // Both vectors are horizontal, so z of their product is the sine.
    let sin = body.forward.cross(ahead).z.abs();
    let half_along_m = body.half_length_m * cos + body.half_width_m * sin;
    let half_across_m = body.half_length_m * sin + body.half_width_m * cos;
    let [right_m, left_m] = corridor.edges_m;
    let is_inside =
        beside.left_m - half_across_m < left_m && beside.left_m + half_across_m > right_m;
    is_inside.then(|| Lead {
        gap_m: beside.station_m - half_along_m - corridor.station_m - corridor.half_length_m,
        speed_mps: body.velocity_mps.dot(ahead),
    })
}
