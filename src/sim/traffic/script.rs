//! Triggers: what an actor does when a condition holds, each once.

use super::distance::KeepDistance;
use super::together::ArriveTogether;

/// A condition and the actions that follow when it first holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Trigger {
    /// Every part that is given must hold.
    pub when: Condition,
    /// The actions, in this order.
    pub then: Vec<Action>,
}

/// Parts of a condition; one without parts holds at once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Condition {
    /// At this time or later, in microseconds since the episode's start.
    pub time_us: Option<i64>,
    /// The origins of the two boxes are at most this far apart.
    pub near: Option<Near>,
    /// The actor has reached this station of its course, in metres.
    pub station_m: Option<f64>,
    /// The ego's box has reached this station of the actor's course, in metres.
    pub ego_station_m: Option<f64>,
    /// The actor is at least this fast, in m/s.
    pub speed_above_mps: Option<f64>,
    /// The actor is at most this fast, in m/s.
    pub speed_below_mps: Option<f64>,
    /// The ego is at least this fast, in m/s.
    pub ego_speed_above_mps: Option<f64>,
    /// Another trigger fired at least [`After::delay_us`] ago. The parts below are evaluated only
    /// from then on.
    pub after: Option<After>,
    /// A measured value is within bounds.
    pub measure: Option<Measure>,
    /// All of these hold.
    pub all: Vec<Condition>,
    /// One of these holds, if there are any.
    pub any: Vec<Condition>,
    /// The parts have held for this time without a break, in microseconds.
    pub held_us: i64,
    /// The condition holds only at the instant at which the parts begin to hold, or cease to hold.
    pub edge: Option<Edge>,
    /// The condition holds this much later than its parts and its edge, in microseconds.
    pub later_us: i64,
}

/// An instant at which the value of a condition changes. The first evaluation is no change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Edge {
    /// From false to true.
    Rising,
    /// From true to false.
    Falling,
    Both,
}

/// A distance to something.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Near {
    /// Index of the actor; `None` for the ego.
    pub actor: Option<usize>,
    /// The distance, in metres.
    pub within_m: f64,
}

/// A trigger that has fired already.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct After {
    /// Index of its actor.
    pub actor: usize,
    /// Index within the actor's script.
    pub trigger: usize,
    pub phase: Phase,
    /// Time since then, in microseconds.
    pub delay_us: i64,
}

/// What has happened to a trigger.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    #[default]
    Fired,
    /// Its actions have reached their aims.
    Done,
    /// Its actions have reached their aims, or others have replaced them.
    Ended,
}

/// An action of an actor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    Speed {
        /// To this speed, in m/s; for an IDM actor the new speed of a free road, or standstill.
        to_mps: f64,
        /// By at most this much per second, in m/s².
        rate_mps2: f64,
    },
    /// Changes its speed by a profile, whatever the acceleration.
    SpeedProfile {
        /// To this speed, in m/s.
        to_mps: f64,
        /// Within this time or distance, or at this rate.
        over: Over,
        /// The course of the speed over time.
        shape: Shape,
    },
    /// Drives as fast as another body, until another action changes the speed.
    SpeedMatch {
        /// Index of the actor; `None` for the ego.
        of: Option<usize>,
        /// Share of its speed.
        factor: f64,
        /// Added to it, in m/s.
        delta_mps: f64,
    },
    /// Keeps a distance from another body.
    KeepDistance(KeepDistance),
    /// Drives so that it is at a place when another body is at its own.
    ArriveTogether(ArriveTogether),
    /// Changes its offset from the course.
    Offset {
        /// To this offset, in metres to the left.
        to_m: f64,
        /// Within this time at its present speed, in seconds.
        over_s: f64,
    },
    /// Changes its offset from the course by a profile.
    OffsetProfile {
        /// To this offset, in metres to the left.
        to_m: f64,
        /// Within this time or distance, or at this rate.
        over: Over,
        /// The course of the offset.
        shape: Shape,
    },
    /// Continues on another course, at the place nearest to where it is.
    Course {
        /// Index of the course among those of the actor.
        course: usize,
        /// Station of the course at which the action is done, in metres; at once without it.
        done_m: Option<f64>,
        /// Station to which the actor is put, in metres; without it, it stays where it is.
        at_m: Option<f64>,
    },
    /// Ends the changes of speed and offset of a trigger of this actor: both keep their present
    /// values.
    Halt {
        /// Index within the actor's script.
        trigger: usize,
    },
    Spawn,
    Remove,
}

/// The extent of a change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Over {
    /// Within this time, in seconds.
    Time(f64),
    /// Within this distance along the course, in metres.
    Distance(f64),
    /// With this largest rate: m/s² for a speed, m/s for an offset.
    Rate(f64),
    /// With this largest second derivative: m/s² for an offset.
    Acceleration(f64),
}

/// The course of a value from its start to its aim, over an extent of 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    Step,
    /// At a constant rate.
    Linear,
    /// A half wave: `(1 - cos πx) / 2`.
    Sinusoidal,
    /// `3x² - 2x³`: its slope is 0 at both ends.
    Cubic,
}

impl Shape {
    /// The share of the change at a share of the extent.
    pub(super) fn at(self, x: f64) -> f64 {
        let x = x.clamp(0.0, 1.0);
        match self {
            Self::Step => 1.0,
            Self::Linear => x,
            Self::Sinusoidal => 0.5 - 0.5 * (std::f64::consts::PI * x).cos(),
            Self::Cubic => x * x * (3.0 - 2.0 * x),
        }
    }

    /// The derivative of [`Self::at`].
    pub(super) fn slope(self, x: f64) -> f64 {
        use std::f64::consts::PI;
        match self {
            // Before its begin and after its end a change stands still.
            _ if !(0.0..=1.0).contains(&x) => 0.0,
            Self::Step => 0.0,
            Self::Linear => 1.0,
            Self::Sinusoidal => 0.5 * PI * (PI * x).sin(),
            Self::Cubic => 6.0 * x * (1.0 - x),
        }
    }

    /// The extent of a change: in metres for [`Over::Distance`], otherwise in seconds.
    pub(super) fn extent(self, change: f64, over: Over) -> f64 {
        use std::f64::consts::PI;
        let change = change.abs();
        match (over, self) {
            (_, Self::Step) => 0.0,
            (Over::Time(extent) | Over::Distance(extent), _) => extent,
            (Over::Rate(rate), Self::Linear) => change / rate,
            // The extent follows from the largest slope of the shape, π/2 in the middle; 3/2 for
            // the cubic.
            (Over::Rate(rate), Self::Sinusoidal) => 0.5 * PI * change / rate,
            (Over::Rate(rate), Self::Cubic) => 1.5 * change / rate,
            // A linear change has no bounded acceleration: as long as a cubic one.
            (Over::Acceleration(most), Self::Linear | Self::Cubic) => (6.0 * change / most).sqrt(),
            // The largest second derivative of the half wave is π²/2, at both ends; that of the
            // cubic is 6.
            (Over::Acceleration(most), Self::Sinusoidal) => PI * (change / (2.0 * most)).sqrt(),
        }
    }
}

/// A value of the traffic, with its bounds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measure {
    pub quantity: Quantity,
    pub of: Body,
    pub above: Option<f64>,
    pub below: Option<f64>,
}

/// A number of a body, in its place or relative to another body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Quantity {
    /// The speed, in m/s.
    Speed,
    /// The distance driven since the episode's start, in metres.
    Travelled,
    /// The distance from a point in the world, in metres.
    Point(glam::DVec3),
    /// The distance from another body, in metres.
    Distance(Other),
    /// The distance along the heading, in metres, without a sign.
    Longitudinal(Other),
    /// The distance across the heading, in metres, without a sign.
    Lateral(Other),
    /// The distance along the heading by the speed, in seconds.
    Headway(Other),
    /// The distance by the rate at which it becomes less, in seconds; endless if it does not.
    TimeToCollision(Other),
}

/// The other body of a distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Other {
    pub to: Body,
    /// Whether the distance is between the boxes; otherwise it is between the reference points.
    pub is_free: bool,
    /// Whether the distance along is that of the own course; otherwise it is along the heading of
    /// the first body.
    pub is_on_course: bool,
    /// Whether a headway is by the straight distance.
    pub is_straight: bool,
}

/// An actor or the ego, with its reference point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Index of the actor; `None` for the ego.
    pub actor: Option<usize>,
    /// From the middle of the box forward to the reference point, in metres.
    pub ahead_m: f64,
}
