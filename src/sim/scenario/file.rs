//! The scenario file `wildcity.scenario/1`, as it is written: JSON with numbers in metres, seconds and radians unless
//! a name says otherwise.
//!
//! Every object may have a `note`, a comment, and a string `"$name"` in place of any value stands for a value of the
//! sweep. Notes are removed and such strings replaced before the file is read as these types.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use wildcity_scene::ActorClass;

/// A scenario: a twin, an ego, actors, and when it ends.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ScenarioFile {
    /// `wildcity.scenario/1`.
    pub format: String,
    /// Name of the scenario.
    pub name: String,
    /// The twin in which it plays.
    pub twin: TwinPin,
    /// A map of the twin. Without one there are no lanes, and the recorded drives are the routes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map: Option<FilePin>,
    /// The ego.
    #[serde(default)]
    pub ego: EgoSection,
    /// Where the ego should drive. If absent, along the trajectory that `ego.start` names; else there is no route.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub route: Option<RouteSection>,
    /// Recorded actors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracks: Option<TracksSection>,
    /// Further actors.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub actors: Vec<ActorSection>,
    /// Values that are tried one after the other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sweep: Option<SweepSection>,
    /// When an episode ends, beside the agent's own end.
    #[serde(default)]
    pub end: EndSection,
    /// What an episode must reach.
    #[serde(default)]
    pub verdict: VerdictSection,
    /// The seed that jitter was drawn with: only in the resolved scenario of a record.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
}

/// A twin, and the hash of its version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TwinPin {
    /// Name of the twin.
    pub name: String,
    /// BLAKE3 of the version's manifest, 64 lower-case hex digits. If absent, the version is not pinned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version_hash: Option<String>,
}

/// A file beside the scenario, and its hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct FilePin {
    /// Name of the file in the scenario's directory.
    pub file: String,
    /// BLAKE3 of its bytes, 64 lower-case hex digits. If absent, the file is not pinned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<String>,
}

/// The ego. Fields that the request `open` has too are overridden by it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct EgoSection {
    /// Where it starts. If absent, as of the request `open`: the start of the twin's first trajectory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartSection>,
    /// How it moves. If absent, by teleport.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<DynamicsSection>,
    /// Length of the warm-up before the start, in microseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warm_up_us: Option<i64>,
    /// Its box. If absent, 5.393 m x 2.109 m x 1.503 m, its centre 1.3 m before the rear axle.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none")]
    pub box_: Option<EgoBoxSection>,
    /// The start shifts by up to so many frames of 0.5 s, earlier or later.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jitter_frames: Option<u32>,
}

/// Where the ego starts: at a station of a trajectory, or at a pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct StartSection {
    /// Name of a recorded trajectory of the twin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trajectory: Option<String>,
    /// Distance along it, in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub station_m: Option<f64>,
    /// A pose, instead of a trajectory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseSection>,
}

/// A pose: a position, and a heading or a whole rotation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct PoseSection {
    /// Position in the world, in metres.
    pub xyz: [f64; 3],
    /// Heading from the world's x axis, in radians, positive to the left. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub yaw_rad: Option<f64>,
    /// Rotation as a unit quaternion (w, x, y, z), instead of a heading.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub q: Option<[f64; 4]>,
}

/// How the ego moves, as in the request `open`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DynamicsSection {
    /// The motion model.
    pub model: ModelSection,
    /// Speed at the start of an episode, in m/s.
    #[serde(default)]
    pub speed: f64,
    /// Whether braking beyond standstill drives backwards.
    #[serde(default)]
    pub reverse: bool,
}

/// Motion model of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ModelSection {
    /// Moves to the requested pose.
    Teleport,
    /// Rolls without slipping.
    Kinematic,
    /// Single-track model.
    Dynamic,
}

/// The box of the ego.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct EgoBoxSection {
    /// Length, width and height, in metres.
    pub size: [f64; 3],
    /// From the rear axle forward to the box's centre, in metres.
    pub center_x: f64,
}

/// Where the ego should drive: exactly one of `trajectory`, `points` and `lanes`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RouteSection {
    /// A recorded trajectory of the twin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trajectory: Option<String>,
    /// Way-points in the world, in metres, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<Vec<[f64; 3]>>,
    /// Lanes of the map, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lanes: Option<Vec<String>>,
    /// Navigation commands. Without them, a command says to which side the route leads 3 s ahead.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub commands: Vec<CommandSection>,
}

/// A navigation command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct CommandSection {
    /// Where it is to be carried out, in metres along the route.
    pub station_m: f64,
    /// The command.
    pub command: NavigationCommand,
    /// Text for language models; `{m}` is replaced by the distance in whole metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// How long before its place it is given, in metres. If absent, 50.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ahead_m: Option<f64>,
}

/// Where to go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum NavigationCommand {
    /// To the left.
    Left,
    /// To the right.
    Right,
    /// Straight on.
    Straight,
}

/// Recorded actors: all tracks of a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TracksSection {
    /// Name of a file `wildcity.tracks/1` in the scenario's directory.
    pub file: String,
    /// BLAKE3 of its bytes, 64 lower-case hex digits. If absent, the file is not pinned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<String>,
    /// Tracks that are left out.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub without: Vec<String>,
    /// Time of the tracks at which the episode begins, in microseconds. If absent, the time at which the recorded
    /// trajectory passed the ego's start; 0 if the ego starts at a pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_us: Option<i64>,
}

/// An actor, with exactly one of `log`, `path`, `idm`, `collide`, `attack` and `stand`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ActorSection {
    /// Name within the scenario, `[a-z0-9._-]+`.
    pub name: String,
    /// Its kind. If absent, that of its asset; without an asset, a vehicle.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(with = "Option<ClassSchema>"))]
    pub class: Option<ActorClass>,
    /// BLAKE3 of its asset, 64 lower-case hex digits, or the name of a built-in asset. Without one it is not drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub asset: Option<String>,
    /// Length, width and height, in metres. If absent, those of its asset; without an asset, of its kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<[f64; 3]>,
    /// Whether it is there from the begin; otherwise its script spawns it. If absent, true.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub present: Option<bool>,
    /// Repeats a track of the tracks file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log: Option<LogSection>,
    /// Follows a course at a speed of its own, whatever others do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path: Option<PathSection>,
    /// Follows a course by the Intelligent Driver Model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub idm: Option<IdmSection>,
    /// Moves through timed positions, blind to others, as in NeuroNCAP.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collide: Option<CollideSection>,
    /// Plans its way towards the ego, as in HUGSIM.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attack: Option<AttackSection>,
    /// Stands.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stand: Option<PoseSection>,
    /// What it does when a condition holds; for `path` and `idm`, and `spawn` and `remove` for all.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub script: Vec<TriggerSection>,
    /// Random displacement of its begin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jitter: Option<JitterSection>,
}

/// A track of the tracks file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct LogSection {
    /// Id of the track.
    pub track: String,
}

/// A line to follow: exactly one of `along`, `points` and `lanes`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CourseSection {
    /// A recorded trajectory of the twin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along: Option<String>,
    /// Points in the world, in metres, in order. They are placed on the ground where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<Vec<[f64; 3]>>,
    /// Lanes of the map, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lanes: Option<Vec<String>>,
    /// Whether to follow it from its end to its start. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reverse: Option<bool>,
}

/// An actor on a course.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct PathSection {
    /// A recorded trajectory of the twin, as the line to follow. Exactly one of `along`, `points` and `lanes`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along: Option<String>,
    /// Points in the world, in metres, in order. They are placed on the ground where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<Vec<[f64; 3]>>,
    /// Lanes of the map, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lanes: Option<Vec<String>>,
    /// Whether to follow it from its end to its start. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reverse: Option<bool>,
    /// Where it begins, in metres along the line.
    pub station_m: f64,
    /// How far to the left of the line it drives, in metres. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset_m: Option<f64>,
    /// Its speed at the begin, in m/s.
    pub speed: f64,
    /// Whether it disappears at the end of the line. Otherwise it stands there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub leaves: Option<bool>,
}

/// An actor that follows a course by the Intelligent Driver Model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IdmSection {
    /// A recorded trajectory of the twin, as the line to follow. Exactly one of `along`, `points` and `lanes`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along: Option<String>,
    /// Points in the world, in metres, in order. They are placed on the ground where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<Vec<[f64; 3]>>,
    /// Lanes of the map, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lanes: Option<Vec<String>>,
    /// Whether to follow it from its end to its start. If absent, false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reverse: Option<bool>,
    /// Where it begins, in metres along the line.
    pub station_m: f64,
    /// How far to the left of the line it drives, in metres. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub offset_m: Option<f64>,
    /// Its speed at the begin, in m/s.
    pub speed: f64,
    /// Whether it disappears at the end of the line. Otherwise it stands there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub leaves: Option<bool>,
    /// Which variant of the model. If absent, `wildcity`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<IdmModel>,
    /// Speed of a free road, in m/s. If absent, that of the variant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub v0: Option<f64>,
    /// Gap to a standing lead, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub s0: Option<f64>,
    /// Time headway, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub headway_s: Option<f64>,
    /// Largest acceleration, in m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub a: Option<f64>,
    /// Comfortable braking, in m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub b: Option<f64>,
}

/// Variants of the Intelligent Driver Model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum IdmModel {
    /// Treiber and Kesting's formula with the parameters of nuPlan.
    Wildcity,
    /// nuPlan's agents.
    Nuplan,
    /// NAVSIM's planner.
    Navsim,
    /// HUGSIM's agents.
    Hugsim,
}

/// Timed positions: either `positions`, or a straight line that meets a trajectory (`along`).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CollideSection {
    /// Times since the episode's start, in seconds, with positions in the world, in metres. The actor faces the
    /// direction of its motion, and stands before the first and after the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub positions: Option<Vec<TimedPosition>>,
    /// Heading of an actor that stands, in radians. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub yaw_rad: Option<f64>,
    /// A recorded trajectory of the twin, which the actor's straight line meets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along: Option<String>,
    /// Where they meet, in metres along the trajectory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub station_m: Option<f64>,
    /// When they meet, in seconds since the episode's start.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_s: Option<f64>,
    /// The actor's heading there relative to the trajectory's, in radians: π is frontal, ±π/2 from the side.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub angle_rad: Option<f64>,
    /// The actor's constant speed, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
}

/// A position at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TimedPosition {
    /// Time since the episode's start, in seconds.
    pub time_s: f64,
    /// Position on the ground, in metres.
    pub xyz: [f64; 3],
}

/// An attacker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct AttackSection {
    /// Where it begins.
    pub pose: PoseSection,
    /// Its speed then, in m/s.
    pub speed: f64,
    /// Ticks of 0.25 s between two plans. If absent, 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ticks: Option<u32>,
    /// The plan is drawn from so many of the best: 1, 2 or 10 in HUGSIM. If absent, 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub best_k: Option<u32>,
}

/// A condition and what follows, once.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct TriggerSection {
    /// A name, for `after` and for events.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The condition.
    pub when: ConditionSection,
    /// The actions, in order.
    #[serde(rename = "do")]
    pub then: Vec<ActionSection>,
}

/// A condition: every given part must hold. One without parts holds at the begin.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ConditionSection {
    /// From this time on, in seconds since the episode's start.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_s: Option<f64>,
    /// At most this far from the middle of the ego's box, or from that of `of`, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub within_m: Option<f64>,
    /// The actor that `within_m` is measured to. If absent, the ego.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// The actor has reached this station of its course, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub station_m: Option<f64>,
    /// The ego has reached this station of the actor's course, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ego_station_m: Option<f64>,
    /// The actor drives at least so fast, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_above: Option<f64>,
    /// The actor drives at most so fast, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_below: Option<f64>,
    /// The ego drives at least so fast, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ego_speed_above: Option<f64>,
    /// A trigger that fired before, by its name: `TRIGGER` of this actor, or `ACTOR/TRIGGER`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
    /// How long before, in seconds. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delay_s: Option<f64>,
}

/// One action.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ActionSection {
    /// Changes the speed to `to` m/s by `rate` m/s².
    Speed {
        /// The new speed, in m/s.
        to: f64,
        /// Acceleration or braking, in m/s².
        rate: f64,
    },
    /// Brakes to standstill by `rate` m/s².
    Stop {
        /// Braking, in m/s².
        rate: f64,
    },
    /// Moves to another offset from the course.
    Offset {
        /// The new offset, in metres to the left.
        to_m: f64,
        /// Within this time, in seconds.
        over_s: f64,
    },
    /// Continues on another course, from its nearest place.
    Path(CourseSection),
    /// Appears.
    Spawn {},
    /// Disappears.
    Remove {},
}

/// Random displacement: each value is drawn uniformly within plus and minus the given one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct JitterSection {
    /// Along the course or the heading, in metres.
    pub longitudinal_m: f64,
    /// To the right of it, in metres.
    pub lateral_m: f64,
    /// Heading, in radians; for `collide`, `attack` and `stand`.
    pub yaw_rad: f64,
    /// Direction that counts as along, in radians from the world's x axis; for `collide`, `attack` and `stand`. If
    /// absent, the actor's heading.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along_rad: Option<f64>,
    /// What was drawn: only in the resolved scenario of a record.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drawn: Option<JitterDraw>,
}

/// A drawn displacement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct JitterDraw {
    /// Along, in metres.
    pub longitudinal_m: f64,
    /// To the right, in metres.
    pub lateral_m: f64,
    /// Heading, in radians.
    pub yaw_rad: f64,
}

/// Values that are tried one after the other: every combination.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct SweepSection {
    /// First and last seed. If absent, only seed 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seeds: Option<[u64; 2]>,
    /// The values of each `$name`.
    #[serde(flatten)]
    pub values: BTreeMap<String, Vec<serde_json::Value>>,
}

/// When an episode ends.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct EndSection {
    /// After this time, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_s: Option<f64>,
    /// Farther than this from the route, in metres: 10 in HUGSIM, 30 in Bench2Drive.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub off_route_m: Option<f64>,
    /// At a contact of this kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contact: Option<ContactRule>,
    /// Slower than 0.1 m/s for this time, in seconds: 60 in Bench2Drive.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stuck_s: Option<f64>,
    /// Whether the end of the route ends the episode: more than 99 % of it, and less than 10 m from its end. If
    /// absent, true.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub route_done: Option<bool>,
}

/// Which contacts end an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ContactRule {
    /// Every contact with an actor.
    Any,
    /// One that is the ego's fault.
    AtFault,
    /// One with a pedestrian.
    Pedestrian,
    /// One with the twin's Gaussians beside the route. They are looked at in no other case.
    Static,
}

/// What an episode must reach.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct VerdictSection {
    /// The share of the route that must be driven, 0 to 1. If absent, 0.8.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<f64>,
}

/// The classes in the schema: the type itself is of a package without schemas.
#[cfg(feature = "schema")]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "ActorClass", rename_all = "snake_case")]
#[expect(dead_code, reason = "only its schema is used")]
pub(super) enum ClassSchema {
    Vehicle,
    Pedestrian,
    Bicycle,
    Object,
}

impl ScenarioFile {
    /// The format that this build reads and writes.
    pub const FORMAT: &str = "wildcity.scenario/1";
}
