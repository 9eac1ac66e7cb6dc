//! Cars on slopes, through standstill and backwards.

use glam::{DQuat, DVec2, DVec3};
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_sim::ego::{
    Action, DynamicsModel, Path, Setpoint, SingleTrackState, TimedPose, Vehicle,
};
use wildcity_sim::{Command, Dynamics, Ego, Ground};

const STEP_US: i64 = 100_000;

/// Uphill along x by a tenth.
fn uphill() -> Trajectory {
    let keyframe = |i: i64| {
        let x_m = 5.0 * i as f64;
        let rotation = DQuat::from_rotation_y(-0.1_f64.atan());
        let position_m = DVec3::new(x_m, 0.0, 8.0 + 0.1 * x_m);
        Keyframe { time_us: i, world_from_rig: Pose { position_m, rotation } }
    };
    Trajectory { name: "uphill".to_owned(), keyframes: (0..=10).map(keyframe).collect() }
}

#[test]
fn a_car_is_lifted_and_pitched_by_the_ground() {
    let drives = [uphill()];
    let ground = Ground::from_drives(&drives);
    for model in [DynamicsModel::Kinematic, DynamicsModel::Dynamic] {
        let dynamics = Dynamics::checked(model, 5.0, false).unwrap();
        let start = dynamics.start_pose(Pose::IDENTITY, &ground);
        let mut ego = Ego::new(dynamics, start);
        let turn = Command::Action(Action { acceleration_m_s2: 0.0, curvature_1_m: 0.03 });
        for step in 0..60 {
            ego = ego.stepped(&turn, STEP_US, &ground).unwrap();
            let pose = ego.world_from_rig();
            let DVec3 { x, z, .. } = pose.position_m;
            assert!((z - (8.0 + 0.1 * x)).abs() < 1e-9, "{model:?}, step {step}: {pose:?}");
            let up = pose.rotation * DVec3::Z;
            let wanted = DVec3::new(-0.1, 0.0, 1.0).normalize();
            assert!(up.distance(wanted) < 1e-9, "{model:?}, step {step}: {up}");
            assert!(ego.velocity_m_s().dot(wanted).abs() < 1e-9, "it drives along the ground");
        }
        // 30 m of an arc of 33 m of radius, less what the slope takes of its plan.
        let driven_m = ego.world_from_rig().position_m - start.position_m;
        assert!(driven_m.x > 20.0 && driven_m.y > 10.0, "{model:?}: {driven_m}");
    }
}

/// The law of a step is that of its parts, also where the car stops in between and goes back.
#[test]
fn a_step_through_standstill_is_its_parts() {
    let car = Vehicle::DEFAULT;
    for (speed_m_s, acceleration_m_s2) in [(1.0, -2.0), (-1.0, 2.0), (0.01, -3.0), (-0.3, 0.5)] {
        let told = Setpoint { acceleration_m_s2, steering_rad: 0.2 };
        let begun =
            SingleTrackState { speed_m_s, steering_rad: -0.1, ..SingleTrackState::default() };
        let bounds_m_s = [-5.0, 5.0];
        let whole = begun.after(&car, told, 2.0, bounds_m_s);
        let parts = (0..200).fold(begun, |now, _| now.after(&car, told, 0.01, bounds_m_s));
        assert!(whole.speed_m_s * speed_m_s < 0.0, "it goes the other way: {whole:?}");
        let off_m = whole.position_m.distance(parts.position_m);
        let off_rad = (whole.yaw_rad - parts.yaw_rad).abs();
        assert!(off_m < 1e-9 && off_rad < 1e-9, "{speed_m_s} m/s: {off_m} m, {off_rad} rad");
        assert!(whole.position_m.distance(DVec2::ZERO) > 1e-3);
    }
}

#[test]
fn a_path_is_followed_backwards() {
    // Back along an arc of 20 m of radius at 2 m/s.
    let place = |seconds: f64| {
        let angle_rad = -2.0 * seconds / 20.0;
        let position_m = DVec3::new(20.0 * angle_rad.sin(), 20.0 * (1.0 - angle_rad.cos()), 0.0);
        Pose { position_m, rotation: DQuat::from_rotation_z(angle_rad) }
    };
    for model in [DynamicsModel::Kinematic, DynamicsModel::Dynamic] {
        let dynamics = Dynamics::checked(model, -2.0, true).unwrap();
        let mut ego = Ego::new(dynamics, Pose::IDENTITY);
        for step in 0..60 {
            let now_s = 0.1 * f64::from(step);
            let timed = |k: i64| TimedPose {
                time_us: k * STEP_US,
                start_from_rig: ego.world_from_rig().inverse() * place(now_s + 0.1 * k as f64),
            };
            let path = Path::checked((1..=20).map(timed).collect()).unwrap();
            ego = ego.stepped(&Command::Path(path), STEP_US, &Ground::from_drives(&[])).unwrap();
            let off_m = ego.world_from_rig().position_m.distance(place(now_s + 0.1).position_m);
            let allowed_m = if model == DynamicsModel::Kinematic { 0.001 } else { 0.1 };
            assert!(off_m < allowed_m, "{model:?}, step {step}: {off_m} m off");
        }
    }
}
