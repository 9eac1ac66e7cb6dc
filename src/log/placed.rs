//! Images with their cameras in the world.

use std::path::PathBuf;

use wildcity_scene::geometry::{Camera, Pose};

use crate::error::LogError;
use crate::log::Log;
use crate::poses::Poses;
use crate::row::ImageRow;

/// An image of a log with its camera in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedImage {
    pub row: ImageRow,
    /// `CAMERA/CAMERA_TIME`: names are in the order of time, and their folder is the camera.
    pub name: String,
    pub file: PathBuf,
    pub camera: Camera,
    /// Pose of the camera in the world; with a rolling shutter, in the middle of its time.
    pub world_from_camera: Pose,
}

impl Log {
    /// The images of which there is a pose, one after the other.
    ///
    /// # Errors
    /// There is no `images.jsonl`. Each image may be an error of its own: a row that cannot be
    /// used, or of a camera that the rig does not have.
    pub fn placed_images(
        &self,
        poses: &Poses,
    ) -> Result<impl Iterator<Item = Result<PlacedImage, LogError>>, LogError> {
        let rows = self.images()?.ok_or_else(|| LogError::NoTable {
            folder: self.folder().to_owned(),
            table: "images.jsonl",
            needed_for: "there is no image to place",
        })?;
        Ok(rows.filter_map(|row| row.and_then(|row| self.place(poses, row)).transpose()))
    }

    /// Places an image; `None` if there is no pose at its time.
    fn place(&self, poses: &Poses, row: ImageRow) -> Result<Option<PlacedImage>, LogError> {
        let mounted = &self.rig.cameras[self.camera_index(&row.camera)?];
        let half_us = mounted.shutter.map_or(0, |shutter| shutter.duration_us / 2);
        // The time of a row is that of its last line of pixels. Its middle line gives the pose that
        // is least wrong for the whole image.
        let middle_us = row.time_us.saturating_sub(half_us);
        let placed = poses.at(middle_us).map(|world_from_rig| PlacedImage {
            // Twelve digits are 11 days of microseconds; shorter numbers get zeros, so that names
            // sort by time.
            name: format!("{0}/{0}_{1:012}", row.camera, row.time_us),
            file: self.path(&row.file),
            camera: mounted.camera,
            world_from_camera: world_from_rig * mounted.rig_from_camera,
            row,
        });
        Ok(placed)
    }
}
