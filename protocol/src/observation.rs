//! The observation: one binary frame in safetensors layout.
//!
//! The frame starts with the length of its header, 8 bytes little-endian. Then come the header,
//! JSON padded with spaces, and the bytes of the tensors. The header's `__metadata__` is
//! `{"observation": "<JSON of ObservationMetadata>"}`, because safetensors allows only strings
//! there.
//!
//! The order of the tensors:
//!
//! 1. `ego.history_xyz`, f32 `[16, 3]`, and `ego.history_rot`, f32 `[16, 3, 3]`.
//!    Then, as requested, `sensor.imu`, f32 `[n, 6]`, and `sensor.wheel_speed`, f32 `[n]`.
//!    For each LiDAR `lidar/<name>/points`, f32 `[n, 3]`, and `lidar/<name>/intensity`, f32 `[n]`.
//! 2. For each image, as requested, `camera/<name>/depth`, `camera/<name>/opacity` and
//!    `camera/<name>/normals`, all f32.
//! 3. For each LiDAR `lidar/<name>/row`, `lidar/<name>/column` and `lidar/<name>/instance`, u16
//!    `[n]`.
//!    If requested, for each image `camera/<name>/instances`, u16.
//!    If requested, for each image `camera/<name>/semantics`, u8.
//! 4. For each image `camera/<name>/rgb`, u8.
//! 5. If requested, earlier frames: `camera/<name>/history/<back>/rgb`, u8.
//!
//! The answer to `step_many` has the same layout: its header has
//! `{"many": "<JSON of ManyMetadata>"}`, and its tensors are u8 `[n]`, each a whole observation.
//!
//! Image names start with `pose/<k>/` if there are several poses (`observe`). The length of the
//! header is a multiple of 8 and floats come first, so floats are aligned to 4 bytes, and instances
//! to 2, and can be read in place.

use serde::{Deserialize, Serialize};

use crate::camera::{Lens, Windshield};
use crate::error::Code;
use crate::message::{Encoding, Pose};

/// Everything that an observation holds beside its tensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(rename = "Observation"))]
pub struct ObservationMetadata {
    /// Number of the request.
    pub seq: u64,
    /// Steps done in the episode; 0 after `reset`.
    pub step: u64,
    /// Simulated time since the episode's start, in microseconds.
    pub time_us: i64,
    /// Name of the session.
    pub session: String,
    /// Seed of the episode.
    pub seed: u64,
    /// Whether the episode has ended.
    pub terminated: bool,
    /// Name of the twin.
    pub twin: String,
    /// Its version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// The twin's latest version, if it is newer than `version`: `switch_version` shows it. It is
    /// known about a second after it was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub newer_version: Option<u64>,
    /// BLAKE3 of the render profile's JSON, in hex.
    pub profile_hash: String,
    /// Name of the backend.
    pub backend: String,
    /// BLAKE3 of the hashes of the images and then of the sweeps (32 bytes each, in order), in hex.
    pub frame_hash: String,
    /// State of the ego at this time.
    pub ego: Ego,
    /// Place and heading of the ego on the earth. Only if the twin says where it lies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub geo: Option<Geo>,
    /// The images, in order. Empty between two decisions.
    pub images: Vec<Image>,
    /// The sweeps of the LiDARs, in the order of the rig. Only of observations of the ego itself,
    /// not of `observe`, and empty between two decisions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sweeps: Vec<Sweep>,
    /// Earlier frames of the same cameras, camera by camera, newest first. Absent if there are
    /// none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Image>,
    /// What happened since the observation before, by time. Only with a scenario.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub events: Vec<Event>,
    /// Where to drive. Only with a scenario that has a route.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub route: Option<Route>,
    /// The actors that are there. Only with `outputs.actors`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actors: Option<Vec<Actor>>,
    /// Wall time that the observation took.
    pub timings: Timings,
    /// Memory of the server, and how long the observation waited for loading.
    pub residency: Residency,
}

/// What the answer to `step_many` holds beside the observations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(rename = "Many"))]
pub struct ManyMetadata {
    /// Number of the request.
    pub seq: u64,
    /// What each step gave, in the order of the request.
    pub answers: Vec<SessionAnswer>,
}

/// What one step of a `step_many` gave: an observation or a refusal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SessionAnswer {
    /// Name of the session.
    pub session: String,
    /// Name of the tensor that is the observation. Absent if the step was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tensor: Option<String>,
    /// Why the step was refused. The session is as it was before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<SessionRefusal>,
}

/// Why a step of a `step_many` was refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SessionRefusal {
    /// Error code.
    pub code: Code,
    /// What went wrong and how to fix it, for people.
    pub message: String,
    /// The field at fault, for example `steps[3].pose.q`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
}

/// State of the ego vehicle at one time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ego {
    /// `world_from_rig`.
    pub pose: Pose,
    /// Velocity in world axes, in m/s. With teleport dynamics: the displacement of the last step
    /// divided by its time, zero at step 0.
    pub velocity: [f64; 3],
    /// Change of the velocity over the last step, per second, in world axes, in m/s². Zero as long
    /// as no earlier velocity is known.
    pub acceleration: [f64; 3],
    /// Yaw rate about the rig's z axis, positive to the left, in rad/s. With teleport dynamics: the
    /// mean over the last step.
    pub yaw_rate: f64,
    /// Angle of the front wheels, positive to the left, in radians. Absent with teleport dynamics,
    /// which have no wheels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steering: Option<f64>,
    /// Number of poses of the history, counted from its end, that were driven. The earlier ones
    /// repeat the start.
    pub history_count: u64,
}

/// Something that happened in a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Event {
    /// When, in simulated microseconds.
    pub time_us: i64,
    /// What.
    pub kind: EventKind,
    /// Name of the actor, if it is about one. A contact without an actor is one with the twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actor: Option<String>,
    /// Name of the trigger, or the reason of an end: `time`, `off_route`, `contact`, `stuck`,
    /// `route_done` or `condition`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Whether the ego is at fault for the contact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_fault: Option<bool>,
    /// Speed of the two against each other at the contact, in m/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub impact: Option<f64>,
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// The ego began to touch an actor, or the twin.
    Contact,
    /// A trigger of an actor fired.
    Trigger,
    /// An actor appeared.
    Appeared,
    /// An actor disappeared.
    Left,
    /// The ego left the area that the twin was trained on. Its images are not reliable from now on.
    OffModel,
    /// A rule ended the episode.
    End,
}

/// Where to drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Route {
    /// Up to 20 points of the route in the rig's frame, in metres: the first beside the ego, then
    /// every 80/19 m.
    pub points: Vec<[f64; 3]>,
    /// What to do next.
    pub command: NavigationCommand,
    /// The same in words, if the scenario has them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Distance of the ego along the route, in metres.
    pub station_m: f64,
    /// Distance of the ego from the route, in metres.
    pub off_m: f64,
    /// Length of the route, in metres.
    pub length_m: f64,
}

/// What to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum NavigationCommand {
    /// To the left.
    Left,
    /// To the right.
    Right,
    /// Straight on.
    Straight,
}

/// An actor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Actor {
    /// Name within the scenario.
    pub name: String,
    /// `vehicle`, `pedestrian`, `bicycle` or `object`.
    pub kind: String,
    /// Its number in the tensors `instances`.
    #[serde(default)]
    pub instance: u16,
    /// Length, width and height of its box, in metres.
    pub size: [f64; 3],
    /// `world_from_actor`: the box's origin is on the ground under its middle, x forward, z up.
    pub pose: Pose,
    /// Velocity in world axes, in m/s.
    pub velocity: [f64; 3],
    /// Yaw rate, positive to the left, in rad/s.
    pub yaw_rate: f64,
}

/// Place and heading of the ego on the earth (WGS84).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Geo {
    /// Latitude, in degrees, positive to the north.
    pub latitude: f64,
    /// Longitude, in degrees, positive to the east.
    pub longitude: f64,
    /// Height of the rig's origin above the ellipsoid, in metres.
    pub altitude: f64,
    /// Direction of the rig's x axis, in degrees from true north to the east, 0 to 360.
    pub heading: f64,
}

/// One image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Image {
    /// Name of the camera.
    pub camera: String,
    /// Index of the camera in `opened.cameras`.
    pub index: u64,
    /// Index of the request's pose. Always 0 except after `observe`.
    pub pose: u64,
    /// Number of this camera's frames since this one. 0, and therefore absent, in `images`.
    #[serde(default, skip_serializing_if = "is_now")]
    pub back: u64,
    /// Name of the colour tensor. The names of the other tensors have `depth`, `opacity`,
    /// `normals`, `instances` or `semantics` in place of its final `rgb`.
    pub tensor: String,
    /// Encoding of the colour image.
    pub encoding: Encoding,
    /// Width, in pixels.
    pub width: u64,
    /// Height, in pixels.
    pub height: u64,
    /// Focal length along x, in pixels, of the image as sent.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point, x, in pixels.
    pub cx: f64,
    /// Principal point, y, in pixels.
    pub cy: f64,
    /// The lens model, for the image as sent. Absent for a pinhole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
    /// The windshield in front of the lens, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub windshield: Option<Windshield>,
    /// Fraction of the image that the lens sees, if that is not all of it. In the rest, colour,
    /// depth and opacity are 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen: Option<f64>,
    /// `rig_from_camera`.
    pub camera_to_rig: Pose,
    /// Time at which the first row is exposed, in simulated microseconds. Equal to `shutter_end_us`
    /// with a global shutter.
    pub shutter_start_us: i64,
    /// Time at which the last row is exposed, in simulated microseconds. This is the image's time.
    pub shutter_end_us: i64,
    /// BLAKE3 of the image's raw pixel bytes (`[height, width, 3]`, before encoding), in hex: of
    /// what is sent, after repair and after the effects of the sensors.
    pub hash: String,
    /// Confidence in the image, if the session asked for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<Trust>,
    /// What became of the image, if the session asked for repair.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair: Option<ImageRepair>,
    /// What the camera did to the image, if the session asked for effects of this camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<ImageSensor>,
}

/// One sweep of a LiDAR.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Sweep {
    /// Name of the LiDAR. Its tensors are `lidar/<name>/points`, in metres in the rig's axes when
    /// their column was fired, `lidar/<name>/intensity`, `lidar/<name>/row`,
    /// `lidar/<name>/column` and `lidar/<name>/instance`; with `outputs.semantics`, u8
    /// `lidar/<name>/class`, too, as in the semantics of an image.
    pub lidar: String,
    /// Time of the first column, in simulated microseconds.
    pub start_us: i64,
    /// Time of the last column, in simulated microseconds: that of the observation. The columns
    /// between are fired at equal distances.
    pub end_us: i64,
    /// Number of rows of the beams.
    pub rows: u64,
    /// Number of columns of the beams.
    pub columns: u64,
    /// Number of points: one for each beam that has a return.
    pub returns: u64,
    /// `rig_from_lidar`.
    pub lidar_to_rig: Pose,
    /// BLAKE3 of these tensors in the order above, in hex.
    pub hash: String,
}

/// What a camera with effects did to an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ImageSensor {
    /// Whether anything was done to it.
    pub status: SensorStatus,
    /// What was done.
    pub reasons: Vec<SensorReason>,
    /// When the frame was due, in simulated microseconds. The shutter times are those that the
    /// camera claims: earlier than this for a frame that stands in for a dropped or late one.
    pub due_us: i64,
    /// When the picture was taken, in simulated microseconds: before the shutter times if the
    /// camera is frozen.
    pub taken_us: i64,
    /// Offset of the exposure, in stops. Only with a drift of the exposure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stops: Option<f64>,
    /// BLAKE3 of the raw pixel bytes before noise, exposure and dirt, in hex. Absent if the camera
    /// has none of them: it is the image's `hash` then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clean_hash: Option<String>,
}

/// Whether a camera did anything to an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum SensorStatus {
    /// Nothing: it is the frame that was due, as rendered.
    Ok,
    /// Something: the reasons say what.
    Degraded,
}

/// What a camera did to an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum SensorReason {
    /// The frame was lost; the last one that arrived stands in for it.
    Dropped,
    /// The frame has not arrived yet; the last one that arrived stands in for it.
    Late,
    /// The picture stands still.
    Frozen,
    /// It has noise.
    Noise,
    /// Its exposure drifts.
    Exposure,
    /// The lens is dirty.
    Dirt,
}

/// What became of an image in a session that asked for repair. Depth, opacity, normals,
/// instances and classes stay those of the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ImageRepair {
    /// What became of it.
    pub status: RepairStatus,
    /// BLAKE3 of the raw pixel bytes before the repair, in hex: the image's `hash` unless the
    /// status is `repaired`.
    pub rendered_hash: String,
    /// Why the model failed. Only with the status `failed`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<RepairFailure>,
    /// The recorded images that the model saw beside it, at most 8: those that gave most pixels
    /// first. Only with the status `repaired`, and if the model needs some.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub references: Vec<String>,
}

/// What became of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum RepairStatus {
    /// It was not selected: it is as rendered.
    Kept,
    /// It was repaired.
    Repaired,
    /// It was selected, but the model failed: it is as rendered.
    Failed,
}

/// Why a model failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum RepairFailure {
    /// It ran longer than its limit and was stopped.
    TimedOut,
    /// It returned NaN or infinity.
    NotFinite,
    /// It ran too long too often and is not used any more. Open another session to load it again.
    Withdrawn,
    /// Anything else. The server's log has the message.
    Other,
}

/// Confidence in an image: how close it is to what was recorded, and the measurements behind that
/// number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Trust {
    /// 1 at a recorded pose, 0 where nothing is known.
    pub value: f64,
    /// Distance from the rig to the nearest recorded keyframe, in metres.
    pub distance_m: f64,
    /// Angle between the rig's orientation there and here, in radians.
    pub angle_rad: f64,
    /// Among the pixels that look down at the ground, the fraction with an opacity below one half.
    pub low_coverage: f64,
    /// Among the rays that look down at the ground, the fraction that meets no block of the twin.
    pub outside: f64,
}

fn is_now(back: &u64) -> bool {
    *back == 0
}

/// Wall time that an observation took, in milliseconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Timings {
    /// Time spent waiting for other sessions' frames.
    pub queue_ms: f64,
    /// Time of rendering, including the encoding that ran in parallel.
    pub render_ms: f64,
    /// CPU time of encoding and hashing, most of it in parallel with rendering.
    pub encode_ms: f64,
    /// Wall time of the repair. Only if the session asked for repair.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair_ms: Option<f64>,
    /// Wall time of each render stage.
    pub stages_ms: Vec<Stage>,
}

/// Memory of the server. What is in memory never changes the images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Residency {
    /// Bytes of Gaussians in memory, over all twins.
    pub held_bytes: u64,
    /// Largest number of bytes of Gaussians that may be in memory.
    pub limit_bytes: u64,
    /// Number of sections of the twin that were not in memory when the request came.
    pub waited_for: u64,
    /// How long the request waited for them, in microseconds of wall time.
    pub waited_us: u64,
}

/// Wall time of a render stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Stage {
    /// Name of the stage.
    pub name: String,
    /// Wall time of the stage, in milliseconds.
    pub ms: f64,
}
