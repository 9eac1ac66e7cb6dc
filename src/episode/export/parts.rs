//! Parts of messages that come from a single line of a record.

use serde_json::{Value, json};

use wildcity_scene::geometry::Pose;
use wildcity_score::EgoSample;

use super::convert::{pose, timestamp, vector};
use super::messages as foxglove;
use crate::drive::ego_samples;
use crate::file::{EpisodeFile, Frame};
use crate::lines::Event;

/// The ego's motion at each frame; none if the record skips steps.
pub(super) fn motions(frames: &[&Frame], dt_us: i64) -> Vec<Option<EgoSample>> {
    // Over a gap, a difference divided by one step would be a wrong velocity.
    let is_gapless = frames.windows(2).all(|pair| pair[1].step == pair[0].step + 1);
    // Frames of a drive all have a pose, so that `poses` is as long as `frames`.
    let poses: Vec<Pose> = frames.iter().filter_map(|frame| frame.poses.last().copied()).collect();
    if !is_gapless || poses.len() < 2 {
        return vec![None; frames.len()];
    }
    ego_samples(&poses, dt_us as f64 * 1e-6).into_iter().map(Some).collect()
}

/// The ego at a time; without velocities if they are unknown.
pub(super) fn odometry(
    time_us: i64,
    world_from_rig: &Pose,
    motion: Option<EgoSample>,
) -> foxglove::Odometry {
    let linear = motion.map(|motion| vector(motion.velocity_mps.extend(0.0).to_array()));
    let angular = motion.map(|motion| vector([0.0, 0.0, motion.yaw_rate_radps]));
    foxglove::Odometry {
        timestamp: Some(timestamp(time_us)),
        frame_id: "world".to_owned(),
        child_frame_id: "rig".to_owned(),
        pose: Some(pose(world_from_rig)),
        linear_velocity: linear,
        angular_velocity: angular,
    }
}

/// The level and the text of an event.
pub(super) fn event_text(episode: &EpisodeFile, event: &Event) -> (i32, String) {
    // Numbers of `LogLevel` in `descriptors.rs`.
    const INFO: i32 = 2;
    const WARNING: i32 = 3;
    let name = |index: u16| {
        let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
        actors.get(usize::from(index)).map_or(index.to_string(), |actor| actor.name.clone())
    };
    match event {
        Event::Contact(contact) => {
            let fault = if contact.ego_at_fault { "at fault" } else { "not at fault" };
            let with = name(contact.actor);
            (WARNING, format!("contact with {with} at {:.2} m/s, {fault}", contact.impact_mps))
        }
        Event::StaticContact { impact_mps, .. } => {
            (WARNING, format!("contact with the twin at {impact_mps:.2} m/s"))
        }
        Event::OffModel { trust } => (WARNING, format!("left the trained area: trust {trust:.3}")),
        Event::Triggered { actor, trigger } => {
            (INFO, format!("{} fires trigger {trigger}", name(*actor)))
        }
        Event::Appeared { actor } => (INFO, format!("{} appears", name(*actor))),
        Event::Left { actor } => (INFO, format!("{} leaves", name(*actor))),
        Event::Ended { rule } => (INFO, format!("ended by the rule {rule}")),
    }
}

/// The command without the values that `/plan` has: a trajectory keeps only the times of its poses.
/// Poses as text would be two thirds of a file.
pub(super) fn command(frame: &Frame) -> Option<Value> {
    let Some(poses) = frame.plan() else { return frame.command.clone() };
    let times_us: Vec<i64> = poses.iter().map(|pose| pose.time_us).collect();
    Some(json!({ "trajectory": { "times_us": times_us, "poses": "/plan" } }))
}

/// The agent's trajectory in the rig's frame, if that was its command.
pub(super) fn plan(frame: &Frame) -> Option<Vec<foxglove::Pose>> {
    Some(frame.plan()?.iter().map(|timed| pose(&timed.start_from_rig)).collect())
}
