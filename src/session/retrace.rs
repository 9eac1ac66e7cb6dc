//! Drives a recorded episode again, command by command, and compares where that leads.

use crate::geometry::Pose;
use crate::sim::ego::Path;
use crate::sim::{Command, Ego, EgoError, Ground};

use super::record::{EpisodeHeader, FrameRecord, FrameRequest, RecordedCommand};

/// A step whose command leads elsewhere than it did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StrayedStep {
    /// Line of the episode's file, from 1.
    pub line: usize,
    /// The step.
    pub step: u64,
    /// `world_from_rig` as recorded.
    pub recorded: Pose,
    /// As it is now.
    pub now: Pose,
}

/// The ego of an episode that is driven again.
pub(super) struct Retrace {
    ego: Ego,
    dt_us: i64,
}

impl Retrace {
    pub(super) fn new(header: &EpisodeHeader) -> Self {
        Self { ego: Ego::new(header.dynamics, header.start), dt_us: header.dt_us }
    }

    /// Does the step of a frame, if it is one. Poses are compared to the bit.
    ///
    /// # Errors
    /// The recorded command is none for this ego.
    pub(super) fn follow(
        &mut self,
        frame: &FrameRecord,
        line: usize,
        ground: &Ground<'_>,
    ) -> Result<Option<StrayedStep>, EgoError> {
        let (FrameRequest::Step, [recorded]) = (frame.request, &frame.poses[..]) else {
            return Ok(None);
        };
        let command = match &frame.command {
            None => Command::Pose(*recorded),
            Some(RecordedCommand::Action(action)) => Command::Action(*action),
            Some(RecordedCommand::Trajectory(poses)) => {
                Command::Path(Path::checked(poses.clone())?)
            }
        };
        self.ego = self.ego.stepped(&command, self.dt_us, ground)?;
        let (now, recorded) = (self.ego.world_from_rig(), *recorded);
        Ok((now != recorded).then_some(StrayedStep { line, step: frame.step, recorded, now }))
    }
}

impl std::fmt::Display for StrayedStep {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { line, step, recorded, now } = self;
        let off_m = recorded.position_m.distance(now.position_m);
        write!(f, "step {step} (line {line}): the command leads {off_m:e} m off")
    }
}
