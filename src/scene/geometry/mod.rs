//! Poses, cameras and boxes, in f64 and SI units.
//!
//! Frames (agents.md's conventions): *world* is the twin's local ENU in metres; *rig* is x forward,
//! y left, z up with its origin on the ground under the rear axle; *camera* is OpenCV's x right,
//! y down, z forward. A transform is named `a_from_b`: it takes coordinates in `b` to `a`.

pub mod bounds;
pub mod camera;
pub mod pose;

pub use bounds::Bounds;
pub use camera::{Camera, CameraError};
pub use pose::{Pose, PoseError};
