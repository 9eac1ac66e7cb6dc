//! Package `physics`: boxes that are put on the ground.
//!
//! AlpaSim has had two forms of the ego: one pose (`pose_pair`, answered by `ego_pose`), and later
//! a trajectory (`ego_trajectory_aabb`, answered by the field of the same name and `ego_status`).
//! Their field numbers differ, so that one message has both.

#![allow(missing_docs, reason = "the fields are AlpaSim's, and are explained there")]

use super::common::{Aabb, Pose, Trajectory};

// Success is 0, which is also what a status that was not sent reads as.
#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum Status {
    SuccessfulUpdate = 0,
    Unknown = 1,
    InsufficientPointsFitplane = 2,
    HighTranslation = 3,
    HighRotation = 4,
}

/// Poses of the middle of a box, now and at the end of the step.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct PosePair {
    #[prost(message, optional, tag = "1")]
    pub now_pose: Option<Pose>,
    #[prost(message, optional, tag = "2")]
    pub future_pose: Option<Pose>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct EgoData {
    #[prost(message, optional, tag = "1")]
    pub aabb: Option<Aabb>,
    #[prost(message, optional, tag = "2")]
    pub pose_pair: Option<PosePair>,
    #[prost(message, optional, tag = "3")]
    pub ego_trajectory_aabb: Option<Trajectory>,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct OtherObject {
    #[prost(message, optional, tag = "1")]
    pub aabb: Option<Aabb>,
    #[prost(message, optional, tag = "2")]
    pub pose_pair: Option<PosePair>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct GroundIntersectionRequest {
    #[prost(string, tag = "1")]
    pub scene_id: String,
    #[prost(fixed64, tag = "2")]
    pub now_us: u64,
    #[prost(fixed64, tag = "3")]
    pub future_us: u64,
    #[prost(message, optional, tag = "4")]
    pub ego_data: Option<EgoData>,
    #[prost(message, repeated, tag = "5")]
    pub other_objects: Vec<OtherObject>,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct ReturnPose {
    #[prost(message, optional, tag = "1")]
    pub pose: Option<Pose>,
    #[prost(enumeration = "Status", tag = "2")]
    pub status: i32,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct GroundIntersectionReturn {
    #[prost(message, optional, tag = "1")]
    pub ego_pose: Option<ReturnPose>,
    #[prost(message, repeated, tag = "2")]
    pub other_poses: Vec<ReturnPose>,
    #[prost(message, optional, tag = "4")]
    pub ego_trajectory_aabb: Option<Trajectory>,
    #[prost(enumeration = "Status", repeated, tag = "5")]
    pub ego_status: Vec<i32>,
}
