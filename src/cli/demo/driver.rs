//! The agent of the demo's scenarios: follows the recorded drive, and keeps its distance from
//! actors on it.

use anyhow::Context;
use glam::DVec3;

use wildcity_client::TimedPose;
use wildcity_client::protocol::observation::ObservationMetadata;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_sim::traffic::{Course, Idm, rolled};

use super::wire_pose;

/// A driver that reads the boxes of actors from `outputs.actors`.
pub(super) struct CarefulDriver {
    course: Course,
}

/// Poses of a plan, and the time between two of them.
const PLAN_POSES: i64 = 20;
const PLAN_STEP_US: i64 = 100_000;
/// Largest lateral distance from the line at which an actor is in the way, in metres: half of both
/// widths.
const BESIDE_M: f64 = 2.2;
/// From the ego's rear axle to its front bumper, in metres.
const FRONT_M: f64 = 4.0;
/// Deceleration of the driver, in m/s²: larger than the comfortable one of the model.
const BRAKING_MPS2: f64 = 6.0;

impl CarefulDriver {
    pub(super) fn new(drive: &Trajectory) -> anyhow::Result<Self> {
        let course = Course::from_drive(drive).context("the recorded drive is too short")?;
        Ok(Self { course })
    }

    /// Where to drive in the next two seconds, in the rig's frame.
    pub(super) fn plan(&self, seen: &ObservationMetadata) -> anyhow::Result<Vec<TimedPose>> {
        let world_from_rig = Pose::checked(seen.ego.pose.xyz, seen.ego.pose.q)?;
        let mut station_m = self.course.nearest(world_from_rig.position_m).station_m;
        let velocity_mps = DVec3::from_array(seen.ego.velocity);
        // Along the heading: a car that slides sideways or rolls back has no speed for the model.
        let mut speed_mps = velocity_mps.dot(world_from_rig.rotation * DVec3::X).max(0.0);
        let free = Idm::WILDCITY.acceleration(speed_mps, 0.0, f64::INFINITY);
        let behind = Idm { braking_mps2: BRAKING_MPS2, ..Idm::WILDCITY };
        let actors = seen.actors.iter().flatten();
        // The actor that asks for the hardest braking decides.
        let acceleration = actors.fold(free, |least: f64, actor| {
            let beside = self.course.nearest(DVec3::from_array(actor.pose.xyz));
            let gap_m = beside.station_m - 0.5 * actor.size[0] - station_m - FRONT_M;
            if beside.left_m.abs() > BESIDE_M || gap_m < -1.0 {
                return least;
            }
            let ahead = self.course.at(beside.station_m).rotation * DVec3::X;
            let lead_mps = DVec3::from_array(actor.velocity).dot(ahead);
            least.min(behind.acceleration(speed_mps, lead_mps, gap_m))
        });
        let rig_from_world = world_from_rig.inverse();
        let poses = (1..=PLAN_POSES).map(|k| {
            let [way_m, next_mps] = rolled(speed_mps, acceleration, PLAN_STEP_US as f64 * 1e-6);
            station_m += way_m;
            speed_mps = next_mps;
            // Poses of a plan are relative to the rig at the time of the observation.
            let pose = rig_from_world * self.course.at(station_m);
            TimedPose { time_us: k * PLAN_STEP_US, pose: wire_pose(&pose) }
        });
        Ok(poses.collect())
    }
}
