//! LiDARs of requests.
//!
//! AlpaSim names a device and no beams. Their elevations are those of the makers' data sheets; the
//! azimuths of a row's beams, which differ by some degrees from row to row in a real device, are
//! those of its column here.

use std::f64::consts::TAU;
use std::sync::Arc;

use wildcity_options::{LidarBeams, LidarColumns};
use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_scene::geometry::{Lidar, LidarError};

use crate::camera::CameraSpecError;
use crate::scene::{LocalFrame, SceneError};
use crate::wire::sensorsim as wire;

/// The sweep that a request asks for. The axes of the LiDAR's pose are x forward, y left, z up.
///
/// # Errors
/// Names the first field that cannot be used.
pub(crate) fn lidar_view(
    request: &wire::LidarRenderRequest,
    frame: &LocalFrame,
) -> Result<LidarView, CameraSpecError> {
    let Some(spec) = &request.lidar_config else {
        return Err(refused("lidar_config", "is missing".to_owned()));
    };
    let device = wire::LidarDeviceType::try_from(spec.lidar_type).map_err(|_| {
        let must = format!("{}: PANDAR128 and AT128 are offered", spec.lidar_type);
        refused("lidar_config.lidar_type", must)
    })?;
    let start_us = request.frame_start_us;
    let end_us = request.frame_end_us;
    let between_us = end_us.checked_sub(start_us).and_then(|us| i64::try_from(us).ok());
    let Some(duration_us) = between_us else {
        let must = format!("{start_us} is after frame_end_us {end_us}");
        return Err(refused("frame_start_us", must));
    };
    let lidar = device_lidar(device, duration_us)
        .map_err(|cause| refused("frame_end_us", cause.to_string()))?;
    let pair = request.sensor_pose.ok_or(SceneError::Missing { field: "sensor_pose" })?;
    Ok(LidarView {
        lidar: Arc::new(lidar),
        world_from_lidar: frame.world_from("sensor_pose.end_pose", pair.end_pose.as_ref())?,
        world_from_lidar_first: frame
            .world_from("sensor_pose.start_pose", pair.start_pose.as_ref())?,
    })
}

fn refused(field: &'static str, must: String) -> CameraSpecError {
    CameraSpecError::Field { field, must }
}

/// The beams of a device that takes `duration_us` for a sweep.
fn device_lidar(device: wire::LidarDeviceType, duration_us: i64) -> Result<Lidar, LidarError> {
    let (elevations_deg, columns): (Vec<f64>, _) = match device {
        wire::LidarDeviceType::Pandar128 => {
            // 26 rows from 14.5° to 2°, 64 to -6°, and 38 to -25°.
            let rows = |from: f64, step: f64, count: u32| {
                (0..count).map(move |row| from - step * f64::from(row))
            };
            let all = rows(14.5, 0.5, 26).chain(rows(1.875, 0.125, 64)).chain(rows(-6.5, 0.5, 38));
            let last_rad = 0.5 * TAU / 1_800.0 - 0.5 * TAU;
            (all.collect(), LidarColumns { count: 3_600, first_rad: 0.5 * TAU, last_rad })
        }
        wire::LidarDeviceType::At128 => {
            // 0.2° from row to row, and 0.1° from column to column over 120°.
            let all = (0..128).map(|row| 12.93 - 0.2 * f64::from(row));
            let half_rad = 60_f64.to_radians();
            (all.collect(), LidarColumns { count: 1_200, first_rad: half_rad, last_rad: -half_rad })
        }
    };
    Lidar::from_options(&LidarBeams {
        row_elevations_rad: elevations_deg.into_iter().map(f64::to_radians).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(columns),
        // A request may have one time: then the columns are fired at once, within a microsecond.
        duration_us: duration_us.max(1),
        min_range_m: None,
        max_range_m: None,
    })
}

/// The answer: points in the axes of the LiDAR at the end of the sweep.
pub(crate) fn answer(view: &LidarView, sweep: &Sweep) -> wire::LidarRenderReturn {
    let columns = view.lidar.columns();
    let last = view.world_from_lidar;
    let last_from_world = last.rotation.inverse();
    // Once for each column, and not for each beam.
    let poses: Vec<_> = (0..columns).map(|column| view.world_from_lidar_at(column)).collect();
    let mut point_xyzs = Vec::new();
    let mut point_intensities = Vec::new();
    for (at, &range_m) in sweep.range_m.iter().enumerate().filter(|(_, range_m)| **range_m > 0.0) {
        let column = at % columns;
        let pose = &poses[column];
        let from_lidar_m =
            pose.rotation * (f64::from(range_m) * view.lidar.direction(at / columns, column));
        // The difference of positions first: both may be far from the origin.
        let from_last_m = from_lidar_m + (pose.position_m - last.position_m);
        point_xyzs.extend((last_from_world * from_last_m).as_vec3().to_array());
        point_intensities.push(sweep.intensity[at].clamp(0.0, 1.0));
    }
    let bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
    wire::LidarRenderReturn {
        // Clients read either the lists or the buffers.
        point_xyzs_buffer: bytes(&point_xyzs),
        point_intensities_buffer: bytes(&point_intensities),
        num_points: point_intensities.len() as u32,
        point_xyzs,
        point_intensities,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_have_the_rows_of_their_data_sheets() {
        for (device, first_deg, last_deg) in [
            (wire::LidarDeviceType::Pandar128, 14.5, -25.0),
            (wire::LidarDeviceType::At128, 12.93, -12.47),
        ] {
            let lidar = device_lidar(device, 100_000).unwrap();
            assert_eq!(lidar.rows(), 128);
            let elevations = lidar.row_elevations_rad();
            assert!((elevations[0].to_degrees() - first_deg).abs() < 1e-9);
            assert!((elevations[127].to_degrees() - last_deg).abs() < 1e-9);
        }
        let refused = device_lidar(wire::LidarDeviceType::At128, 2_000_000).unwrap_err();
        assert_eq!(refused.field(), "duration_us");
    }
}
