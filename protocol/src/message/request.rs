//! Requests: messages from the client.

use serde::{Deserialize, Serialize};

use super::branch::Branch;
use super::open::{Open, Start};
use super::pose::Pose;

/// A message from the client. Every request gets exactly one answer with the same `seq`.
///
/// `seq` counts the requests of a connection from 0 without gaps. After `resume` it continues the count of
/// the session. A request is carried out only once: if its number is sent again, the server repeats the
/// answer. A refused request can be sent again with the same number or with the next one.
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
    /// Opens a session on a twin. Answer: `opened`.
    Open(Box<Open>),
    /// Moves the ego, advances the time by `dt_us` and renders. Exactly one of `pose`, `trajectory` and
    /// `action` is given. Answer: an observation.
    Step {
        /// Number of this request.
        seq: u64,
        /// `world_from_rig` at the end of the step. Only with teleport dynamics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pose: Option<Pose>,
        /// Planned poses of the ego, 1 to 64 in order of time, up to the end of the step or later.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        trajectory: Option<Vec<TimedPose>>,
        /// Acceleration and curvature of the ego. Only with kinematic or dynamic dynamics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        action: Option<Action>,
        /// Whether the episode ends with this step.
        #[serde(default)]
        terminate: bool,
    },
    /// Renders images from poses without moving the ego. Answer: one observation with the images of all
    /// poses.
    Observe {
        /// Number of this request.
        seq: u64,
        /// Poses of the rig, `world_from_rig`: 1 to `limits.observe_poses`.
        poses: Vec<Pose>,
    },
    /// Announces where the ego may go next, so that the server loads what is visible from there. Answer:
    /// `ok`, at once.
    Prefetch {
        /// Number of this request.
        seq: u64,
        /// Poses of the rig, `world_from_rig`, in driving order. The straight lines between them count too.
        /// They replace the poses of the previous `prefetch`.
        poses: Vec<Pose>,
    },
    /// Starts a new episode in the same session. Answer: an observation.
    Reset {
        /// Number of this request.
        seq: u64,
        /// Seed of the episode.
        #[serde(default)]
        seed: u64,
        /// Where to start. If absent, the session's start.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        start: Option<Start>,
    },
    /// Shows another version of the twin from the next step on. The episode continues. Answer: `switched`.
    SwitchVersion {
        /// Number of this request.
        seq: u64,
        /// Number of the version. If absent, the latest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        version: Option<u64>,
    },
    /// Stores the state of the episode under a name, in place of an earlier snapshot of that name. Answer: `ok`.
    Snapshot {
        /// Number of this request.
        seq: u64,
        /// Name of the snapshot.
        name: String,
    },
    /// Returns to a snapshot of this session. Answer: an observation of that state.
    Restore {
        /// Number of this request.
        seq: u64,
        /// Name of the snapshot.
        name: String,
    },
    /// Opens a session in a state of another episode. Answer: `opened`.
    Branch(Branch),
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
        /// Number of the last answer that the client received.
        last_seq: u64,
    },
}

/// A pose of a planned trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TimedPose {
    /// Time since the start of the step, in microseconds: above 0, and above that of the previous pose.
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
    pub acceleration: f64,
    /// Curvature of the rear axle's path, positive to the left, in 1/m, -0.2 to 0.2.
    pub curvature: f64,
}

/// Name and version of the client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ClientInfo {
    /// Name of the program or library.
    pub name: String,
    /// Version of the twin.
    pub version: String,
}
