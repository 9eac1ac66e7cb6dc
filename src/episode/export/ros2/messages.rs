//! The bytes of ROS 2's messages. Fields are in the order of their definitions.

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_score::EgoSample;

use super::super::convert::nanoseconds;
use super::super::messages::CameraCalibration;
use super::super::sweep::{FIELDS, Number, POINT_BYTES, packed};
use super::cdr::Cdr;
use crate::sweep_point::SweepPoint;

/// The frame of the world (REP 105).
pub(super) const MAP: &str = "map";

/// The frame of the rig.
pub(super) const BASE: &str = "base_link";

/// A time of a message.
#[derive(Clone, Copy)]
pub(super) struct Stamp {
    sec: i32,
    nanosec: u32,
}

/// The pose of a frame in its parent.
pub(super) struct Transform {
    pub(super) parent: &'static str,
    pub(super) child: String,
    pub(super) pose: Pose,
}

impl Stamp {
    pub(super) fn new(time_us: i64) -> Self {
        let nanoseconds = nanoseconds(time_us);
        // Seconds of a longer episode than 68 years stay at the largest; the remainder fits u32.
        let sec = i32::try_from(nanoseconds / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (nanoseconds % 1_000_000_000) as u32 }
    }
}

impl Cdr {
    fn put_stamp(&mut self, stamp: Stamp) {
        self.put_i32(stamp.sec);
        self.put_u32(stamp.nanosec);
    }

    fn put_header(&mut self, stamp: Stamp, frame: &str) {
        self.put_stamp(stamp);
        self.put_text(frame);
    }

    fn put_vector(&mut self, vector: DVec3) {
        self.put_array(&vector.to_array());
    }

    /// Position, then rotation with the scalar last: a pose and a transform alike.
    fn put_pose(&mut self, pose: &Pose) {
        self.put_vector(pose.position_m);
        self.put_array(&pose.rotation.to_array());
    }
}

pub(super) fn clock(stamp: Stamp) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.put_stamp(stamp);
    cdr.finish()
}

pub(super) fn compressed_image(stamp: Stamp, frame: &str, jpeg: &[u8]) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.put_header(stamp, frame);
    cdr.put_text("jpeg");
    cdr.put_bytes(jpeg);
    cdr.finish()
}

/// An unorganised cloud: beams without a return are left out.
pub(super) fn point_cloud(stamp: Stamp, frame: &str, points: &[SweepPoint]) -> Vec<u8> {
    // A sweep has 2²⁰ beams at most, whose bytes fit u32.
    let count = points.len() as u32;
    let mut cdr = Cdr::new();
    cdr.put_header(stamp, frame);
    cdr.put_u32(1);
    cdr.put_u32(count);
    cdr.put_len(FIELDS.len());
    for (name, offset, number) in FIELDS {
        cdr.put_text(name);
        cdr.put_u32(offset);
        // The constants of `sensor_msgs/PointField`.
        cdr.put_u8(match number {
            Number::U16 => 4,
            Number::I32 => 5,
            Number::F32 => 7,
        });
        cdr.put_u32(1);
    }
    // The numbers are not big-endian.
    cdr.put_bool(false);
    cdr.put_u32(POINT_BYTES);
    cdr.put_u32(POINT_BYTES * count);
    cdr.put_bytes(&packed(points));
    // All points are finite.
    cdr.put_bool(true);
    cdr.finish()
}

pub(super) fn camera_info(stamp: Stamp, frame: &str, calibration: &CameraCalibration) -> Vec<u8> {
    let CameraCalibration { width, height, distortion_model, d, k, r, p, .. } = calibration;
    let mut cdr = Cdr::new();
    cdr.put_header(stamp, frame);
    cdr.put_u32(*height);
    cdr.put_u32(*width);
    cdr.put_text(ros_model(distortion_model));
    cdr.put_sequence(d);
    [k, r, p].into_iter().for_each(|matrix| cdr.put_array(matrix));
    // No binning, and the whole image as the region of interest.
    (0..6).for_each(|_| cdr.put_u32(0));
    cdr.put_bool(false);
    cdr.finish()
}

/// The name of a model of distortion in ROS (`sensor_msgs/distortion_models.hpp`).
fn ros_model(foxglove: &str) -> &str {
    match foxglove {
        "kannala_brandt" | "fisheye" => "equidistant",
        "" => "plumb_bob",
        name => name,
    }
}

pub(super) fn transforms(stamp: Stamp, transforms: &[Transform]) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.put_len(transforms.len());
    for Transform { parent, child, pose } in transforms {
        cdr.put_header(stamp, parent);
        cdr.put_text(child);
        cdr.put_pose(pose);
    }
    cdr.finish()
}

/// The ego in the map; its velocities are in its own frame. Unknown velocities are zero, with a
/// first covariance of -1.
pub(super) fn odometry(stamp: Stamp, map_from_base: &Pose, motion: Option<EgoSample>) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.put_header(stamp, MAP);
    cdr.put_text(BASE);
    cdr.put_pose(map_from_base);
    cdr.put_array(&[0.0; 36]);
    let linear = motion.map_or(DVec3::ZERO, |motion| motion.velocity_mps.extend(0.0));
    let yaw_rate = motion.map_or(0.0, |motion| motion.yaw_rate_radps);
    cdr.put_vector(linear);
    cdr.put_vector(yaw_rate * DVec3::Z);
    let mut covariance = [0.0; 36];
    covariance[0] = if motion.is_some() { 0.0 } else { -1.0 };
    cdr.put_array(&covariance);
    cdr.finish()
}

/// Poses in a frame, all with one time.
pub(super) fn path<'a>(
    stamp: Stamp,
    frame: &str,
    poses: impl ExactSizeIterator<Item = &'a Pose>,
) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.put_header(stamp, frame);
    cdr.put_len(poses.len());
    for pose in poses {
        cdr.put_header(stamp, frame);
        cdr.put_pose(pose);
    }
    cdr.finish()
}
