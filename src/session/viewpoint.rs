//! Converts views of the renderer to viewpoints, which determine the levels of detail.

use wildcity_render::View;
use wildcity_render::lidar::LidarView;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::{RigCamera, RigLidar};
use wildcity_twin::residency::Viewpoint;

/// The viewpoint of each view: its position, and its focal length along the finer axis.
///
/// For a rolling shutter this is the position at the end of the exposure. The level of detail
/// depends only on the distance, not on the direction.
pub fn viewpoints(views: &[View]) -> Vec<Viewpoint> {
    let viewpoint = |view: &View| Viewpoint {
        position_m: view.world_from_camera.position_m,
        // The finer axis, so that neither has too little detail.
        focal_px: view.camera.pinhole.fx.max(view.camera.pinhole.fy),
    };
    views.iter().map(viewpoint).collect()
}

/// The viewpoints of all cameras and then all LiDARs of a rig at a pose of it.
pub(crate) fn rig_viewpoints(
    cameras: &[RigCamera],
    lidars: &[RigLidar],
    world_from_rig: Pose,
) -> Vec<Viewpoint> {
    let mut places = viewpoints(&View::from_rig(cameras, world_from_rig));
    places.extend(lidars.iter().map(|mounted| {
        let world_from_lidar = world_from_rig * mounted.rig_from_lidar;
        lidar_viewpoint(&LidarView::at_rest(mounted.lidar.clone(), world_from_lidar))
    }));
    places
}

/// The longest time that an image or a sweep of a rig takes, in microseconds.
pub(crate) fn longest_exposure_us(cameras: &[RigCamera], lidars: &[RigLidar]) -> i64 {
    let sweeps = lidars.iter().map(|mounted| mounted.lidar.duration_us());
    sweeps.fold(View::longest_exposure_us(cameras), i64::max)
}

/// The viewpoint of a LiDAR at the end of its sweep. A beam is about a milliradian wide: a pixel of
/// a camera with a focal length of 1,000. Beams that are closer to each other need more detail.
pub fn lidar_viewpoint(view: &LidarView) -> Viewpoint {
    let focal_px = view.lidar.resolution_rad().recip().max(1_000.0);
    Viewpoint { position_m: view.world_from_lidar.position_m, focal_px }
}
