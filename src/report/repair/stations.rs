//! The poses of the repair section: on the drive and at lateral offsets from it.

use glam::DVec3;
use serde::Serialize;

use wildcity_render::View;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{RigCamera, RigError};

use wildcity_session::limits::FRAME_M;

use crate::sample_points::mean_speed_m_per_us;

/// The poses that are measured, and the size of the images.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RepairSampling {
    /// Number of stations along the drive.
    pub stations: u32,
    /// Lateral distances from the drive in metres, ascending. The first is 0.
    pub offsets_m: Vec<f64>,
    /// Longest side of an image, in pixels.
    pub side_px: u32,
}

/// A pose on or off the drive, and that of the previous frame.
pub(super) struct RepairStation {
    /// Index of its distance from the drive.
    pub(super) offset: usize,
    /// Whether it is used to select thresholds; the other poses verify them.
    pub(super) for_selection: bool,
    /// The rig in this frame and in the previous one.
    pub(super) world_from_rig: [Pose; 2],
    /// The cameras in this frame and in the previous one.
    pub(super) views: [Vec<View>; 2],
}

impl RepairSampling {
    /// Samples the drive itself and lateral distances from it, which may be in any order.
    pub fn new(stations: u32, beside_m: &[f64], side_px: u32) -> Self {
        let mut offsets_m = vec![0.0];
        // 0 is there already, and `dedup` needs equal values side by side.
        offsets_m.extend(beside_m.iter().copied().filter(|offset_m| *offset_m != 0.0));
        offsets_m.sort_by(f64::total_cmp);
        offsets_m.dedup();
        Self { stations, offsets_m, side_px }
    }

    /// The cameras at this size, without their overlays, because a model does not repair the ego
    /// vehicle.
    ///
    /// # Errors
    /// A camera cannot be that small.
    pub(super) fn cameras(&self, cameras: &[RigCamera]) -> Result<Vec<RigCamera>, RigError> {
        let sides = |camera: &RigCamera| camera.camera.width_px.max(camera.camera.height_px);
        // At least 1, so that nothing divides by 0.
        let longest_px = cameras.iter().map(sides).max().unwrap_or(1);
        // Scale all cameras by one factor, as a session with smaller images does.
        let factor = (f64::from(self.side_px) / f64::from(longest_px)).min(1.0);
        let scaled = |camera: &RigCamera| {
            let mut bare = camera.clone();
            bare.appearance.overlay = None;
            // Unchanged, so that the camera keeps its size as the native one.
            if factor == 1.0 {
                return Ok(bare);
            }
            let side = |px: u32| ((f64::from(px) * factor).round() as u64).max(1);
            bare.scaled(side(camera.camera.width_px), side(camera.camera.height_px))
        };
        cameras.iter().map(scaled).collect()
    }

    /// The poses of all stations. Every other station is for selection. Two stations have their
    /// offsets to the left, the next two to the right, and so on. All stations are at least one
    /// frame from the start.
    pub(super) fn stations(&self, drive: &Trajectory, cameras: &[RigCamera]) -> Vec<RepairStation> {
        let speed_m_per_us = mean_speed_m_per_us(drive);
        let length_m = drive.length_m();
        let mut stations = Vec::new();
        for station in 0..self.stations {
            // The middle of each of `stations` equal parts of the drive.
            let share = (f64::from(station) + 0.5) / f64::from(self.stations);
            let station_m = (share * length_m).max(FRAME_M);
            // In the rig's axes y points to the left.
            let sign = if (station / 2).is_multiple_of(2) { 1.0 } else { -1.0 };
            for (offset, offset_m) in self.offsets_m.iter().enumerate() {
                let position_m = DVec3::new(0.0, sign * offset_m, 0.0);
                let beside = Pose { position_m, ..Pose::IDENTITY };
                let at = |station_m: f64| drive.at_station(station_m) * beside;
                let stations_m = [station_m, station_m - FRAME_M];
                let views = stations_m.map(|station_m| {
                    // A rolling shutter needs earlier poses: the rig moves along the drive
                    // at its mean speed.
                    let before = |age_us: i64| at(station_m - speed_m_per_us * age_us as f64);
                    View::from_moving_rig(cameras, at(station_m), &before)
                });
                let for_selection = station.is_multiple_of(2);
                let world_from_rig = stations_m.map(at);
                stations.push(RepairStation { offset, for_selection, world_from_rig, views });
            }
        }
        stations
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::Rig;
    use wildcity_scene::trajectory::Keyframe;

    fn drive() -> Trajectory {
        // 40 m along x, at 10 m/s.
        let keyframe = |at: i64| Keyframe {
            time_us: 100_000 * at,
            world_from_rig: Pose { position_m: DVec3::new(at as f64, 0.0, 0.0), ..Pose::IDENTITY },
        };
        Trajectory { name: "log".to_owned(), keyframes: (0..=40).map(keyframe).collect() }
    }

    #[test]
    fn the_drive_comes_first_and_distances_ascend() {
        let sampling = RepairSampling::new(4, &[5.0, 1.0, 0.0, 1.0, 3.0], 360);
        assert_eq!(sampling.offsets_m, [0.0, 1.0, 3.0, 5.0]);
    }

    #[test]
    fn stations_alternate_and_each_has_the_frame_before() {
        let sampling = RepairSampling::new(4, &[3.0], 360);
        let mut rig = Rig::preset("vehicle6").unwrap();
        rig.cameras.truncate(2);
        let cameras = sampling.cameras(&rig.cameras).unwrap();
        assert_eq!(cameras[0].camera.width_px.max(cameras[0].camera.height_px), 360);
        let stations = sampling.stations(&drive(), &cameras);
        let at = |station: &RepairStation| station.world_from_rig[0].position_m;
        let places: Vec<[f64; 2]> =
            stations.iter().map(|station| [at(station).x, at(station).y]).collect();
        // Middles of four parts of 40 m; the first two stations have their offset to the left, +y.
        let wanted = [[5.0, 0.0], [5.0, 3.0], [15.0, 0.0], [15.0, 3.0], [25.0, 0.0], [25.0, -3.0]];
        assert_eq!(places[..6], wanted);
        let selection: Vec<bool> = stations.iter().map(|station| station.for_selection).collect();
        // Two poses per station, and every other station.
        assert_eq!(selection, [true, true, false, false, true, true, false, false]);
        for station in &stations {
            let [now, before] = station.world_from_rig;
            let moved_m = now.position_m - before.position_m;
            assert!((moved_m - DVec3::new(FRAME_M, 0.0, 0.0)).length() < 1e-9, "{moved_m}");
            assert_eq!(station.views[0].len(), 2);
        }
    }
}
