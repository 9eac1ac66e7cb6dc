//! The lines that a scenario adds to an episode's file.
//!
//! ```text
//! {"kind":"scenario", ...}  after the header: the resolved scenario, the ego's size, the route
//! {"kind":"actors", ...}    one before each frame that a step rendered: the poses of the actors
//! {"kind":"event", ...}     contacts, and the reason for the end
//! {"kind":"result", ...}    before the end: verdict and scores
//! ```
//!
//! A session without a scenario writes only events: contacts with the twin, and that the ego left
//! the trained area.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass};
use wildcity_score::own;
use wildcity_sim::contact::{CollisionType, Contact};
use wildcity_sim::traffic::{ActorSpec, ActorState, EgoBox};

use crate::limits;

/// The scenario that an episode drives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioLine {
    pub name: String,
    /// BLAKE3 of the resolved scenario's JSON, in hex: with its seed, the identity of the episode.
    pub hash: String,
    /// The resolved scenario: with the values of the sweep, and the jitter sampled.
    pub scenario: serde_json::Value,
    pub ego: EgoLine,
    /// The actors, in order of their index.
    #[serde(default)]
    pub actors: Vec<ActorLine>,
    /// The recorded drive from where the episode starts; empty if there is none to follow.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub route: Vec<RoutePoint>,
    /// The route where nothing says when the ego is due, neither a recorded drive nor an end of the
    /// scenario: places in metres.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub way: Vec<[f64; 3]>,
    /// When the episode ends at the latest, in microseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_us: Option<i64>,
    /// Progress that a pass takes, 0 to 1.
    pub least_progress: f64,
    /// The lanes of a map near the route; none without a map.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lanes: Vec<LaneLine>,
    /// The road under the lanes for vehicles, each by the points of its middle line; none without a
    /// map. The ego stands on it where no recorded drive is near.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ground: Vec<Vec<GroundPoint>>,
    /// Whether contact with the twin's Gaussians is looked for.
    #[serde(default)]
    pub checks_static: bool,
}

/// The box of the ego, and where it is relative to the rear axle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EgoLine {
    /// Length, width and height, in metres.
    pub size: [f64; 3],
    /// From the rear axle forward to the centre, in metres.
    pub center_x: f64,
}

/// Constant properties of an actor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActorLine {
    pub name: String,
    pub class: ActorClass,
    /// Length, width and height, in metres.
    pub size: [f64; 3],
    /// BLAKE3 of its asset, in hex; absent if it is not drawn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asset: Option<String>,
}

/// A point of the recorded drive: time since the episode's start in microseconds, and place in
/// metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoutePoint(pub i64, pub [f64; 3]);

/// A point of a road: place in metres, and unit normal, which is left out if it is vertical.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroundPoint {
    pub at: [f64; 3],
    #[serde(default = "vertical", skip_serializing_if = "is_vertical")]
    pub up: [f64; 3],
}

fn vertical() -> [f64; 3] {
    [0.0, 0.0, 1.0]
}

fn is_vertical(up: &[f64; 3]) -> bool {
    *up == vertical()
}

/// A lane or an area of the map, seen from above.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LaneLine {
    /// Its outline, in metres, without repeating the first point.
    pub outline: Vec<[f64; 2]>,
    /// Its middle, in driving direction, in metres; none of an area.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub center: Vec<[f64; 2]>,
    /// Whether it belongs to the route.
    #[serde(default)]
    pub route: bool,
    /// Whether it is an intersection.
    #[serde(default)]
    pub intersection: bool,
}

/// Where the actors are at a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActorsLine {
    pub step: u64,
    pub time_us: i64,
    /// The actors that are present, by rising index.
    pub actors: Vec<ActorStateLine>,
}

/// An actor at a step: index, pose, velocity in m/s along world axes, yaw rate in rad/s.
///
/// The pose has all digits, since images depend on it. Velocity and yaw rate are f32: half of their
/// digits would be noise, and they are a third of a record.
// Without names of fields, which would be repeated for each actor at each step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActorStateLine(pub u16, pub [f64; 3], pub [f64; 4], pub [f32; 3], pub f32);

/// Something that happened at a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EventLine {
    /// Steps done when it was over.
    pub step: u64,
    /// When it happened, in microseconds.
    pub time_us: i64,
    #[serde(flatten)]
    pub event: Event,
}

/// Kind of an event.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// A contact with an actor began.
    Contact(ContactEvent),
    /// A contact with the twin's Gaussians began.
    StaticContact {
        /// The area that was met, in m².
        area_m2: f64,
        /// The ego's speed, in m/s.
        impact_mps: f64,
    },
    /// The trust of an observation fell below its limit.
    OffModel {
        trust: f64,
    },
    /// A trigger of an actor's script fired.
    Triggered {
        actor: u16,
        /// Index of the trigger in its script.
        trigger: u32,
    },
    Appeared {
        actor: u16,
    },
    Left {
        actor: u16,
    },
    /// A rule of the scenario ended the episode: `time`, `contact`, `off_route`, `route_done`,
    /// `stuck`, `condition`.
    Ended {
        rule: String,
    },
}

/// A contact with an actor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ContactEvent {
    /// Index of the actor.
    pub actor: u16,
    /// Kind of contact, as `active_front`.
    pub collision: Collision,
    /// Whether the boxes overlapped when the episode began, or when the actor appeared.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub at_start: bool,
    /// Whether the ego is at fault (`wildcity.fault@1`).
    pub ego_at_fault: bool,
    /// Unit vector from the ego to the actor.
    pub normal: [f64; 2],
    /// Speed against each other, in m/s.
    pub impact_mps: f64,
    /// The ego's velocity, in m/s.
    pub ego_velocity: [f64; 2],
    /// The actor's velocity, in m/s.
    pub actor_velocity: [f64; 2],
}

/// The kind of a contact, [`CollisionType`] in JSON.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names are those of CollisionType")]
pub enum Collision {
    StoppedEgo,
    StoppedTrack,
    ActiveRear,
    ActiveFront,
    ActiveLateral,
}

/// Verdict and scores of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// `passed`, `failed`, `off_model` or `not_judged`.
    pub verdict: String,
    /// The faults, by time.
    pub faults: Vec<FaultLine>,
    /// Criteria that were not judged, and the reasons.
    pub not_judged: Vec<String>,
    /// The scores, each with its name and version.
    pub scores: BTreeMap<String, ScoreLine>,
}

/// A fault of the ego.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FaultLine {
    /// Its name, as `contact.at_fault`.
    pub fault: String,
    pub time_us: i64,
    /// Name of the actor, for a contact with one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actor: Option<String>,
    /// The area that was met, in m², for a contact with the twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub area_m2: Option<f64>,
    /// The ego's speed, in m/s, for a contact with the twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub impact_mps: Option<f64>,
}

impl FaultLine {
    /// The fault in words, with the values of the episode's scores:
    /// `contact.pedestrian with walker at 4.615 s`.
    pub fn text(&self, scores: &BTreeMap<String, ScoreLine>) -> String {
        let actor = self.actor.as_ref().map(|actor| format!(" with {actor}")).unwrap_or_default();
        let text = format!("{}{actor} at {:.3} s", self.fault, self.time_us as f64 * 1e-6);
        if let (Some(impact_mps), Some(area_m2)) = (self.impact_mps, self.area_m2) {
            return format!("{text}, at {impact_mps:.2} m/s, {area_m2:.3} m²");
        }
        let part = |name: &str| scores.get(own::NAME)?.parts.get(name).copied().flatten();
        match (&*self.fault, part("progress"), part("least_progress")) {
            // The only fault that two numbers explain: how far the ego came, and how far it had to
            // come.
            ("progress", Some(progress), Some(least)) => {
                let progress = less(progress, least);
                format!("{text}: {progress} of the recorded drive, and {least} is the least")
            }
            _ => text,
        }
    }
}

/// A value in as many digits, at least three, as show that it is less than another.
fn less(value: f64, than: f64) -> String {
    let in_digits = |digits: usize| format!("{value:.digits$}");
    let shows = |text: &String| text.parse::<f64>().is_ok_and(|shown| shown < than);
    (3..=17).map(in_digits).find(shows).unwrap_or_else(|| value.to_string())
}

/// A score: its value, or null and the reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreLine {
    pub value: Option<f64>,
    /// Reason for the missing value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Inputs of the value; null for a missing input.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parts: BTreeMap<String, Option<f64>>,
}

impl From<CollisionType> for Collision {
    fn from(kind: CollisionType) -> Self {
        // Without `_`: a kind that `sim` adds does not compile before it has a name in records.
        match kind {
            CollisionType::StoppedEgo => Self::StoppedEgo,
            CollisionType::StoppedTrack => Self::StoppedTrack,
            CollisionType::ActiveRear => Self::ActiveRear,
            CollisionType::ActiveFront => Self::ActiveFront,
            CollisionType::ActiveLateral => Self::ActiveLateral,
        }
    }
}

impl From<Collision> for CollisionType {
    fn from(kind: Collision) -> Self {
        match kind {
            Collision::StoppedEgo => Self::StoppedEgo,
            Collision::StoppedTrack => Self::StoppedTrack,
            Collision::ActiveRear => Self::ActiveRear,
            Collision::ActiveFront => Self::ActiveFront,
            Collision::ActiveLateral => Self::ActiveLateral,
        }
    }
}

impl ContactEvent {
    /// The event of a contact.
    pub fn new(contact: &Contact) -> Self {
        Self {
            actor: contact.actor,
            collision: contact.kind.into(),
            at_start: contact.at_start,
            ego_at_fault: contact.ego_at_fault,
            normal: contact.normal.to_array(),
            impact_mps: contact.impact_mps,
            ego_velocity: contact.ego_velocity_mps.to_array(),
            actor_velocity: contact.actor_velocity_mps.to_array(),
        }
    }

    /// The contact of an event at a time, in microseconds.
    pub fn contact(&self, time_us: i64) -> Contact {
        Contact {
            actor: self.actor,
            time_us,
            at_start: self.at_start,
            kind: self.collision.into(),
            ego_at_fault: self.ego_at_fault,
            normal: DVec2::from_array(self.normal),
            impact_mps: self.impact_mps,
            ego_velocity_mps: DVec2::from_array(self.ego_velocity),
            actor_velocity_mps: DVec2::from_array(self.actor_velocity),
        }
    }
}

impl EventLine {
    /// The line of a contact.
    pub fn contact(step: u64, contact: &Contact) -> Self {
        let event = Event::Contact(ContactEvent::new(contact));
        Self { step, time_us: contact.time_us, event }
    }

    /// Checks that the event is about one of the scenario's `actors`.
    ///
    /// # Errors
    /// It is not; describes the error.
    pub fn check(&self, actors: usize) -> Result<(), String> {
        match self.event.actor() {
            Some(actor) => check_index(actor, actors),
            None => Ok(()),
        }
    }
}

impl Event {
    /// Index of the actor that it is about.
    pub fn actor(&self) -> Option<u16> {
        match self {
            Self::Contact(contact) => Some(contact.actor),
            Self::Triggered { actor, .. } | Self::Appeared { actor } | Self::Left { actor } => {
                Some(*actor)
            }
            Self::StaticContact { .. } | Self::OffModel { .. } | Self::Ended { .. } => None,
        }
    }
}

fn check_index(actor: u16, actors: usize) -> Result<(), String> {
    if usize::from(actor) < actors {
        Ok(())
    } else {
        Err(format!("actor {actor}, but the scenario has {actors} actors"))
    }
}

impl ScenarioLine {
    /// Checks that the line can be read back.
    ///
    /// # Errors
    /// It is longer than [`SCENARIO_LINE_BYTES`](limits::SCENARIO_LINE_BYTES); says what to do.
    pub fn check(&self) -> Result<(), String> {
        // The kind and the line break are added.
        const ADDED_BYTES: usize = 64;
        // Without lanes it is far shorter than that, and need not be counted.
        if self.lanes.is_empty() && self.ground.is_empty() {
            return Ok(());
        }
        self.check_bytes(limits::SCENARIO_LINE_BYTES - ADDED_BYTES)
    }

    /// Checks that it has at most so many bytes.
    fn check_bytes(&self, most_bytes: usize) -> Result<(), String> {
        let mut counted = ByteCount(0);
        // Numbers, texts and lists: counting them cannot fail.
        let _ = serde_json::to_writer(&mut counted, self);
        if counted.0 <= most_bytes {
            return Ok(());
        }
        Err(format!(
            "its lanes and the route take {} bytes in the record, and at most {most_bytes} can be read back: name a map \
             of the surroundings of the route",
            counted.0
        ))
    }
}

/// Counts the bytes that are written into it.
struct ByteCount(usize);

impl std::io::Write for ByteCount {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 += bytes.len();
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl EgoLine {
    /// The line of a box.
    pub fn new(ego: &EgoBox) -> Self {
        let ActorBox { length_m, width_m, height_m } = ego.box_;
        Self { size: [length_m, width_m, height_m], center_x: ego.center_x_m }
    }
}

impl ActorLine {
    /// The line of an actor.
    pub fn new(spec: &ActorSpec) -> Self {
        let ActorBox { length_m, width_m, height_m } = spec.box_;
        let size = [length_m, width_m, height_m];
        Self { name: spec.name.clone(), class: spec.class, size, asset: spec.asset.clone() }
    }

    /// Length, width and height of its box, in metres.
    pub fn actor_box(&self) -> ActorBox {
        let [length_m, width_m, height_m] = self.size;
        ActorBox { length_m, width_m, height_m }
    }
}

impl ActorsLine {
    /// The line of the actors that are present.
    pub fn new(step: u64, time_us: i64, states: &[ActorState]) -> Self {
        let there = states.iter().filter(|state| state.present);
        Self { step, time_us, actors: there.map(ActorStateLine::new).collect() }
    }

    /// Checks that the line is about some of the scenario's `actors`, each once, by rising index.
    ///
    /// # Errors
    /// It is not, or an actor has no valid pose; describes the error.
    pub fn check(&self, actors: usize) -> Result<(), String> {
        // Indices that rise also occur only once, and `diff` can compare two lines place by place.
        let mut before: Option<u16> = None;
        for state in &self.actors {
            let actor = state.0;
            check_index(actor, actors)?;
            if let Some(before) = before.filter(|before| *before >= actor) {
                return Err(format!("actor {actor} follows actor {before}: indices must rise"));
            }
            // The poses are checked once here; `state` would only skip an invalid one.
            if let Err(error) = Pose::checked(state.1, state.2) {
                return Err(format!("actor {actor}: {error}"));
            }
            before = Some(actor);
        }
        Ok(())
    }
}

impl ActorStateLine {
    fn new(state: &ActorState) -> Self {
        let Pose { position_m, .. } = state.world_from_actor;
        Self(
            state.index,
            position_m.to_array(),
            state.world_from_actor.q_wxyz(),
            // Next to 100 m/s, values of f32 are 8 µm/s apart.
            state.velocity_mps.as_vec3().to_array(),
            state.yaw_rate_radps as f32,
        )
    }

    /// The state; `None` if the pose is invalid.
    pub fn state(&self) -> Option<ActorState> {
        let Self(index, xyz_m, q_wxyz, velocity_mps, yaw_rate_radps) = *self;
        Some(ActorState {
            index,
            world_from_actor: Pose::checked(xyz_m, q_wxyz).ok()?,
            velocity_mps: DVec3::from_array(velocity_mps.map(f64::from)),
            yaw_rate_radps: f64::from(yaw_rate_radps),
            // Only actors that are present are written.
            present: true,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_shown_in_digits_that_tell_it_from_its_limit() {
        let shown = [(0.333_333, 0.8), (0.799_96, 0.8), (0.8 - 1e-12, 0.8), (0.799, 0.8)];
        let texts = shown.map(|(value, than)| less(value, than));
        assert_eq!(texts, ["0.333", "0.79996", "0.799999999999", "0.799"]);
    }

    #[test]
    fn a_scenario_that_cannot_be_read_back_is_told_before_it_is_written() {
        let line = ScenarioLine {
            name: "town".to_owned(),
            hash: String::new(),
            scenario: serde_json::Value::Null,
            ego: EgoLine { size: [5.0, 2.0, 1.5], center_x: 1.3 },
            actors: Vec::new(),
            route: Vec::new(),
            way: Vec::new(),
            limit_us: None,
            least_progress: 0.8,
            lanes: Vec::new(),
            ground: vec![vec![GroundPoint { at: [1.5; 3], up: [0.0, 0.0, 1.0] }; 1000]],
            checks_static: true,
        };
        let bytes = serde_json::to_vec(&line).unwrap().len();
        assert_eq!((line.check(), line.check_bytes(bytes)), (Ok(()), Ok(())));
        let error = line.check_bytes(bytes - 1).unwrap_err();
        assert!(error.contains(&format!("{bytes} bytes")) && error.contains("map"), "{error}");
    }
}
