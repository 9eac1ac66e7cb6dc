//! Traffic: the states of actors beside the ego.

mod state;

pub use state::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};
