//! Recorded drives with known properties.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use glam::{DQuat, DVec3};
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;

/// A drive through these positions at these times.
pub(crate) fn drive(poses: impl IntoIterator<Item = (i64, DVec3)>) -> Trajectory {
    let keyframe = |(time_us, position_m)| Keyframe {
        time_us,
        world_from_rig: Pose { position_m, rotation: DQuat::IDENTITY },
    };
    Trajectory { name: "log".into(), keyframes: poses.into_iter().map(keyframe).collect() }
}

/// East at 10 m/s, a keyframe every 0.1 s.
pub(crate) fn straight(length_m: u32) -> Trajectory {
    drive((0..=i64::from(length_m)).map(|i| (100_000 * i, DVec3::new(i as f64, 0.0, 0.0))))
}
