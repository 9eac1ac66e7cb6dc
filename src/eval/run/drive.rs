//! Where images are along the recorded drives of a twin.

use std::sync::Arc;

use glam::DVec3;

use wildcity_render::View;
use wildcity_scene::Trajectory;
use wildcity_scene::geometry::Pose;
use wildcity_session::limits::FRAME_M;
use wildcity_session::{RenderedImage, TrainingCoverage};
use wildcity_twin::store::Version;

/// The recorded drives of a twin.
pub(super) struct Drives {
    version: Arc<Version>,
    coverage: TrainingCoverage,
}

/// Where an image is along a drive.
#[derive(Clone, Copy)]
pub(super) struct DrivePlace<'a> {
    trajectory: &'a Trajectory,
    station_m: f64,
    /// Pose of the drive at this station.
    drive: Pose,
    /// Pose of the rig when the image was taken.
    pub(super) world_from_rig: Pose,
}

impl Drives {
    /// `None` if the twin has no recorded drive.
    pub(super) fn from_version(version: &Arc<Version>) -> Option<Self> {
        let coverage = TrainingCoverage::new(&version.manifest)?;
        Some(Self { version: version.clone(), coverage })
    }

    /// The place of an image that a camera took from a pose.
    ///
    /// If the twin's rig has a camera of this name, its mounting gives the pose of the rig. For
    /// another camera, the rig has the heading of the drive, and the lateral distance of the camera
    /// from it.
    pub(super) fn place(
        &self,
        camera_name: &str,
        world_from_camera: &Pose,
    ) -> Option<DrivePlace<'_>> {
        let manifest = &self.version.manifest;
        let cameras = manifest.rig.iter().flat_map(|rig| &rig.cameras);
        let mounted = cameras.into_iter().find(|camera| camera.name == camera_name);
        // world_from_rig = world_from_camera * camera_from_rig.
        let rig = mounted.map(|mounted| *world_from_camera * mounted.rig_from_camera.inverse());
        let at_m = rig.map_or(world_from_camera.position_m, |rig| rig.position_m);
        let places = manifest.trajectories.iter().map(|drive| (drive, drive.nearest(at_m)));
        let (trajectory, place) =
            // Drives may cross or lie side by side: the image belongs to the nearest one.
            places.min_by(|(_, a), (_, b)| a.distance_m.total_cmp(&b.distance_m))?;
        let drive = trajectory.at_station(place.station_m);
        let beside = || {
            // Rig axes: x points forward and y to the left.
            let left = drive.rotation * DVec3::Y;
            let beside_m = left.dot(at_m - drive.position_m);
            Pose { position_m: drive.position_m + beside_m * left, ..drive }
        };
        let world_from_rig = rig.unwrap_or_else(beside);
        Some(DrivePlace { trajectory, station_m: place.station_m, drive, world_from_rig })
    }

    /// The trust in an image, as sessions compute it.
    pub(super) fn trust(&self, world_from_rig: &Pose, view: &View, image: &RenderedImage) -> f64 {
        self.coverage.trust(world_from_rig, view, &image.opacity).value
    }
}

impl DrivePlace<'_> {
    /// The direction to the left of the drive, as a unit vector.
    pub(super) fn left(&self) -> DVec3 {
        self.drive.rotation * DVec3::Y
    }

    /// The motion to the place [`FRAME_M`] before this one, or behind it at the start of the drive:
    /// a pose of the world is moved by multiplying it from the left. `None` if the drive is
    /// shorter.
    pub(super) fn step_back(&self) -> Option<Pose> {
        let from_m = if self.station_m >= FRAME_M {
            self.station_m - FRAME_M
        } else {
            self.station_m + FRAME_M
        };
        let before = self.trajectory.at_station(from_m);
        // A station beyond an end is that of the end: then the drive is too short for a step.
        let is_moved = before.position_m.distance(self.drive.position_m) > 0.5 * FRAME_M;
        is_moved.then(|| before * self.drive.inverse())
    }
}
