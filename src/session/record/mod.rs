//! Records of episodes, and their replay.
//!
//! Every answer with images is on record before it is sent, so that whatever an agent has seen can
//! be rendered again. A replay executes the recorded commands, renders the recorded poses, and
//! compares both with the record: poses to the bit, images by their hashes.

mod actor_replay;
pub(crate) mod branch_error;
pub(crate) mod command;
pub(crate) mod continuation;
pub(crate) mod ego_replay;
pub(crate) mod error;
pub(crate) mod format;
pub(crate) mod quota;
pub(crate) mod recorded_episode;
pub(crate) mod recorder;
mod repair_replay;
pub(crate) mod repairs;
pub(crate) mod replay;
pub(crate) mod replay_report;
mod sensor_replay;
mod values;
