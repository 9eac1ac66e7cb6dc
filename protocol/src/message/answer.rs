//! Answers: text messages from the server.

use serde::{Deserialize, Serialize};

use super::drive::Drive;
use super::{Dynamics, OnFailure, Outputs, Pose, RigCamera, Sensors};
use crate::error::Code;

/// A text message from the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Answer {
    /// Answer to `hello`.
    Welcome {
        /// Number of the request.
        seq: u64,
        /// The protocol version that the server chose.
        protocol: String,
        /// Name and version of the server.
        server: ServerInfo,
        /// The server's limits.
        limits: Limits,
        /// Name of the render backend.
        backend: String,
        /// Twins that can be opened.
        twins: Vec<TwinInfo>,
        /// Names of the models that can repair images. Absent if there are none.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        repairs: Vec<String>,
    },
    /// Answer to `open` and to `branch`: every setting of the session, defaults included.
    Opened(Box<Opened>),
    /// Answer to `resume`.
    Resumed {
        /// Number of the request.
        seq: u64,
        /// Name of the session.
        session: String,
        /// Number of the last request that the session carried out. Repeat that request to get its
        /// answer again, or continue with the next number.
        last_seq: u64,
        /// Steps done in the episode.
        step: u64,
        /// Simulated time, in microseconds.
        time_us: i64,
        /// The settings of the session, as in the answer to `open`; the version is the present one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        opened: Option<Box<Opened>>,
        /// The other sessions that the request named, in its order.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        also: Vec<ResumedSession>,
    },
    /// Answer to `prefetch`, to `snapshot` and to `share_memory` with a proof.
    Ok {
        /// Number of the request.
        seq: u64,
    },
    /// Answer to `share_memory` without `proof`: the memory that the server offers. Its first bytes
    /// are the proof.
    SharedMemory {
        /// Number of the request.
        seq: u64,
        /// Path by which the memory can be opened, of a client in the same container and of the
        /// same user.
        path: String,
        /// Target of that path, which is a symbolic link. If it has another one, the path is of
        /// another machine or container, and must not be opened.
        target: String,
        /// Bytes of the proof, at the beginning of the memory.
        proof_bytes: u64,
        /// Number of slots.
        slots: u64,
        /// Bytes from one slot to the next.
        slot_bytes: u64,
    },
    /// In place of an observation, or of the answer to `step_many`: where in the shared memory it
    /// is.
    InMemory {
        /// Number of the request.
        seq: u64,
        /// Index of the slot.
        slot: u64,
        /// Offset in the memory, in bytes.
        offset: u64,
        /// Length of the message, in bytes.
        bytes: u64,
    },
    /// Answer to `switch_version`: the version that the session shows from the next step on.
    Switched {
        /// Number of the request.
        seq: u64,
        /// The version.
        version: u64,
        /// BLAKE3 of the version's manifest, in hex.
        version_hash: String,
        /// BLAKE3 of the render profile's JSON, in hex.
        profile_hash: String,
        /// The render profile: numbers and booleans by name.
        profile: serde_json::Map<String, serde_json::Value>,
    },
    /// Answer to `close`.
    Closed {
        /// Number of the request.
        seq: u64,
        /// Summary of the last episode.
        summary: Summary,
    },
    /// Answer to a refused request. A refused request changes nothing and can be sent again.
    Error {
        /// Number of the request. Absent if the server could not read it.
        #[serde(skip_serializing_if = "Option::is_none")]
        seq: Option<u64>,
        /// Error code.
        code: Code,
        /// What went wrong and how to fix it, for people.
        message: String,
        /// The field at fault, for example `pose.q[2]`.
        #[serde(skip_serializing_if = "Option::is_none")]
        field: Option<String>,
        /// Whether the server closes the connection after this message.
        fatal: bool,
    },
}

/// Name and version of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ServerInfo {
    /// `wildcity`.
    pub name: String,
    /// Version of the package.
    pub version: String,
}

/// The server's limits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Limits {
    /// Largest message to the server, in bytes.
    pub message_bytes: u64,
    /// Largest number of poses of one `observe`.
    pub observe_poses: u64,
    /// Largest number of cameras of a rig.
    pub cameras: u64,
    /// Longest image side, in pixels.
    pub side_px: u64,
    /// Largest number of pixels of one answer, over all its images.
    pub answer_pixels: u64,
    /// How long a client may send nothing before the server closes the connection, in milliseconds.
    pub idle_ms: u64,
    /// How long a session can be resumed after its connection is lost, in milliseconds.
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
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// Number of Gaussians.
    pub gaussians: u64,
    /// Degree of the spherical harmonics.
    pub sh_degree: u8,
    /// The recorded trajectories.
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
    /// Number of keyframes.
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
    /// Name of the twin.
    pub twin: String,
    /// Version of the twin.
    pub version: u64,
    /// BLAKE3 of the version's manifest, in hex.
    pub version_hash: String,
    /// BLAKE3 of the render profile's JSON, in hex.
    pub profile_hash: String,
    /// The render profile: numbers and booleans by name.
    pub profile: serde_json::Map<String, serde_json::Value>,
    /// Name of the backend.
    pub backend: String,
    /// Seed of the first episode.
    pub seed: u64,
    /// `world_from_rig` at time zero; after `branch`, where a `reset` without a start begins.
    pub start: Pose,
    /// How the ego moves.
    pub dynamics: Dynamics,
    /// Simulated time of a step, in microseconds.
    pub dt_us: i64,
    /// How long an answer may take, in milliseconds.
    pub deadline_ms: u64,
    /// Time between two observations with images, in microseconds.
    pub decision_us: i64,
    /// Length of the recorded drive before the start, in microseconds.
    pub warm_up_us: i64,
    /// The cameras in the order of the images, with the intrinsics of the images as sent.
    pub cameras: Vec<RigCamera>,
    /// The LiDARs, in the order of the sweeps.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lidars: Vec<OpenedLidar>,
    /// What each observation holds.
    pub outputs: Outputs,
    /// The twin's recorded trajectories.
    pub trajectories: Vec<TrajectoryInfo>,
    /// Memory of the server that is reserved for the largest frame of the session and its images,
    /// in bytes.
    pub reserved_bytes: u64,
    /// The repair of the images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repair: Option<OpenedRepair>,
    /// Effects of the sensors, and the delay of the planner.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Sensors>,
    /// The scenario.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenario: Option<OpenedScenario>,
    /// What the tensors `semantics` mean, if the session asked for them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub semantics: Option<OpenedSemantics>,
    /// The part of a recorded drive that `open` asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trajectory: Option<Drive>,
}

/// A LiDAR of a session's rig.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct OpenedLidar {
    /// Name within the rig.
    pub name: String,
    /// Number of rows of its beams.
    pub rows: u64,
    /// Number of columns of its beams.
    pub columns: u64,
    /// Time of a revolution, or of a frame of a LiDAR that does not spin, in microseconds.
    pub duration_us: i64,
    /// Nothing nearer returns, in metres.
    pub min_range_m: f64,
    /// Nothing farther returns, in metres.
    pub max_range_m: f64,
    /// Pose of the LiDAR on the rig.
    pub lidar_to_rig: Pose,
}

/// What the values of `semantics` mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct OpenedSemantics {
    /// Whether the Gaussians of the twin have classes. Without them, all of the twin is unlabelled,
    /// and only actors have classes.
    pub labelled: bool,
    /// The name of each value, from 0 on: `none`, `unlabelled`, and then the names of Cityscapes.
    pub classes: Vec<String>,
}

/// The repair of a session's images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct OpenedRepair {
    /// Name of the model.
    pub model: String,
    /// Version of the model.
    pub version: String,
    /// BLAKE3 of what decides the repaired bytes beside the image, in hex: manifest, files,
    /// runtime, provider.
    pub repair_hash: String,
    /// Where it runs: `cpu`, `cuda` or `tensorrt`.
    pub provider: String,
    /// Whether three runs gave the same bytes when the model was loaded.
    pub deterministic: bool,
    /// A camera is repaired from trust below this on.
    pub below: f64,
    /// A camera is no longer repaired from trust above this on.
    pub above: f64,
    /// Under this trust nothing is repaired.
    pub at_least: f64,
    /// Most images that are repaired of one pose of the rig.
    pub per_step: u64,
    /// What happens when the model fails.
    pub on_failure: OnFailure,
    /// What the model compares images with. Only if it needs recorded images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub references: Option<ReferenceSource>,
}

/// What a repair model compares images with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ReferenceSource {
    /// Recorded images of the twin.
    Recorded,
    /// The twin has none: images of the twin itself, drawn on its recorded drive.
    Rendered,
}

/// The scenario of a session.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct OpenedScenario {
    /// Its name.
    pub name: String,
    /// BLAKE3 of the scenario with the first episode's seed, all values and all hashes: what that
    /// episode is.
    pub hash: String,
    /// Number of actors.
    pub actors: u64,
}

/// A session that is resumed together with another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ResumedSession {
    /// Name of the session.
    pub session: String,
    /// Steps done in its episode.
    pub step: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Its settings, as in the answer to `open`; the version is the present one.
    pub opened: Box<Opened>,
}

/// Summary of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Summary {
    /// Why the episode ended.
    pub outcome: Outcome,
    /// Number of steps.
    pub steps: u64,
    /// Simulated time, in microseconds.
    pub time_us: i64,
    /// Distance driven, in metres.
    pub distance_m: f64,
    /// The lowest mean confidence of an observation's images. Only with `outputs.trust`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least_trust: Option<f64>,
    /// Name of the recorded episode, as in `GET /v1/episodes`. Absent if the session drove nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub episode: Option<String>,
}

/// Why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The agent closed the session, or ended the episode with `terminate`.
    Completed,
    /// As `completed`, but the agent left the recorded area: the trust of a pose was below 0.1, or,
    /// with `outputs.trust`, the mean trust of the images of a reset or a step.
    OffModel,
    /// A rule ended the episode: a contact, off the route, or stuck.
    DrivingFailure,
    /// The agent violated the protocol in a way that ended the connection.
    AgentError,
    /// The agent sent nothing, or did not read, for too long.
    AgentTimeout,
    /// The connection was lost and not resumed in time.
    AgentLost,
    /// An internal error of the server.
    ServerError,
}
