//! Effects of sensors: lost, late and frozen frames, noise, drifting exposure, dirt on the lens, an
//! inertial measurement unit, the wheel speed, and the planner latency.
//!
//! Every effect is a function of the episode's seed, the sensor's name and a time. There is no
//! running state, so a branch, a restored snapshot and a replay sample the same values, whatever
//! other sessions do. Biases and the exposure drift without state: they are
//! [interpolated](draw::drift) between samples for the multiples of a period. The only state of an
//! episode, [`EpisodeSensors`], has the decisions that have not taken effect, and the motion since
//! the last observation.
//!
//! | module | what it computes |
//! |---|---|
//! | `settings`, `check` | the settings of a session, and their limits |
//! | `draw` | Gaussian samples, and values that drift |
//! | `delivery` | the frame that a camera delivers, and the picture that it shows |
//! | `pixels` | noise, exposure and dirt |
//! | `motion` | specific force, angular velocity, and wheel speed |
//! | `decisions` | the decision that is in effect |

pub(crate) mod check;
pub(crate) mod decisions;
pub(crate) mod delivery;
pub(crate) mod draw;
pub(crate) mod motion;
pub(crate) mod pixels;
pub(crate) mod settings;

use serde::{Deserialize, Serialize};
use wildcity_options::Sensors;

use self::decisions::Decisions;
use self::motion::MotionSample;
use crate::limits::SENSOR_REACH_US;

/// State of an episode's sensors.
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
            decisions: Decisions::new(sensors.delay_us.unwrap_or(0)),
            motion: settings::measures_motion(sensors).then(Vec::new),
        }
    }

    /// Whether the values are in the range that is allowed. They may have been read from a file.
    pub(crate) fn is_in_range(&self) -> bool {
        (0..=SENSOR_REACH_US).contains(&self.reach_us) && self.decisions.is_in_range()
    }
}

/// Effects of a camera on an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageSensor {
    /// When the frame was due, in microseconds since the episode's start.
    pub due_us: i64,
    /// When the picture was taken.
    pub taken_us: i64,
    /// The effects, in the order of [`SensorReason`].
    pub reasons: [Option<SensorReason>; 5],
    /// Offset of the exposure, in stops; only with a drift.
    pub stops: Option<f64>,
    /// BLAKE3 of the pixels before noise, exposure and dirt; only if the camera has one of them.
    pub clean_hash: Option<blake3::Hash>,
}

/// An effect of a camera on an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SensorReason {
    /// The frame was lost, and an earlier one replaces it.
    Dropped,
    /// The frame has not arrived, and an earlier one replaces it.
    Late,
    /// The picture stands still.
    Frozen,
    Noise,
    Exposure,
    /// The lens is dirty.
    Dirt,
}
