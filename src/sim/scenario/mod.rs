//! Scenarios: files that say which actors move in a twin, where the ego drives, and when an episode ends.
//!
//! | module | what it does |
//! |---|---|
//! | `file`, `tracks` | the formats `wildcity.scenario/1` and `wildcity.tracks/1` |
//! | `document` | reads a scenario, and puts in the values of its sweep |
//! | `resolve`, `around`, `actors`, `jitter` | checks a scenario against its twin, and sets up its traffic |
//! | `end` | the rules that end an episode |
//! | `error` | mistakes, with their place in the file |

mod actors;
mod around;
mod document;
mod end;
pub(crate) mod error;
mod file;
mod jitter;
mod pose;
mod resolve;
mod tracks;

pub use around::{AssetInfo, EgoStart, Surroundings};
pub use document::{Case, Document};
pub use end::{EndInput, EndReason, EndRules, Stuck};
pub use error::FileError;
pub use file::*;
pub use resolve::Scenario;
pub use tracks::{KeyframeSection, TrackSection, TracksFile};
