//! The LiDAR, the inertial unit and the satellite fixes of a generated log.

use std::f64::consts::TAU;

use glam::{DQuat, DVec2, DVec3};

use wildcity_log::{GpsRow, ImuRow, SweepPoints};
use wildcity_scene::geo::{GeoAnchor, GeoError};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::route::Route;

/// Name of the LiDAR.
pub(super) const LIDAR: &str = "top";

/// Steps of a turn: a LiDAR that flashes an eighth of its surroundings at once.
pub(super) const SECTORS: u32 = 8;

/// Columns and rows of a step.
const SECTOR_PX: [u32; 2] = [60, 32];

/// Slopes of the highest and the lowest row: 6° above and 25° below the horizon.
const SLOPES: [f64; 2] = [0.10, -0.47];

/// Farthest point, in metres.
const REACH_M: f32 = 80.0;

/// Least opacity of a pixel that returns light.
const OPAQUE: f32 = 0.95;

/// Time between the three poses of which accelerations are computed, in microseconds.
const DIFFERENCE_US: i64 = 50_000;

const GRAVITY_M_PER_S2: f64 = 9.81;

/// The camera that renders a step, and its pose in the LiDAR's axes.
pub(super) fn sector(step: u32) -> (Camera, Pose) {
    let [width, height] = SECTOR_PX.map(f64::from);
    let fx = 0.5 * width / (0.5 * TAU / f64::from(SECTORS)).tan();
    let [above, below] = SLOPES;
    let fy = height / (above - below);
    let pinhole = Pinhole { fx, fy, cx: 0.5 * width, cy: above * fy };
    let camera = Camera::from_pinhole(SECTOR_PX[0], SECTOR_PX[1], pinhole);
    let azimuth = DQuat::from_rotation_z(TAU * (f64::from(step) + 0.5) / f64::from(SECTORS));
    // Camera x (right) is -y of the LiDAR, y (down) is -z, z (ahead) is x.
    let ahead = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
    (camera, Pose { position_m: DVec3::ZERO, rotation: azimuth * ahead })
}

/// Adds the points of a rendered step to a sweep, all at one time. Without depth there is no point.
pub(super) fn add_points(
    sweep: &mut SweepPoints,
    step: u32,
    time_us: i64,
    [depth_m, opacity]: [&[f32]; 2],
    rgb8: &[u8],
) {
    let (camera, lidar_from_camera) = sector(step);
    let width = camera.width_px as usize;
    for (pixel, (depth_m, opacity)) in depth_m.iter().zip(opacity).enumerate() {
        let at_px = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let Some(direction) = camera.unproject(at_px) else { continue };
        if *opacity < OPAQUE || *depth_m <= 0.0 || *depth_m > REACH_M {
            continue;
        }
        // A pinhole's depth is z.
        let point_m = direction / direction.z * f64::from(*depth_m);
        sweep.points_m.push(lidar_from_camera.transform_point(point_m).as_vec3().to_array());
        sweep.time_us.push(time_us);
        let light: u32 = rgb8[3 * pixel..][..3].iter().map(|value| u32::from(*value)).sum();
        sweep.intensity.get_or_insert_default().push(light as f32 / 765.0);
        sweep.ring.get_or_insert_default().push((pixel / width) as u16);
    }
}

/// What an inertial unit measures, from differences of the drive's poses; `None` at its ends.
pub(super) fn imu(route: &Route<'_>, time_us: i64) -> Option<ImuRow> {
    let at = |offset_us: i64| route.pose_at(time_us + offset_us).ok();
    let poses = [at(-DIFFERENCE_US)?, at(0)?, at(DIFFERENCE_US)?];
    let step_s = DIFFERENCE_US as f64 / 1e6;
    let [before, here, after] = poses;
    let turned = before.rotation.inverse() * after.rotation;
    let second = before.position_m + after.position_m - 2.0 * here.position_m;
    let world = second / (step_s * step_s) + GRAVITY_M_PER_S2 * DVec3::Z;
    Some(ImuRow {
        time_us,
        angular_velocity_rad_per_s: (turned.to_scaled_axis() / (2.0 * step_s)).to_array(),
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
