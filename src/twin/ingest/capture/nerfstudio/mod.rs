//! transforms.json of nerfstudio and instant-ngp.
//!
//! Poses are `world_from_camera` with OpenGL's camera: x right, y up, z backwards. Intrinsics are
//! of the file or of a frame (nerfstudio's data conventions; instant-ngp's
//! docs/nerf_dataset_tips.md). If both have them, they must agree: nerfstudio takes those of the
//! file, instant-ngp those of the frame.

mod intrinsics;

use std::path::Path;

use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::Value;

use wildcity_scene::geometry::Pose;
use wildcity_scene::views::{MOST_STOPS, refused_stops};

use super::{CaptureError, Place, PosedImage, to_rotation};
use crate::ingest::file::read_whole;
use crate::limits;
use intrinsics::{Intrinsics, Wrong};

/// Largest factor of a loss.
const MOST_WEIGHT: f64 = 1e3;

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
    depth_file_path: Option<String>,
    weight: Option<f64>,
    time_us: Option<Value>,
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
    /// File of its depth (`depth_file_path`): a grey PNG of 16 bits in millimetres, 0 where there
    /// is none.
    pub depth: Option<String>,
    /// Factor of its loss (`weight`): 1 without it, and less for images that were not recorded.
    pub weight: Option<f64>,
    /// Its exposure (`exposure_stops`) in stops relative to the scene's, if the file has it.
    pub exposure_stops: Option<f64>,
}

/// What is read of a transforms.json.
#[derive(Clone, Debug, PartialEq)]
pub struct NerfstudioCapture {
    pub frames: Vec<FrameImage>,
    /// Fields that change the images or their times, and are not read.
    pub warnings: Vec<String>,
}

/// Reads the file, or the one in a folder.
///
/// # Errors
/// The error names the file, the line or the field, and what to do.
pub fn read(path: &Path) -> Result<NerfstudioCapture, CaptureError> {
    let inside = path.join("transforms.json");
    // Programs differ in whether they take the folder or the file, so both are accepted.
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
    let warnings = warnings(&file);
    let frames = file.frames.into_iter().enumerate();
    let read = |(index, mut frame): (usize, Frame)| {
        // Taken out of the frame, because `posed` consumes the rest of it.
        let mask = frame.mask_path.take();
        let depth = frame.depth_file_path.take();
        let exposure_stops = frame.exposure_stops;
        let weight = frame.weight;
        if let Some(weight) = weight.filter(|weight| !(0.0..=MOST_WEIGHT).contains(weight)) {
            let place = Place::Field(format!("frames[{index}].weight"));
            let reason = format!("{weight} is no factor of a loss; give 0 to {MOST_WEIGHT}");
            return Err(CaptureError::at(path, place, reason));
        }
        if let Some(stops) = refused_stops(exposure_stops) {
            let place = Place::Field(format!("frames[{index}].exposure_stops"));
            let reason = format!("{stops}; give -{MOST_STOPS} to {MOST_STOPS}");
            return Err(CaptureError::at(path, place, reason));
        }
        let posed = posed(path, index, frame, &file.intrinsics)?;
        Ok(FrameImage { posed, mask, depth, weight, exposure_stops })
    };
    Ok(NerfstudioCapture { frames: frames.map(read).collect::<Result<_, _>>()?, warnings })
}

/// Warns of fields that are not read.
fn warnings(file: &Transforms) -> Vec<String> {
    let has = |field: &str| {
        file.intrinsics.has(field) || file.frames.iter().any(|frame| frame.intrinsics.has(field))
    };
    // With times for all frames, the fields in other units are only a duplicate.
    let is_timed = file.frames.iter().all(|frame| frame.time_us.is_some());
    let mut warnings = Vec::new();
    for field in ["timestamp", "timestamps", "time"] {
        if !is_timed && has(field) {
            warnings.push(format!(
                "{field} is not read, because programs differ in its unit: give time_us, in whole microseconds"
            ));
        }
    }
    if has("fisheye_crop_radius") {
        warnings.push(
            "fisheye_crop_radius is not read: images are used up to their corners; give masks (mask_path)"
                .to_owned(),
        );
    }
    warnings
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
    // nerfstudio writes 4 rows, and some exporters leave out the constant last one.
    let is_matrix = (3..=4).contains(&rows.len()) && rows.iter().all(|row| row.len() == 4);
    if !is_matrix {
        return Err(matrix("expected 4 rows of 4 numbers: world_from_camera"));
    }
    if rows.get(3).is_some_and(|bottom| bottom[..] != [0.0, 0.0, 0.0, 1.0]) {
        return Err(matrix(
            "the last row must be 0, 0, 0, 1: a pose is a rotation and a translation",
        ));
    }
    let row = |at: usize| DVec3::new(rows[at][0], rows[at][1], rows[at][2]);
    // The rows are those of the matrix, and glam takes columns.
    let world_from_opengl = DMat3::from_cols(row(0), row(1), row(2)).transpose();
    // From OpenGL's camera (y up, z backwards) to this program's (y down, z forward): a half turn
    // about x, which negates the second and the third column.
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
    let camera = shared
        .joined_with(frame.intrinsics)
        .and_then(|fields| fields.camera())
        .map_err(|Wrong { field, reason }| wrong(field, reason))?;
    let time_us = match frame.time_us {
        None | Some(Value::Null) => None,
        Some(time) => Some(time.as_i64().ok_or_else(|| {
            wrong("time_us", format!("is {time}; give whole microseconds, without a decimal point"))
        })?),
    };
    Ok(PosedImage { name: frame.file_path, camera, world_from_camera, time_us })
}
