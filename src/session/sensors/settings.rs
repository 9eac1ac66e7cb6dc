//! What the sensor settings of a session mean.

use wildcity_options::{AxisNoise, CameraSensor, Imu, Sensors};

use crate::limits::{BIAS_PERIOD_US, SENSOR_DROPS};

/// The settings with all values that apply, as answers and records have them; `None` if they have
/// no effect. A camera without effects is the same as one that is not named.
pub(crate) fn used(mut sensors: Sensors) -> Option<Sensors> {
    sensors.cameras.retain(|_, camera| *camera != CameraSensor::default());
    if let Some(imu) = &mut sensors.imu {
        imu.accelerometer.get_or_insert_default();
        imu.gyroscope.get_or_insert_default();
        imu.bias_period_us.get_or_insert(BIAS_PERIOD_US);
    }
    sensors.delay_us = sensors.delay_us.filter(|delay_us| *delay_us != 0);
    (sensors != Sensors::default()).then_some(sensors)
}

/// Whether samples of the motion are delivered.
pub(crate) fn measures_motion(sensors: &Sensors) -> bool {
    sensors.imu.is_some() || sensors.wheel_speed.is_some()
}

/// Errors of the axes of specific force and angular velocity.
pub(crate) fn axes(imu: &Imu) -> [AxisNoise; 2] {
    [imu.accelerometer, imu.gyroscope].map(Option::unwrap_or_default)
}

/// Time between two sampled biases, in microseconds.
pub(crate) fn bias_period_us(imu: &Imu) -> i64 {
    imu.bias_period_us.unwrap_or(BIAS_PERIOD_US)
}

/// Whether a sensor changes pixels.
pub(crate) fn changes_pixels(sensor: &CameraSensor) -> bool {
    sensor.noise.is_some() || sensor.exposure.is_some() || sensor.dirt.is_some()
}

/// Whether a sensor changes which frame is delivered, or which picture the frame shows.
pub(crate) fn changes_times(sensor: &CameraSensor) -> bool {
    sensor.drop.is_some() || sensor.late.is_some() || sensor.freeze.is_some()
}

/// How long before a frame is due the picture may have been taken that is shown instead, in
/// microseconds.
pub(crate) fn reach_us(sensor: &CameraSensor, period_us: i64) -> i64 {
    // A frame that replaces another one may itself be of a frozen picture: the ages add up.
    let frozen_us = sensor.freeze.map_or(0, |freeze| freeze.for_us);
    arrival_us(sensor, period_us) + frozen_us
}

/// Largest age, at the time when a frame is due, of the frame that may be delivered in its place,
/// in microseconds.
pub(crate) fn arrival_us(sensor: &CameraSensor, period_us: i64) -> i64 {
    // Of that many lost frames in a row, the oldest is delivered all the same.
    let dropped_us = sensor.drop.map_or(0, |_| SENSOR_DROPS * period_us);
    sensor.late.map_or(0, |late| late.by_us) + dropped_us
}
