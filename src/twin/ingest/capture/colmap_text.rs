//! cameras.txt, images.txt and points3D.txt of COLMAP.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use wildcity_scene::geometry::Camera;

use super::colmap_model::{MODELS, pose};
use super::{CaptureError, CapturePoint, Place, PosedImage};
use crate::ingest::file::read_whole;
use crate::limits;

pub(super) fn read(cameras: &Path, images: &Path) -> Result<Vec<PosedImage>, CaptureError> {
    let known = read_cameras(cameras)?;
    read_images(images, cameras, &known)
}

fn read_text(path: &Path) -> Result<String, CaptureError> {
    let bytes = read_whole(path, limits::CAPTURE_BYTES)
        .map_err(|cause| CaptureError::File { path: path.to_owned(), cause })?;
    String::from_utf8(bytes).map_err(|error| {
        let byte = error.utf8_error().valid_up_to();
        CaptureError::at(path, Place::Byte(byte), "not UTF-8: is it a text file of COLMAP?")
    })
}

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS..`
fn read_cameras(path: &Path) -> Result<BTreeMap<u64, Camera>, CaptureError> {
    const FORM: &str = "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS..";
    let text = read_text(path)?;
    let mut cameras = BTreeMap::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let wrong = |reason: String| CaptureError::at(path, Place::Line(index + 1), reason);
        let words: Vec<&str> = line.split_whitespace().collect();
        let [id, name, width, height, parameters @ ..] = &words[..] else {
            return Err(wrong(FORM.to_owned()));
        };
        let number = |field: &str, word: &str| number::<u64>(field, word).map_err(wrong);
        let id = number("CAMERA_ID", id)?;
        let size = [number("WIDTH", width)?, number("HEIGHT", height)?];
        let parameters: Result<Vec<f64>, String> =
            parameters.iter().map(|word| self::number("a parameter", word)).collect();
        let parameters = parameters.map_err(wrong)?;
        let Some(model) = MODELS.iter().find(|model| model.name == *name) else {
            return Err(wrong(format!("{name:?} is not a camera model of COLMAP; {FORM}")));
        };
        model.check_supported().map_err(wrong)?;
        if parameters.len() != model.parameters {
            let given = parameters.len();
            let needed = model.parameters;
            return Err(wrong(format!("{given} parameters; {name} has {needed}")));
        }
        let camera = model.camera(size, &parameters).map_err(wrong)?;
        if cameras.insert(id, camera).is_some() {
            return Err(wrong(format!("camera {id} occurs twice: remove one of the two lines")));
        }
    }
    Ok(cameras)
}

/// Reads points3D.txt: `POINT3D_ID X Y Z R G B ERROR TRACK..`
pub(super) fn read_points(path: &Path) -> Result<Vec<CapturePoint>, CaptureError> {
    let text = read_text(path)?;
    let mut points = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let point = point(line);
        points
            .push(point.map_err(|reason| CaptureError::at(path, Place::Line(index + 1), reason))?);
    }
    Ok(points)
}

fn point(line: &str) -> Result<CapturePoint, String> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [_, x, y, z, r, g, b, ..] = &words[..] else {
        return Err("expected POINT3D_ID X Y Z R G B ERROR TRACK..".to_owned());
    };
    let at = [number("X", x)?, number("Y", y)?, number("Z", z)?];
    if !at.iter().all(|value: &f64| value.is_finite()) {
        return Err(format!("the point is at {at:?}: write the model again"));
    }
    Ok(CapturePoint { at, rgb8: [number("R", r)?, number("G", g)?, number("B", b)?] })
}

/// Two lines an image: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, and its points, which are
/// not read.
fn read_images(
    path: &Path,
    cameras_path: &Path,
    cameras: &BTreeMap<u64, Camera>,
) -> Result<Vec<PosedImage>, CaptureError> {
    let text = read_text(path)?;
    let mut images = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((index, line)) = lines.next() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let wrong = |reason: String| CaptureError::at(path, Place::Line(index + 1), reason);
        // The name is the rest of the line and may contain spaces, so only the nine words before it
        // are split.
        let mut rest = line.trim_start();
        let mut words = [""; 9];
        for word in &mut words {
            let end = rest.find(char::is_whitespace).unwrap_or(rest.len());
            (*word, rest) = (&rest[..end], rest[end..].trim_start());
        }
        let name = rest.trim_end();
        if name.is_empty() {
            let reason = "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; each image has two lines, the \
                          second with its points, which may be empty";
            return Err(wrong(reason.to_owned()));
        }
        let mut numbers = [0.0; 7];
        for (value, word) in numbers.iter_mut().zip(&words[1..8]) {
            *value = number("a number of the pose", word).map_err(wrong)?;
        }
        let [qw, qx, qy, qz, tx, ty, tz] = numbers;
        let camera_id: u64 = number("CAMERA_ID", words[8]).map_err(wrong)?;
        let Some(camera) = cameras.get(&camera_id) else {
            return Err(wrong(format!(
                "camera {camera_id} is not in {}: both files must be of one model",
                cameras_path.display()
            )));
        };
        let world_from_camera = pose([qw, qx, qy, qz], [tx, ty, tz]).map_err(wrong)?;
        images.push(PosedImage {
            name: name.to_owned(),
            camera: *camera,
            world_from_camera,
            time_us: None,
        });
        // A writer that leaves the second line out would lose every other image.
        let points = lines.next();
        if let Some((index, points)) = points.filter(|(_, points)| !is_points(points)) {
            let reason = format!(
                "{points:?} is not a line of points (X Y POINT3D_ID, repeated), which must follow each image and may be \
                 empty: write it again with `colmap model_converter`"
            );
            return Err(CaptureError::at(path, Place::Line(index + 1), reason));
        }
    }
    if images.is_empty() {
        return Err(CaptureError::at(
            path,
            Place::File,
            "there is no image in it: give a model with images",
        ));
    }
    Ok(images)
}

/// Whether a line holds points: three numbers each. Files without points have empty lines.
fn is_points(line: &str) -> bool {
    let words: Vec<&str> = line.split_whitespace().collect();
    words.len().is_multiple_of(3) && words.iter().all(|word| word.parse::<f64>().is_ok())
}

fn number<T: FromStr>(field: &str, word: &str) -> Result<T, String> {
    word.parse().map_err(|_| format!("{field} is {word:?}, not a number"))
}
