//! Control messages: JSON text frames.
//!
//! Answers may gain fields, so the types in them let unknown ones pass. In requests unknown fields
//! are mistakes: types of requests refuse them, and [`super::unknown_field`] finds them within the
//! types that both ways share.
//!
//! One file, since whoever speaks the protocol reads it from top to bottom: requests, what they hold,
//! answers.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::camera::{Exposure, Lens, Shutter, Windshield};
use super::error::Code;

/// A rigid transform: position in metres, unit quaternion (w, x, y, z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Pose {
    /// Position, in metres.
    pub xyz: [f64; 3],
    /// Unit quaternion (w, x, y, z).
    pub q: [f64; 4],
}

/// What a client sends. Every request gets exactly one answer with the same `seq`.
///
/// `seq` counts the requests of a connection from 0 without gaps; after `resume` it goes on from the
/// session's. A request that was carried out is never carried out again: its number brings the same
/// answer again. One that was refused can be sent again under its number, or under the next.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// First of a connection. Answer: `welcome`.
    Hello {
        /// Number of this request.
        seq: u64,
        /// Who is calling, for the server's log.
        client: ClientInfo,
        /// Protocol versions that the client speaks.
        protocols: Vec<String>,
    },
    /// Opens a session on a twin. Answer: `opened`.
    Open(Box<Open>),
    /// Moves the ego, lets `dt_us` pass and renders. Exactly one of `pose`, `trajectory` and `action` says
    /// how. Answer: an observation.
    Step {
        /// Number of this request.
        seq: u64,
        /// `world_from_rig` at the end of the step, of an ego that teleports.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pose: Option<Pose>,
        /// Where the ego is to be next, 1 to 64 poses in order of time, to beyond the step's end.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        trajectory: Option<Vec<TimedPose>>,
        /// How the ego is to move, of one that is driven.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        action: Option<Action>,
        /// Whether the episode ends with this step.
        #[serde(default)]
        terminate: bool,
    },
    /// Renders poses without moving. Answer: one observation with all of them.
    Observe {
        /// Number of this request.
        seq: u64,
        /// `world_from_rig` each; 1 to `limits.observe_poses`.
        poses: Vec<Pose>,
    },
    /// Loads what is seen from where the ego may go next. Answer: `ok`, before it is loaded.
    Prefetch {
        /// Number of this request.
        seq: u64,
        /// `world_from_rig` each, in the order of the way; what lies straight between them counts. In
        /// place of those of the request before.
        poses: Vec<Pose>,
    },
    /// Starts a new episode in the same session. Answer: an observation.
    Reset {
        /// Number of this request.
        seq: u64,
        /// Seed of the episode.
        #[serde(default)]
        seed: u64,
        /// Where to start; the session's start if absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        start: Option<Start>,
    },
    /// Sees another version of the twin from the next step on; the episode goes on. Answer:
    /// `switched`.
    SwitchVersion {
        /// Number of this request.
        seq: u64,
        /// The version; the latest if absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        version: Option<u64>,
    },
    /// Ends the session. Answer: `closed`.
    Close {
        /// Number of this request.
        seq: u64,
    },
    /// Continues a session after a lost connection, in place of `open`. Answer: `resumed`.
    Resume {
        /// Number of this request on the new connection.
        seq: u64,
        /// Name of the session.
        session: String,
        /// Last `seq` whose answer arrived.
        last_seq: u64,
    },
}

/// A pose of a trajectory that an agent wants to drive.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TimedPose {
    /// Time since the step's start, in microseconds; above that of the pose before, and above 0.
    pub time_us: i64,
    /// The rig then, in the frame of the rig at the step's start.
    pub pose: Pose,
}

/// Acceleration and curvature for one step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Action {
    /// Along the car, in m/s², -9.8 to 9.8.
    pub acceleration: f64,
    /// Of the rear axle's way, in 1/m, to the left, -0.2 to 0.2.
    pub curvature: f64,
}

/// How the ego moves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Dynamics {
    /// The model.
    pub model: DynamicsModel,
    /// Speed at the start of an episode, in m/s.
    #[serde(default)]
    pub speed: f64,
    /// Whether a car that brakes beyond standstill goes backwards; else it stands.
    #[serde(default)]
    pub reverse: bool,
}

/// A model of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "schema", schemars(rename = "Model"))]
pub enum DynamicsModel {
    /// Goes to the pose that it is told.
    Teleport,
    /// Rolls without slipping, and has acceleration and curvature at once.
    Kinematic,
    /// A single track with linear tyres, whose steering and drive lag by 0.1 s.
    Dynamic,
}

/// Who is calling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ClientInfo {
    /// Program or library.
    pub name: String,
    /// Its version.
    pub version: String,
}

/// Opens a session on a twin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Open {
    /// Number of this request.
    pub seq: u64,
    /// Name of the twin.
    pub twin: String,
    /// Its version; the latest if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<u64>,
    /// Name for the session; chosen by the server if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub session: Option<String>,
    /// Seed of the first episode.
    #[serde(default)]
    pub seed: u64,
    /// Where to start; the start of the twin's first trajectory, or its origin, if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Start>,
    /// Cameras; the twin's rig, or the preset `vehicle6`, if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<RigChoice>,
    /// Fields of the twin's render profile that this session wants otherwise, as `{"tau_px": 2.0}`; the
    /// server's own changes, if it has any, for those that are absent.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub profile: serde_json::Map<String, serde_json::Value>,
    /// What each observation holds.
    #[serde(default)]
    pub outputs: Outputs,
    /// How the ego moves; by teleport if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<DynamicsChoice>,
    /// Simulated time of a step, in microseconds; the server's default if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dt_us: Option<i64>,
    /// How long an answer may take, in milliseconds; the server's limit if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deadline_ms: Option<u64>,
    /// Time between two decisions of the agent, in simulated microseconds, whole steps: only those
    /// observations have images. Every one if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub decision_us: Option<i64>,
    /// How much of the recorded drive lies before the start, in microseconds: its poses are the ego's
    /// history, and its frames are in the first bundle. 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warm_up_us: Option<i64>,
}

impl Open {
    /// The latest version of a twin, and every default.
    pub fn twin(name: impl Into<String>) -> Self {
        Self {
            seq: 0,
            twin: name.into(),
            version: None,
            session: None,
            seed: 0,
            start: None,
            rig: None,
            profile: serde_json::Map::new(),
            outputs: Outputs::default(),
            dynamics: None,
            dt_us: None,
            deadline_ms: None,
            decision_us: None,
            warm_up_us: None,
        }
    }
}

/// Where an episode starts.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum Start {
    /// At a pose.
    Pose {
        /// `world_from_rig`.
        pose: Pose,
    },
    /// Somewhere along a recorded trajectory.
    Station {
        /// Name of the trajectory.
        trajectory: String,
        /// Distance along it, in metres.
        #[serde(default)]
        station_m: f64,
    },
}

/// Which cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum RigChoice {
    /// A preset, by name.
    Preset(String),
    /// All of them, written out.
    Full(Rig),
}

/// How the ego moves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum DynamicsChoice {
    /// A model, from standstill.
    Model(DynamicsModel),
    /// All of it, written out.
    Full(Dynamics),
}

/// The cameras of a vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Name.
    pub name: String,
    /// Cameras, in the order in which images are answered.
    pub cameras: Vec<RigCamera>,
}

/// A camera on the vehicle, a pinhole unless it has a lens; all intrinsics in pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct RigCamera {
    /// Name.
    pub name: String,
    /// Image width.
    pub width: u64,
    /// Image height.
    pub height: u64,
    /// Focal length along x; answers have it always, requests may leave it to an f-theta lens.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fx: Option<f64>,
    /// Focal length along y, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fy: Option<f64>,
    /// Principal point, x, from the image's left edge.
    pub cx: f64,
    /// Principal point, y, from the image's top edge.
    pub cy: f64,
    /// The lens, where it is no pinhole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens: Option<Lens>,
    /// The windshield before it, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub windshield: Option<Windshield>,
    /// How its rows are exposed one after the other; all at once if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shutter: Option<Shutter>,
    /// What it makes of colours; they are as they are if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure: Option<Exposure>,
    /// What of its own car it sees: a PNG with opacity, of the image's size, laid over it, as
    /// `data:image/png;base64,..`. Answers do not repeat it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overlay: Option<String>,
    /// `rig_from_camera`: camera axes are x right, y down, z forward.
    pub camera_to_rig: Pose,
}

/// What each observation holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Outputs {
    /// Names of the cameras to render, in the order wanted; all if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cameras: Option<Vec<String>>,
    /// Other parts and sizes of images than the rig's, by the camera's name; the cameras of `opened`
    /// describe what is sent.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub images: BTreeMap<String, ImagePart>,
    /// How colour images travel.
    pub encoding: Encoding,
    /// JPEG quality, 1 to 100; ignored by the other encodings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quality: Option<u8>,
    /// Whether to add `depth`, f32 `[height, width]`: expected camera z in metres.
    pub depth: bool,
    /// Whether to add `opacity`, f32 `[height, width]`: the validity of depth and colour.
    pub opacity: bool,
    /// Whether to add `normals`, f32 `[height, width, 3]`: unit vectors in the camera's axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normals: Option<bool>,
    /// How many last frames of each camera an observation holds; 1 if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames: Option<u64>,
    /// Whether to say how far each image may be believed; false if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trust: Option<bool>,
    /// Time between two frames by camera, in simulated microseconds, whole steps; every step takes one
    /// if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub period_us: Option<BTreeMap<String, i64>>,
}

impl Default for Outputs {
    fn default() -> Self {
        Self {
            cameras: None,
            images: BTreeMap::new(),
            encoding: Encoding::Jpeg,
            quality: None,
            depth: false,
            opacity: false,
            normals: None,
            frames: None,
            trust: None,
            period_us: None,
        }
    }
}

/// What is sent of a camera's image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct ImagePart {
    /// First column and row, width and height of the part, in the rig's pixels; all of it if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<[u64; 4]>,
    /// Width and height that the part is drawn at, in pixels; as many as it has if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<[u64; 2]>,
}

/// How colour images travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// A JPEG file, u8 `[n]`.
    Jpeg,
    /// A PNG file, u8 `[n]`.
    Png,
    /// Pixels, u8 `[height, width, 3]`.
    Raw,
}

/// What the server sends as text.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Answer {
    /// To `hello`.
    Welcome {
        /// Number of the request.
        seq: u64,
        /// The protocol version chosen.
        protocol: String,
        /// Name, version and build of the server.
        server: ServerInfo,
        /// What the server accepts.
        limits: Limits,
        /// Name of the backend that renders.
        backend: String,
        /// Twins that can be opened.
        twins: Vec<TwinInfo>,
    },
    /// To `open`: everything resolved, nothing implicit.
    Opened(Box<Opened>),
    /// To `resume`.
    Resumed {
        /// Number of the request.
        seq: u64,
        /// Name of the session.
        session: String,
        /// Last request that the session carried out: repeat it to get its answer again, or go on
        /// with the number after it.
        last_seq: u64,
        /// Steps done in the episode.
        step: u64,
        /// Simulated time, in microseconds.
        time_us: i64,
    },
    /// To `prefetch`.
    Ok {
        /// Number of the request.
        seq: u64,
    },
    /// To `switch_version`: what the session sees from now on.
    Switched {
        /// Number of the request.
        seq: u64,
        /// The version.
        version: u64,
        /// BLAKE3 of the version's manifest, in hex.
        version_hash: String,
        /// BLAKE3 of the render profile's JSON, in hex.
        profile_hash: String,
        /// The render profile: numbers and switches by name.
        profile: serde_json::Map<String, serde_json::Value>,
    },
    /// To `close`.
    Closed {
        /// Number of the request.
        seq: u64,
        /// What happened.
        summary: Summary,
    },
    /// To any request that was refused. A refused request changes nothing and can be sent again.
    Error {
        /// Number of the request; absent if it could not be read.
        #[serde(skip_serializing_if = "Option::is_none")]
        seq: Option<u64>,
        /// What went wrong.
        code: Code,
        /// For people: what, and how to fix it.
        message: String,
        /// The field at fault, as `pose.q[2]`.
        #[serde(skip_serializing_if = "Option::is_none")]
        field: Option<String>,
        /// Whether the connection ends with this message.
        fatal: bool,
    },
}

/// Name, version and build of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ServerInfo {
    /// `wildcity`.
    pub name: String,
    /// Version of the package.
    pub version: String,
}

/// What the server accepts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Limits {
    /// Largest message to the server, in bytes.
    pub message_bytes: u64,
    /// Poses of one `observe`.
    pub observe_poses: u64,
    /// Cameras of a rig.
    pub cameras: u64,
    /// Longest image side, in pixels.
    pub side_px: u64,
    /// Pixels of one answer.
    pub answer_pixels: u64,
    /// Longest silence before the connection is closed, in milliseconds.
    pub idle_ms: u64,
    /// How long a session can be resumed, in milliseconds.
    pub resume_ms: u64,
}

/// A twin that can be opened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct TwinInfo {
    /// Name.
    pub name: String,
    /// Latest version.
    pub version: u64,
    /// BLAKE3 of that version's manifest, in hex.
    pub version_hash: String,
    /// Gaussians in it.
    pub gaussians: u64,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Recorded trajectories.
    pub trajectories: Vec<TrajectoryInfo>,
}

/// A recorded trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct TrajectoryInfo {
    /// Name.
    pub name: String,
    /// Length, in metres.
    pub length_m: f64,
    /// Keyframes.
    pub keyframes: u64,
}

/// An open session.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Opened {
    /// Number of the request.
    pub seq: u64,
    /// Name of the session.
    pub session: String,
    /// The twin.
    pub twin: String,
    /// Its version.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// BLAKE3 of the render profile's JSON, in hex.
    pub profile_hash: String,
    /// The render profile: numbers and switches by name.
    pub profile: serde_json::Map<String, serde_json::Value>,
    /// Name of the backend.
    pub backend: String,
    /// Seed of the first episode.
    pub seed: u64,
    /// `world_from_rig` at time zero.
    pub start: Pose,
    /// How the ego moves.
    pub dynamics: Dynamics,
    /// Simulated time of a step, in microseconds.
    pub dt_us: i64,
    /// How long an answer may take, in milliseconds.
    pub deadline_ms: u64,
    /// Time between two observations with images, in microseconds.
    pub decision_us: i64,
    /// How much of the recorded drive lies before the start, in microseconds.
    pub warm_up_us: i64,
    /// Cameras in the order of the images, with intrinsics as sent.
    pub cameras: Vec<RigCamera>,
    /// What each observation holds.
    pub outputs: Outputs,
    /// The twin's recorded trajectories.
    pub trajectories: Vec<TrajectoryInfo>,
    /// Memory of the server that is set aside for the session's largest frame, in bytes.
    pub reserved_bytes: u64,
}

/// How an episode went.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Summary {
    /// Why it ended.
    pub outcome: Outcome,
    /// Steps done.
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Distance driven, in metres.
    pub distance_m: f64,
    /// The least mean trust of an observation's images; with `outputs.trust`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_trust: Option<f64>,
}

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The agent closed it, or ended it with `terminate`.
    Completed,
    /// The same, and images of a reset or a step had a trust below 0.1 on average: the agent left what was
    /// recorded. Told only with `outputs.trust`.
    OffModel,
    /// The agent broke the protocol beyond repair.
    AgentError,
    /// The agent was silent for too long.
    AgentTimeout,
    /// The connection was lost and not resumed in time.
    AgentLost,
    /// A fault of the server.
    ServerError,
}
