//! Motion in a city twin: the dynamics of the ego vehicle under an agent's commands, the ground it stands
//! on, and contact with other boxes.
//!
//! Everything here is pure: the same state and the same command give the same bytes.

pub mod contact;
pub mod ego;
pub mod ground;
pub mod limits;
pub mod traffic;

pub use ego::{Command, Dynamics, Ego, EgoError, EgoModel};
pub use ground::Ground;
