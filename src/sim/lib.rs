//! What moves in a city twin: the ego, by what its agent wants and what a car can do.
//!
//! Pure: the same state, the same command, the same bytes.

pub mod ego;
pub mod ground;
pub mod limits;

pub use ego::{Command, Dynamics, Ego, EgoError, EgoModel};
pub use ground::Ground;
