//! The LiDAR, the inertial unit and the satellite fixes of a generated log.

use std::f64::consts::TAU;

use glam::DVec3;

use wildcity_log::{GpsRow, ImuRow, SweepPoints};
use wildcity_render::lidar::Sweep;
use wildcity_scene::geo::{GeoAnchor, GeoError};
use wildcity_scene::geometry::{Lidar, LidarError, Pose};
use wildcity_scene::route::Route;
use wildcity_session::options::{LidarBeams, LidarColumns};

/// Name of the LiDAR.
pub(super) const LIDAR: &str = "top";

/// Elevations of the highest and the lowest row: 6° above and 25° below the horizon.
const ELEVATIONS_RAD: [f64; 2] = [0.10, -0.44];

/// Rows and columns of a turn.
const BEAMS: [u32; 2] = [32, 1_800];

/// Time between the three poses of which accelerations are computed, in microseconds.
const DIFFERENCE_US: i64 = 50_000;

const GRAVITY_M_PER_S2: f64 = 9.81;

/// The LiDAR, which turns once in `duration_us`.
pub(super) fn lidar(duration_us: i64) -> Result<Lidar, LidarError> {
    let [rows, columns] = BEAMS.map(f64::from);
    let [above, below] = ELEVATIONS_RAD;
    let row = |row: u32| above + (below - above) * f64::from(row) / (rows - 1.0);
    let half = 0.5 * TAU;
    Lidar::from_options(&LidarBeams {
        row_elevations_rad: (0..BEAMS[0]).map(row).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(LidarColumns {
            count: BEAMS[1].into(),
            first_rad: half,
            // The LiDAR turns clockwise, from pi to one column before -pi: the next turn begins
            // there.
            last_rad: TAU / columns - half,
        }),
        duration_us,
        min_range_m: None,
        max_range_m: Some(80.0),
    })
}

/// The points of a sweep that begins at a time, in the order in which they were measured.
pub(super) fn points(lidar: &Lidar, sweep: &Sweep, begin_us: i64) -> SweepPoints {
    let mut points = SweepPoints::default();
    for column in 0..lidar.columns() {
        // Ages count back from the end of the sweep, times of a log forward from its beginning.
        let until_end_us = lidar.duration_us() as f64 - lidar.age_us(column);
        for row in 0..lidar.rows() {
            let at = row * lidar.columns() + column;
            let range_m = f64::from(sweep.range_m[at]);
            if range_m > 0.0 {
                let point_m = range_m * lidar.direction(row, column);
                points.points_m.push(point_m.as_vec3().to_array());
                points.time_us.push(begin_us + until_end_us.round() as i64);
                points.intensity.get_or_insert_default().push(sweep.intensity[at]);
                points.ring.get_or_insert_default().push(row as u16);
            }
        }
    }
    points
}

/// What an inertial unit measures, from differences of the drive's poses; `None` at its ends.
pub(super) fn imu(route: &Route<'_>, time_us: i64) -> Option<ImuRow> {
    let at = |offset_us: i64| route.pose_at(time_us + offset_us).ok();
    let poses = [at(-DIFFERENCE_US)?, at(0)?, at(DIFFERENCE_US)?];
    let step_s = DIFFERENCE_US as f64 / 1e6;
    let [before, here, after] = poses;
    // Central differences: both are of the same instant, that of `here`.
    let turned = before.rotation.inverse() * after.rotation;
    let second = before.position_m + after.position_m - 2.0 * here.position_m;
    // An accelerometer measures specific force: at rest it shows gravity, upwards.
    let world = second / (step_s * step_s) + GRAVITY_M_PER_S2 * DVec3::Z;
    Some(ImuRow {
        time_us,
        angular_velocity_rad_per_s: (turned.to_scaled_axis() / (2.0 * step_s)).to_array(),
        // From the world into the axes of the rig.
        acceleration_m_per_s2: (here.rotation.inverse() * world).to_array(),
    })
}

/// A satellite fix at the rig's origin.
pub(super) fn gps(geo: &GeoAnchor, pose: &Pose, time_us: i64) -> Result<GpsRow, GeoError> {
    let point = geo.locate(pose)?.point;
    Ok(GpsRow {
        time_us,
        latitude_deg: point.latitude_deg,
        longitude_deg: point.longitude_deg,
        altitude_m: point.altitude_m,
    })
}
