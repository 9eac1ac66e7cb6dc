//! Poses, cameras and boxes, in f64 and SI units.
//!
//! Frames: *world* is the twin's local ENU frame (east, north, up). *Rig* is x forward, y left, z
//! up, with its origin on the ground under the middle of the rear axle. *Camera* follows OpenCV: x
//! right, y down, z forward. A transform `a_from_b` takes coordinates in frame `b` to frame `a`.

pub mod bounds;
pub mod camera;
pub mod lidar;
pub mod pose;

pub use bounds::Bounds;
pub use camera::{Camera, CameraError};
pub use lidar::{Lidar, LidarError};
pub use pose::{Pose, PoseError};
