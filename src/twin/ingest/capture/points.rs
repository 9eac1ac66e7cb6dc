//! The points of a capture, with which training begins: those of a COLMAP model, and of a PLY file.

use std::io::BufReader;
use std::path::Path;

use super::point::CapturePoint;
use super::{CaptureError, Place, colmap_binary, colmap_text};
use crate::ingest::file::open;
use crate::ingest::ply;

/// Reads the points of a COLMAP model (points3D.bin or points3D.txt, in the folder, sparse/0 or
/// sparse), or of a PLY file with x, y, z and, if it has colours, red, green and blue. `None` if a
/// folder has no points.
///
/// # Errors
/// The error names the file and the line or the byte.
pub fn read_points(source: &Path) -> Result<Option<Vec<CapturePoint>>, CaptureError> {
    if source.is_file() {
        return read_ply(source).map(Some);
    }
    for below in ["", "sparse/0", "sparse", "0"] {
        let file = |extension: &str| source.join(below).join(format!("points3D.{extension}"));
        // COLMAP itself prefers the binary file.
        if let Some(path) = Some(file("bin")).filter(|path| path.is_file()) {
            return colmap_binary::read_points(&path).map(Some);
        }
        if let Some(path) = Some(file("txt")).filter(|path| path.is_file()) {
            return colmap_text::read_points(&path).map(Some);
        }
    }
    Ok(None)
}

fn read_ply(path: &Path) -> Result<Vec<CapturePoint>, CaptureError> {
    let opened = open(path);
    let (file, file_bytes) =
        opened.map_err(|cause| CaptureError::File { path: path.to_owned(), cause })?;
    let points = ply::read_points(BufReader::new(file), file_bytes);
    points.map_err(|error| CaptureError::at(path, Place::File, error.to_string()))
}
