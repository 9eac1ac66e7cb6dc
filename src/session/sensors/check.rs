//! Checks the sensor settings of a session.

use std::ops::RangeInclusive;

use wildcity_scene::rig::{RigCamera, RigLidar};

use wildcity_options::{
    CameraSensor, ExposureDrift, FrozenFrames, ImageNoise, LateFrames, LensDirt, LidarSensor,
    Sensors, WheelSpeed,
};

use super::settings::{axes, bias_period_us, reach_us};
use crate::error::SessionError;
use crate::limits::{self, SENSOR_REACH_US};
use crate::observe::schedule::Schedule;

/// The effects of each camera, by its index.
///
/// # Errors
/// Names the first value that is out of range, or the first camera that the rig does not have.
pub(crate) fn check(
    sensors: &Sensors,
    cameras: &[RigCamera],
    lidars: &[RigLidar],
    schedule: &Schedule,
    dt_us: i64,
) -> Result<Vec<CameraSensor>, SessionError> {
    // A camera without settings has the default, which changes nothing.
    let mut by_index = vec![CameraSensor::default(); cameras.len()];
    for (name, sensor) in &sensors.cameras {
        let field = format!("sensors.cameras.{name}");
        let Some(index) = cameras.iter().position(|camera| camera.name == *name) else {
            let known = cameras.iter().map(|camera| camera.name.clone()).collect();
            return Err(SessionError::UnknownCamera { field, name: name.clone(), known });
        };
        check_camera(sensor, &field, schedule.period_us(index))?;
        by_index[index] = *sensor;
    }
    for (name, LidarSensor { noise_m, drop }) in &sensors.lidars {
        let field = format!("sensors.lidars.{name}");
        if lidars.iter().all(|lidar| lidar.name != *name) {
            let known: Vec<&str> = lidars.iter().map(|lidar| lidar.name.as_str()).collect();
            let must = format!("for no LiDAR of the rig, which has {known:?}");
            return Err(SessionError::CameraOption { field, must });
        }
        number(&format!("{field}.noise_m"), noise_m.unwrap_or(0.0), 0.0..=10.0)?;
        number(&format!("{field}.drop"), drop.unwrap_or(0.0), 0.0..=1.0)?;
    }
    if let Some(imu) = &sensors.imu {
        for (name, axis) in ["accelerometer", "gyroscope"].into_iter().zip(axes(imu)) {
            let field = |end: &str| format!("sensors.imu.{name}.{end}");
            number(&field("noise"), axis.noise, 0.0..=100.0)?;
            number(&field("bias"), axis.bias, 0.0..=100.0)?;
        }
        time("sensors.imu.bias_period_us", bias_period_us(imu), limits::DRIFT_PERIOD_US)?;
    }
    if let Some(WheelSpeed { noise, scale }) = sensors.wheel_speed {
        number("sensors.wheel_speed.noise", noise, 0.0..=100.0)?;
        number("sensors.wheel_speed.scale", scale, 0.0..=0.5)?;
    }
    // The whole delay in steps: decisions take effect at the start of a step.
    whole("sensors.delay_us", sensors.delay_us.unwrap_or(0), dt_us, 0..=limits::BUNDLE_PERIOD_US)?;
    Ok(by_index)
}

fn check_camera(sensor: &CameraSensor, field: &str, period_us: i64) -> Result<(), SessionError> {
    let at = |end: &str| format!("{field}.{end}");
    let accepted_us = 0..=SENSOR_REACH_US;
    if let Some(drop) = sensor.drop {
        number(&at("drop"), drop, 0.0..=0.9)?;
    }
    if let Some(LateFrames { chance, by_us }) = sensor.late {
        number(&at("late.chance"), chance, 0.0..=1.0)?;
        whole(&at("late.by_us"), by_us, period_us, period_us..=SENSOR_REACH_US)?;
    }
    if let Some(FrozenFrames { chance, for_us }) = sensor.freeze {
        number(&at("freeze.chance"), chance, 0.0..=1.0)?;
        whole(&at("freeze.for_us"), for_us, period_us, period_us..=SENSOR_REACH_US)?;
    }
    // Each delay is within its limit, but a picture can be late, frozen and replaced.
    if !accepted_us.contains(&reach_us(sensor, period_us)) {
        let must = format!(
            "such that a picture may be {} µs old; at most {SENSOR_REACH_US} µs are accepted",
            reach_us(sensor, period_us)
        );
        return Err(SessionError::CameraOption { field: field.to_owned(), must });
    }
    if let Some(ImageNoise { full_well, read }) = sensor.noise {
        number(&at("noise.full_well"), full_well, 10.0..=1e6)?;
        number(&at("noise.read"), read, 0.0..=1000.0)?;
    }
    if let Some(ExposureDrift { stops, period_us }) = sensor.exposure {
        number(&at("exposure.stops"), stops, 0.0..=4.0)?;
        time(&at("exposure.period_us"), period_us, limits::DRIFT_PERIOD_US)?;
    }
    if let Some(LensDirt { spots, radius, opacity }) = sensor.dirt {
        if !(1..=limits::DIRT_SPOTS).contains(&spots) {
            let must = format!("{spots}; 1 to {} are accepted", limits::DIRT_SPOTS);
            return Err(SessionError::CameraOption { field: at("dirt.spots"), must });
        }
        number(&at("dirt.radius"), radius, 0.001..=0.5)?;
        number(&at("dirt.opacity"), opacity, 0.0..=1.0)?;
    }
    Ok(())
}

fn number(field: &str, value: f64, accepted: RangeInclusive<f64>) -> Result<(), SessionError> {
    // NaN is in no range.
    if accepted.contains(&value) {
        return Ok(());
    }
    let must = format!("{value}; {} to {} are accepted", accepted.start(), accepted.end());
    Err(SessionError::CameraOption { field: field.to_owned(), must })
}

fn time(field: &str, value_us: i64, accepted_us: RangeInclusive<i64>) -> Result<(), SessionError> {
    whole(field, value_us, 1, accepted_us)
}

/// Checks that a time is within its limits and a multiple of another.
fn whole(
    field: &str,
    value_us: i64,
    of_us: i64,
    accepted_us: RangeInclusive<i64>,
) -> Result<(), SessionError> {
    if accepted_us.contains(&value_us) && value_us % of_us == 0 {
        return Ok(());
    }
    let least_us = accepted_us.start();
    let most_us = accepted_us.end();
    let must = match of_us {
        1 => format!("{value_us} µs; {least_us} to {most_us} µs are accepted"),
        _ => format!(
            "{value_us} µs; multiples of {of_us} µs from {least_us} to {most_us} µs are accepted"
        ),
    };
    Err(SessionError::CameraOption { field: field.to_owned(), must })
}
