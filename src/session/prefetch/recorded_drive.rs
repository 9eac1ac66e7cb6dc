//! A recorded drive that the ego may follow.

use glam::DVec3;

use wildcity_scene::Trajectory;
use wildcity_scene::geometry::{Bounds, Pose};
use wildcity_scene::route::BoxIndex;

/// A recorded drive as a polyline. Its trajectory has at least one keyframe.
#[derive(Debug)]
pub(crate) struct RecordedDrive {
    poses: Vec<Pose>,
    /// Distance of each pose along the drive, in metres.
    stations_m: Vec<f64>,
    /// The boxes of the segments from each pose to the next; of a single pose, the box of that
    /// pose.
    segments: BoxIndex,
}

/// The point of a drive that is nearest to another point.
#[derive(Clone, Copy, Debug)]
pub(super) struct NearestPoint {
    /// Distance along the drive, in metres.
    pub(super) station_m: f64,
    /// Distance from the other point, in metres.
    pub(super) distance_m: f64,
}

impl RecordedDrive {
    /// The drive of a trajectory.
    pub(crate) fn new(trajectory: &Trajectory) -> Self {
        let poses: Vec<Pose> = trajectory.keyframes.iter().map(|key| key.world_from_rig).collect();
        let mut stations_m = Vec::with_capacity(poses.len());
        let mut station_m = 0.0;
        for (index, pose) in poses.iter().enumerate() {
            // The first pose is its own predecessor, at distance 0.
            let previous = poses[index.saturating_sub(1)];
            station_m += pose.position_m.distance(previous.position_m);
            stations_m.push(station_m);
        }
        let segment = |index: usize| {
            let mut bounds = Bounds::EMPTY;
            for pose in &poses[index..poses.len().min(index + 2)] {
                bounds.add(pose.position_m, DVec3::ZERO);
            }
            bounds
        };
        // One segment less than poses, but one of a single pose, and none without poses.
        let count = poses.len().saturating_sub(1).max(poses.len().min(1));
        let segments: Vec<Bounds> = (0..count).map(segment).collect();
        Self { poses, stations_m, segments: BoxIndex::new(&segments) }
    }

    /// The point of the drive that is nearest to `point_m`; `None` if the drive has no poses.
    pub(super) fn nearest(&self, point_m: DVec3) -> Option<NearestPoint> {
        // Nearest point on one segment; `station_m` is the distance along that segment.
        let on_segment = |index: usize| {
            let from_m = self.poses[index].position_m;
            let to_m = self.poses.get(index + 1).map_or(from_m, |next| next.position_m);
            let segment_m = to_m - from_m;
            let to_point_m = point_m - from_m;
            // Where the car stood, a segment has no length: t is 0 then, and not NaN.
            let length_squared_m2 = segment_m.length_squared().max(1e-12);
            let t = (to_point_m.dot(segment_m) / length_squared_m2).clamp(0.0, 1.0);
            NearestPoint {
                station_m: t * segment_m.length(),
                distance_m: (to_point_m - t * segment_m).length(),
            }
        };
        // The distance to a segment is not below that to its box, except for rounding: among
        // equally near segments, rounding may decide.
        let distance_to = |index: usize| on_segment(index).distance_m;
        let (index, distance_m) = self.segments.min_cost(point_m, distance_to)?;
        let station_m = self.stations_m[index] + on_segment(index).station_m;
        Some(NearestPoint { station_m, distance_m })
    }

    /// The pose at a distance along the drive, in metres. Beyond its end the drive continues
    /// straight.
    pub(super) fn pose_at(&self, station_m: f64) -> Pose {
        let after = self.stations_m.partition_point(|&m| m < station_m);
        // There is at least one pose, see the type.
        let last = self.poses.len() - 1;
        if after > last {
            let end = self.poses[last];
            let beyond_m = station_m - self.stations_m[last];
            return Pose { position_m: end.position_m + end.rotation * DVec3::X * beyond_m, ..end };
        }
        let before = after.saturating_sub(1);
        let length_m = self.stations_m[after] - self.stations_m[before];
        // At station 0 both are the first pose.
        let t = if length_m > 0.0 { (station_m - self.stations_m[before]) / length_m } else { 1.0 };
        self.poses[before].interpolate(&self.poses[after], t)
    }
}
