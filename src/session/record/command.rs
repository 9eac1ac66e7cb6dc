//! Commands to the ego, as records and waiting decisions have them.

use serde::{Deserialize, Serialize};

use wildcity_scene::geometry::Pose;
use wildcity_sim::ego::{Action, Path, TimedPose};
use wildcity_sim::{Command, EgoError};

/// A command to the ego.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordedCommand {
    Action(Action),
    Trajectory(Vec<TimedPose>),
    /// A pose that is reached later: only with a delay of the planner.
    Pose(Pose),
}

impl RecordedCommand {
    /// The record of a command; `None` for a pose, which the poses of its frame have.
    pub(crate) fn new(command: &Command) -> Option<Self> {
        match command {
            // The pose would be in the line twice.
            Command::Pose(_) => None,
            Command::Path(_) | Command::Action(_) => Some(Self::from_command(command)),
        }
    }

    /// The record of any command, a pose included.
    pub(crate) fn from_command(command: &Command) -> Self {
        match command {
            Command::Pose(pose) => Self::Pose(*pose),
            Command::Path(path) => Self::Trajectory(path.poses().to_vec()),
            Command::Action(action) => Self::Action(*action),
        }
    }

    /// The command.
    ///
    /// # Errors
    /// A recorded path is invalid.
    pub(crate) fn command(&self) -> Result<Command, EgoError> {
        Ok(match self {
            Self::Pose(pose) => Command::Pose(*pose),
            Self::Action(action) => Command::Action(*action),
            // A file may have been changed, so that the path is checked as one of a request is.
            Self::Trajectory(poses) => Command::Path(Path::checked(poses.clone())?),
        })
    }
}
