//! Effects of sensors.

use wildcity_protocol::observation::{ImageSensor, SensorReason, SensorStatus};

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
