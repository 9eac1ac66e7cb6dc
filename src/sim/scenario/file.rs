//! The scenario file `wildcity.scenario/1`, as it is written: JSON with numbers in metres, seconds
//! and radians unless a name says otherwise.
//!
//! Every object may have a `note`, a comment, and a string `"$name"` in place of any value stands
//! for a value of the sweep. Notes are removed and such strings replaced before the file is read as
//! these types.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use wildcity_options::{Dynamics, strict};

use super::actor_file::ActorSection;
use super::pose::PoseSection;
use super::script_file::ConditionSection;

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
    /// Where the ego should drive. If absent, along the trajectory that `ego.start` names, if any.
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
    /// When an episode ends, unless the agent ends it before.
    #[serde(default)]
    pub end: EndSection,
    /// The requirements that an episode must meet.
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
    /// BLAKE3 of the version's manifest, 64 lower-case hex digits. If absent, the version is not
    /// pinned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version_hash: Option<String>,
}

/// A file in the scenario's directory, and its hash.
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
    /// Where it starts. If absent, as in the request `open`: the start of the twin's first
    /// trajectory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartSection>,
    /// How it moves. If absent, by teleport.
    #[serde(deserialize_with = "strict::deserialize", skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<Dynamics>,
    /// Length of the warm-up before the start, in microseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warm_up_us: Option<i64>,
    /// Its box. If absent, 5.393 m x 2.109 m x 1.503 m, its centre 1.3 m before the rear axle.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none")]
    pub box_: Option<EgoBoxSection>,
    /// Largest shift of the start, in frames of 0.5 s, earlier or later.
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
    /// Where it must be carried out, in metres along the route.
    pub station_m: f64,
    /// The command.
    pub command: NavigationCommand,
    /// Text for language models; `{m}` is replaced by the distance in whole metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Distance before its place at which it is given, in metres. If absent, 50.
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
    /// Time of the tracks at which the episode begins, in microseconds. If absent, the time at
    /// which the recorded trajectory passed the ego's start; 0 if the ego starts at a pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_us: Option<i64>,
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
    /// Whether the end of the route ends the episode: more than 99 % of it, and less than 10 m from
    /// its end. If absent, true.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub route_done: Option<bool>,
    /// When this holds. A trigger is named `ACTOR/TRIGGER`; parts that are about a trigger's own
    /// actor are refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub when: Option<ConditionSection>,
}

/// Which contacts end an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ContactRule {
    /// Every contact, with an actor or with the twin.
    Any,
    /// One that is the ego's fault, as every contact with the twin is.
    AtFault,
    /// One with a pedestrian.
    Pedestrian,
    /// One with the twin.
    Static,
}

/// The requirements that an episode must meet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct VerdictSection {
    /// Distance that a pass requires, as a share of what the recorded drive covers in the same
    /// time, 0 to 1. If absent, 0.8.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<f64>,
    /// Whether contact with the twin is looked for. If absent, true. If false, `contact.static` is
    /// not judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub twin_contact: Option<bool>,
}

impl ScenarioFile {
    /// The format that this build reads and writes.
    pub const FORMAT: &str = "wildcity.scenario/1";
}
