//! Control messages: JSON text frames.
//!
//! The client sends a [`Request`], the server replies with an [`Answer`] or an
//! [observation](crate::observation). Unknown fields of requests are mistakes: [`crate::decode`]
//! refuses them at any depth. Unknown fields of answers are ignored, because answers may gain
//! fields.

mod answer;
mod branch;
mod drive;
mod open;
mod pose;
mod request;
mod sensors;

pub use answer::{
    Answer, Limits, Opened, OpenedRepair, OpenedScenario, Outcome, ReferenceSource, ResumedSession,
    ServerInfo, Summary, TrajectoryInfo, TwinInfo,
};
pub use branch::{Branch, BranchPoint};
pub use drive::{Drive, DrivePose, DriveSection};
pub use open::{
    ContactMode, Dynamics, DynamicsChoice, DynamicsModel, Encoding, ImagePart, OnFailure, Open,
    Outputs, RandomStart, Repair, Rig, RigCamera, RigChoice, ScenarioChoice, Start,
};
pub use pose::Pose;
pub use request::{Action, ClientInfo, Request, SessionStep, TimedPose};
pub use sensors::{
    AxisNoise, CameraSensor, ExposureDrift, FrozenFrames, ImageNoise, Imu, LateFrames, LensDirt,
    Sensors, WheelSpeed,
};

/// Pattern of names, as a regular expression.
#[cfg(feature = "schema")]
pub const NAME_PATTERN: &str = "^[a-z0-9_-][a-z0-9._-]{0,63}$";

/// Pattern of names of recorded episodes: the name of a session, a hyphen and a number.
#[cfg(feature = "schema")]
pub(crate) const EPISODE_PATTERN: &str = "^[a-z0-9_-][a-z0-9._-]{0,63}-[0-9]{1,20}$";

/// Says in the schema of a list that no item is there twice.
#[cfg(feature = "schema")]
pub(crate) fn unique_items(schema: &mut schemars::Schema) {
    schema.insert("uniqueItems".to_owned(), true.into());
}

/// Says in the schema of a map of periods which of them are accepted.
#[cfg(feature = "schema")]
pub(crate) fn periods(schema: &mut schemars::Schema) {
    if let Some(serde_json::Value::Object(period)) = schema.get_mut("additionalProperties") {
        period.insert("minimum".to_owned(), 1_000.into());
        period.insert("maximum".to_owned(), 10_000_000.into());
    }
}

/// Says in the schema of a step that it has exactly one movement.
#[cfg(feature = "schema")]
pub(crate) fn one_movement(schema: &mut schemars::Schema) {
    require_exactly_one(schema, &["pose", "trajectory", "action"]);
}

/// Says in the schema of an exposure that it has either a matrix or a gain.
#[cfg(feature = "schema")]
pub(crate) fn matrix_or_gain(schema: &mut schemars::Schema) {
    require_exactly_one(schema, &["matrix", "gain"]);
}

#[cfg(feature = "schema")]
fn require_exactly_one(schema: &mut schemars::Schema, fields: &[&str]) {
    let one_of = fields.iter().map(|field| serde_json::json!({ "required": [field] }));
    schema.insert("oneOf".to_owned(), one_of.collect::<Vec<_>>().into());
}
