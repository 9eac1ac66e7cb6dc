//! Camera lists: JSON files of views in the scene's own axes, and perhaps of their images.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DQuat};
use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::limits;
use wildcity_options::strict;
use wildcity_scene::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use wildcity_scene::geometry::{Camera, CameraError, Pose, PoseError};
use wildcity_scene::views::{MOST_STOPS, refused_stops};

use super::file::{self, FileError};
use wildcity_scene::rig::MAX_NAME_BYTES;

/// A camera of a list.
#[derive(Clone, Debug, PartialEq)]
pub struct ListedCamera {
    /// Its name, which becomes part of file names.
    pub name: String,
    pub camera: Camera,
    /// Its pose, in the axes and units of the scene.
    pub world_from_camera: Pose,
    /// The smallest z that it draws, if the list has it, in units of the scene.
    pub near: Option<f64>,
    /// File of the image that it took, if the list has it, relative to the list.
    pub image: Option<String>,
    /// File of the image's mask, likewise.
    pub mask: Option<String>,
    /// Time at which the image was taken, in microseconds, if the list has it.
    pub time_us: Option<i64>,
    /// The exposure of the image in stops relative to the scene's, if the list has it.
    pub exposure_stops: Option<f64>,
}

/// Why a camera list was refused.
#[derive(Debug, thiserror::Error)]
pub enum CamerasError {
    /// It cannot be read, is not a regular file, or is larger than a camera list may be.
    #[error(transparent)]
    File(#[from] FileError),
    /// The JSON is not a camera list.
    #[error(
        "not a camera list: {0}; it is one object, one a line, or a list of objects, with name, width, height, \
         fx, fy, cx, cy, R_world_to_cam (3 rows), and position or position_ply"
    )]
    Json(serde_json::Error),
    /// It has no camera.
    #[error("the camera list is empty")]
    Empty,
    /// A name cannot be part of a file name, or occurs twice.
    #[error("camera {index}: name {name:?} {must}")]
    Name {
        /// Index of the camera, from 0.
        index: usize,
        name: String,
        /// The values that are accepted.
        must: &'static str,
    },
    /// A camera has neither `position` nor `position_ply`, or both.
    #[error("camera {name:?}: give either position or position_ply")]
    Position { name: String },
    /// The matrix is a rotation with a reflection.
    #[error("camera {name:?}: R_world_to_cam is a mirror; flip one of its axes")]
    Mirror { name: String },
    /// The matrix is not a rotation.
    #[error(
        "camera {name:?}: R_world_to_cam is no rotation (rows off by {error:.1e} from orthonormal, \
         determinant {determinant:.3})"
    )]
    Rotation {
        name: String,
        /// Largest absolute entry of R Rᵀ - I.
        error: f64,
        determinant: f64,
    },
    /// The position cannot be used.
    #[error("camera {name:?}: {cause}")]
    Pose { name: String, cause: PoseError },
    /// An exposure that no camera has.
    #[error("camera {name:?}: exposure_stops is {stops}; give -{most} to {most}", most = MOST_STOPS)]
    Stops { name: String, stops: f64 },
    /// A field that only cameras of a rig have.
    #[error(
        "camera {name:?}: a camera in a list has no {field}, because it is at rest; leave {field} out, or mount \
         the camera on a rig"
    )]
    RigCameraField {
        name: String,
        /// `shutter`, `exposure` or `overlay`.
        field: &'static str,
    },
    /// A field in which other programs describe a lens.
    #[error(
        "camera {name:?}: {field} is not a field of a camera list: give \"lens\", such as {{\"model\": \"opencv\", \"k\": \
         [..]}}, or leave {field} out"
    )]
    OtherLens { name: String, field: &'static str },
    /// The size or an intrinsic cannot be used.
    #[error("camera {name:?}: {cause}")]
    Camera { name: String, cause: CameraError },
}

const NAME_RULE: &str = "must be 1 to 64 of A-Z a-z 0-9 . _ -, not starting with .";

/// One entry of the JSON.
#[derive(Deserialize)]
struct Entry {
    name: String,
    width: u64,
    height: u64,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: f64,
    cy: f64,
    #[serde(default, deserialize_with = "strict::deserialize")]
    lens: Option<LensFields>,
    #[serde(default, deserialize_with = "strict::deserialize")]
    windshield: Option<WindshieldFields>,
    shutter: Option<IgnoredAny>,
    exposure: Option<IgnoredAny>,
    overlay: Option<IgnoredAny>,
    near: Option<f64>,
    image: Option<String>,
    mask: Option<String>,
    time_us: Option<i64>,
    exposure_stops: Option<f64>,
    position: Option<[f64; 3]>,
    position_ply: Option<[f64; 3]>,
    #[serde(rename = "R_world_to_cam")]
    rotation: [[f64; 3]; 3],
    #[serde(flatten)]
    others: BTreeMap<String, IgnoredAny>,
}

/// Fields of other programs' cameras that change the picture. Others are ignored.
const REFUSED_FIELDS: [&str; 10] = [
    "camera_model",
    "distortion",
    "distortion_params",
    "is_fisheye",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
];

/// Reads a camera list: one object, one object a line (JSON Lines), or a list of objects.
///
/// A camera's axes are x right, y down, z forward: `p_camera = R_world_to_cam (p - position)`.
///
/// # Errors
/// Names the camera and the field at fault.
pub fn read(path: &Path) -> Result<Vec<ListedCamera>, CamerasError> {
    let text = file::read_whole(path, limits::CAMERA_LIST_BYTES)?;
    // JSON Lines and one object both begin with a brace, and a list with a bracket.
    let one_or_many = match text.trim_ascii_start().first() {
        Some(b'{') => serde_json::Deserializer::from_slice(&text).into_iter().collect(),
        _ => serde_json::from_slice(&text),
    };
    let entries: Vec<Entry> = one_or_many.map_err(CamerasError::Json)?;
    if entries.is_empty() {
        return Err(CamerasError::Empty);
    }
    let mut cameras = Vec::with_capacity(entries.len());
    let mut names = BTreeSet::new();
    for (index, entry) in entries.into_iter().enumerate() {
        // Names become names of files, so that separators, spaces and hidden files are refused.
        let allowed = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        let usable = (1..=MAX_NAME_BYTES).contains(&entry.name.len())
            && entry.name.chars().all(allowed)
            && !entry.name.starts_with('.');
        let twice = !names.insert(entry.name.clone());
        if !usable || twice {
            let must = if twice { "occurs twice" } else { NAME_RULE };
            return Err(CamerasError::Name { index, name: entry.name, must });
        }
        cameras.push(check(entry)?);
    }
    Ok(cameras)
}

fn check(entry: Entry) -> Result<ListedCamera, CamerasError> {
    let Entry { name, width, height, fx, fy, cx, cy, lens, windshield, near, image, mask, .. } =
        entry;
    let time_us = entry.time_us;
    let exposure_stops = entry.exposure_stops;
    if let Some(stops) = refused_stops(exposure_stops) {
        return Err(CamerasError::Stops { name, stops });
    }
    // These describe a motion during the image, a change of its colours, or a part of a vehicle. A
    // camera of a list has none; its exposure is `exposure_stops`.
    let of_rigs = [
        ("shutter", entry.shutter.is_some()),
        ("exposure", entry.exposure.is_some()),
        ("overlay", entry.overlay.is_some()),
    ];
    if let Some((field, _)) = of_rigs.into_iter().find(|(_, given)| *given) {
        return Err(CamerasError::RigCameraField { name, field });
    }
    // To ignore a lens would render another picture without a word.
    if let Some(field) = REFUSED_FIELDS.into_iter().find(|field| entry.others.contains_key(*field))
    {
        return Err(CamerasError::OtherLens { name, field });
    }
    let position = match (entry.position, entry.position_ply) {
        (Some(position), None) | (None, Some(position)) => position,
        _ => return Err(CamerasError::Position { name }),
    };
    // glam's columns are the file's rows, so this matrix is the inverse: the rotation of
    // world_from_camera.
    let rotation = DMat3::from_cols_array_2d(&entry.rotation);
    // R Rᵀ - I is zero for a rotation. 1e-4 leaves room for entries that were rounded.
    let off = (rotation * rotation.transpose() - DMat3::IDENTITY).to_cols_array();
    let error = off.iter().fold(0.0, |most: f64, e| most.max(e.abs()));
    let determinant = rotation.determinant();
    let is_orthonormal = error <= 1e-4;
    if is_orthonormal && determinant < 0.0 {
        return Err(CamerasError::Mirror { name });
    }
    if !is_orthonormal {
        return Err(CamerasError::Rotation { name, error, determinant });
    }
    // Rounded entries make a quaternion of nearly length 1, and poses need exactly 1.
    let rotation = DQuat::from_mat3(&rotation).normalize();
    let q = [rotation.w, rotation.x, rotation.y, rotation.z];
    let pose = Pose::checked(position, q);
    let world_from_camera =
        pose.map_err(|cause| CamerasError::Pose { name: name.clone(), cause })?;
    // A side that does not fit is clamped, and the check below refuses it with its name.
    let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    let intrinsics = Intrinsics {
        size_px,
        focal_px: [fx, fy],
        center_px: [cx, cy],
        lens,
        windshield,
        native_size_px: None,
    };
    let camera = intrinsics
        .camera()
        .and_then(|camera| camera.check().map(|()| camera))
        .map_err(|cause| CamerasError::Camera { name: name.clone(), cause })?;
    Ok(ListedCamera { name, camera, world_from_camera, near, image, mask, time_us, exposure_stops })
}
