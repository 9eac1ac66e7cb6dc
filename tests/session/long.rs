//! Episodes of 100,000 steps, nearly three hours of driving, stay exact and reproducible.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use wildcity_scene::geometry::Pose;
use wildcity_session::Episode;
use wildcity_sim::ego::{Action, DynamicsModel};
use wildcity_sim::{Command, Dynamics, Ego, Ground};

const STEPS: u64 = 100_000;
const STEP_US: i64 = 100_000;

/// Largest accepted [`skewness`], 9 epsilons. Normalising leaves a quaternion's length within 2
/// epsilons of 1, so the product of its matrix with the transpose is within 4 epsilons of the
/// identity, and is rounded itself.
const MAX_SKEWNESS: f64 = 2e-15;

fn episode(model: DynamicsModel, start: Pose, speed_m_s: f64) -> Episode {
    let dynamics = Dynamics::checked(model, speed_m_s, false).unwrap();
    Episode::new(7, Ego::new(dynamics, start), STEP_US)
}

/// How far a matrix is from a rotation: the largest element of `M Mᵀ - I`.
fn skewness(pose: &Pose) -> f64 {
    let matrix = pose.rotation_matrix();
    let rest = matrix * matrix.transpose() - glam::DMat3::IDENTITY;
    rest.to_cols_array().into_iter().fold(0.0, |worst, part| worst.max(part.abs()))
}

#[test]
fn a_thousand_laps_end_where_they_began() {
    // 10 m/s on a circle with a circumference of 100 m: a metre per step.
    let action = Action { acceleration_m_s2: 0.0, curvature_1_m: TAU / 100.0 };
    // Each step rounds the position to half an ulp, and the heading, which acts at the radius of 16
    // m: over 100,000 steps, 1.8e-15 m and 16 x 1.1e-16 m each near the origin, and 7.3e-12 m each
    // where coordinates are 100 km.
    for (away_m, bound_m) in [(0.0, 1e-9), (1e5, 1e-6)] {
        let rotation = DQuat::from_euler(glam::EulerRot::ZYX, 0.7, 0.05, -0.02);
        let start = Pose { position_m: DVec3::new(away_m, -away_m, 30.0), rotation };
        let mut driven = episode(DynamicsModel::Kinematic, start, 10.0);
        let mut worst_m = 0.0f64;
        for step in 1..=STEPS {
            driven =
                driven.stepped(&Command::Action(action), &Ground::from_drives(&[]), false).unwrap();
            let pose = driven.world_from_rig();
            assert!(skewness(&pose) < MAX_SKEWNESS, "step {step}: {pose:?}");
            if step % 100 == 0 {
                worst_m = worst_m.max(pose.position_m.distance(start.position_m));
            }
        }
        assert_eq!((driven.step(), driven.time_us()), (STEPS, STEPS as i64 * STEP_US));
        eprintln!("{away_m} m from the origin: {worst_m:e} m of drift");
        assert!(worst_m < bound_m, "{away_m} m from the origin: {worst_m} m of drift");
        let driven_m = driven.summary(wildcity_session::Outcome::Completed).distance_m;
        // The sum of the chords, 2 r sin(φ/2) each, up to 100,000 roundings by half an ulp of 1e5
        // m.
        let chords_m = STEPS as f64 * 100.0 / TAU * 2.0 * (TAU / 200.0).sin();
        assert!((driven_m - chords_m).abs() < 1e-6, "{driven_m} m, not {chords_m}");
    }
}

#[test]
fn a_dynamic_car_driven_twice_is_bit_identical() {
    let drive = || {
        let mut driven = episode(DynamicsModel::Dynamic, Pose::IDENTITY, 5.0);
        let mut hasher = blake3::Hasher::new();
        for step in 0..STEPS {
            // Repeatedly stops, starts and turns.
            let phase = step as f64;
            let action = Action {
                acceleration_m_s2: 6.0 * (phase / 70.0).sin(),
                curvature_1_m: 0.05 * (phase / 31.0).sin(),
            };
            driven =
                driven.stepped(&Command::Action(action), &Ground::from_drives(&[]), false).unwrap();
            let pose = driven.world_from_rig();
            assert!(skewness(&pose) < MAX_SKEWNESS, "step {step}: {pose:?}");
            let speed_m_s = driven.ego().velocity_m_s().dot(pose.rotation * DVec3::X);
            assert!((-1e-9..60.0 + 1e-9).contains(&speed_m_s), "step {step}: {speed_m_s} m/s");
            for number in pose.position_m.to_array().into_iter().chain(pose.q_wxyz()) {
                hasher.update(&number.to_le_bytes());
            }
        }
        assert_eq!(driven.time_us(), STEPS as i64 * STEP_US);
        hasher.finalize()
    };
    assert_eq!(drive(), drive());
}
