//! Where two episodes part.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use crate::file::{EpisodeFile, Frame};
use crate::lines::{ActorsLine, ScenarioLine};

/// Kind of difference, in the order of cause and effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum What {
    /// Twin, start, dynamics, seed, scenario or rig: the episodes have different setups.
    Setup,
    Command,
    Ego,
    /// The pose of an actor.
    Actor,
    Image,
    Length,
}

/// The first difference of two episodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    pub step: u64,
    pub what: What,
    /// The difference as a part of a sentence.
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

/// The first step at which the command, the ego, an actor or an image of two episodes differ,
/// tested in this order, after the setup. `None` if the episodes are equal from start to end.
pub fn diff(a: &EpisodeFile, b: &EpisodeFile) -> Option<Difference> {
    // A difference of the setup explains every later one, so that it alone is reported.
    if let Some(how) = setup(a, b) {
        return Some(Difference { step: 0, what: What::Setup, how });
    }
    let frames_a = a.driven();
    let frames_b = b.driven();
    // `zip` ends with the shorter episode: the lengths count only if all common steps are equal.
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
    // The first frame is the start and no step. `max` keeps an episode without frames at 0 steps.
    let [steps_a, steps_b] = [frames_a.len(), frames_b.len()].map(|frames| frames.max(1) - 1);
    (steps_a != steps_b).then(|| Difference {
        step: steps_a.min(steps_b) as u64,
        what: What::Length,
        how: format!("{steps_a} steps, {steps_b} steps"),
    })
}

/// The first field in which two episodes were not set up alike, with both values.
fn setup(a: &EpisodeFile, b: &EpisodeFile) -> Option<String> {
    let cameras = |episode: &EpisodeFile| {
        let names: Vec<&str> = episode.header.rig.cameras.iter().map(|c| c.name.as_str()).collect();
        names.join(", ")
    };
    let seconds = |dt_us: i64| format!("{} s", dt_us as f64 / 1e6);
    let version = |episode: &EpisodeFile| {
        let header = &episode.header;
        let hash: String = header.version_hash.chars().take(8).collect();
        format!("{} ({hash})", header.version)
    };
    let field =
        |name: &str, a: String, b: String| (a != b).then(|| format!("{name} {a} against {b}"));
    field("twin", a.header.twin.clone(), b.header.twin.clone())
        .or_else(|| field(&format!("version of twin {}", a.header.twin), version(a), version(b)))
        // Before the scenario, which contains it.
        .or_else(|| field("seed", a.header.seed.to_string(), b.header.seed.to_string()))
        .or_else(|| scenario(a.scenario.as_ref(), b.scenario.as_ref()))
        .or_else(|| {
            value_difference("dynamics", &json(&a.header.dynamics), &json(&b.header.dynamics))
        })
        .or_else(|| field("length of a step", seconds(a.header.dt_us), seconds(b.header.dt_us)))
        .or_else(|| value_difference("start", &json(&a.header.start), &json(&b.header.start)))
        .or_else(|| field("cameras", cameras(a), cameras(b)))
}

fn scenario(a: Option<&ScenarioLine>, b: Option<&ScenarioLine>) -> Option<String> {
    let name = |line: Option<&ScenarioLine>| line.map_or("none", |line| &line.name).to_owned();
    if name(a) != name(b) {
        return Some(format!("scenario {} against {}", name(a), name(b)));
    }
    let (a, b) = a.zip(b)?;
    if a.hash == b.hash {
        return None;
    }
    let at = format!("scenario {}", a.name);
    // The hash is that of the text. Two texts of different digits can have equal values, and then
    // only the hashes can be shown.
    let hashes = || format!("{at}: hash {} against {}", a.hash, b.hash);
    Some(value_difference(&at, &a.scenario, &b.scenario).unwrap_or_else(hashes))
}

/// A value of numbers and texts as JSON, which cannot fail.
fn json(value: &impl serde::Serialize) -> Value {
    serde_json::to_value(value).unwrap_or_default()
}

/// The first place at which two values differ, and both values:
/// `at: actors[0].idm.speed 8.0 against 9.0`.
fn value_difference(at: &str, a: &Value, b: &Value) -> Option<String> {
    let (path, a, b) = first_difference(String::new(), a, b)?;
    let text = |value: &Value| match value {
        Value::Null => "none".to_owned(),
        value => shortened(&value.to_string()),
    };
    Some(format!("{at}: {}{} against {}", path.trim_start_matches('.'), text(a), text(b)))
}

/// The path of the first difference, with a space behind it, and both values.
fn first_difference<'a>(
    path: String,
    a: &'a Value,
    b: &'a Value,
) -> Option<(String, &'a Value, &'a Value)> {
    match (a, b) {
        // Each level compares whole values again. A scenario is a few levels deep, so that this
        // costs less than building the path of every equal value.
        _ if a == b => None,
        (Value::Object(a), Value::Object(b)) => {
            // Keys of both sides, sorted: a key that one side lacks is found as well, as null on
            // that side.
            let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            let of = |map: &'a Map<String, Value>, key: &str| map.get(key).unwrap_or(&Value::Null);
            keys.into_iter()
                .find_map(|key| first_difference(format!("{path}.{key}"), of(a, key), of(b, key)))
        }
        (Value::Array(a), Value::Array(b)) => {
            let of = |list: &'a [Value], index: usize| list.get(index).unwrap_or(&Value::Null);
            (0..a.len().max(b.len()))
                .find_map(|k| first_difference(format!("{path}[{k}]"), of(a, k), of(b, k)))
        }
        _ => Some((format!("{path} "), a, b)),
    }
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
    // From here on something differs. A termination comes first: it differs even if the commands
    // are equal.
    if a.terminated != b.terminated {
        return Some((What::Command, format!("terminate {}, {}", a.terminated, b.terminated)));
    }
    Some((What::Command, format!("{}, {}", shortened(&text(a)), shortened(&text(b)))))
}

fn ego(a: &Frame, b: &Frame) -> Option<(What, String)> {
    // `driven` returns only frames that have poses, so that `?` hides no difference.
    let pose_a = a.poses.last()?;
    let pose_b = b.poses.last()?;
    if pose_a == pose_b {
        return None;
    }
    let off_m = pose_a.position_m.distance(pose_b.position_m);
    let off_rad = pose_a.rotation.angle_between(pose_b.rotation);
    Some((What::Ego, format!("{off_m:.3e} m and {off_rad:.3e} rad apart")))
}

fn actors_at(episode: &EpisodeFile, step: u64) -> Option<&ActorsLine> {
    // A step has several lines if the session returned to an earlier state. The last one was
    // driven.
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
    // Indices rise in both lists, and a state contains its index. An actor that only one side has
    // makes the states at its place differ.
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
    // A warm-up has several images of each camera.
    let camera = first.and_then(|image| cameras.get(image % cameras.len().max(1)));
    let how = match camera {
        Some(camera) => format!("camera {:?}", camera.name),
        None => format!("{} images, {} images", a.images.len(), b.images.len()),
    };
    Some((What::Image, how))
}

fn shortened(text: &str) -> String {
    // Counts characters and not bytes, so that the cut is on a boundary of a character.
    const MOST: usize = 120;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{} ..", &text[..end]),
        None => text.to_owned(),
    }
}
