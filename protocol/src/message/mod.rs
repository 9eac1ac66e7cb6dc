//! Control messages: JSON text frames.
//!
//! The client sends a [`Request`], the server replies with an [`Answer`] or an
//! [observation](crate::observation). Unknown fields of requests are mistakes: the types that only requests
//! use refuse them, and [`crate::unknown_field`] finds them in the types that requests share with answers.
//! Unknown fields of answers are ignored, because answers may gain fields.

mod answer;
mod branch;
mod drive;
mod open;
mod pose;
mod request;

pub use answer::{
    Answer, Limits, Opened, OpenedScenario, Outcome, ServerInfo, Summary, TrajectoryInfo, TwinInfo,
};
pub use branch::{Branch, BranchPoint};
pub use drive::{Drive, DrivePose, DriveSection};
pub use open::{
    Dynamics, DynamicsChoice, DynamicsModel, Encoding, ImagePart, Open, Outputs, Rig, RigCamera,
    RigChoice, ScenarioChoice, Start,
};
pub use pose::Pose;
pub use request::{Action, ClientInfo, Request, TimedPose};
