//! wildcity as AlpaSim's physics: the service `physics.PhysicsService`, which puts boxes on the
//! ground.
//!
//! The ground is that of the version's recorded drives, as for the simulated car. There is no mesh.

mod ground;

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_session::{Engine, SessionError};
use wildcity_sim::Ground;

use crate::limits;
use crate::scene::LocalFrame;
use crate::sensorsim::{OpenScene, SensorsimError};
use crate::wire::common::{Aabb, Pose as WirePose, PoseAtTime, Trajectory as WireTrajectory};
use crate::wire::physics as wire;

pub use ground::on_ground;

/// Puts the boxes of the ego and of other actors on the ground of a scene. `running` has a permit
/// for each request that may run at the same time.
///
/// # Errors
/// There is no such scene, or a pose or a size is missing or invalid, or too many requests run.
pub(crate) async fn ground_intersection(
    engine: &Arc<Engine>,
    running: &Arc<Semaphore>,
    asked: wire::GroundIntersectionRequest,
) -> Result<wire::GroundIntersectionReturn, Status> {
    let permit = permit(running)?;
    let scene = OpenScene::open(engine, &asked.scene_id).await?;
    // Every keyframe of the drives is tested for every box.
    let work = move || {
        // Held until the work ends, even if the client disconnects earlier.
        let _permit = permit;
        let drives = &scene.resident.version.manifest.trajectories;
        answer(drives, &scene.frame, &asked)
    };
    let answered = tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| Status::internal(error.to_string()))?;
    Ok(answered?)
}

/// The permit to run a request.
///
/// # Errors
/// None is free.
fn permit(running: &Arc<Semaphore>) -> Result<OwnedSemaphorePermit, SensorsimError> {
    let busy = SessionError::Busy { what: "requests of physics" };
    running.clone().try_acquire_owned().map_err(|_| busy.into())
}

/// The answer to a request, in a scene's local frame, on the ground of some drives.
///
/// # Errors
/// Names the pose or the size that is missing or invalid.
fn answer(
    drives: &[Trajectory],
    frame: &LocalFrame,
    asked: &wire::GroundIntersectionRequest,
) -> Result<wire::GroundIntersectionReturn, SensorsimError> {
    // The work is boxes times keyframes, so it is bounded before it begins.
    let boxes = asked.other_objects.len() + asked.ego_data.as_ref().map_or(0, ego_boxes);
    let most = limits::PHYSICS_BOXES;
    if boxes > most {
        let text = format!("{boxes} poses; at most {most} are accepted");
        return Err(SensorsimError::Invalid(text));
    }
    // One ground for all boxes of the request.
    let ground = Ground::from_drives(drives);
    let placed = |field, pose: Option<&WirePose>, height_m: f64| {
        let world: Pose = frame.world_from(field, pose)?;
        let (there, status) = on_ground(&ground, &world, height_m);
        let pose = Some(frame.local_from(&there));
        Ok::<_, SensorsimError>(wire::ReturnPose { pose, status: status.into() })
    };
    let mut answer = wire::GroundIntersectionReturn::default();
    if let Some(ego) = &asked.ego_data {
        let height_m = height_m("ego_data.aabb", ego.aabb)?;
        // A request has one form of the ego or the other, by the version of the client. Each is
        // answered in its own field.
        if let Some(pair) = &ego.pose_pair {
            let field = "ego_data.pose_pair.future_pose";
            answer.ego_pose = Some(placed(field, pair.future_pose.as_ref(), height_m)?);
        }
        if let Some(trajectory) = &ego.ego_trajectory_aabb {
            let mut poses = Vec::with_capacity(trajectory.poses.len());
            for at in &trajectory.poses {
                let field = "ego_data.ego_trajectory_aabb.poses.pose";
                let wire::ReturnPose { pose, status } = placed(field, at.pose.as_ref(), height_m)?;
                poses.push(PoseAtTime { pose, timestamp_us: at.timestamp_us });
                answer.ego_status.push(status);
            }
            answer.ego_trajectory_aabb = Some(WireTrajectory { poses });
        }
    }
    for other in &asked.other_objects {
        let height_m = height_m("other_objects.aabb", other.aabb)?;
        let pose = other.pose_pair.and_then(|pair| pair.future_pose);
        let field = "other_objects.pose_pair.future_pose";
        answer.other_poses.push(placed(field, pose.as_ref(), height_m)?);
    }
    Ok(answer)
}

fn ego_boxes(ego: &wire::EgoData) -> usize {
    let of_trajectory =
        ego.ego_trajectory_aabb.as_ref().map_or(0, |trajectory| trajectory.poses.len());
    of_trajectory + usize::from(ego.pose_pair.is_some())
}

/// The height of a box, in metres.
fn height_m(field: &str, size: Option<Aabb>) -> Result<f64, SensorsimError> {
    let size = size.ok_or_else(|| SensorsimError::Invalid(format!("{field} is missing")))?;
    let Aabb { size_x, size_y, size_z } = size;
    let most_m = wildcity_scene::ActorBox::MOST_M as f32;
    let sizes = [("size_x", size_x), ("size_y", size_y), ("size_z", size_z)];
    for (name, value) in sizes {
        // NaN is in no range, and so is refused as well.
        let accepted = (0.0..=most_m).contains(&value);
        if !accepted {
            let text = format!("{field}.{name} is {value:?}; a box has from 0 to {most_m:?} m");
            return Err(SensorsimError::Invalid(text));
        }
    }
    Ok(f64::from(size_z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::pose_to_wire;
    use crate::wire::common;
    use glam::DVec3;
    use wildcity_scene::trajectory::Keyframe;

    fn level() -> Vec<Trajectory> {
        let keyframe = |i: i64| Keyframe {
            time_us: i,
            world_from_rig: Pose {
                position_m: DVec3::new(1000.0 + i as f64, 0.0, 7.0),
                ..Pose::IDENTITY
            },
        };
        vec![Trajectory { name: "log".into(), keyframes: (0..=50).map(keyframe).collect() }]
    }

    fn wire_pose(x_m: f64, z_m: f64) -> common::Pose {
        pose_to_wire(&Pose { position_m: DVec3::new(x_m, 0.0, z_m), ..Pose::IDENTITY })
    }

    fn height(pose: Option<common::Pose>) -> f32 {
        pose.and_then(|pose| pose.vec).map_or(f32::NAN, |vec| vec.z)
    }

    #[test]
    fn both_forms_of_the_ego_and_the_others_are_answered_in_the_local_frame() {
        let frame = LocalFrame { origin_m: DVec3::new(1000.0, 0.0, 5.0) };
        let aabb = Some(Aabb { size_x: 4.0, size_y: 2.0, size_z: 1.0 });
        let pair =
            |z_m| Some(wire::PosePair { now_pose: None, future_pose: Some(wire_pose(3.0, z_m)) });
        let at = |z_m, timestamp_us| common::PoseAtTime {
            pose: Some(wire_pose(4.0, z_m)),
            timestamp_us,
        };
        // The second pose is 6.5 m too high, so it is returned as it came.
        let trajectory = common::Trajectory { poses: vec![at(2.0, 8), at(9.0, 9)] };
        let asked = wire::GroundIntersectionRequest {
            ego_data: Some(wire::EgoData {
                aabb,
                pose_pair: pair(2.25),
                ego_trajectory_aabb: Some(trajectory),
            }),
            other_objects: vec![wire::OtherObject { aabb, pose_pair: pair(3.0) }],
            ..Default::default()
        };
        let answered = answer(&level(), &frame, &asked).unwrap();
        // The ground is 2 m above the local origin, and the box is 1 m high.
        assert_eq!(height(answered.ego_pose.unwrap().pose), 2.5);
        assert_eq!(height(answered.other_poses[0].pose), 2.5);
        let poses = answered.ego_trajectory_aabb.unwrap().poses;
        assert_eq!(poses.iter().map(|at| at.timestamp_us).collect::<Vec<_>>(), [8, 9]);
        assert_eq!((height(poses[0].pose), height(poses[1].pose)), (2.5, 9.0));
        let good = wire::Status::SuccessfulUpdate;
        let high = wire::Status::HighTranslation;
        assert_eq!(answered.ego_status, [i32::from(good), i32::from(high)]);
    }

    #[test]
    fn what_is_missing_is_named() {
        let frame = LocalFrame { origin_m: DVec3::ZERO };
        let refused = |asked: wire::GroundIntersectionRequest| {
            let status = answer(&level(), &frame, &asked).unwrap_err().status();
            assert_eq!(status.code(), tonic::Code::InvalidArgument);
            status.message().to_owned()
        };
        let ego = |ego_data| wire::GroundIntersectionRequest {
            ego_data: Some(ego_data),
            ..Default::default()
        };
        let text = refused(ego(wire::EgoData::default()));
        assert!(text.contains("ego_data.aabb is missing"), "{text}");
        let aabb = Some(Aabb { size_x: 4.0, size_y: f32::NAN, size_z: 1.0 });
        let text = refused(ego(wire::EgoData { aabb, ..Default::default() }));
        assert!(text.contains("ego_data.aabb.size_y is NaN"), "{text}");
        let aabb = Some(Aabb { size_x: 4.0, size_y: 2.0, size_z: 1.0 });
        let others = |count: usize| wire::GroundIntersectionRequest {
            other_objects: vec![wire::OtherObject { aabb, pose_pair: None }; count],
            ..Default::default()
        };
        let text = refused(others(1));
        assert!(text.contains("other_objects.pose_pair.future_pose is missing"), "{text}");
        let text = refused(others(limits::PHYSICS_BOXES + 1));
        assert!(text.contains("1025 poses; at most 1024"), "{text}");
        assert_eq!(
            answer(&level(), &frame, &Default::default()).unwrap(),
            wire::GroundIntersectionReturn::default()
        );
    }

    #[test]
    fn the_ego_has_a_box_for_its_pair_and_for_each_pose_of_its_trajectory() {
        let trajectory = common::Trajectory { poses: vec![common::PoseAtTime::default(); 2] };
        let pair = wire::PosePair { now_pose: None, future_pose: None };
        let mut ego = wire::EgoData::default();
        assert_eq!(ego_boxes(&ego), 0);
        ego.ego_trajectory_aabb = Some(trajectory);
        assert_eq!(ego_boxes(&ego), 2);
        ego.pose_pair = Some(pair);
        assert_eq!(ego_boxes(&ego), 3);
    }

    #[test]
    fn a_request_without_a_permit_is_refused_for_now() {
        let running = Arc::new(Semaphore::new(1));
        let first = permit(&running).unwrap();
        let refused = permit(&running).unwrap_err().status();
        assert_eq!(refused.code(), tonic::Code::Unavailable, "{refused}");
        drop(first);
        assert!(permit(&running).is_ok());
    }
}
