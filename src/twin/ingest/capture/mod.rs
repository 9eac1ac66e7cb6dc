//! Camera poses of training images, and the points that training begins with: COLMAP models, as
//! text and binary, and transforms.json of nerfstudio and instant-ngp.
//!
//! The poses are in the axes and unit of the file, which are those of a scene that was trained from
//! it.

mod colmap_binary;
mod colmap_model;
mod colmap_text;
mod error;
mod nerfstudio;
mod point;
mod points;

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat};

use wildcity_scene::align::PosedImage;

pub use error::{CaptureError, Place};
pub use nerfstudio::{FrameImage, NerfstudioCapture, read as read_nerfstudio};
pub use point::CapturePoint;
pub use points::read_points;

/// Reads a COLMAP model: the folder with cameras.bin and images.bin, or with cameras.txt and
/// images.txt; or a folder that has it in sparse/0 or sparse.
///
/// # Errors
/// There is no model, or the error names the file, the line or the byte, and what to do.
pub fn read_colmap(dir: &Path) -> Result<Vec<PosedImage>, CaptureError> {
    let candidates = ["", "sparse/0", "sparse", "0"].map(|below| dir.join(below));
    for dir in &candidates {
        let pair = |extension: &str| -> Option<[PathBuf; 2]> {
            let files = ["cameras", "images"].map(|name| dir.join(format!("{name}.{extension}")));
            files.iter().all(|file| file.is_file()).then_some(files)
        };
        // COLMAP itself prefers the binary files.
        if let Some([cameras, images]) = pair("bin") {
            return colmap_binary::read(&cameras, &images);
        }
        if let Some([cameras, images]) = pair("txt") {
            return colmap_text::read(&cameras, &images);
        }
    }
    Err(CaptureError::NoModel { dir: dir.to_owned() })
}

/// A rotation that may be off by rounding. `None` if it is a reflection or stretched.
fn to_rotation(matrix: DMat3) -> Option<DQuat> {
    let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
    let is_rotation = off.iter().all(|e| e.abs() <= 1e-3) && matrix.determinant() > 0.0;
    is_rotation.then(|| DQuat::from_mat3(&matrix).normalize())
}
