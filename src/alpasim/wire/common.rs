//! Package `common`: poses and versions.

#![allow(missing_docs, reason = "the fields are AlpaSim's, and are explained there")]

// Every message field is an `Option`: a sender may leave it out, and the reader names what it
// misses.
// A tag that is not here is a field that this project does not read; prost skips it.

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Empty {}

/// A quaternion; not normalised.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Quat {
    #[prost(float, tag = "1")]
    pub w: f32,
    #[prost(float, tag = "2")]
    pub x: f32,
    #[prost(float, tag = "3")]
    pub y: f32,
    #[prost(float, tag = "4")]
    pub z: f32,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Vec3 {
    #[prost(float, tag = "1")]
    pub x: f32,
    #[prost(float, tag = "2")]
    pub y: f32,
    #[prost(float, tag = "3")]
    pub z: f32,
}

/// Size of a box, in metres.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Aabb {
    #[prost(float, tag = "1")]
    pub size_x: f32,
    #[prost(float, tag = "2")]
    pub size_y: f32,
    #[prost(float, tag = "3")]
    pub size_z: f32,
}

/// A rigid transform: p_a = R(quat) p_b + vec.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct Pose {
    #[prost(message, optional, tag = "1")]
    pub vec: Option<Vec3>,
    #[prost(message, optional, tag = "2")]
    pub quat: Option<Quat>,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct PoseAtTime {
    #[prost(message, optional, tag = "1")]
    pub pose: Option<Pose>,
    #[prost(fixed64, tag = "2")]
    pub timestamp_us: u64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct Trajectory {
    #[prost(message, repeated, tag = "1")]
    pub poses: Vec<PoseAtTime>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct VersionId {
    #[prost(string, tag = "1")]
    pub version_id: String,
    #[prost(string, tag = "2")]
    pub git_hash: String,
    #[prost(message, optional, tag = "3")]
    pub grpc_api_version: Option<ApiVersion>,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct ApiVersion {
    #[prost(uint32, tag = "1")]
    pub major: u32,
    #[prost(uint32, tag = "2")]
    pub minor: u32,
    #[prost(uint32, tag = "3")]
    pub patch: u32,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableScenesReturn {
    #[prost(string, repeated, tag = "1")]
    pub scene_ids: Vec<String>,
}
