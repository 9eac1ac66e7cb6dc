//! The request `branch`: a session that begins in the middle of another episode.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

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

/// Decided by the fields that are present.
impl<'de> Deserialize<'de> for BranchPoint {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Either {
            session: Option<String>,
            snapshot: Option<String>,
            episode: Option<String>,
            step: Option<u64>,
        }
        // Not serde's `untagged`, which can only say that no variant fits.
        let Either { session, snapshot, episode, step } = Either::deserialize(deserializer)?;
        match (session, snapshot, episode, step) {
            (Some(session), Some(snapshot), None, None) => Ok(Self::Snapshot { session, snapshot }),
            (None, None, Some(episode), Some(step)) => Ok(Self::Recorded { episode, step }),
            _ => Err(D::Error::custom(
                "a branch is from either session and snapshot, or episode and step",
            )),
        }
    }
}
