//! The poses at which settings are compared: along the recorded drive and at offsets from it, or
//! around a capture.

use glam::{DQuat, DVec3};

use super::setting::Setting;
use wildcity_render::View;
use wildcity_render::compare::images::{crop_view, view_along};
use wildcity_scene::geometry::{Bounds, CameraError, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Manifest, Trajectory};

/// A pose at which all settings are measured.
#[derive(Clone, Debug)]
pub struct SamplePoint {
    /// For example `60 m, 3 m left`.
    pub name: String,
    /// Lateral distance from the recorded drive in metres, to either side. 0 on the drive, and for
    /// a twin without one.
    pub offset_m: f64,
    /// Whether settings are selected by the results here. The other points verify the selection.
    pub for_selection: bool,
    /// Pose of the rig. None for a twin without a drive.
    pub world_from_rig: Option<Pose>,
    /// The cameras with their whole images, which are timed.
    pub views: Vec<View>,
    /// A window of each camera's image at full focal length. Only the windows are compared.
    pub windows: Vec<View>,
}

/// The number of sample points, and the size of the windows that are compared.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Sampling {
    /// Number of stations along the drive. Each has a sample point per distance of [`OFFSETS_M`]; a
    /// twin without a drive gets as many points around it.
    pub stations: u32,
    /// Width and height of the compared windows, in pixels.
    pub window_px: [u32; 2],
}

/// Lateral distances from the recorded drive, in metres: on it, in the other half of the lane, in
/// the next lane, and in the lane after that.
pub const OFFSETS_M: [f64; 4] = [0.0, 1.0, 3.0, 5.0];

/// Sample points along the twin's first recorded drive with these cameras, or around the twin if it
/// has no drive.
pub fn sample_points(
    manifest: &Manifest,
    cameras: &[RigCamera],
    sampling: Sampling,
) -> Vec<SamplePoint> {
    match manifest.trajectories.first() {
        Some(drive) => along(drive, cameras, sampling),
        None => around(manifest.bounds(), sampling),
    }
}

/// Sample points at evenly spaced stations. Every other station is for selection. Two stations have
/// their offsets to the left, the next two to the right, and so on.
///
/// The rig moves with the mean speed of the whole drive, for cameras with rolling shutters.
fn along(drive: &Trajectory, cameras: &[RigCamera], sampling: Sampling) -> Vec<SamplePoint> {
    let length_m = drive.length_m();
    // Constant over the drive: the poses of an exposure must not depend on where it stopped.
    let speed_m_per_us = mean_speed_m_per_us(drive);
    let mut points = Vec::new();
    for station in 0..sampling.stations {
        // The middle of each of `stations` equal parts of the drive.
        let share = (f64::from(station) + 0.5) / f64::from(sampling.stations);
        let station_m = share * length_m;
        let is_left = (station / 2).is_multiple_of(2);
        // In the rig's axes y points to the left.
        let sign = if is_left { 1.0 } else { -1.0 };
        let side = if is_left { "left" } else { "right" };
        for offset_m in OFFSETS_M {
            let rig_from_offset_rig = Pose {
                position_m: DVec3::new(0.0, sign * offset_m, 0.0),
                rotation: DQuat::IDENTITY,
            };
            // The offset is in the rig's axes, and turns with it in a bend.
            let world_from_rig_before = |age_us: i64| {
                drive.at_station(station_m - speed_m_per_us * age_us as f64) * rig_from_offset_rig
            };
            let world_from_rig = world_from_rig_before(0);
            let name = match offset_m {
                0.0 => format!("{station_m:.0} m"),
                _ => format!("{station_m:.0} m, {offset_m} m {side}"),
            };
            let point = SamplePoint {
                name,
                offset_m,
                for_selection: station.is_multiple_of(2),
                world_from_rig: Some(world_from_rig),
                views: View::from_moving_rig(cameras, world_from_rig, &world_from_rig_before),
                windows: Vec::new(),
            };
            // The number of the point continues the sequence of the windows.
            points.push(point.with_windows(points.len(), sampling.window_px, 1.0));
        }
    }
    points
}

/// Length of a drive over its duration; 0 if it takes no time.
pub(super) fn mean_speed_m_per_us(drive: &Trajectory) -> f64 {
    let ends = drive.keyframes.first().zip(drive.keyframes.last());
    let duration_us = ends.map_or(0, |(first, last)| last.time_us - first.time_us);
    if duration_us > 0 { drive.length_m() / duration_us as f64 } else { 0.0 }
}

/// Number of sample points around a capture for each station: as many as there are offsets from a
/// drive.
const POINTS_PER_STATION: u32 = OFFSETS_M.len() as u32;

/// Share of the sides of these images in which windows lie: around the middle, where the object is.
const WINDOW_SHARE: f64 = 0.5;

/// Images around a capture, in pixels.
const AROUND_SIZE_PX: [u32; 2] = [640, 480];
/// Focal length of these images, in pixels.
const AROUND_FOCAL_PX: f64 = 600.0;
/// Elevation of these cameras, seen from the middle of the object.
const AROUND_ELEVATION_DEG: f64 = 20.0;

/// Cameras on a circle around the middle of a captured object. Each sees all of it. z is up.
fn around(bounds: Bounds, sampling: Sampling) -> Vec<SamplePoint> {
    let middle_m = 0.5 * (bounds.min_m + bounds.max_m);
    // 640 x 480 px at a focal length of 600 px show ±0.53 m across and ±0.4 m down at a distance of
    // 1 m. So the longest side of the box fits at 1.2 times its length from the middle.
    let distance_m = 1.2 * bounds.size_m().max_element();
    let count = POINTS_PER_STATION * sampling.stations;
    let point_at = |index: u32| {
        let turn = f64::from(index) / f64::from(count);
        let (sin, cos) = (turn * std::f64::consts::TAU).sin_cos();
        // Height over the horizontal unit vector (cos, sin).
        let slope = AROUND_ELEVATION_DEG.to_radians().tan();
        let toward_camera = DVec3::new(cos, sin, slope).normalize();
        let position_m = middle_m + distance_m * toward_camera;
        let view =
            view_along(AROUND_SIZE_PX, AROUND_FOCAL_PX, position_m, -toward_camera, DVec3::NEG_Z);
        let point = SamplePoint {
            name: format!("{:.1}° around", 360.0 * turn),
            offset_m: 0.0,
            for_selection: index.is_multiple_of(2),
            world_from_rig: None,
            views: vec![view],
            windows: Vec::new(),
        };
        point.with_windows(index as usize, sampling.window_px, WINDOW_SHARE)
    };
    (0..count).map(point_at).collect()
}

/// 1/ρ and 1/ρ² with the plastic number ρ = 1.3247...: multiples of them, modulo 1, cover the unit
/// square evenly without being regular (Roberts 2018, the R2 sequence).
const R2_STEPS: [f64; 2] = [0.754_877_666_2, 0.569_840_290_99];

/// More cameras than a rig has: the sequence continues from camera to camera, then from point to
/// point.
const CAMERAS_PER_POINT: usize = 16;

impl SamplePoint {
    /// Adds a window in each image. The windows of all points spread evenly over `share` of the
    /// image's sides, around its middle. `index` is the number of this point.
    fn with_windows(mut self, index: usize, window_px: [u32; 2], share: f64) -> Self {
        let window = |(camera, view): (usize, &View)| {
            // Every camera of every point has its own number.
            let i = (index * CAMERAS_PER_POINT + camera + 1) as f64;
            let image_px = [view.camera.width_px, view.camera.height_px];
            // An image that is smaller than the window is compared as a whole.
            let size_px = [0, 1].map(|axis| window_px[axis].min(image_px[axis]));
            let corner_px = [0, 1].map(|axis| {
                let in_unit_square = (0.5 + i * R2_STEPS[axis]).fract();
                // Drawn together around the middle by `share`.
                let in_image = 0.5 + share * (in_unit_square - 0.5);
                // `in_image` is below 1, so that the window ends within the image.
                (in_image * f64::from(image_px[axis] - size_px[axis])) as i32
            });
            crop_view(*view, corner_px, size_px)
        };
        self.windows = self.views.iter().enumerate().map(window).collect();
        self
    }

    /// This point with all images and windows scaled.
    ///
    /// # Errors
    /// A camera cannot be scaled to such a small image.
    pub(super) fn scaled(&self, setting: &Setting) -> Result<Self, CameraError> {
        let scale_all = |views: &[View]| -> Result<Vec<View>, CameraError> {
            let mut views: Vec<View> =
                views.iter().map(|view| scaled(*view, setting.scale)).collect::<Result<_, _>>()?;
            // Without a native size the pixels count as native ones.
            if setting.own_blur {
                views.iter_mut().for_each(|view| view.camera.native_size_px = None);
            }
            Ok(views)
        };
        Ok(Self {
            views: scale_all(&self.views)?,
            windows: scale_all(&self.windows)?,
            ..self.clone()
        })
    }
}

/// A view whose image sides and intrinsics are scaled.
///
/// # Errors
/// The camera cannot be scaled to such a small image.
pub(super) fn scaled(view: View, scale: f64) -> Result<View, CameraError> {
    // At least 1: no side vanishes.
    let side_px = |px: u32| ((f64::from(px) * scale).round() as u64).max(1);
    let own = view.camera;
    let camera = own.scaled(side_px(own.width_px), side_px(own.height_px))?;
    Ok(View { camera, ..view })
}
