//! Package `nre.grpc.protos.sensorsim`: cameras, render requests and images.

#![allow(missing_docs, reason = "the fields are AlpaSim's, and are explained there")]

use super::common::{Pose, Trajectory};

// An enumeration is an i32 in its message: a number that is not listed reads as the first entry, 0.

#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum ShutterType {
    Unknown = 0,
    RollingTopToBottom = 1,
    RollingLeftToRight = 2,
    RollingBottomToTop = 3,
    RollingRightToLeft = 4,
    Global = 5,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum ImageFormat {
    Undefined = 0,
    Png = 1,
    Jpeg = 2,
    Jpeg2000 = 3,
    RgbUint8Planar = 4,
    Avc = 5,
    Av1 = 6,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum PolynomialType {
    Unknown = 0,
    PixeldistToAngle = 1,
    AngleToPixeldist = 2,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum ReferencePolynomial {
    Forward = 0,
    Backward = 1,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct LinearCde {
    #[prost(double, tag = "1")]
    pub linear_c: f64,
    #[prost(double, tag = "2")]
    pub linear_d: f64,
    #[prost(double, tag = "3")]
    pub linear_e: f64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct FthetaCameraParam {
    #[prost(double, tag = "1")]
    pub principal_point_x: f64,
    #[prost(double, tag = "2")]
    pub principal_point_y: f64,
    #[prost(enumeration = "PolynomialType", tag = "3")]
    pub reference_poly: i32,
    #[prost(double, repeated, tag = "4")]
    pub pixeldist_to_angle_poly: Vec<f64>,
    #[prost(double, repeated, tag = "5")]
    pub angle_to_pixeldist_poly: Vec<f64>,
    #[prost(double, tag = "6")]
    pub max_angle: f64,
    #[prost(message, optional, tag = "7")]
    pub linear_cde: Option<LinearCde>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct OpenCvPinholeCameraParam {
    #[prost(double, tag = "1")]
    pub principal_point_x: f64,
    #[prost(double, tag = "2")]
    pub principal_point_y: f64,
    #[prost(double, tag = "3")]
    pub focal_length_x: f64,
    #[prost(double, tag = "4")]
    pub focal_length_y: f64,
    #[prost(double, repeated, tag = "5")]
    pub radial_coeffs: Vec<f64>,
    #[prost(double, repeated, tag = "6")]
    pub tangential_coeffs: Vec<f64>,
    #[prost(double, repeated, tag = "7")]
    pub thin_prism_coeffs: Vec<f64>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct OpenCvFisheyeCameraParam {
    #[prost(double, tag = "1")]
    pub principal_point_x: f64,
    #[prost(double, tag = "2")]
    pub principal_point_y: f64,
    #[prost(double, tag = "3")]
    pub focal_length_x: f64,
    #[prost(double, tag = "4")]
    pub focal_length_y: f64,
    #[prost(double, repeated, tag = "5")]
    pub radial_coeffs: Vec<f64>,
    #[prost(double, tag = "6")]
    pub max_angle: f64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct BivariateWindshieldModelParameters {
    #[prost(enumeration = "ReferencePolynomial", tag = "1")]
    pub reference_poly: i32,
    #[prost(double, repeated, tag = "2")]
    pub horizontal_poly: Vec<f64>,
    #[prost(double, repeated, tag = "3")]
    pub vertical_poly: Vec<f64>,
    #[prost(double, repeated, tag = "4")]
    pub horizontal_poly_inverse: Vec<f64>,
    #[prost(double, repeated, tag = "5")]
    pub vertical_poly_inverse: Vec<f64>,
}

// The tags of a oneof share the numbers of the message that contains it, `CameraSpec`.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum CameraParam {
    #[prost(message, tag = "2")]
    Ftheta(FthetaCameraParam),
    #[prost(message, tag = "3")]
    OpencvPinhole(OpenCvPinholeCameraParam),
    #[prost(message, tag = "4")]
    OpencvFisheye(OpenCvFisheyeCameraParam),
}

#[derive(Clone, PartialEq, prost::Oneof)]
pub enum ExternalDistortion {
    #[prost(message, tag = "10")]
    BivariateWindshield(BivariateWindshieldModelParameters),
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct CameraSpec {
    #[prost(string, tag = "1")]
    pub temporary_camera_spec: String,
    #[prost(oneof = "CameraParam", tags = "2, 3, 4")]
    pub camera_param: Option<CameraParam>,
    #[prost(string, tag = "5")]
    pub logical_id: String,
    #[prost(uint32, tag = "7")]
    pub resolution_h: u32,
    #[prost(uint32, tag = "8")]
    pub resolution_w: u32,
    #[prost(enumeration = "ShutterType", tag = "9")]
    pub shutter_type: i32,
    #[prost(oneof = "ExternalDistortion", tags = "10")]
    pub external_distortion: Option<ExternalDistortion>,
}

/// Poses at the start and the end of an exposure.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct PosePair {
    #[prost(message, optional, tag = "1")]
    pub start_pose: Option<Pose>,
    #[prost(message, optional, tag = "2")]
    pub end_pose: Option<Pose>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct DynamicObject {
    #[prost(string, tag = "1")]
    pub track_id: String,
    #[prost(message, optional, tag = "2")]
    pub pose_pair: Option<PosePair>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct EgoMaskId {
    #[prost(string, tag = "1")]
    pub camera_logical_id: String,
    #[prost(string, tag = "2")]
    pub rig_config_id: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct EgoMaskMetadata {
    #[prost(message, optional, tag = "1")]
    pub ego_mask_id: Option<EgoMaskId>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableEgoMasksReturn {
    #[prost(message, repeated, tag = "1")]
    pub ego_mask_metadata: Vec<EgoMaskMetadata>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RgbRenderRequest {
    #[prost(string, tag = "1")]
    pub scene_id: String,
    #[prost(uint32, tag = "2")]
    pub resolution_h: u32,
    #[prost(uint32, tag = "3")]
    pub resolution_w: u32,
    #[prost(message, optional, tag = "4")]
    pub camera_intrinsics: Option<CameraSpec>,
    #[prost(fixed64, tag = "5")]
    pub frame_start_us: u64,
    #[prost(fixed64, tag = "6")]
    pub frame_end_us: u64,
    #[prost(message, optional, tag = "7")]
    pub sensor_pose: Option<PosePair>,
    #[prost(message, repeated, tag = "8")]
    pub dynamic_objects: Vec<DynamicObject>,
    #[prost(enumeration = "ImageFormat", tag = "9")]
    pub image_format: i32,
    #[prost(float, tag = "10")]
    pub image_quality: f32,
    #[prost(bool, tag = "11")]
    pub insert_ego_mask: bool,
    #[prost(message, optional, tag = "12")]
    pub ego_mask_id: Option<EgoMaskId>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct RgbRenderReturn {
    #[prost(bytes = "vec", tag = "1")]
    pub image_bytes: Vec<u8>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct BatchRgbRenderRequest {
    #[prost(message, repeated, tag = "1")]
    pub items: Vec<BatchRgbRenderRequestItem>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct BatchRgbRenderRequestItem {
    #[prost(string, tag = "1")]
    pub camera_name: String,
    #[prost(message, optional, tag = "2")]
    pub request: Option<RgbRenderRequest>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct BatchRgbRenderReturn {
    #[prost(message, repeated, tag = "1")]
    pub items: Vec<BatchRgbRenderReturnItem>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct BatchRgbRenderReturnItem {
    #[prost(string, tag = "1")]
    pub camera_name: String,
    #[prost(message, optional, tag = "2")]
    pub result: Option<RgbRenderReturn>,
    #[prost(bool, tag = "3")]
    pub success: bool,
    #[prost(string, tag = "4")]
    pub error_message: String,
}

/// A LiDAR whose beams are known by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, prost::Enumeration)]
#[repr(i32)]
pub enum LidarDeviceType {
    Pandar128 = 0,
    At128 = 1,
}

#[derive(Clone, Copy, PartialEq, prost::Message)]
pub struct LidarSpec {
    #[prost(enumeration = "LidarDeviceType", tag = "2")]
    pub lidar_type: i32,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct LidarRenderRequest {
    #[prost(string, tag = "1")]
    pub scene_id: String,
    #[prost(message, optional, tag = "2")]
    pub lidar_config: Option<LidarSpec>,
    #[prost(fixed64, tag = "3")]
    pub frame_start_us: u64,
    #[prost(fixed64, tag = "4")]
    pub frame_end_us: u64,
    #[prost(message, optional, tag = "5")]
    pub sensor_pose: Option<PosePair>,
    #[prost(message, repeated, tag = "6")]
    pub dynamic_objects: Vec<DynamicObject>,
}

/// The points of a sweep, in the LiDAR's axes at its end.
#[derive(Clone, PartialEq, prost::Message)]
pub struct LidarRenderReturn {
    /// x, y and z of one point after the other, in metres.
    #[prost(float, repeated, tag = "1")]
    pub point_xyzs: Vec<f32>,
    /// From 0 to 1.
    #[prost(float, repeated, tag = "2")]
    pub point_intensities: Vec<f32>,
    #[prost(uint32, tag = "3")]
    pub num_points: u32,
    /// The same as little-endian f32.
    #[prost(bytes = "vec", tag = "4")]
    pub point_xyzs_buffer: Vec<u8>,
    #[prost(bytes = "vec", tag = "5")]
    pub point_intensities_buffer: Vec<u8>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AggregatedRenderRequest {
    #[prost(message, repeated, tag = "1")]
    pub rgb_requests: Vec<RgbRenderRequest>,
    #[prost(message, repeated, tag = "2")]
    pub lidar_requests: Vec<LidarRenderRequest>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AggregatedRenderReturn {
    #[prost(message, repeated, tag = "1")]
    pub rgb_returns: Vec<RgbRenderReturn>,
    #[prost(message, repeated, tag = "2")]
    pub lidar_returns: Vec<LidarRenderReturn>,
    #[prost(bytes = "vec", tag = "3")]
    pub driver_data: Vec<u8>,
}

/// A request that names a scene: of its cameras, or of its trajectories.
#[derive(Clone, PartialEq, prost::Message)]
pub struct SceneRequest {
    #[prost(string, tag = "1")]
    pub scene_id: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableCamera {
    #[prost(message, optional, tag = "1")]
    pub intrinsics: Option<CameraSpec>,
    #[prost(message, optional, tag = "2")]
    pub rig_to_camera: Option<Pose>,
    #[prost(string, tag = "3")]
    pub logical_id: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableCamerasReturn {
    #[prost(message, repeated, tag = "1")]
    pub available_cameras: Vec<AvailableCamera>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableTrajectory {
    #[prost(message, optional, tag = "2")]
    pub trajectory: Option<Trajectory>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct AvailableTrajectoriesReturn {
    #[prost(message, repeated, tag = "1")]
    pub available_trajectories: Vec<AvailableTrajectory>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct LoadedSceneEntry {
    #[prost(string, tag = "1")]
    pub scene_id: String,
    #[prost(uint64, tag = "2")]
    pub loaded_instance_count: u64,
    #[prost(uint64, tag = "3")]
    pub reusable_instance_count: u64,
}

#[derive(Clone, PartialEq, prost::Message)]
pub struct LoadedScenesReturn {
    #[prost(message, repeated, tag = "1")]
    pub scenes: Vec<LoadedSceneEntry>,
    #[prost(uint64, tag = "2")]
    pub loaded_instance_capacity: u64,
}
