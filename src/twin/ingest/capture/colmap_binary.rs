//! cameras.bin, images.bin and points3D.bin of COLMAP (src/colmap/scene/reconstruction_io.cc),
//! little-endian.

use std::collections::BTreeMap;
use std::path::Path;

use wildcity_scene::geometry::Camera;

use super::colmap_model::{MODELS, pose};
use super::{CaptureError, CapturePoint, Place, PosedImage};
use crate::ingest::file::read_whole;
use crate::limits;

/// Bytes of a point of an image: x, y, and the number of its 3D point.
const POINT_BYTES: u64 = 24;
/// Bytes of a point of an image that a 3D point was made of: the numbers of the image and the
/// point.
const TRACK_BYTES: u64 = 8;

pub(super) fn read(cameras: &Path, images: &Path) -> Result<Vec<PosedImage>, CaptureError> {
    let known = read_cameras(cameras)?;
    read_images(images, cameras, &known)
}

/// The bytes of a file from a place on.
struct Bytes<'a> {
    path: &'a Path,
    bytes: Vec<u8>,
    at: usize,
}

impl<'a> Bytes<'a> {
    fn open(path: &'a Path) -> Result<Self, CaptureError> {
        let bytes = read_whole(path, limits::CAPTURE_BYTES)
            .map_err(|cause| CaptureError::File { path: path.to_owned(), cause })?;
        Ok(Self { path, bytes, at: 0 })
    }

    fn wrong(&self, reason: impl Into<String>) -> CaptureError {
        CaptureError::at(self.path, Place::Byte(self.at), reason)
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], CaptureError> {
        let taken = self
            .bytes
            .get(self.at..)
            .and_then(|rest| rest.first_chunk::<N>())
            .copied()
            .ok_or_else(|| self.ended())?;
        self.at += N;
        Ok(taken)
    }

    fn ended(&self) -> CaptureError {
        self.wrong("the file ends here, within an entry: copy it again")
    }

    fn u64(&mut self) -> Result<u64, CaptureError> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    fn i32(&mut self) -> Result<i32, CaptureError> {
        Ok(i32::from_le_bytes(self.take()?))
    }

    fn f64(&mut self) -> Result<f64, CaptureError> {
        Ok(f64::from_le_bytes(self.take()?))
    }

    fn skip(&mut self, bytes: u64) -> Result<(), CaptureError> {
        // The length comes from the file: a sum that overflows is an end beyond the file, too.
        let end = usize::try_from(bytes).ok().and_then(|bytes| self.at.checked_add(bytes));
        match end.filter(|&end| end <= self.bytes.len()) {
            Some(end) => self.at = end,
            None => return Err(self.ended()),
        }
        Ok(())
    }

    /// A text that ends with a zero byte.
    fn text(&mut self) -> Result<String, CaptureError> {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&byte| byte == 0).ok_or_else(|| self.ended())?;
        let text = String::from_utf8(rest[..length].to_vec())
            .map_err(|_| self.wrong("the name of the image is not UTF-8: rename it"))?;
        self.at += length + 1;
        Ok(text)
    }

    fn check_end(&self) -> Result<(), CaptureError> {
        match self.bytes.len() - self.at {
            0 => Ok(()),
            more => Err(self.wrong(format!(
                "{more} bytes after the last entry: the file is damaged, or of another program; write it again"
            ))),
        }
    }
}

fn read_cameras(path: &Path) -> Result<BTreeMap<i32, Camera>, CaptureError> {
    let mut bytes = Bytes::open(path)?;
    let mut cameras = BTreeMap::new();
    // The count is untrusted, so nothing is allocated for it: a count that is too large ends at
    // `ended`.
    for _ in 0..bytes.u64()? {
        let id = bytes.i32()?;
        let number = bytes.i32()?;
        let size = [bytes.u64()?, bytes.u64()?];
        let Some(model) = MODELS.iter().find(|model| model.id == number) else {
            return Err(bytes.wrong(format!(
                "camera {id}: model {number} is not one of COLMAP's up to version 4: is it a cameras.bin of COLMAP?"
            )));
        };
        model.check_supported().map_err(|reason| bytes.wrong(format!("camera {id}: {reason}")))?;
        // The number of parameters follows from the model and is not in the file.
        let parameters: Result<Vec<f64>, _> = (0..model.parameters).map(|_| bytes.f64()).collect();
        let camera = model
            .camera(size, &parameters?)
            .map_err(|reason| bytes.wrong(format!("camera {id}: {reason}")))?;
        if cameras.insert(id, camera).is_some() {
            return Err(bytes.wrong(format!("camera {id} occurs twice: write the model again")));
        }
    }
    bytes.check_end()?;
    Ok(cameras)
}

fn read_images(
    path: &Path,
    cameras_path: &Path,
    cameras: &BTreeMap<i32, Camera>,
) -> Result<Vec<PosedImage>, CaptureError> {
    let mut bytes = Bytes::open(path)?;
    let mut images = Vec::new();
    for _ in 0..bytes.u64()? {
        let id = bytes.i32()?;
        let q_wxyz = [bytes.f64()?, bytes.f64()?, bytes.f64()?, bytes.f64()?];
        let translation = [bytes.f64()?, bytes.f64()?, bytes.f64()?];
        let camera_id = bytes.i32()?;
        let name = bytes.text()?;
        let world_from_camera = pose(q_wxyz, translation)
            .map_err(|reason| bytes.wrong(format!("image {id}: {reason}")))?;
        let points = bytes.u64()?;
        // Features of an image are not used. Saturated, a count that is too large fails in `skip`.
        bytes.skip(points.saturating_mul(POINT_BYTES))?;
        let Some(camera) = cameras.get(&camera_id) else {
            return Err(bytes.wrong(format!(
                "image {id}: camera {camera_id} is not in {}: both files must be of one model",
                cameras_path.display()
            )));
        };
        images.push(PosedImage { name, camera: *camera, world_from_camera, time_us: None });
    }
    bytes.check_end()?;
    if images.is_empty() {
        return Err(CaptureError::at(
            path,
            Place::File,
            "there is no image in it: give a model with images",
        ));
    }
    Ok(images)
}

/// Reads points3D.bin: points with their colours.
pub(super) fn read_points(path: &Path) -> Result<Vec<CapturePoint>, CaptureError> {
    let mut bytes = Bytes::open(path)?;
    let mut points = Vec::new();
    for _ in 0..bytes.u64()? {
        let id = bytes.u64()?;
        let at = [bytes.f64()?, bytes.f64()?, bytes.f64()?];
        if !at.iter().all(|value| value.is_finite()) {
            return Err(bytes.wrong(format!("point {id} is at {at:?}: write the model again")));
        }
        let rgb8 = bytes.take::<3>()?;
        // Read only to pass over it: the error of reprojection is not used.
        let _error_px = bytes.f64()?;
        let track = bytes.u64()?;
        bytes.skip(track.saturating_mul(TRACK_BYTES))?;
        points.push(CapturePoint { at, rgb8 });
    }
    bytes.check_end()?;
    Ok(points)
}
