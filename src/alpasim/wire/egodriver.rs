//! Package `egodriver`: inputs of a driver from a runtime, and its plan.

#![allow(missing_docs, reason = "the fields are AlpaSim's, and are explained there")]

use super::common::{Trajectory, Vec3};
use super::sensorsim::AvailableCamera;

// The tags have gaps: drivers also get fields that wildcity does not have, and read them as absent.

/// State of the ego in the axes of its rig: m/s, rad/s, m/s².
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct DynamicState {
    #[prost(message, optional, tag = "1")]
    pub angular_velocity: Option<Vec3>,
    #[prost(message, optional, tag = "2")]
    pub linear_velocity: Option<Vec3>,
    #[prost(message, optional, tag = "3")]
    pub linear_acceleration: Option<Vec3>,
    #[prost(message, optional, tag = "4")]
    pub angular_acceleration: Option<Vec3>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct VehicleDefinition {
    #[prost(message, repeated, tag = "3")]
    pub available_cameras: Vec<AvailableCamera>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RolloutSpec {
    #[prost(message, optional, tag = "1")]
    pub vehicle: Option<VehicleDefinition>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct DriveSessionRequest {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
    #[prost(fixed64, tag = "2")]
    pub random_seed: u64,
    #[prost(message, optional, tag = "5")]
    pub rollout_spec: Option<RolloutSpec>,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct SessionRequestStatus {}

#[derive(Clone, PartialEq, prost::Message)]
pub struct DriveSessionCloseRequest {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct CameraImage {
    #[prost(fixed64, tag = "2")]
    pub frame_start_us: u64,
    #[prost(fixed64, tag = "3")]
    pub frame_end_us: u64,
    #[prost(bytes = "vec", tag = "4")]
    pub image_bytes: Vec<u8>,
    #[prost(string, tag = "5")]
    pub logical_id: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RolloutCameraImage {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
    #[prost(message, optional, tag = "3")]
    pub camera_image: Option<CameraImage>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RolloutEgoTrajectory {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
    #[prost(message, optional, tag = "3")]
    pub trajectory: Option<Trajectory>,
    #[prost(message, repeated, tag = "5")]
    pub dynamic_states: Vec<DynamicState>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct Route {
    #[prost(message, repeated, tag = "1")]
    pub waypoints: Vec<Vec3>,
    #[prost(fixed64, tag = "2")]
    pub timestamp_us: u64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RouteRequest {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
    #[prost(message, optional, tag = "3")]
    pub route: Option<Route>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct DriveRequest {
    #[prost(string, tag = "1")]
    pub session_uuid: String,
    #[prost(fixed64, tag = "3")]
    pub time_now_us: u64,
    #[prost(fixed64, tag = "4")]
    pub time_query_us: u64,
}

/// A plan. Its debug information is a pickle, and is not read.
#[derive(Clone, PartialEq, prost::Message)]
pub struct DriveResponse {
    #[prost(message, optional, tag = "2")]
    pub trajectory: Option<Trajectory>,
    #[prost(bool, tag = "4")]
    pub terminate_session: bool,
}
