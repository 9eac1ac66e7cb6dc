//! Motion in a city twin: the dynamics of the ego vehicle under an agent's commands, the ground it
//! stands on, the traffic around it, contact with its boxes, and the scenarios, maps and routes
//! that describe it.
//!
//! Everything here is pure: the same state and the same command give the same bytes.

pub mod contact;
pub mod ego;
pub mod ground;
pub mod limits;
pub mod map;
mod plane;
pub mod route;
pub mod scenario;
pub mod traffic;

pub use ego::{Command, Dynamics, DynamicsModel, Ego, EgoError};
pub use ground::{DriveBoxes, Ground};
