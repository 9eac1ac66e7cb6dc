//! The request `branch`: a session that begins in the middle of another episode.

use serde::{Deserialize, Serialize};

/// Opens a session in a state of another episode, with that episode's settings: version, cameras,
/// outputs, dynamics.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Branch {
    /// Number of this request.
    pub seq: u64,
    /// The state.
    pub from: BranchPoint,
    /// Name for the session. If absent, the server chooses one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
    pub session: Option<String>,
}

/// A state of an episode.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum BranchPoint {
    /// A snapshot of a session that still exists, on any connection of the same token.
    Snapshot {
        /// Name of the session.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        session: String,
        /// Name of the snapshot.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::NAME_PATTERN)))]
        snapshot: String,
    },
    /// A step of an episode that the server has recorded.
    Recorded {
        /// Name of the episode: that of its file, without `.jsonl`.
        #[cfg_attr(feature = "schema", schemars(regex(pattern = super::EPISODE_PATTERN)))]
        episode: String,
        /// Number of steps done there.
        step: u64,
    },
}
