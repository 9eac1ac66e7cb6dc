//! transforms.json of nerfstudio and instant-ngp.
//!
//! Poses are `world_from_camera` with OpenGL's camera: x right, y up, z backwards. Intrinsics are
//! of the file or of a frame, which overrides the file's (nerfstudio's data conventions;
//! instant-ngp's docs/nerf_dataset_tips.md).

mod intrinsics;

use std::path::Path;

use glam::{DMat3, DVec3};
use serde::Deserialize;

use wildcity_scene::geometry::Pose;
use wildcity_scene::views::{MOST_STOPS, refused_stops};

use super::{CaptureError, Place, PosedImage, to_rotation};
use crate::ingest::file::read_whole;
use crate::limits;
use intrinsics::{Intrinsics, Wrong};

/// The file. Fields without an effect on cameras and images, such as `aabb_scale` and
/// `ply_file_path`, are not listed.
#[derive(Deserialize)]
struct Transforms {
    frames: Vec<Frame>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    mask_path: Option<String>,
    time_us: Option<i64>,
    exposure_stops: Option<f64>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

/// A frame: its camera and the other data of its image.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameImage {
    /// Its image and camera.
    pub posed: PosedImage,
    /// File of its mask (`mask_path`), if it has one.
    pub mask: Option<String>,
    /// Its exposure (`exposure_stops`) in stops relative to the scene's, if the file has it.
    pub exposure_stops: Option<f64>,
}

/// Reads the file, or the one in a folder.
///
/// # Errors
/// The error names the file, the line or the field, and what to do.
pub fn read(path: &Path) -> Result<Vec<PosedImage>, CaptureError> {
    Ok(read_frames(path)?.into_iter().map(|frame| frame.posed).collect())
}

/// The frames with masks and times.
///
/// # Errors
/// As [`read`].
pub fn read_frames(path: &Path) -> Result<Vec<FrameImage>, CaptureError> {
    let inside = path.join("transforms.json");
    let path = if path.is_dir() { inside.as_path() } else { path };
    let text = read_whole(path, limits::CAPTURE_BYTES)
        .map_err(|cause| CaptureError::File { path: path.to_owned(), cause })?;
    let file: Transforms = serde_json::from_slice(&text).map_err(|error| {
        let reason = format!(
            "{error}; expected {{\"fl_x\", \"cx\", .., \"frames\": [{{\"file_path\", \"transform_matrix\"}}]}}"
        );
        CaptureError::at(path, Place::Line(error.line().max(1)), reason)
    })?;
    if file.frames.is_empty() {
        let place = Place::Field("frames".to_owned());
        return Err(CaptureError::at(path, place, "there is no frame: give a file with frames"));
    }
    let frames = file.frames.into_iter().enumerate();
    let read = |(index, mut frame): (usize, Frame)| {
        let mask = frame.mask_path.take();
        let exposure_stops = frame.exposure_stops;
        if let Some(stops) = refused_stops(exposure_stops) {
            let place = Place::Field(format!("frames[{index}].exposure_stops"));
            let reason = format!("{stops}; give -{MOST_STOPS} to {MOST_STOPS}");
            return Err(CaptureError::at(path, place, reason));
        }
        let posed = posed(path, index, frame, &file.intrinsics)?;
        Ok(FrameImage { posed, mask, exposure_stops })
    };
    frames.map(read).collect()
}

fn posed(
    path: &Path,
    index: usize,
    frame: Frame,
    shared: &Intrinsics,
) -> Result<PosedImage, CaptureError> {
    let at = |field: &str| Place::Field(format!("frames[{index}].{field}"));
    let wrong = |field: &str, reason: String| CaptureError::at(path, at(field), reason);
    let matrix = |reason: &str| wrong("transform_matrix", reason.to_owned());
    let rows = &frame.transform_matrix;
    let is_matrix = (3..=4).contains(&rows.len()) && rows.iter().all(|row| row.len() == 4);
    if !is_matrix {
        return Err(matrix("expected 4 rows of 4 numbers: world_from_camera"));
    }
    let row = |at: usize| DVec3::new(rows[at][0], rows[at][1], rows[at][2]);
    let world_from_opengl = DMat3::from_cols(row(0), row(1), row(2)).transpose();
    let rotation =
        to_rotation(world_from_opengl * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
    let Some(rotation) = rotation else {
        return Err(matrix(
            "the left 3 x 3 numbers are not a rotation: rows must have length 1, at right angles, without a \
             mirror; write the poses without a scale",
        ));
    };
    let q_wxyz = [rotation.w, rotation.x, rotation.y, rotation.z];
    let position = [rows[0][3], rows[1][3], rows[2][3]];
    let world_from_camera =
        Pose::checked(position, q_wxyz).map_err(|cause| matrix(&cause.to_string()))?;
    let camera = shared.overridden_by(frame.intrinsics).camera();
    let camera = camera.map_err(|Wrong { field, reason }| wrong(field, reason))?;
    let time_us = frame.time_us;
    Ok(PosedImage { name: frame.file_path, camera, world_from_camera, time_us })
}
