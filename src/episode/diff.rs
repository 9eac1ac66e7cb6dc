//! Where two episodes part.

use crate::file::{EpisodeFile, Frame};
use crate::lines::ActorsLine;

/// What differs, in the order of cause and effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum What {
    /// Twin, start, dynamics, seed, scenario or rig: the episodes are not of one kind.
    Setup,
    /// The agent's command.
    Command,
    /// The ego's pose.
    Ego,
    /// The pose of an actor.
    Actor,
    /// The pixels.
    Image,
    /// One episode ends.
    Length,
}

/// The first difference of two episodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The step.
    pub step: u64,
    /// What differs.
    pub what: What,
    /// How, in words.
    pub how: String,
}

impl What {
    /// The name in output.
    pub fn name(self) -> &'static str {
        match self {
            Self::Setup => "setup",
            Self::Command => "command",
            Self::Ego => "ego",
            Self::Actor => "actor",
            Self::Image => "image",
            Self::Length => "length",
        }
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "step {}: {}: {}", self.step, self.what.name(), self.how)
    }
}

/// The first step at which the command, the ego, an actor or an image of two episodes differ, asked in this order;
/// before them the setup. `None` if they are alike from begin to end.
pub fn diff(a: &EpisodeFile, b: &EpisodeFile) -> Option<Difference> {
    if let Some(how) = setup(a, b) {
        return Some(Difference { step: 0, what: What::Setup, how });
    }
    let frames_a = a.driven();
    let frames_b = b.driven();
    for (frame_a, frame_b) in frames_a.iter().zip(&frames_b) {
        let actors_a = actors_at(a, frame_a.step);
        let actors_b = actors_at(b, frame_b.step);
        let found = command(frame_a, frame_b)
            .or_else(|| ego(frame_a, frame_b))
            .or_else(|| actors(a, actors_a, actors_b))
            .or_else(|| image(a, frame_a, frame_b));
        if let Some((what, how)) = found {
            return Some(Difference { step: frame_a.step, what, how });
        }
    }
    let [steps_a, steps_b] = [frames_a.len(), frames_b.len()].map(|frames| frames.max(1) - 1);
    (steps_a != steps_b).then(|| Difference {
        step: steps_a.min(steps_b) as u64,
        what: What::Length,
        how: format!("{steps_a} steps, {steps_b} steps"),
    })
}

fn setup(a: &EpisodeFile, b: &EpisodeFile) -> Option<String> {
    let scenario = |episode: &EpisodeFile| match &episode.scenario {
        Some(scenario) => scenario.hash.clone(),
        None => "none".to_owned(),
    };
    let cameras = |episode: &EpisodeFile| {
        let names: Vec<&str> = episode.header.rig.cameras.iter().map(|c| c.name.as_str()).collect();
        names.join(", ")
    };
    let pairs = [
        ("twin", a.header.twin.clone(), b.header.twin.clone()),
        ("version hash", a.header.version_hash.clone(), b.header.version_hash.clone()),
        // Before the scenario, whose hash contains it.
        ("seed", a.header.seed.to_string(), b.header.seed.to_string()),
        ("scenario", scenario(a), scenario(b)),
        ("dynamics", format!("{:?}", a.header.dynamics), format!("{:?}", b.header.dynamics)),
        ("step", format!("{} us", a.header.dt_us), format!("{} us", b.header.dt_us)),
        ("start", format!("{:?}", a.header.start), format!("{:?}", b.header.start)),
        ("cameras", cameras(a), cameras(b)),
    ];
    let found = pairs.into_iter().find(|(_, a, b)| a != b);
    found.map(|(name, a, b)| format!("{name} {a} against {b}"))
}

fn command(a: &Frame, b: &Frame) -> Option<(What, String)> {
    let text = |frame: &Frame| match &frame.command {
        // A pose is its own command.
        None => "a pose".to_owned(),
        Some(command) => command.to_string(),
    };
    // Two builds may write the same plan in two ways.
    let is_same = a.command == b.command || a.plan().is_some_and(|plan| b.plan() == Some(plan));
    if is_same && a.terminated == b.terminated {
        return None;
    }
    if a.terminated != b.terminated {
        return Some((What::Command, format!("terminate {}, {}", a.terminated, b.terminated)));
    }
    Some((What::Command, format!("{}, {}", shortened(&text(a)), shortened(&text(b)))))
}

fn ego(a: &Frame, b: &Frame) -> Option<(What, String)> {
    let (pose_a, pose_b) = (a.poses.last()?, b.poses.last()?);
    if pose_a == pose_b {
        return None;
    }
    let off_m = pose_a.position_m.distance(pose_b.position_m);
    let off_rad = pose_a.rotation.angle_between(pose_b.rotation);
    Some((What::Ego, format!("{off_m:.3e} m and {off_rad:.3e} rad apart")))
}

fn actors_at(episode: &EpisodeFile, step: u64) -> Option<&ActorsLine> {
    episode.actors.iter().rev().find(|line| line.step == step)
}

fn actors(
    episode: &EpisodeFile,
    a: Option<&ActorsLine>,
    b: Option<&ActorsLine>,
) -> Option<(What, String)> {
    let name = |index: u16| {
        let actors = episode.scenario.as_ref().map_or(&[][..], |scenario| &scenario.actors);
        actors.get(usize::from(index)).map_or(index.to_string(), |actor| actor.name.clone())
    };
    let empty = Vec::new();
    let a = a.map_or(&empty, |line| &line.actors);
    let b = b.map_or(&empty, |line| &line.actors);
    for (state_a, state_b) in a.iter().zip(b) {
        if state_a != state_b {
            let place = |xyz_m: [f64; 3]| glam::DVec3::from_array(xyz_m);
            let off_m = place(state_a.1).distance(place(state_b.1));
            return Some((What::Actor, format!("{} is {off_m:.3e} m apart", name(state_a.0))));
        }
    }
    let differ = a.len() != b.len();
    differ.then(|| (What::Actor, format!("{} actors, {} actors", a.len(), b.len())))
}

fn image(episode: &EpisodeFile, a: &Frame, b: &Frame) -> Option<(What, String)> {
    if a.frame_hash == b.frame_hash && a.images == b.images {
        return None;
    }
    let cameras = &episode.header.rig.cameras;
    let first = a.images.iter().zip(&b.images).position(|(a, b)| a != b);
    // Of a warm-up there are several images of each camera.
    let camera = first.and_then(|image| cameras.get(image % cameras.len().max(1)));
    let how = match camera {
        Some(camera) => format!("camera {:?}", camera.name),
        None => format!("{} images, {} images", a.images.len(), b.images.len()),
    };
    Some((What::Image, how))
}

fn shortened(text: &str) -> String {
    const MOST: usize = 120;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{} ..", &text[..end]),
        None => text.to_owned(),
    }
}
