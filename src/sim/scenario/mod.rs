//! Scenarios: files that say which actors move in a twin, where the ego drives, and when an episode
//! ends.
//!
//! | module | what it does |
//! |---|---|
//! | `file`, `actor_file`, `script_file`, `line_fields`, `tracks` | the formats `wildcity.scenario/1` and `wildcity.tracks/1` |
//! | `document`, `size` | reads a scenario, and puts in the values of its sweep |
//! | `resolve`, `around` | checks a scenario against its twin |
//! | `actors`, `courses`, `collide`, `script`, `condition`, `pair_action`, `jitter`, `pose` | checks its actors, and sets them up |
//! | `end` | the rules that end an episode |
//! | `error` | mistakes, with their place in the file |

mod actor_file;
mod actors;
mod around;
mod collide;
mod condition;
mod courses;
mod document;
mod end;
pub(crate) mod error;
mod file;
mod jitter;
mod line_fields;
mod pair_action;
mod pose;
mod resolve;
mod script;
mod script_file;
mod size;
mod tracks;

pub use actor_file::*;
pub use around::{AssetInfo, Assets, EgoStart, NoAssets, Surroundings};
pub use document::{Case, Document, written_values};
pub use end::{EndInput, EndReason, EndRules, Stuck};
pub use error::{FileError, check_format};
pub use file::*;
pub use pose::PoseSection;
pub use resolve::Scenario;
pub use script_file::*;
pub use size::Values;
pub use tracks::{KeyframeSection, TrackSection, TracksFile};
