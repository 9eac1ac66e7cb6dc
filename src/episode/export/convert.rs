//! Times, poses and boxes as Foxglove's messages have them.

use wildcity_scene::geometry::Pose;

use super::messages as foxglove;

/// Offset that is added to the times of an episode, in microseconds.
// A warm-up has negative times, down to -20 s.
const TIME_OFFSET_US: i64 = 1_000_000_000;

pub(super) fn nanoseconds(time_us: i64) -> u64 {
    // A time before the offset becomes 0. 2⁶³ µs are more nanoseconds than a u64 holds, so that the
    // product saturates.
    u64::try_from(time_us.saturating_add(TIME_OFFSET_US)).unwrap_or(0).saturating_mul(1000)
}

pub(super) fn timestamp(time_us: i64) -> foxglove::Timestamp {
    let nanoseconds = nanoseconds(time_us);
    foxglove::Timestamp {
        // u64::MAX / 10⁹ = 1.8 · 10¹⁰ fits an i64, and a remainder below 10⁹ fits an i32.
        seconds: (nanoseconds / 1_000_000_000) as i64,
        nanos: (nanoseconds % 1_000_000_000) as i32,
    }
}

pub(super) fn vector([x, y, z]: [f64; 3]) -> foxglove::Vector3 {
    foxglove::Vector3 { x, y, z }
}

pub(super) fn pose(pose: &Pose) -> foxglove::Pose {
    foxglove::Pose {
        position: Some(vector(pose.position_m.to_array())),
        orientation: Some(quaternion(pose)),
    }
}

/// A pose at a place, with the axes of its frame.
pub(super) fn place(xyz_m: [f64; 3]) -> foxglove::Pose {
    pose(&Pose { position_m: xyz_m.into(), ..Pose::IDENTITY })
}

fn quaternion(pose: &Pose) -> foxglove::Quaternion {
    // Foxglove puts the scalar last, and this project first.
    let [w, x, y, z] = pose.q_wxyz();
    foxglove::Quaternion { x, y, z, w }
}

pub(super) fn transform(
    parent: &str,
    child: &str,
    time_us: i64,
    pose: &Pose,
) -> foxglove::FrameTransform {
    foxglove::FrameTransform {
        timestamp: Some(timestamp(time_us)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(vector(pose.position_m.to_array())),
        rotation: Some(quaternion(pose)),
    }
}

/// The frame of a camera: x right, y down, z into the image.
pub(super) fn camera_frame(camera: usize) -> String {
    format!("camera/{camera}")
}

pub(super) fn color(r: f64, g: f64, b: f64, a: f64) -> foxglove::Color {
    foxglove::Color { r, g, b, a }
}

/// An entity without shapes.
pub(super) fn entity(time_us: i64, frame: &str, id: &str) -> foxglove::SceneEntity {
    foxglove::SceneEntity {
        timestamp: Some(timestamp(time_us)),
        frame_id: frame.to_owned(),
        id: id.to_owned(),
        // Moves with its frame between two updates, as the ego's box does with the rig.
        frame_locked: true,
        ..foxglove::SceneEntity::default()
    }
}

pub(super) fn cube(
    center: &Pose,
    size_m: [f64; 3],
    color: foxglove::Color,
) -> foxglove::CubePrimitive {
    foxglove::CubePrimitive {
        pose: Some(pose(center)),
        size: Some(vector(size_m)),
        color: Some(color),
    }
}
