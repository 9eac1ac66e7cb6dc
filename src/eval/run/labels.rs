//! Boxes and LiDAR points: labels of images from a driving log.

use std::path::Path;

use anyhow::{Context, ensure};

use crate::{
    Boxes, BoxesSubject, DepthMap, GROWN_PX, LidarDepth, LidarPoints, LidarSubject, MovingBox,
    WorldPoints, hide,
};
use wildcity_log::{Log, open_lines};
use wildcity_render::View;
use wildcity_scene::align::Alignment;
use wildcity_scene::trajectory::Keyframe;
use wildcity_session::{OpenScene, RenderedImage};
use wildcity_twin::ingest;

use super::Settings;
use crate::images::RealImage;

/// Largest file of boxes or LiDAR points. An hour of a LiDAR with 64 rows has 20 GB: give some
/// minutes of it.
const LABEL_BYTES: u64 = 4 << 30;

/// The labels of the images.
pub(super) struct Labels {
    boxes: Option<Boxes>,
    lidar: Option<WorldPoints>,
    window_us: i64,
    pub(super) boxes_subject: Option<BoxesSubject>,
    pub(super) lidar_subject: Option<LidarSubject>,
}

impl Labels {
    pub(super) fn load(
        settings: &Settings,
        source: &OpenScene,
        alignment: &Alignment,
        images: &[&RealImage],
    ) -> anyhow::Result<Self> {
        for (option, file) in [("--boxes", &settings.boxes), ("--lidar", &settings.lidar)] {
            // Both labels are matched by time; without one they would be left out of an image
            // silently.
            let untimed = images.iter().find(|image| image.time_us.is_none());
            if let (Some(_), Some(image)) = (file, untimed) {
                anyhow::bail!(
                    "{option}: image {} has no time: give \"time_us\" in transforms.json or in the camera list, in the \
                     clock of this file",
                    image.name
                );
            }
        }
        let mut labels = Self {
            boxes: None,
            lidar: None,
            window_us: (settings.lidar_window_s * 1e6).round() as i64,
            boxes_subject: None,
            lidar_subject: None,
        };
        if let Some(path) = &settings.boxes {
            let boxes = read_boxes(path).with_context(|| format!("--boxes {}", path.display()))?;
            let file = path.display().to_string();
            labels.boxes_subject = Some(BoxesSubject { file, tracks: boxes.tracks() });
            labels.boxes = Some(boxes.aligned(alignment));
        }
        if let Some(path) = &settings.lidar {
            let about = || format!("--lidar {}", path.display());
            let read = if Log::is_log(path) {
                read_log(path, images, labels.window_us).with_context(about)?
            } else {
                read_lidar(path)?
            };
            let points = in_world(&read, source, alignment).with_context(about)?;
            labels.lidar_subject = Some(LidarSubject {
                file: path.display().to_string(),
                points: points.points_m.len(),
                left_out: points.skipped,
            });
            labels.lidar = Some(points);
        }
        Ok(labels)
    }

    /// Masks moving objects in an image. Returns the pixels that count, and the share that is
    /// masked; `None` without boxes.
    pub(super) fn hide(
        &self,
        image: &RealImage,
        view: &View,
        alignment: &Alignment,
    ) -> Option<(Vec<bool>, f64)> {
        let (boxes, time_us) = self.boxes.as_ref().zip(image.time_us)?;
        let mut counts = vec![true; view.camera.pixels()];
        let size_px = [view.camera.width_px, view.camera.height_px];
        let world_from_camera = alignment.pose(&image.world_from_camera);
        let moving: Vec<MovingBox> = boxes.moving_at(time_us);
        for one in moving {
            let hull_px = one.hull_px(&view.camera, &world_from_camera);
            hide(&hull_px, size_px, GROWN_PX, &mut counts);
        }
        let hidden = counts.iter().filter(|counts| !**counts).count();
        let share = hidden as f64 / counts.len() as f64;
        Some((counts, share))
    }

    /// Compares the depth of an image; `None` without LiDAR.
    pub(super) fn depth(
        &self,
        image: &RealImage,
        view: &View,
        rendered: &RenderedImage,
        counts: Option<&[bool]>,
    ) -> Option<LidarDepth> {
        let (lidar, time_us) = self.lidar.as_ref().zip(image.time_us)?;
        let from_us = time_us.saturating_sub(self.window_us);
        let to_us = time_us.saturating_add(self.window_us);
        let map = DepthMap {
            camera: &view.camera,
            world_from_camera: &view.world_from_camera,
            depth_m: &rendered.depth_m,
            opacity: &rendered.opacity,
            counts,
        };
        Some(LidarDepth::compare(lidar.between_us(from_us, to_us), &map))
    }
}

fn read_boxes(path: &Path) -> anyhow::Result<Boxes> {
    Ok(Boxes::read(open_lines(path, LABEL_BYTES)?)?)
}

fn read_lidar(path: &Path) -> anyhow::Result<LidarPoints> {
    let about = || format!("--lidar {}", path.display());
    let bytes = ingest::read_whole(path, LABEL_BYTES).with_context(about)?;
    LidarPoints::parse(&bytes).with_context(about)
}

/// The points of a log near the times of the images; sweeps at other times are not read.
fn read_log(path: &Path, images: &[&RealImage], window_us: i64) -> anyhow::Result<LidarPoints> {
    let log = Log::open(path)?;
    let mut times_us: Vec<i64> = images.iter().filter_map(|image| image.time_us).collect();
    // Sorted, so that each sweep is matched by bisection and not against every image.
    times_us.sort_unstable();
    let is_near = |from_us: i64, to_us: i64| {
        let from_us = from_us.saturating_sub(window_us);
        // The first time that is not too early is near if it is not too late.
        let first = times_us.partition_point(|time_us| *time_us < from_us);
        times_us.get(first).is_some_and(|time_us| *time_us <= to_us.saturating_add(window_us))
    };
    let mut points = Vec::new();
    for row in log.sweeps()?.context("the log has no lidar.jsonl")? {
        let row = row?;
        if is_near(row.time_us, row.until_us) {
            points.extend(log.points_on_rig(&row)?);
        }
    }
    Ok(LidarPoints::from_rig(points, log.poses()?.keyframes().to_vec()))
}

fn in_world(
    points: &LidarPoints,
    source: &OpenScene,
    alignment: &Alignment,
) -> anyhow::Result<WorldPoints> {
    let drives = source.version().map(|version| &version.manifest.trajectories);
    // Points in the rig's axes without poses of their own are placed by the first drive of the
    // twin.
    let drive = drives.and_then(|drives| drives.first()).map(|drive| &drive.keyframes[..]);
    let world = points.in_world(alignment, drive.map(|keys: &[Keyframe]| keys))?;
    ensure!(
        !world.points_m.is_empty(),
        "none of the {} points has a time between two poses at most 0.2 s apart: points, poses and images need one clock",
        points.len()
    );
    Ok(world)
}
