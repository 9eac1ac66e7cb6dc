//! Traffic: the actors that move around the ego.
//!
//! | module | what it holds |
//! |---|---|
//! | `world` | all actors of an episode, advanced by sub-steps; their triggers |
//! | `ego_motion` | the ego between two states |
//! | `behaviour` | how an actor moves, with the state of its motion |
//! | `track` | actors that repeat recorded motion, or timed positions |
//! | `follow`, `course`, `lateral` | actors on a course, with changes of offset |
//! | `speed`, `distance`, `together` | changes of speed: to a speed, at a distance from another, and to arrive with another |
//! | `idm`, `lead` | the Intelligent Driver Model, and what an actor follows |
//! | `attack` | actors that plan their way towards the ego |
//! | `script`, `condition`, `waiting` | conditions and actions, the values of conditions, and the triggers that wait |
//! | `state` | the states of actors and ego, as contacts and renderer read them |

pub mod attack;
mod behaviour;
mod condition;
mod course;
mod distance;
mod ego_motion;
mod follow;
mod idm;
mod lateral;
mod lead;
mod script;
mod speed;
mod state;
mod together;
mod track;
mod waiting;
mod world;

pub use attack::Attack;
pub use behaviour::Behaviour;
pub use course::{Course, CourseFootPoint};
pub use distance::{Bounds, Gap, KeepDistance, Side};
pub use ego_motion::EgoMotion;
pub use follow::CourseFollower;
pub use idm::{Idm, rolled};
pub use script::{
    Action, After, Body, Condition, Edge, Measure, Near, Other, Over, Phase, Quantity, Shape,
    Trigger,
};
pub use state::{ActorSpec, ActorState, EgoBox, EgoState, SubStep};
pub use together::{ArriveTogether, FinalSpeed};
pub use track::{Track, TrackError, TrackKeyframe, Tracked};
pub use world::{Actor, Firing, Traffic, World};
