//! A driver's answer as a trajectory of wildcity's protocol.

use wildcity_client::{Pose as WirePose, TimedPose};
use wildcity_scene::geometry::Pose;
use wildcity_sim::limits::PATH_US;

use super::driver::DriverError;
use crate::limits;
use crate::scene::LocalFrame;
use crate::wire::common::Trajectory;

/// The poses after `now_us`, in the present rig frame. Drivers begin with the present pose.
///
/// # Errors
/// There is no pose after `now_us`, the plan ends before the step does, a pose is invalid, or times
/// do not rise.
pub(super) fn trajectory(
    plan: Option<&Trajectory>,
    frame: &LocalFrame,
    world_from_rig: &Pose,
    now_us: u64,
    dt_us: i64,
) -> Result<Vec<TimedPose>, DriverError> {
    let poses = plan.map(|plan| plan.poses.as_slice()).unwrap_or_default();
    let rig_from_world = world_from_rig.inverse();
    // Invariant: all planned times are in (now_us, last_us] and rise.
    let mut last_us = now_us;
    let mut planned = Vec::new();
    for at in poses.iter().filter(|at| at.timestamp_us > now_us) {
        if at.timestamp_us <= last_us {
            let text = format!("has a pose at {} us after one at {last_us} us", at.timestamp_us);
            return Err(DriverError::Plan(text));
        }
        last_us = at.timestamp_us;
        let pose = frame
            .world_from("pose", at.pose.as_ref())
            .map_err(|error| DriverError::Plan(format!("at {last_us} us: {error}")))?;
        let in_rig = rig_from_world * pose;
        // Not negative, because the filter keeps later poses only.
        let time_us = i64::try_from(last_us - now_us).unwrap_or(i64::MAX);
        // The server accepts no later pose, and only the step until the next plan is driven.
        if time_us > PATH_US && planned.last().is_some_and(|last: &TimedPose| last.time_us >= dt_us)
        {
            break;
        }
        let pose = WirePose { xyz: in_rig.position_m.to_array(), q: in_rig.q_wxyz() };
        planned.push(TimedPose { time_us, pose });
        // What is beyond is not driven before the next plan. It is not checked either.
        if planned.len() == limits::PLAN_POSES {
            break;
        }
    }
    match planned.last() {
        None => Err(DriverError::Plan(format!("has no pose after {now_us} us"))),
        // Extrapolation would be a plan that the driver did not make.
        Some(last) if last.time_us < dt_us => {
            let text = format!("ends {} us from now, within the step of {dt_us} us", last.time_us);
            Err(DriverError::Plan(text))
        }
        Some(_) => Ok(planned),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::common::PoseAtTime;
    use glam::DVec3;

    const FRAME: LocalFrame = LocalFrame { origin_m: DVec3::new(100.0, 0.0, 0.0) };

    fn plan(times_us: &[u64]) -> Trajectory {
        let at = |&timestamp_us: &u64| {
            // 10 m/s along x: 1e-5 m for each microsecond.
            let position_m = FRAME.origin_m + 1e-5 * timestamp_us as f64 * DVec3::X;
            let pose = FRAME.local_from(&Pose { position_m, ..Pose::IDENTITY });
            PoseAtTime { pose: Some(pose), timestamp_us }
        };
        Trajectory { poses: times_us.iter().map(at).collect() }
    }

    #[test]
    fn plans_begin_after_now_and_reach_beyond_the_step() {
        // The ego is where the plan is at 100 ms, at 1 m. The next pose, at 200 ms, is 1 m ahead of
        // it.
        let here = Pose { position_m: FRAME.origin_m + DVec3::X, ..Pose::IDENTITY };
        let read = |times_us: &[u64]| {
            let plan = plan(times_us);
            trajectory(Some(&plan), &FRAME, &here, 100_000, 100_000)
        };
        let planned = read(&[100_000, 200_000, 300_000]).unwrap();
        let times_us: Vec<i64> = planned.iter().map(|at| at.time_us).collect();
        assert_eq!(times_us, [100_000, 200_000]);
        assert!((planned[0].pose.xyz[0] - 1.0).abs() < 1e-6);
        // None, only the present one, one within the step, falling times, and equal times.
        for times_us in [&[][..], &[100_000], &[150_000], &[300_000, 200_000], &[200_000, 200_000]]
        {
            assert!(read(times_us).is_err(), "{times_us:?}");
        }
        let mut broken = plan(&[200_000]);
        broken.poses[0].pose.as_mut().unwrap().vec.as_mut().unwrap().x = f32::NAN;
        assert!(trajectory(Some(&broken), &FRAME, &here, 100_000, 100_000).is_err());
        assert!(trajectory(None, &FRAME, &here, 100_000, 100_000).is_err());
    }
}
