//! Episodes as a folder with the tables of nuScenes, version 1.0, which nuscenes-devkit loads.
//!
//! | table | rows |
//! |---|---|
//! | `scene`, `log`, `map` | one each; the map is an empty mask, because the devkit opens one |
//! | `sample` | the step at the start, and then the first after each half second |
//! | `sensor`, `calibrated_sensor` | the cameras, as pinholes |
//! | `sample_data`, `ego_pose` | one of each for an image; without images, a pose for each step |
//! | `instance`, `sample_annotation` | the actors, and their boxes at the samples |
//! | `category`, `attribute`, `visibility` | those of nuScenes that are named |
//!
//! What nuScenes measures and an episode does not has the value that says nothing: points of LiDAR
//! and radar in a box are 0, and the visibility is the highest. Times are those of the other
//! exports: those of the episode plus 1,000 s.

mod tables;

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use wildcity_scene::Rig;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::RigCamera;

use super::calibration::pinhole_error_px;
use super::error::{ExportError, Exported};
use crate::file::{EpisodeFile, Frame};

use tables::Tables;

/// Name of the version, which is that of the folder of the tables.
const VERSION: &str = "v1.0-wildcity";

/// Time between samples, in microseconds.
// Annotations of nuScenes have 2 Hz.
const SAMPLE_US: i64 = 500_000;

/// A black image of one pixel.
// PNG with 8 bits of gray: signature, IHDR, IDAT and IEND.
const EMPTY_MASK: [u8; 67] = [
    137, 80, 78, 71, 13, 10, 26, 10, 0, 0, 0, 13, 73, 72, 68, 82, 0, 0, 0, 1, 0, 0, 0, 1, 8, 0, 0,
    0, 0, 58, 126, 155, 85, 0, 0, 0, 10, 73, 68, 65, 84, 120, 156, 99, 96, 0, 0, 0, 2, 0, 1, 72,
    175, 164, 113, 0, 0, 0, 0, 73, 69, 78, 68, 174, 66, 96, 130,
];

/// An image of an episode, with the ego's pose when it was taken.
#[derive(Clone, Copy, Debug)]
pub struct NuscenesImage<'a> {
    /// Index of its camera in the rig.
    pub camera: usize,
    /// When it was taken, in microseconds.
    pub time_us: i64,
    /// The ego's pose then.
    pub world_from_rig: Pose,
    pub jpeg: &'a [u8],
}

/// A folder of nuScenes that is being written, under another name until it is whole.
pub struct NuscenesExport<'a> {
    episode: &'a EpisodeFile,
    cameras: Vec<RigCamera>,
    /// Names of the cameras as nuScenes has them.
    channels: Vec<String>,
    frames: Vec<&'a Frame>,
    images: Vec<Image>,
    out: PathBuf,
    /// Removed when it is dropped without its name.
    part: TempDir,
}

/// An image that is written.
struct Image {
    camera: usize,
    time_us: i64,
    world_from_rig: Pose,
    /// Its path in the folder.
    file: String,
    /// Index of the nearest sample.
    sample: usize,
    /// Whether it is the nearest one of its camera to that sample.
    is_key: bool,
}

impl<'a> NuscenesExport<'a> {
    /// Starts a folder, which must not exist. `rig` is that of the episode's header; without one
    /// there are no cameras.
    ///
    /// # Errors
    /// The folder exists or cannot be made, or the episode has no frame.
    pub fn begin(
        episode: &'a EpisodeFile,
        rig: Option<&Rig>,
        out: &Path,
    ) -> Result<Self, ExportError> {
        let frames = episode.driven();
        if frames.is_empty() {
            return Err(ExportError::Empty);
        }
        if out.exists() {
            return Err(ExportError::Exists(out.to_owned()));
        }
        let part = partial_folder(out).map_err(|cause| failed(out, cause))?;
        let cameras = rig.map_or_else(Vec::new, |rig| rig.cameras.clone());
        let channels = tables::channels(cameras.iter().map(|camera| &*camera.name));
        let out = out.to_owned();
        Ok(Self { episode, cameras, channels, frames, images: Vec::new(), out, part })
    }

    /// Adds an image of the episode, in any order.
    ///
    /// # Errors
    /// The file cannot be written, or the rig does not have the camera.
    pub fn image(&mut self, image: &NuscenesImage<'_>) -> Result<(), ExportError> {
        let NuscenesImage { camera, time_us, world_from_rig, jpeg } = *image;
        let channel = self.channels.get(camera).ok_or_else(|| {
            let cameras = self.channels.len();
            ExportError::Images(format!("an image of camera {camera} of a rig with {cameras}"))
        })?;
        // The number keeps two images of one time apart.
        let name = format!("{}-{}", tables::timestamp_us(time_us), self.images.len());
        let file = format!("sweeps/{channel}/{name}.jpg");
        self.write(&file, jpeg)?;
        let new = Image { camera, time_us, world_from_rig, file, sample: 0, is_key: false };
        self.images.push(new);
        Ok(())
    }

    /// Writes the tables, and gives the folder its name. The messages of the result are the rows.
    ///
    /// # Errors
    /// A file cannot be written: no folder is left then.
    pub fn finish(mut self) -> Result<Exported, ExportError> {
        let samples = samples(&self.frames);
        self.assign_samples(&samples);
        self.move_key_images()?;
        let mut tables = Tables::new(self.episode);
        tables.scene(&samples);
        tables.sensors(&self.cameras, &self.channels);
        tables.images(&self.images, &self.cameras);
        if self.images.is_empty() {
            tables.poses(&self.frames);
        }
        tables.boxes(self.episode, &samples);
        for (name, rows) in &tables.rows {
            self.write(&format!("{VERSION}/{name}.json"), &serde_json::to_vec(rows)?)?;
        }
        self.write(tables::MAP_FILE, &EMPTY_MASK)?;
        // What is renamed is not in the way of the removal.
        fs::rename(self.part.path(), &self.out).map_err(|cause| failed(&self.out, cause))?;
        let errors_px = self.cameras.iter().map(pinhole_error_px);
        let calibration_error_px = errors_px.fold(0.0, f64::max);
        let messages = tables.rows.values().map(|rows| rows.len() as u64).sum();
        Ok(Exported { messages, calibration_error_px })
    }

    /// Gives each image its nearest sample, and each sample its nearest image of each camera.
    fn assign_samples(&mut self, samples: &[&Frame]) {
        // Images of one time stay in the order in which they came.
        self.images.sort_by_key(|image| image.time_us);
        let mut nearest: BTreeMap<(usize, usize), (u64, usize)> = BTreeMap::new();
        for (index, image) in self.images.iter_mut().enumerate() {
            let after = samples.partition_point(|sample| sample.time_us < image.time_us);
            let around = [after.saturating_sub(1), after.min(samples.len() - 1)];
            let off_us = |sample: usize| samples[sample].time_us.abs_diff(image.time_us);
            image.sample =
                if off_us(around[0]) <= off_us(around[1]) { around[0] } else { around[1] };
            let found = (off_us(image.sample), index);
            let key = nearest.entry((image.sample, image.camera)).or_insert(found);
            *key = found.min(*key);
        }
        for (_, index) in nearest.into_values() {
            self.images[index].is_key = true;
        }
    }

    /// nuScenes has the images of samples in a folder of their own.
    fn move_key_images(&mut self) -> Result<(), ExportError> {
        for index in 0..self.images.len() {
            let Image { file, is_key: true, .. } = &self.images[index] else { continue };
            let new = file.replacen("sweeps", "samples", 1);
            let path = self.part.path().join(&new);
            let renamed =
                make_parent(&path).and_then(|()| fs::rename(self.part.path().join(file), &path));
            renamed.map_err(|cause| failed(&self.out.join(&new), cause))?;
            self.images[index].file = new;
        }
        Ok(())
    }

    fn write(&self, file: &str, data: &[u8]) -> Result<(), ExportError> {
        let path = self.part.path().join(file);
        let written = make_parent(&path).and_then(|()| fs::write(&path, data));
        written.map_err(|cause| failed(&self.out.join(file), cause))
    }
}

/// Writes an episode as tables of nuScenes, without images.
///
/// # Errors
/// The folder exists or cannot be written, or the episode has no frame.
pub fn export_nuscenes(
    episode: &EpisodeFile,
    rig: Option<&Rig>,
    out: &Path,
) -> Result<Exported, ExportError> {
    NuscenesExport::begin(episode, rig, out)?.finish()
}

fn failed(path: &Path, cause: io::Error) -> ExportError {
    ExportError::Io { path: path.to_owned(), cause }
}

/// A folder beside `out`, with the rights of any new one.
fn partial_folder(out: &Path) -> io::Result<TempDir> {
    let name = out.file_name().ok_or_else(|| io::Error::other("the path has no name"))?;
    let mut prefix = name.to_owned();
    prefix.push(".");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(".partial");
    // The default of tempfile is 0700, with which other users could not read the export. The umask
    // still applies.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
    // The parent of a bare name is the empty path, which is no folder that can be opened.
    match out.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => builder.tempdir_in(folder),
        _ => builder.tempdir_in("."),
    }
}

fn make_parent(path: &Path) -> io::Result<()> {
    path.parent().map_or(Ok(()), fs::create_dir_all)
}

/// The first frame, and then the first one after each half second.
fn samples<'a>(frames: &[&'a Frame]) -> Vec<&'a Frame> {
    let mut found: Vec<&Frame> = Vec::new();
    for frame in frames {
        let is_due = found
            .first()
            .is_none_or(|first| frame.time_us - first.time_us >= SAMPLE_US * found.len() as i64);
        if is_due {
            found.push(frame);
        }
    }
    found
}
