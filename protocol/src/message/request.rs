//! Requests: messages from the client.

use serde::{Deserialize, Serialize};

use super::branch::Branch;
use super::{DynamicsChoice, Open, Pose, Start};

/// A message from the client. Every request gets exactly one answer with the same `seq`.
///
/// `seq` counts the requests of a connection from 0 without gaps. After `resume` it continues the
/// count of the session. A request is carried out only once: if its number is sent again, the
/// server repeats the answer. A refused request can be sent again with the same number or with the
/// next one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// The first request of a connection. Answer: `welcome`.
    Hello {
        /// Number of this request.
        seq: u64,
        /// Name and version of the client, for the server's log.
        client: ClientInfo,
        /// Protocol versions that the client supports.
        protocols: Vec<String>,
    },
    /// Asks for the observations in memory instead of the socket, for a client on the same machine.
    /// Without `proof` the answer is `shared_memory`: where the memory is. With it, the answer is
    /// `ok`, and the observations come in that memory from then on.
    ShareMemory {
        /// Number of this request.
        seq: u64,
        /// The text at the beginning of the memory, which only a client that can open it knows.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        proof: Option<String>,
    },
    /// Opens a session on a twin. Answer: `opened`.
    Open(Box<Open>),
    /// Moves the ego, advances the time by `dt_us` or to `until_us`, and renders. Exactly one of
    /// `pose`, `trajectory` and `action` is given. Answer: an observation.
    #[cfg_attr(feature = "schema", schemars(transform = super::one_movement))]
    Step {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// `world_from_rig` at the end of the step. Only with teleport dynamics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pose: Option<Pose>,
        /// Planned poses of the ego, 1 to 64 in order of time, up to the end of the step or later.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 64)))]
        trajectory: Option<Vec<TimedPose>>,
        /// Acceleration and curvature of the ego. Only with kinematic or dynamic dynamics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        action: Option<Action>,
        /// For how long the trajectory or the action is followed, in microseconds since the start
        /// of the step: a whole number of `dt_us`. The answer is the observation at its end. If
        /// absent, `dt_us`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 60_000_000)))]
        until_us: Option<i64>,
        /// What the agent notes about the step, for the record: any JSON but `null`, of at most
        /// 65,536 bytes without white space.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        notes: Option<serde_json::Value>,
        /// Whether the episode ends with this step.
        #[serde(default)]
        terminate: bool,
    },
    /// Steps several sessions of the connection. A session whose step is refused does not stop the
    /// others. Answer: one binary message with the observation or the refusal of each.
    StepMany {
        /// Number of this request.
        seq: u64,
        /// The steps, each of another session: 1 to 64.
        #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 64)))]
        steps: Vec<SessionStep>,
    },
    /// Renders images from poses without moving the ego. Answer: one observation with the images of
    /// all poses.
    Observe {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Poses of the rig, `world_from_rig`: 1 to `limits.observe_poses`.
        #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 16)))]
        poses: Vec<Pose>,
    },
    /// Announces where the ego may go next, so that the server loads what is visible from there.
    /// Answer: `ok`, at once.
    Prefetch {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Poses of the rig, `world_from_rig`, in driving order. The straight lines between them
        /// count too. They replace the poses of the previous `prefetch`.
        #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 256)))]
        poses: Vec<Pose>,
    },
    /// Starts a new episode in the same session. Answer: an observation.
    Reset {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Seed of the episode.
        #[serde(default)]
        seed: u64,
        /// Where to start. If absent, the session's start.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        start: Option<Start>,
        /// How the ego moves in this episode. If absent, as in the session.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        dynamics: Option<DynamicsChoice>,
        /// Speed at the start of this episode, in m/s, in place of that of the dynamics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(range(min = -10.0, max = 60.0)))]
        speed: Option<f64>,
    },
    /// Shows another version of the twin from the next step on. The episode continues. Answer:
    /// `switched`.
    SwitchVersion {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Number of the version. If absent, the latest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        version: Option<u64>,
    },
    /// Stores the state of the episode under a name, in place of an earlier snapshot of that name.
    /// Answer: `ok`.
    Snapshot {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Name of the snapshot.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        name: String,
    },
    /// Returns to a snapshot of this session. Answer: an observation of that state.
    Restore {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
        /// Name of the snapshot.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        name: String,
    },
    /// Opens a session in a state of another episode. Answer: `opened`.
    Branch(Branch),
    /// Ends the session. Answer: `closed`.
    Close {
        /// Number of this request.
        seq: u64,
        /// Which session of the connection. If absent, its only one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: Option<String>,
    },
    /// Continues a session after a lost connection, in place of `open`. Answer: `resumed`.
    Resume {
        /// Number of this request on the new connection.
        seq: u64,
        /// Name of the session.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: String,
        /// Number of the last answer that the client received.
        last_seq: u64,
        /// Names of the other sessions of the lost connection, at most 63.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        #[cfg_attr(feature = "schema", schemars(length(max = 63)))]
        #[cfg_attr(feature = "schema", schemars(inner(regex(pattern = super::NAME_PATTERN))))]
        also: Vec<String>,
    },
}

/// The step of one session in a `step_many`, with the fields of `step`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[cfg_attr(feature = "schema", schemars(transform = super::one_movement))]
#[serde(deny_unknown_fields)]
pub struct SessionStep {
    /// Name of the session.
    #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
    pub session: String,
    /// `world_from_rig` at the end of the step. Only with teleport dynamics.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<Pose>,
    /// Planned poses of the ego, 1 to 64 in order of time, up to the end of the step or later.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(length(min = 1, max = 64)))]
    pub trajectory: Option<Vec<TimedPose>>,
    /// Acceleration and curvature of the ego. Only with kinematic or dynamic dynamics.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub action: Option<Action>,
    /// For how long the trajectory or the action is followed, in microseconds since the start of
    /// the step: a whole number of `dt_us`. The answer is the observation at its end. If absent,
    /// `dt_us`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 60_000_000)))]
    pub until_us: Option<i64>,
    /// What the agent notes about the step, for the record: any JSON but `null`, of at most 65,536
    /// bytes without white space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub notes: Option<serde_json::Value>,
    /// Whether the episode ends with this step.
    #[serde(default)]
    pub terminate: bool,
}

/// A pose of a planned trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TimedPose {
    /// Time since the start of the step, in microseconds: above 0, and above that of the previous
    /// pose.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 60_000_000)))]
    pub time_us: i64,
    /// Pose of the rig at that time, in the rig frame at the start of the step.
    pub pose: Pose,
}

/// Acceleration and curvature during one step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Action {
    /// Longitudinal acceleration, in m/s², -9.8 to 9.8.
    #[cfg_attr(feature = "schema", schemars(range(min = -9.8, max = 9.8)))]
    pub acceleration: f64,
    /// Curvature of the rear axle's path, positive to the left, in 1/m, -0.2 to 0.2.
    #[cfg_attr(feature = "schema", schemars(range(min = -0.2, max = 0.2)))]
    pub curvature: f64,
}

/// Name and version of the client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ClientInfo {
    /// Name of the program or library.
    pub name: String,
    /// Its version.
    pub version: String,
}
