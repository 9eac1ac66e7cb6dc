//! LiDAR points with the colours of images: points to begin a training with.

use glam::DVec3;

use wildcity_scene::random::Random;

use crate::check::{Projection, SampleReader};
use crate::error::LogError;
use crate::log::Log;
use crate::poses::Poses;
use crate::tracks::Tracks;

/// A point of the world with a colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColoredPoint {
    /// In the world of the log, in metres.
    pub at_m: DVec3,
    /// sRGB of an image that shows it.
    pub rgb8: [u8; 3],
}

/// At most `most` points, a uniform sample of all that some images of each camera show. Points in
/// boxes that move are left out. The same log gives the same points.
///
/// # Errors
/// A table, an image or a sweep cannot be used.
pub fn colored_points(
    log: &Log,
    poses: &Poses,
    images_per_camera: usize,
    most: usize,
) -> Result<Vec<ColoredPoint>, LogError> {
    let tracks = Tracks::read(log, [i64::MIN, i64::MAX])?;
    let reader = SampleReader::choose(log, images_per_camera)?;
    // A fixed seed: the same log gives the same points.
    let mut random = Random::new(0, "points", 0);
    let mut points: Vec<ColoredPoint> = Vec::new();
    let mut seen = 0;
    for sample in reader.samples() {
        let image = reader.image(sample)?;
        let mounted = &log.rig.cameras[log.camera_index(&sample.image.camera)?];
        let projection = Projection { poses, mounted, time_us: sample.image.time_us };
        let near = tracks.near(sample.image.time_us);
        for point in reader.points(sample, poses)? {
            let shown = projection.project(point.world_m);
            let Some((at_px, _)) = shown else { continue };
            // Moving objects would leave a trail of points, which a training would take for the
            // scene.
            if near.hides(point.world_m, point.time_us) {
                continue;
            }
            let colored = ColoredPoint { at_m: point.world_m, rgb8: image.color(at_px) };
            // Reservoir sampling: each of the points so far stays with the same chance.
            seen += 1;
            if points.len() < most {
                points.push(colored);
            } else if let Some(place) = points.get_mut(random.below(seen)) {
                *place = colored;
            }
        }
    }
    Ok(points)
}
