//! Effects of sensors.

use wildcity_protocol::message;
use wildcity_protocol::observation::{ImageSensor, SensorReason, SensorStatus};
use wildcity_session::limits;
use wildcity_session::{
    AxisNoise, CameraSensor, ExposureDrift, FrozenFrames, ImageNoise, Imu, LateFrames, LensDirt,
    Sensors, WheelSpeed,
};

/// Converts the sensor settings of a request.
pub(super) fn convert_sensors(sensors: message::Sensors) -> Sensors {
    let message::Sensors { cameras, imu, wheel_speed, delay_us } = sensors;
    let axis = |axis: Option<message::AxisNoise>| {
        let message::AxisNoise { noise, bias } = axis.unwrap_or_default();
        AxisNoise { noise, bias }
    };
    let unit = |message::Imu { accelerometer, gyroscope, bias_period_us }: message::Imu| Imu {
        accelerometer: axis(accelerometer),
        gyroscope: axis(gyroscope),
        bias_period_us: bias_period_us.unwrap_or(limits::BIAS_PERIOD_US),
    };
    let wheels =
        |message::WheelSpeed { noise, scale }: message::WheelSpeed| WheelSpeed { noise, scale };
    Sensors {
        cameras: cameras
            .into_iter()
            .map(|(name, camera)| (name, convert_camera_sensor(camera)))
            .collect(),
        imu: imu.map(unit),
        wheel_speed: wheel_speed.map(wheels),
        delay_us: delay_us.unwrap_or(0),
    }
}

fn convert_camera_sensor(camera: message::CameraSensor) -> CameraSensor {
    let message::CameraSensor { drop, late, freeze, noise, exposure, dirt } = camera;
    CameraSensor {
        drop,
        late: late.map(|message::LateFrames { chance, by_us }| LateFrames { chance, by_us }),
        freeze: freeze
            .map(|message::FrozenFrames { chance, for_us }| FrozenFrames { chance, for_us }),
        noise: noise.map(|message::ImageNoise { full_well, read }| ImageNoise { full_well, read }),
        exposure: exposure
            .map(|message::ExposureDrift { stops, period_us }| ExposureDrift { stops, period_us }),
        dirt: dirt.map(|message::LensDirt { spots, radius, opacity }| LensDirt {
            spots,
            radius,
            opacity,
        }),
    }
}

/// Converts the sensor settings for an answer, with all values that apply.
pub(super) fn sensors_to(sensors: &Sensors) -> message::Sensors {
    let Sensors { cameras, imu, wheel_speed, delay_us } = sensors;
    let axis = |AxisNoise { noise, bias }| Some(message::AxisNoise { noise, bias });
    let unit = |&Imu { accelerometer, gyroscope, bias_period_us }: &Imu| message::Imu {
        accelerometer: axis(accelerometer),
        gyroscope: axis(gyroscope),
        bias_period_us: Some(bias_period_us),
    };
    let wheels = |&WheelSpeed { noise, scale }: &WheelSpeed| message::WheelSpeed { noise, scale };
    message::Sensors {
        cameras: cameras.iter().map(|(name, camera)| (name.clone(), camera_to(*camera))).collect(),
        imu: imu.as_ref().map(unit),
        wheel_speed: wheel_speed.as_ref().map(wheels),
        // Left out as in a request without a delay, so that the answer can be sent back.
        delay_us: (*delay_us != 0).then_some(*delay_us),
    }
}

fn camera_to(camera: CameraSensor) -> message::CameraSensor {
    let CameraSensor { drop, late, freeze, noise, exposure, dirt } = camera;
    message::CameraSensor {
        drop,
        late: late.map(|LateFrames { chance, by_us }| message::LateFrames { chance, by_us }),
        freeze: freeze
            .map(|FrozenFrames { chance, for_us }| message::FrozenFrames { chance, for_us }),
        noise: noise.map(|ImageNoise { full_well, read }| message::ImageNoise { full_well, read }),
        exposure: exposure
            .map(|ExposureDrift { stops, period_us }| message::ExposureDrift { stops, period_us }),
        dirt: dirt.map(|LensDirt { spots, radius, opacity }| message::LensDirt {
            spots,
            radius,
            opacity,
        }),
    }
}

/// Converts the effects of a camera on an image.
pub(super) fn image_sensor(sensor: wildcity_session::ImageSensor) -> ImageSensor {
    let wildcity_session::ImageSensor { due_us, taken_us, reasons, stops, clean_hash } = sensor;
    let reason = |reason| match reason {
        wildcity_session::SensorReason::Dropped => SensorReason::Dropped,
        wildcity_session::SensorReason::Late => SensorReason::Late,
        wildcity_session::SensorReason::Frozen => SensorReason::Frozen,
        wildcity_session::SensorReason::Noise => SensorReason::Noise,
        wildcity_session::SensorReason::Exposure => SensorReason::Exposure,
        wildcity_session::SensorReason::Dirt => SensorReason::Dirt,
    };
    // The session has a place for each reason, of which most are empty.
    let reasons: Vec<SensorReason> = reasons.into_iter().flatten().map(reason).collect();
    ImageSensor {
        status: if reasons.is_empty() { SensorStatus::Ok } else { SensorStatus::Degraded },
        reasons,
        due_us,
        taken_us,
        stops,
        clean_hash: clean_hash.map(|hash| hash.to_hex().to_string()),
    }
}
