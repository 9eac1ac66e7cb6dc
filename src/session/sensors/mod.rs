//! Effects of sensors: lost, late and frozen frames, noise, drifting exposure, dirt on the lens, an inertial
//! measurement unit, the speed of the wheels, and the delay of the planner.
//!
//! Every effect is a function of the episode's seed, the sensor's name and a time. There is no running state, so a
//! branch, a restored snapshot and a replay draw the same numbers, alone or among other sessions. Biases and the
//! exposure wander all the same: they are [interpolated](draw::drift) between numbers that are drawn for
//! multiples of a period. What an episode does keep is in [`EpisodeSensors`]: decisions that wait, and the motion
//! since the last observation.
//!
//! | module | what it computes |
//! |---|---|
//! | `settings`, `check` | what a session asks for, and its limits |
//! | `draw` | normal and wandering numbers |
//! | `delivery` | which frame a camera delivers, and which picture it shows |
//! | `pixels` | noise, exposure and dirt |
//! | `motion` | specific force, angular velocity, and speed of the wheels |
//! | `decisions` | which decision holds |

mod check;
pub(crate) mod decisions;
pub(crate) mod delivery;
pub(crate) mod draw;
pub(crate) mod motion;
pub(crate) mod pixels;
pub(crate) mod settings;

use serde::{Deserialize, Serialize};

use self::decisions::Decisions;
use self::motion::MotionSample;
use self::settings::Sensors;
use crate::limits::SENSOR_REACH_US;

/// What an episode keeps for its sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EpisodeSensors {
    /// How much farther than the history the track reaches back, in microseconds.
    pub(crate) reach_us: i64,
    /// Decisions that are in effect or wait.
    pub(crate) decisions: Decisions,
    /// The motion since the last observation, a sample for each step; none unless it is measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) motion: Option<Vec<MotionSample>>,
}

impl EpisodeSensors {
    /// At the start of an episode of a session.
    pub(crate) fn at_start(sensors: &Sensors, reach_us: i64) -> Self {
        Self {
            reach_us,
            decisions: Decisions::new(sensors.delay_us),
            motion: sensors.measures_motion().then(Vec::new),
        }
    }

    /// Whether what was read from a file may be.
    pub(crate) fn is_in_range(&self) -> bool {
        (0..=SENSOR_REACH_US).contains(&self.reach_us) && self.decisions.is_in_range()
    }
}

/// What a camera with effects did to an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageSensor {
    /// When the frame was due, in microseconds since the episode's start.
    pub due_us: i64,
    /// When the picture was taken.
    pub taken_us: i64,
    /// What was done, in the order of [`SensorReason`].
    pub reasons: [Option<SensorReason>; 5],
    /// Offset of the exposure, in stops; only with a drift.
    pub stops: Option<f64>,
    /// BLAKE3 of the pixels before noise, exposure and dirt; only if the camera has one of them.
    pub clean_hash: Option<blake3::Hash>,
}

/// What a camera did to an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SensorReason {
    /// The frame was lost: an earlier one stands in for it.
    Dropped,
    /// The frame has not arrived: an earlier one stands in for it.
    Late,
    /// The picture stands still.
    Frozen,
    /// It has noise.
    Noise,
    /// Its exposure drifts.
    Exposure,
    /// The lens is dirty.
    Dirt,
}
