//! The options of a session, defined once: the request `open` and its parts, as JSON has them.
//!
//! The messages of the protocol, rig files, scenario files and records have these types, and a
//! session is opened with [`Open`]. They are plain data: the user of a value checks it, and names
//! the field at fault. The ranges and the sentences of the fields become the JSON schemas, from
//! which the types of the Python client and of the viewer are generated.
//!
//! Reading ignores unknown fields, because answers may gain fields. Requests are compared with
//! their schema before, and [`strict`] reads files.

#![warn(missing_docs)]

pub mod camera;
mod deserialize;
mod drive;
mod lidar;
mod open;
mod pose;
mod sensors;
pub mod strict;

pub use drive::DriveSection;
pub use lidar::{LidarBeams, LidarColumns, RigLidar};
pub use open::{
    ContactMode, Dynamics, DynamicsChoice, DynamicsModel, Encoding, Follow, ImagePart, OnFailure,
    Open, Outputs, RandomStart, Repair, Rig, RigCamera, RigChoice, ScenarioChoice, Start,
};
pub use pose::Pose;
pub use sensors::{
    AxisNoise, CameraSensor, ExposureDrift, FrozenFrames, ImageNoise, Imu, LateFrames, LensDirt,
    LidarSensor, Sensors, WheelSpeed,
};

/// Pattern of names, as a regular expression.
#[cfg(feature = "schema")]
pub const NAME_PATTERN: &str = "^[a-z0-9_-][a-z0-9._-]{0,63}$";

/// Says in the schema of a list that no item is there twice.
#[cfg(feature = "schema")]
fn unique_items(schema: &mut schemars::Schema) {
    schema.insert("uniqueItems".to_owned(), true.into());
}

/// Says in the schema of a map of periods which of them are accepted.
#[cfg(feature = "schema")]
fn periods(schema: &mut schemars::Schema) {
    if let Some(serde_json::Value::Object(period)) = schema.get_mut("additionalProperties") {
        period.insert("minimum".to_owned(), 1_000.into());
        period.insert("maximum".to_owned(), 10_000_000.into());
    }
}

/// Says in the schema of an exposure that it has either a matrix or a gain.
#[cfg(feature = "schema")]
fn matrix_or_gain(schema: &mut schemars::Schema) {
    require_exactly_one(schema, &["matrix", "gain"]);
}

/// Says in the schema of an object that it has exactly one of some fields.
#[cfg(feature = "schema")]
pub fn require_exactly_one(schema: &mut schemars::Schema, fields: &[&str]) {
    let one_of = fields.iter().map(|field| serde_json::json!({ "required": [field] }));
    schema.insert("oneOf".to_owned(), one_of.collect::<Vec<_>>().into());
}
