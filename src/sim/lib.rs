//! Motion in a city twin: the dynamics of the ego vehicle under an agent's commands, and the ground it stands
//! on.
//!
//! Everything here is pure: the same state and the same command give the same bytes.

pub mod ego;
pub mod ground;
pub mod limits;
pub mod traffic;

pub use ego::{Command, Dynamics, Ego, EgoError, EgoModel};
pub use ground::Ground;
