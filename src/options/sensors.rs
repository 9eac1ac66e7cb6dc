//! Sensor effects, which a session asks for. All are sampled with the episode's seed. Answers
//! repeat these types, and a newer server may add fields to them; in requests, unknown fields are
//! refused by `decode`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Effects of the sensors, and the delay of the planner. What is absent is off.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Sensors {
    /// Effects on images, by camera name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub cameras: BTreeMap<String, CameraSensor>,
    /// Effects on sweeps, by LiDAR name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub lidars: BTreeMap<String, LidarSensor>,
    /// Adds the tensor `sensor.imu`: specific force and angular velocity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub imu: Option<Imu>,
    /// Adds the tensor `sensor.wheel_speed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wheel_speed: Option<WheelSpeed>,
    /// Time after which a decision takes effect, in microseconds: a whole number of steps. If
    /// absent, 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 10_000_000)))]
    pub delay_us: Option<i64>,
}

/// Effects on the images of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct CameraSensor {
    /// Probability that a frame is lost. The camera's last frame that arrived stands in for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 0.9)))]
    pub drop: Option<f64>,
    /// Frames that arrive late.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub late: Option<LateFrames>,
    /// Times in which the picture stands still.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub freeze: Option<FrozenFrames>,
    /// Noise of the image sensor.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<ImageNoise>,
    /// Drift of the exposure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureDrift>,
    /// Dirt on the lens.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dirt: Option<LensDirt>,
}

/// Effects on the sweeps of a LiDAR.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct LidarSensor {
    /// Standard deviation of the ranges, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 10.0)))]
    pub noise_m: Option<f64>,
    /// Probability that a beam has no return.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub drop: Option<f64>,
}

/// Frames that arrive late.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct LateFrames {
    /// Probability that a frame is late.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub chance: f64,
    /// How late, in microseconds: a whole number of the camera's frames.
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 10_000_000)))]
    pub by_us: i64,
}

/// Times in which a camera repeats a frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct FrozenFrames {
    /// Probability that the camera is frozen in an interval of `for_us`.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub chance: f64,
    /// Length of the intervals, in microseconds: a whole number of the camera's frames.
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 10_000_000)))]
    pub for_us: i64,
}

/// Shot and read noise of an image sensor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ImageNoise {
    /// Electrons of a pixel at full white: fewer are noisier.
    #[cfg_attr(feature = "schema", schemars(range(min = 10.0, max = 1e6)))]
    pub full_well: f64,
    /// Standard deviation of the read noise, in electrons.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1000.0)))]
    pub read: f64,
}

/// Drift of a camera's exposure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct ExposureDrift {
    /// Standard deviation, in stops: one stop doubles the light.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 4.0)))]
    pub stops: f64,
    /// Time between two values that are drawn, in microseconds.
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 3_600_000_000_i64)))]
    pub period_us: i64,
}

/// Dirt on a lens: round, dark spots with soft edges.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct LensDirt {
    /// Number of spots.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 256)))]
    pub spots: u64,
    /// Mean radius of a spot, as a fraction of the image's width.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 0.5)))]
    pub radius: f64,
    /// Fraction of the light that the middle of a spot takes.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub opacity: f64,
}

/// An inertial measurement unit at the rig's origin, along the rig's axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub struct Imu {
    /// Errors of each axis of the specific force, in m/s². If absent, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accelerometer: Option<AxisNoise>,
    /// Errors of each axis of the angular velocity, in rad/s. If absent, none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gyroscope: Option<AxisNoise>,
    /// Time between two biases that are drawn, in microseconds. If absent, 60 s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schemars(range(min = 1_000, max = 3_600_000_000_i64)))]
    pub bias_period_us: Option<i64>,
}

/// Errors of an axis of an inertial measurement unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct AxisNoise {
    /// Standard deviation of one sample.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 100.0)))]
    pub noise: f64,
    /// Standard deviation of the bias, which drifts.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 100.0)))]
    pub bias: f64,
}

/// Errors of the speed that the wheels measure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct WheelSpeed {
    /// Standard deviation of one sample, in m/s.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 100.0)))]
    pub noise: f64,
    /// Standard deviation of the error of scale, which an episode keeps: 0.01 is one hundredth.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 0.5)))]
    pub scale: f64,
}
