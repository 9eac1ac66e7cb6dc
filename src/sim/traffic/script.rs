//! Triggers: what an actor does when a condition holds, each once.

/// A condition and the actions that follow when it first holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Trigger {
    /// Every part that is given must hold.
    pub when: Condition,
    /// The actions, in this order.
    pub then: Vec<Action>,
}

/// Parts of a condition; one without parts holds at once.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
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
    /// Another trigger fired at least [`After::delay_us`] ago.
    pub after: Option<After>,
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
    /// Time since then, in microseconds.
    pub delay_us: i64,
}

/// An action of an actor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    /// Changes its speed.
    Speed {
        /// To this speed, in m/s; for an IDM actor the new speed of a free road, or standstill.
        to_mps: f64,
        /// By at most this much per second, in m/s².
        rate_mps2: f64,
    },
    /// Changes its offset from the course.
    Offset {
        /// To this offset, in metres to the left.
        to_m: f64,
        /// Within this time at its present speed, in seconds.
        over_s: f64,
    },
    /// Continues on another course, at the place nearest to where it is.
    Course {
        /// Index of the course among those of the actor.
        course: usize,
    },
    /// Appears.
    Spawn,
    /// Disappears.
    Remove,
}
