//! The observation: one binary frame in safetensors layout.
//!
//! 8 bytes little-endian header length, a JSON header (space-padded), raw tensor bytes. The
//! header's `__metadata__` is `{"observation": "<JSON of ObservationMetadata>"}`: safetensors allows only
//! strings there.
//!
//! Tensors, in this order: `ego.history_xyz` f32 `[16, 3]`, `ego.history_rot` f32 `[16, 3, 3]`,
//! then per image `camera/<name>/depth` f32 and `camera/<name>/opacity` f32 and `camera/<name>/normals` f32 where asked for, then
//! per image `camera/<name>/rgb` u8. The header's length is a multiple of 8 and floats come first,
//! so that they lie on multiples of 4 and can be read in place. With several poses (`observe`)
//! image names start with `pose/<k>/`. Last come earlier frames, where asked for:
//! `camera/<name>/history/<back>/rgb` u8.

use serde::{Deserialize, Serialize};

use super::camera::{Lens, Windshield};
use super::message::{Encoding, Pose};

/// What an observation says beside its tensors.
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
    /// The twin.
    pub twin: String,
    /// Its version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// BLAKE3 of the render profile's JSON, in hex.
    pub profile_hash: String,
    /// Name of the backend.
    pub backend: String,
    /// BLAKE3 of the images' hashes (32 bytes each, in order), in hex.
    pub frame_hash: String,
    /// The ego at this time.
    pub ego: Ego,
    /// The images, in order; none between two decisions.
    pub images: Vec<Image>,
    /// Earlier frames of the same cameras, camera by camera, the newest first; absent if there are
    /// none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Image>,
    /// What it cost.
    pub timings: Timings,
    /// What of it had to be loaded.
    pub residency: Residency,
}

/// The ego vehicle at one time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Ego {
    /// `world_from_rig`.
    pub pose: Pose,
    /// Velocity in world axes, in m/s: now, or of a teleport over the last step, and zero at step 0.
    pub velocity: [f64; 3],
    /// Change of velocity over the last step per second, in world axes, in m/s²; zero as long as no
    /// velocity before is known.
    pub acceleration: [f64; 3],
    /// Yaw rate about the rig's z axis, to the left, in rad/s: now, or of a teleport over the last step.
    pub yaw_rate: f64,
    /// Angle of the front wheels, to the left, in radians; absent of a teleport, which has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steering: Option<f64>,
    /// How many poses of the history, counted from its end, were driven; the earlier ones repeat
    /// the start.
    pub history_count: u64,
}

/// One image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Image {
    /// Name of the camera.
    pub camera: String,
    /// Its index in `opened.cameras`.
    pub index: u64,
    /// Which of the request's poses: 0 but for `observe`.
    pub pose: u64,
    /// How many frames of this camera ago; absent, for 0, in `images`.
    #[serde(default, skip_serializing_if = "is_now")]
    pub back: u64,
    /// Name of the colour tensor; `depth`, `opacity` and `normals` replace `rgb` at its end.
    pub tensor: String,
    /// How the colour image travels.
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
    /// The lens, where it is no pinhole, as it maps rays to the image as sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
    /// The windshield before it, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub windshield: Option<Windshield>,
    /// The share of the image that the lens sees, where that is not all of it: elsewhere colour, depth
    /// and opacity are 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen: Option<f64>,
    /// `rig_from_camera`.
    pub camera_to_rig: Pose,
    /// Exposure of the first row, in simulated microseconds; equal to the end with a global shutter.
    pub shutter_start_us: i64,
    /// Exposure of the last row, in simulated microseconds: the image's time.
    pub shutter_end_us: i64,
    /// BLAKE3 of the image's raw pixel bytes (`[height, width, 3]`, before encoding), in hex.
    pub hash: String,
    /// How far it may be believed, if asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<Trust>,
}

/// How far an image may be believed, and why.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Trust {
    /// 1 where and as it was recorded, 0 where nothing is known.
    pub value: f64,
    /// From the rig to the nearest recorded keyframe, in metres.
    pub distance_m: f64,
    /// Between the rig's axes there and here, in radians.
    pub angle_rad: f64,
    /// Share of pixels of less than half opacity, of those that look down at the ground.
    pub low_coverage: f64,
    /// Share of rays that meet no block of the twin, of those that look down.
    pub outside: f64,
}

fn is_now(back: &u64) -> bool {
    *back == 0
}

/// What an observation cost, in milliseconds of wall time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Timings {
    /// Waiting for other sessions' frames.
    pub queue_ms: f64,
    /// Rendering, with the encoding that ran beside it.
    pub render_ms: f64,
    /// CPU time of encoding and hashing, most of it beside rendering.
    pub encode_ms: f64,
    /// Wall time of each render stage.
    pub stages_ms: Vec<Stage>,
}

/// Memory of the server behind an observation. What is in memory never changes what is drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Residency {
    /// Bytes of Gaussians in memory, of all twins.
    pub held_bytes: u64,
    /// Bytes that there may be.
    pub limit_bytes: u64,
    /// Sections of the twin that were not in memory when the request came.
    pub waited_for: u64,
    /// How long the request waited until they were, in microseconds of wall time.
    pub waited_us: u64,
}

/// Wall time of a render stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Stage {
    /// Name of the stage.
    pub name: String,
    /// Its time, in milliseconds.
    pub ms: f64,
}
