//! From where a twin is looked at: along its recorded drive and beside it, or around it.

use glam::{DQuat, DVec3};

use super::settings::scaled;
use wildcity_render::View;
use wildcity_render::compare::images::{crop_view, view_along};
use wildcity_scene::geometry::{Bounds, CameraError, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_scene::{Manifest, Trajectory};

/// Somewhere that all settings are measured.
#[derive(Clone, Debug)]
pub struct SamplePoint {
    /// As `60 m, 3 m left`.
    pub name: String,
    /// Metres beside the recorded drive, whichever side; 0 on it, and where there is none.
    pub offset_m: f64,
    /// Whether a setting may be chosen by what is seen here. The others verify the choice.
    pub chooses: bool,
    /// Where the rig stands; none where there is no drive.
    pub world_from_rig: Option<Pose>,
    /// The cameras in full: what is timed.
    pub views: Vec<View>,
    /// A part of each camera's image at full focal length: what is compared.
    pub windows: Vec<View>,
}

/// How many places, and how much is compared at each.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Sampling {
    /// Stations along the drive; around a capture without one, four times as many places.
    pub stations: u32,
    /// Width and height of the part of an image that is compared, in pixels.
    pub window_px: [u32; 2],
}

/// How far beside the recorded drive, in metres: on it, in the lane's other half, the next lane, and the
/// one after it.
pub const OFFSETS_M: [f64; 4] = [0.0, 1.0, 3.0, 5.0];

/// Places along the twin's first recorded drive with these cameras, or around it if there is none.
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

/// Every other station chooses; offsets are to the left and to the right in turn. The rig moves as fast as
/// it did on the whole drive, which rolling shutters see.
fn along(drive: &Trajectory, cameras: &[RigCamera], sampling: Sampling) -> Vec<SamplePoint> {
    let mut places = Vec::new();
    let length_m = drive.length_m();
    let (first, last) = (drive.keyframes.first(), drive.keyframes.last());
    let took_us = first.zip(last).map_or(0, |(first, last)| last.time_us - first.time_us);
    let m_per_us = if took_us > 0 { length_m / took_us as f64 } else { 0.0 };
    for station in 0..sampling.stations {
        let share = (f64::from(station) + 0.5) / f64::from(sampling.stations);
        let station_m = share * length_m;
        let (sign, side) =
            if (station / 2).is_multiple_of(2) { (1.0, "left") } else { (-1.0, "right") };
        for offset_m in OFFSETS_M {
            // In the rig's axes y is left.
            let beside = Pose {
                position_m: DVec3::new(0.0, sign * offset_m, 0.0),
                rotation: DQuat::IDENTITY,
            };
            let world_from_rig_before =
                |age_us: i64| drive.at_station(station_m - m_per_us * age_us as f64) * beside;
            let world_from_rig = world_from_rig_before(0);
            let views = View::of_moving_rig(cameras, world_from_rig, &world_from_rig_before);
            let name = match offset_m {
                0.0 => format!("{station_m:.0} m"),
                _ => format!("{station_m:.0} m, {offset_m} m {side}"),
            };
            let place = SamplePoint {
                name,
                offset_m,
                chooses: station.is_multiple_of(2),
                world_from_rig: Some(world_from_rig),
                views,
                windows: Vec::new(),
            };
            places.push(place.with_windows(places.len(), sampling.window_px, 1.0));
        }
    }
    places
}

/// Places around a capture for each station: as many as there are offsets beside a drive.
const AROUND: u32 = OFFSETS_M.len() as u32;

/// Share of the sides of such images that windows lie in: around the middle, where the thing is.
const MIDDLE: f64 = 0.5;

/// Cameras of 640 x 480 px on a circle around the middle, 20° above it, that see all of it: a capture of
/// one thing. z is up.
fn around(bounds: Bounds, sampling: Sampling) -> Vec<SamplePoint> {
    let middle_m = 0.5 * (bounds.min_m + bounds.max_m);
    // A lens of 600 px sees ±0.53 across and ±0.4 down of what is 1 m away: the box' longest side fits at
    // 1.2 times its length from its middle.
    let away_m = 1.2 * bounds.size_m().max_element();
    let place_at = |station: u32| {
        let share = f64::from(station) / f64::from(AROUND * sampling.stations);
        let (sin, cos) = (share * std::f64::consts::TAU).sin_cos();
        let toward = DVec3::new(cos, sin, 20.0_f64.to_radians().tan()).normalize();
        let view = view_along([640, 480], 600.0, middle_m + away_m * toward, -toward, DVec3::NEG_Z);
        let place = SamplePoint {
            name: format!("{:.1}° around", 360.0 * share),
            offset_m: 0.0,
            chooses: station.is_multiple_of(2),
            world_from_rig: None,
            views: vec![view],
            windows: Vec::new(),
        };
        place.with_windows(station as usize, sampling.window_px, MIDDLE)
    };
    (0..AROUND * sampling.stations).map(place_at).collect()
}

impl SamplePoint {
    /// The same with a window in each image, spread evenly over a share of its sides around the middle
    /// (Roberts 2018: powers of the plastic number's inverse); `index` counts the places.
    fn with_windows(mut self, index: usize, window_px: [u32; 2], within: f64) -> Self {
        let window = |(camera, view): (usize, &View)| {
            let i = (index * 16 + camera + 1) as f64;
            let size_px = [view.camera.width_px, view.camera.height_px];
            let own_px = [0, 1].map(|axis| window_px[axis].min(size_px[axis]));
            let at = [0.754_877_666_2, 0.569_840_290_99].map(|step: f64| (0.5 + i * step).fract());
            let at = [0, 1].map(|axis| {
                let share = 0.5 + within * (at[axis] - 0.5);
                (share * f64::from(size_px[axis] - own_px[axis])) as i32
            });
            crop_view(*view, at, own_px)
        };
        self.windows = self.views.iter().enumerate().map(window).collect();
        self
    }

    /// The same with all images scaled.
    ///
    /// # Errors
    /// A camera so small cannot be used.
    pub(super) fn scaled(&self, scale: f64) -> Result<Self, CameraError> {
        let all = |views: &[View]| -> Result<Vec<View>, CameraError> {
            views.iter().map(|view| scaled(*view, scale)).collect()
        };
        Ok(Self { views: all(&self.views)?, windows: all(&self.windows)?, ..self.clone() })
    }
}
