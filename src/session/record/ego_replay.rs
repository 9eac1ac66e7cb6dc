//! Executes the commands of a recorded episode again, and compares the poses with the recorded
//! ones.

use wildcity_scene::geometry::Pose;
use wildcity_sim::{Command, Ground};

use super::format::{EpisodeHeader, FrameRecord, FrameRequest};
use crate::episode::Episode;
use crate::error::SessionError;

/// A step at which the command leads to a pose that differs from the recorded one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DivergedStep {
    /// Line of the episode's file, from 1.
    pub line: usize,
    pub step: u64,
    /// `world_from_rig` in the record.
    pub recorded: Pose,
    /// `world_from_rig` that the same command leads to now.
    pub now: Pose,
}

/// An episode that is driven again.
pub(crate) struct EgoReplay {
    episode: Episode,
}

impl EgoReplay {
    pub(crate) fn new(header: &EpisodeHeader) -> Self {
        Self { episode: header.first_state() }
    }

    /// The state after the frames so far.
    pub(crate) fn into_episode(self) -> Episode {
        self.episode
    }

    /// The episode after the frames so far.
    pub(crate) fn episode(&self) -> &Episode {
        &self.episode
    }

    /// If a frame is a step, executes it, and compares the poses bit by bit.
    ///
    /// # Errors
    /// The ego cannot execute the recorded command.
    pub(crate) fn drive(
        &mut self,
        frame: &FrameRecord,
        line: usize,
        ground: &Ground<'_>,
    ) -> Result<Option<DivergedStep>, SessionError> {
        // The poses before the last one are those of a warm-up's frames.
        let (FrameRequest::Step, Some(&recorded)) = (frame.request, frame.poses.last()) else {
            return Ok(None);
        };
        // Without a command in the line, the pose of the frame is the command.
        let command = match &frame.command {
            None => Command::Pose(recorded),
            Some(recorded) => recorded.command().map_err(SessionError::Ego)?,
        };
        // Not ended, even if the recorded step was the last one: a branch goes on from here.
        self.episode = self.episode.followed(&command, frame.steps as usize, ground, false)?.0;
        let now = self.episode.world_from_rig();
        Ok((now != recorded).then_some(DivergedStep { line, step: frame.step, recorded, now }))
    }
}

impl std::fmt::Display for DivergedStep {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { line, step, recorded, now } = self;
        let off_m = recorded.position_m.distance(now.position_m);
        write!(f, "step {step} (line {line}): the command leads {off_m:e} m off")
    }
}
