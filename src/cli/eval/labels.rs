//! `--boxes` and `--lidar`: labels of images from a driving log.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use wildcity_eval::{
    Boxes, BoxesSubject, DepthMap, GROWN_PX, LidarDepth, LidarPoints, LidarSubject, MovingBox,
    WorldPoints, hide,
};
use wildcity_render::View;
use wildcity_scene::align::Alignment;
use wildcity_scene::trajectory::Keyframe;
use wildcity_session::RenderedImage;
use wildcity_twin::ingest;

use crate::cli::limits;
use crate::cli::real_images::RealImage;
use crate::cli::scene_source::Source;

/// Largest value of `--lidar-window`, in seconds.
const LONGEST_S: f64 = 10.0;

/// `--boxes` and `--lidar`.
#[derive(Debug, clap::Args)]
pub(super) struct LabelOptions {
    /// File of boxes around vehicles and pedestrians, one JSON object per line: time_us, track,
    /// size (length, width, height in the unit of the poses), world_from_box ({"xyz", "q"}: the
    /// middle of the box, in the axes of the poses of --images), and optionally velocity. Pixels in
    /// boxes that move faster than 1 m/s do not count. The images need time_us in their list.
    #[arg(long, value_name = "FILE")]
    boxes: Option<PathBuf>,

    /// Points of a LiDAR, a safetensors file: points_m [n, 3], time_us [n]; and optionally
    /// rig_from_lidar [4, 4], pose_time_us [m] and world_from_rig [m, 4, 4] in the axes of the
    /// poses of --images [default: the twin's first drive]. The rendered depth is compared with
    /// these points. The images need time_us in their list, in the same clock.
    #[arg(long, value_name = "FILE")]
    lidar: Option<PathBuf>,

    /// Largest time between an image and the LiDAR points that are compared with it, in seconds.
    #[arg(long, value_name = "S", default_value = "0.05", value_parser = seconds, requires = "lidar")]
    lidar_window: f64,
}

/// The labels of the images.
pub(super) struct Labels {
    boxes: Option<Boxes>,
    lidar: Option<WorldPoints>,
    window_us: i64,
    pub(super) boxes_subject: Option<BoxesSubject>,
    pub(super) lidar_subject: Option<LidarSubject>,
}

impl LabelOptions {
    pub(super) fn needs_depth(&self) -> bool {
        self.lidar.is_some()
    }

    /// Reads the files.
    pub(super) fn load(
        &self,
        source: &Source,
        alignment: &Alignment,
        images: &[&RealImage],
    ) -> anyhow::Result<Labels> {
        for (option, file) in [("--boxes", &self.boxes), ("--lidar", &self.lidar)] {
            let untimed = images.iter().find(|image| image.time_us.is_none());
            if let (Some(_), Some(image)) = (file, untimed) {
                anyhow::bail!(
                    "{option}: image {} has no time: give \"time_us\" in transforms.json or in the camera list, in the \
                     clock of this file",
                    image.name
                );
            }
        }
        let mut labels = Labels {
            boxes: None,
            lidar: None,
            window_us: (self.lidar_window * 1e6).round() as i64,
            boxes_subject: None,
            lidar_subject: None,
        };
        if let Some(path) = &self.boxes {
            let boxes = read_boxes(path).with_context(|| format!("--boxes {}", path.display()))?;
            let file = path.display().to_string();
            labels.boxes_subject = Some(BoxesSubject { file, tracks: boxes.tracks() });
            labels.boxes = Some(boxes.aligned(alignment));
        }
        if let Some(path) = &self.lidar {
            let about = || format!("--lidar {}", path.display());
            let points = read_lidar(path, source, alignment).with_context(about)?;
            labels.lidar_subject = Some(LidarSubject {
                file: path.display().to_string(),
                points: points.points_m.len(),
                left_out: points.skipped,
            });
            labels.lidar = Some(points);
        }
        Ok(labels)
    }
}

impl Labels {
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
    let bytes = ingest::read_whole(path, limits::LABEL_BYTES)?;
    let text = std::str::from_utf8(&bytes).context("the file is not UTF-8 text")?;
    Ok(Boxes::parse(text)?)
}

fn read_lidar(path: &Path, source: &Source, alignment: &Alignment) -> anyhow::Result<WorldPoints> {
    let points = LidarPoints::parse(&ingest::read_whole(path, limits::LABEL_BYTES)?)?;
    let drives = source.version().map(|version| &version.manifest.trajectories);
    let drive = drives.and_then(|drives| drives.first()).map(|drive| &drive.keyframes[..]);
    let world = points.in_world(alignment, drive.map(|keys: &[Keyframe]| keys))?;
    ensure!(
        !world.points_m.is_empty(),
        "none of the {} points has a time between two poses at most 0.2 s apart: points, poses and images need one clock",
        points.len()
    );
    Ok(world)
}

fn seconds(text: &str) -> Result<f64, String> {
    let must = || format!("expected seconds from 0 to {LONGEST_S}");
    let seconds: f64 = text.parse().map_err(|_| must())?;
    if (0.0..=LONGEST_S).contains(&seconds) { Ok(seconds) } else { Err(must()) }
}
