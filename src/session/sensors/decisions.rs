//! Decisions that take effect after a delay.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use wildcity_scene::geometry::Pose;
use wildcity_sim::ego::Action;
use wildcity_sim::{Command, DynamicsModel, Ego, EgoError, Ground};

use crate::limits::BUNDLE_PERIOD_US;
use crate::record::command::RecordedCommand;

/// The decisions of an episode that are in effect or wait, in the order in which they were made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Decisions {
    /// Time after which a decision takes effect, in microseconds.
    delay_us: i64,
    made: VecDeque<Decision>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Decision {
    /// When it was made, in microseconds since the episode's start.
    made_us: i64,
    /// `world_from_rig` at that time: a trajectory is in this frame.
    world_from_rig: Pose,
    command: RecordedCommand,
}

impl Decisions {
    pub(crate) fn new(delay_us: i64) -> Self {
        Self { delay_us, made: VecDeque::new() }
    }

    /// Whether the values are in the range that is allowed. They may have been read from a file.
    pub(crate) fn is_in_range(&self) -> bool {
        (0..=BUNDLE_PERIOD_US).contains(&self.delay_us)
    }

    /// Whether decisions take effect at once.
    pub(crate) fn are_immediate(&self) -> bool {
        self.delay_us == 0
    }

    /// Returns the ego after each of some steps of `dt_us` from `time_us`. The decision `command`
    /// is made at `time_us`, takes effect after the latency, and holds until the end of these steps
    /// plus the latency. Before the first decision takes effect, a car keeps its speed on a
    /// straight line, and an ego with `teleport` keeps its pose.
    ///
    /// # Errors
    /// The ego cannot execute the command, or a path ends before the next decision can take effect.
    pub(crate) fn follow(
        &mut self,
        command: &Command,
        ego: &Ego,
        [time_us, dt_us]: [i64; 2],
        steps: usize,
        ground: &Ground<'_>,
    ) -> Result<Vec<Ego>, EgoError> {
        if let Command::Path(path) = command {
            // The next decision is made after these steps, and takes effect after the delay: until
            // then the path is followed.
            let end_us = dt_us * steps as i64 + self.delay_us;
            if path.end_us() < end_us {
                return Err(EgoError::PathShort { end_us: path.end_us(), step_us: end_us });
            }
        }
        // Refuse a command that this ego does not accept now, and not when it takes effect.
        ego.stepped(command, dt_us, ground)?;
        let world_from_rig = ego.world_from_rig();
        let command = RecordedCommand::from_command(command);
        self.made.push_back(Decision { made_us: time_us, world_from_rig, command });

        let mut egos: Vec<Ego> = Vec::with_capacity(steps);
        for step in 0..steps {
            let now_us = time_us + dt_us * step as i64;
            // If the second decision is in effect, the first one is over.
            while self.made.get(1).is_some_and(|next| next.made_us + self.delay_us <= now_us) {
                self.made.pop_front();
            }
            let before = egos.last().unwrap_or(ego);
            // The first decision is in effect, or still waits. In that case all others wait too.
            let effective = self.made.front().filter(|made| made.made_us + self.delay_us <= now_us);
            egos.push(match effective {
                None => before.stepped(&none_yet(before), dt_us, ground)?,
                Some(Decision { made_us, world_from_rig, command }) => {
                    // A path is in the frame of its decision: it goes on where it is at this time
                    // and place.
                    let since_us = now_us - made_us;
                    before.resumed(&command.command()?, *world_from_rig, since_us, dt_us, ground)?
                }
            });
        }
        Ok(egos)
    }
}

/// The command before the first decision.
fn none_yet(ego: &Ego) -> Command {
    match ego.dynamics().model {
        DynamicsModel::Teleport => Command::Pose(ego.world_from_rig()),
        DynamicsModel::Kinematic | DynamicsModel::Dynamic => {
            Command::Action(Action { acceleration_m_s2: 0.0, curvature_1_m: 0.0 })
        }
    }
}
