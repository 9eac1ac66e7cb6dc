//! Control messages: JSON text frames.
//!
//! The client sends a [`Request`], the server replies with an [`Answer`] or an
//! [observation](crate::observation). Unknown fields of requests are mistakes: [`crate::decode`]
//! refuses them at any depth. Unknown fields of answers are ignored, because answers may gain
//! fields.

mod answer;
mod branch;
mod drive;
mod request;

pub use answer::{
    Answer, Limits, Opened, OpenedLidar, OpenedRepair, OpenedScenario, OpenedSemantics, Outcome,
    ReferenceSource, ResumedSession, ServerInfo, Summary, TrajectoryInfo, TwinInfo,
};
pub use branch::{Branch, BranchPoint};
pub use drive::{Drive, DrivePose};
pub use request::{Action, ClientInfo, Request, SessionStep, TimedPose};
#[cfg(feature = "schema")]
pub use wildcity_options::NAME_PATTERN;
pub use wildcity_options::{
    AxisNoise, CameraSensor, ContactMode, DriveSection, Dynamics, DynamicsChoice, DynamicsModel,
    Encoding, ExposureDrift, FrozenFrames, ImageNoise, ImagePart, Imu, LateFrames, LensDirt,
    LidarBeams, LidarColumns, LidarSensor, OnFailure, Open, Outputs, Pose, RandomStart, Repair,
    Rig, RigCamera, RigChoice, RigLidar, ScenarioChoice, Sensors, Start, WheelSpeed,
};

/// Pattern of names of recorded episodes: the name of a session, a hyphen and a number.
#[cfg(feature = "schema")]
pub(crate) const EPISODE_PATTERN: &str = "^[a-z0-9_-][a-z0-9._-]{0,63}-[0-9]{1,20}$";

/// Says in the schema of a step that it has exactly one movement.
#[cfg(feature = "schema")]
pub(crate) fn one_movement(schema: &mut schemars::Schema) {
    wildcity_options::require_exactly_one(schema, &["pose", "trajectory", "action"]);
}
