//! Sensor settings of a session.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::limits::SENSOR_DROPS;

/// Effects of the sensors, and the delay of the planner.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sensors {
    /// Effects on images, by the camera's name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub cameras: BTreeMap<String, CameraSensor>,
    /// The inertial measurement unit, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub imu: Option<Imu>,
    /// The measured speed of the wheels, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wheel_speed: Option<WheelSpeed>,
    /// Time after which a decision takes effect, in microseconds.
    #[serde(skip_serializing_if = "is_zero")]
    pub delay_us: i64,
}

/// Effects on the images of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraSensor {
    /// Probability that a frame is lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drop: Option<f64>,
    /// Frames that arrive late.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub late: Option<LateFrames>,
    /// Intervals in which the picture stands still.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub freeze: Option<FrozenFrames>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<ImageNoise>,
    /// Drift of the exposure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureDrift>,
    /// Dirt on the lens.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dirt: Option<LensDirt>,
}

/// Frames that arrive late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LateFrames {
    /// Probability that a frame is late.
    pub chance: f64,
    /// How late, in microseconds.
    pub by_us: i64,
}

/// Intervals in which the picture stands still.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrozenFrames {
    /// Probability that an interval is frozen.
    pub chance: f64,
    /// Length of the intervals, in microseconds.
    pub for_us: i64,
}

/// Shot and read noise.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageNoise {
    /// Electrons of a pixel at full white.
    pub full_well: f64,
    /// Standard deviation of the read noise, in electrons.
    pub read: f64,
}

/// Drift of the exposure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureDrift {
    /// Standard deviation, in stops.
    pub stops: f64,
    /// Time between two sampled values, in microseconds.
    pub period_us: i64,
}

/// Dirt on the lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LensDirt {
    pub spots: u64,
    /// Mean radius, as a fraction of the image's width.
    pub radius: f64,
    /// Fraction of the light that the middle of a spot takes.
    pub opacity: f64,
}

/// An inertial measurement unit at the rig's origin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Imu {
    /// Errors of each axis of the specific force, in m/s².
    pub accelerometer: AxisNoise,
    /// Errors of each axis of the angular velocity, in rad/s.
    pub gyroscope: AxisNoise,
    /// Time between two sampled biases, in microseconds.
    pub bias_period_us: i64,
}

/// Errors of an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AxisNoise {
    /// Standard deviation of a sample.
    pub noise: f64,
    /// Standard deviation of the bias.
    pub bias: f64,
}

/// Errors of the speed of the wheels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WheelSpeed {
    /// Standard deviation of a sample, in m/s.
    pub noise: f64,
    /// Standard deviation of the error of scale.
    pub scale: f64,
}

fn is_zero(value: &i64) -> bool {
    *value == 0
}

impl Sensors {
    /// Whether samples of the motion are delivered.
    pub(crate) fn measures_motion(&self) -> bool {
        self.imu.is_some() || self.wheel_speed.is_some()
    }

    /// Removes cameras that have no effect; `None` if nothing is left.
    pub(crate) fn used(mut self) -> Option<Self> {
        // A camera without effects is the same as one that is not named, also in the record.
        self.cameras.retain(|_, camera| *camera != CameraSensor::default());
        (self != Self::default()).then_some(self)
    }
}

impl CameraSensor {
    /// Whether it changes pixels.
    pub(crate) fn changes_pixels(&self) -> bool {
        self.noise.is_some() || self.exposure.is_some() || self.dirt.is_some()
    }

    /// Whether it changes which frame is delivered, or which picture the frame shows.
    pub(crate) fn changes_times(&self) -> bool {
        self.drop.is_some() || self.late.is_some() || self.freeze.is_some()
    }

    /// How long before a frame is due the picture may have been taken that is shown instead, in
    /// microseconds.
    pub(crate) fn reach_us(&self, period_us: i64) -> i64 {
        // A frame that replaces another one may itself be of a frozen picture: the ages add up.
        let frozen_us = self.freeze.map_or(0, |freeze| freeze.for_us);
        self.arrival_us(period_us) + frozen_us
    }

    /// Largest age, at the time when a frame is due, of the frame that may be delivered in its
    /// place, in microseconds.
    pub(crate) fn arrival_us(&self, period_us: i64) -> i64 {
        // Of that many lost frames in a row, the oldest is delivered all the same.
        let dropped_us = self.drop.map_or(0, |_| SENSOR_DROPS * period_us);
        self.late.map_or(0, |late| late.by_us) + dropped_us
    }
}
