//! The actors of a scenario file, as they are written.

use serde::{Deserialize, Serialize};

use wildcity_scene::ActorClass;

use super::line_fields::section_on_course;
use super::pose::PoseSection;
use super::script_file::TriggerSection;

/// The name of the asset of an actor that is not drawn.
pub const NOT_DRAWN: &str = "none";

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
    /// The name of its asset, or its BLAKE3, 64 lower-case hex digits; `none` if it is not drawn.
    /// If absent, the generated asset of its class whose size is the nearest.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub asset: Option<String>,
    /// Length, width and height, in metres. If absent, those of its asset; without an asset, of its
    /// kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<[f64; 3]>,
    /// Whether it is present from the start; otherwise its script spawns it. If absent, true.
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
    /// Moves through timed positions and ignores all others, as in NeuroNCAP.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collide: Option<CollideSection>,
    /// Plans its way towards the ego, as in HUGSIM.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attack: Option<AttackSection>,
    /// Stands.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stand: Option<PoseSection>,
    /// Conditions and their actions: all actions for `path` and `idm`, only `spawn` and `remove`
    /// for the others.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub script: Vec<TriggerSection>,
    /// Random displacement of its starting pose.
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

section_on_course! {
    /// An actor on a course.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
    #[serde(deny_unknown_fields, default)]
    pub struct PathSection {}
}

section_on_course! {
    /// An actor that follows a course by the Intelligent Driver Model.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
    #[serde(deny_unknown_fields, default)]
    pub struct IdmSection {
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
    /// Times since the episode's start, in seconds, with positions in the world, in metres. The
    /// actor faces the direction of its motion, and stands before the first and after the last.
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
    /// The actor's heading there relative to the trajectory's, in radians: π is frontal, ±π/2 from
    /// the side.
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
    /// Where it starts.
    pub pose: PoseSection,
    /// Its speed then, in m/s.
    pub speed: f64,
    /// Ticks of 0.25 s between two plans. If absent, 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ticks: Option<u32>,
    /// Number of best plans from which one is sampled: 1, 2 or 10 in HUGSIM. If absent, 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub best_k: Option<u32>,
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
    /// Direction that counts as along, in radians from the world's x axis; for `collide`, `attack`
    /// and `stand`. If absent, the actor's heading.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub along_rad: Option<f64>,
    /// The sampled displacement: only in the resolved scenario of a record.
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
