//! LiDAR points in images.

use glam::{DVec2, DVec3};

use wildcity_scene::rig::RigCamera;

use crate::log::Log;
use crate::poses::Poses;
use crate::row::SweepRow;

/// Farthest point that is compared, in metres.
const REACH_M: f32 = 80.0;

/// Nearest point that is compared, in metres: nearer ones are on the vehicle.
const NEAR_M: f32 = 1.5;

/// Steps in which the row of a rolling shutter is found.
const SHUTTER_STEPS: u32 = 3;

/// The projection of points of the LiDAR into an image at its time.
#[derive(Clone, Copy, Debug)]
pub struct Projection<'a> {
    pub poses: &'a Poses,
    pub mounted: &'a RigCamera,
    /// When the last row of the image was exposed, in microseconds.
    pub time_us: i64,
}

/// A point of a LiDAR, in the rig's axes at its time.
#[derive(Clone, Copy, Debug)]
pub(super) struct RigPoint {
    pub(super) rig_m: DVec3,
    /// When it was seen, or to when the source has moved it.
    pub(super) time_us: i64,
    /// Whether it is nearer than a neighbour by much: an edge.
    pub(super) is_edge: bool,
}

impl Projection<'_> {
    /// Where a point of the world is in the image, and its distance in metres; `None` if the image
    /// does not show it. With a rolling shutter, the camera is where it was when the row of the
    /// point was exposed.
    pub fn project(&self, world_m: DVec3) -> Option<(DVec2, f64)> {
        let mut shown = self.project_at(world_m, self.time_us)?;
        let Some(shutter) = self.mounted.shutter else { return Some(shown) };
        // The row depends on the time, and the time on the row: each step is ten times closer.
        for _ in 0..SHUTTER_STEPS {
            let fraction = shutter.direction.fraction(shown.0, &self.mounted.camera);
            // `time_us` is when the last row was exposed, so that earlier ones are before it.
            let before_us = (1.0 - fraction) * shutter.duration_us as f64;
            let time_us = self.time_us.saturating_sub(before_us.round() as i64);
            shown = self.project_at(world_m, time_us)?;
        }
        Some(shown)
    }

    fn project_at(&self, world_m: DVec3, time_us: i64) -> Option<(DVec2, f64)> {
        let world_from_camera = self.poses.at(time_us)? * self.mounted.rig_from_camera;
        let camera_m = world_from_camera.inverse().transform_point(world_m);
        let camera = &self.mounted.camera;
        let at_px = camera.project(camera_m)?;
        let is_inside = at_px.cmpge(DVec2::ZERO).all() && at_px.cmplt(camera.size_px()).all();
        is_inside.then(|| (at_px, camera_m.length()))
    }
}

impl RigPoint {
    /// The point in the world if its time was wrong by `late_us`.
    pub(super) fn world_m(&self, poses: &Poses, late_us: i64) -> Option<DVec3> {
        let pose = poses.at(self.time_us.checked_sub(late_us)?)?;
        Some(pose.transform_point(self.rig_m))
    }
}

/// The points of a sweep in the rig's axes, those that are compared.
pub(super) fn rig_points(
    log: &Log,
    row: &SweepRow,
) -> Result<Vec<RigPoint>, crate::error::LogError> {
    let sweep = log.points(row)?;
    let ranges: Vec<f32> =
        // From the LiDAR itself, before the mount: leaps of the range are seen from there.
        sweep.points_m.iter().map(|[x, y, z]| (x * x + y * y + z * z).sqrt()).collect();
    let is_edge = super::edges::lidar_edges(&ranges, sweep.ring.as_deref());
    let placed = sweep.on_rig(row, log.rig_from_lidar(&row.lidar)?);
    let mut points = Vec::new();
    for (at, (time_us, rig_m)) in placed.enumerate() {
        // NaN, a point without a return, is in no range.
        if (NEAR_M..=REACH_M).contains(&ranges[at]) {
            points.push(RigPoint { rig_m, time_us, is_edge: is_edge[at] });
        }
    }
    Ok(points)
}
