//! The scripts of a scenario file's actors, as they are written.

use serde::{Deserialize, Serialize};

use super::line_fields::section_on_line;

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

/// A condition: every given part must hold. A condition without parts holds at the start.
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
    /// The actor's speed is at least this, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_above: Option<f64>,
    /// The actor's speed is at most this, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_below: Option<f64>,
    /// The ego's speed is at least this, in m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ego_speed_above: Option<f64>,
    /// A trigger that has fired, by its name: `TRIGGER` of this actor, or `ACTOR/TRIGGER`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
    /// What must have happened to `after`. If absent, `fired`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phase: Option<PhaseSection>,
    /// Least time since then, in seconds. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delay_s: Option<f64>,
    /// A value of an actor or of the ego.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub measure: Option<MeasureSection>,
    /// All of these must hold.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub all: Vec<ConditionSection>,
    /// One of these must hold.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub any: Vec<ConditionSection>,
    /// The parts must have held for this time without a break, in seconds. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_s: Option<f64>,
    /// Holds only at the instant at which the parts begin to hold (`rising`), cease to hold
    /// (`falling`), or either (`both`). The first evaluation is no such instant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub edge: Option<EdgeSection>,
    /// Holds this much later than its parts and its edge, in seconds. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub later_s: Option<f64>,
}

/// What has happened to a trigger.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum PhaseSection {
    /// It fired.
    Fired,
    /// Its actions have reached their aims.
    Done,
    /// Its actions have reached their aims, or others have replaced them.
    Ended,
}

/// An instant at which a condition changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum EdgeSection {
    /// It begins to hold.
    Rising,
    /// It ceases to hold.
    Falling,
    /// Either.
    Both,
}

/// A value of an actor or of the ego, with its bounds: `above`, `below`, or both.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct MeasureSection {
    /// What is measured.
    pub quantity: QuantitySection,
    /// The actor that is measured. If absent, the ego.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// From the middle of its box forward to its reference point, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ahead_m: Option<f64>,
    /// The actor to which a distance is measured. If absent, the ego.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<String>,
    /// From the middle of that actor's box forward to its reference point, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_ahead_m: Option<f64>,
    /// The point of `point`, in metres in the world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub xyz: Option<[f64; 3]>,
    /// Whether a distance is between boxes. If absent, it is between reference points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub free: Option<bool>,
    /// Whether `longitudinal`, `lateral` and `headway` are along the course of the trigger's actor.
    /// If absent, they are along the heading of the measured body.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_course: Option<bool>,
    /// Whether `headway` and `time_to_collision` are by the straight distance. If absent, they are
    /// by the distance along.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub straight: Option<bool>,
    /// At least this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub above: Option<f64>,
    /// At most this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub below: Option<f64>,
}

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum QuantitySection {
    /// The speed, in m/s.
    Speed,
    /// The distance driven since the episode's start, in metres.
    Travelled,
    /// The distance from `xyz`, in metres.
    Point,
    /// The distance from `to`, in metres.
    Distance,
    /// The distance from `to` along, in metres without a sign.
    Longitudinal,
    /// The distance from `to` across, in metres without a sign.
    Lateral,
    /// The distance from `to` along, divided by the speed, in seconds.
    Headway,
    /// The distance from `to` along, divided by the rate at which it becomes less, in seconds.
    TimeToCollision,
}

/// The course of a value from its start to its aim.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ShapeSection {
    /// At once.
    Step,
    /// At a constant rate.
    Linear,
    /// A half wave.
    Sinusoidal,
    /// A cubic without a rate at its ends.
    Cubic,
}

/// A change to a value by a shape: with exactly one of `over_s`, `over_m`, `rate` and
/// `acceleration`, and with none of them for `step`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ProfileSection {
    /// The aim: a speed in m/s, or an offset in metres to the left.
    pub to: f64,
    /// The shape.
    pub shape: ShapeSection,
    /// Within this time, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub over_s: Option<f64>,
    /// Within this distance, in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub over_m: Option<f64>,
    /// With this largest rate: m/s² for a speed, m/s for an offset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// With this largest acceleration of an offset, in m/s².
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<f64>,
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
    /// Changes the speed by a shape, whatever the acceleration.
    SpeedProfile(ProfileSection),
    /// Drives as fast as another, until another action changes the speed.
    SpeedMatch {
        /// The other actor. If absent, the ego.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        of: Option<String>,
        /// Share of its speed. If absent, 1.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        factor: Option<f64>,
        /// Added to it, in m/s. If absent, 0.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        delta: Option<f64>,
    },
    /// Keeps a distance from another.
    KeepDistance(KeepDistanceSection),
    /// Drives so that it is at a place when another is at its own.
    ArriveTogether(ArriveTogetherSection),
    /// Moves to another offset from the course by a shape.
    OffsetProfile(ProfileSection),
    /// Continues on another course, from its nearest place.
    Path(CourseSection),
    /// Ends the changes of speed and offset of another trigger of this actor.
    Halt {
        /// The trigger.
        trigger: String,
    },
    /// Appears.
    Spawn {},
    /// Disappears.
    Remove {},
}

/// A distance from another, along the own course or the own heading: exactly one of `gap_m` and
/// `headway_s`. With the largest `acceleration` and `braking`, the actor makes up what is missing;
/// without both, it is put there at once and takes over the other's speed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct KeepDistanceSection {
    /// The other actor. If absent, the ego.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// The distance, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gap_m: Option<f64>,
    /// The distance as the time in which whichever drives behind covers it, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub headway_s: Option<f64>,
    /// Whether the actor drives behind or ahead of the other. If absent, where it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side: Option<SideSection>,
    /// Whether the distance is between boxes. If absent, it is between reference points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub free: Option<bool>,
    /// Whether the distance is along the actor's course. If absent, it is along its heading.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub on_course: Option<bool>,
    /// From the middle of its box forward to its reference point, in metres. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ahead_m: Option<f64>,
    /// From the middle of the other's box forward to its reference point, in metres. If absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub to_ahead_m: Option<f64>,
    /// Whether the action is done once the distance is reached. If absent, it is kept until another
    /// action changes the speed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub once: Option<bool>,
    /// Largest acceleration, in m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration: Option<f64>,
    /// Largest braking, in m/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub braking: Option<f64>,
    /// Largest speed, in m/s. If absent, that of all actors.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fastest: Option<f64>,
}

/// A side of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum SideSection {
    /// Behind it.
    Behind,
    /// Ahead of it.
    Ahead,
}

/// An arrival at a place when another is at its own: `speed`, or `factor` and `delta`, is the speed
/// of the arrival. Without them, the actor changes its speed at a constant rate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ArriveTogetherSection {
    /// The actor's place, in metres in the world: the nearest on its course counts.
    pub at: [f64; 3],
    /// The other actor. If absent, the ego.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// The other's place, in metres in the world.
    pub of_at: [f64; 3],
    /// From the middle of its box forward to its reference point, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ahead_m: Option<f64>,
    /// From the middle of the other's box forward to its reference point, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_ahead_m: Option<f64>,
    /// Speed of the arrival, in m/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Speed of the arrival as a share of the other's. If absent, 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub factor: Option<f64>,
    /// Added to it, in m/s. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delta: Option<f64>,
    /// So far before its place it has that speed, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steady_m: Option<f64>,
    /// It is there within this distance, in metres. If absent, 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub within_m: Option<f64>,
    /// The other is there within this distance, in metres. If absent, 0: when it passes its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of_within_m: Option<f64>,
}

section_on_line! {
    /// A line to follow: exactly one of `along`, `points` and `lanes`.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
    #[serde(deny_unknown_fields, default)]
    pub struct CourseSection {
        /// Place on the line at which the action is done, in metres: for a condition with the
        /// `phase` `done`. If absent, it is done at once.
        #[serde(skip_serializing_if = "Option::is_none")]
        pub done_m: Option<f64>,
        /// Place on the line to which the actor is put, in metres. If absent, it continues from the
        /// nearest place.
        #[serde(skip_serializing_if = "Option::is_none")]
        pub at_m: Option<f64>,
    }
}
