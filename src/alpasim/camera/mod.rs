//! Cameras and shutters, to and from AlpaSim's messages.
//!
//! # Principal points
//! AlpaSim measures the principal point of an f-theta camera from the centre of the first pixel, so
//! that its value is 0.5 less than in this project. For OpenCV's models it is measured from the
//! corner, as in this project.

mod listed;
mod polynomial;
mod requested;

use wildcity_scene::geometry::CameraError;
use wildcity_scene::rig::RigCamera;

use crate::limits;
use crate::scene::SceneError;

pub use listed::available;
pub use requested::{camera, view};

/// Prefix of the logical ids of cameras.
const PREFIX: &str = "camera_";

/// Why a request for an image was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraSpecError {
    /// A field is missing, or has the wrong number of values.
    #[error("{field}: {must}")]
    Field { field: &'static str, must: String },
    /// The numbers are no camera.
    #[error("camera_intrinsics: {0}")]
    Camera(CameraError),
    /// A pose is missing or invalid.
    #[error(transparent)]
    Pose(#[from] SceneError),
}

impl From<CameraError> for CameraSpecError {
    fn from(cause: CameraError) -> Self {
        Self::Camera(cause)
    }
}

/// The logical id of a camera.
pub fn logical_id(name: &str) -> String {
    format!("{PREFIX}{name}")
}

/// The name of a camera from its logical id.
pub fn camera_name(logical_id: &str) -> Option<&str> {
    logical_id.strip_prefix(PREFIX)
}

/// The rig's cameras, then those of a preset with names that the rig does not have.
pub fn with_preset(own: &[RigCamera], preset: Vec<RigCamera>) -> Vec<RigCamera> {
    let is_free = |camera: &RigCamera| own.iter().all(|other| other.name != camera.name);
    // The own cameras come first, so that a client that takes the first of a name gets the
    // calibrated one.
    own.iter().cloned().chain(preset.into_iter().filter(is_free)).collect()
}

/// The quality of a JPEG: the request's percentage, or the default for 0.
pub fn jpeg_quality(image_quality: f32) -> u8 {
    match image_quality {
        // From 1 to 100 after `min`, which fits a u8. NaN and negative values take the other arm.
        quality if quality >= 1.0 => quality.round().min(100.0) as u8,
        _ => limits::JPEG_QUALITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::sensorsim as wire;
    use wildcity_scene::Rig;
    use wildcity_scene::geometry::Camera;
    use wildcity_scene::geometry::camera::Lens;

    /// Every preset camera, listed and requested again, is the same camera, also at another size.
    #[test]
    fn cameras_survive_the_wire() {
        for preset in Rig::preset_names() {
            for camera in Rig::preset(preset).unwrap().cameras {
                let listed = available(&camera);
                let spec = listed.intrinsics.as_ref();
                let Camera { width_px, height_px, .. } = camera.camera;
                let same = super::camera(spec, [width_px, height_px]).unwrap();
                let center = same.pinhole;
                // 0.5 is subtracted and added again.
                assert!((center.cx - camera.camera.pinhole.cx).abs() < 1e-9, "{}", camera.name);
                assert_eq!(same.lens, camera.camera.lens, "{}", camera.name);
                assert_eq!(same.windshield, camera.camera.windshield, "{}", camera.name);
                let small = super::camera(spec, [480, 270]).unwrap();
                let expected = camera.camera.scaled(480, 270).unwrap();
                assert!((small.pinhole.cx - expected.pinhole.cx).abs() < 1e-9);
                assert_eq!(small.lens, expected.lens);
            }
        }
    }

    /// The polynomial that the reference does not give is its inverse to 0.3 pixels.
    #[test]
    fn fitted_polynomials_invert_the_reference() {
        for camera in Rig::preset("alpamayo2").unwrap().cameras {
            let Lens::FTheta(lens) = &camera.camera.lens else { panic!("{}", camera.name) };
            let Some(wire::CameraParam::Ftheta(sent)) =
                available(&camera).intrinsics.unwrap().camera_param
            else {
                panic!("{}", camera.name);
            };
            let at = |polynomial: &[f64], x: f64| {
                // Horner's scheme; the coefficients are in order of their powers.
                polynomial.iter().rev().fold(0.0, |sum, coefficient| sum * x + coefficient)
            };
            // From an angle to a radius and back to an angle: the error is taken in pixels, as it
            // would be seen in an image.
            for step in 1..=100 {
                let angle_rad = lens.limit_rad() * f64::from(step) / 100.0;
                let px = at(&sent.angle_to_pixeldist_poly, angle_rad);
                let back_rad = at(&sent.pixeldist_to_angle_poly, px);
                let error_px = (at(&sent.angle_to_pixeldist_poly, back_rad) - px).abs();
                assert!(error_px < 0.3, "{}: {error_px} px at {angle_rad}", camera.name);
            }
        }
    }

    #[test]
    fn bad_cameras_are_refused_by_name() {
        let listed = available(&Rig::preset("alpamayo1").unwrap().cameras[0]);
        let good = listed.intrinsics.unwrap();
        let refused = |change: &dyn Fn(&mut wire::CameraSpec), size: [u32; 2]| {
            let mut spec = good.clone();
            change(&mut spec);
            camera(Some(&spec), size).unwrap_err().to_string()
        };
        assert!(refused(&|spec| spec.camera_param = None, [8, 8]).contains("camera_param"));
        assert!(refused(&|_| (), [0, 8]).contains("width is 0"));
        assert!(refused(&|spec| spec.resolution_h = 0, [8, 8]).contains("height is 0"));
        // Seven coefficients of 1, where the lens has powers 0 to 5. A seventh of 0 would be
        // accepted.
        let many = |spec: &mut wire::CameraSpec| {
            if let Some(wire::CameraParam::Ftheta(lens)) = &mut spec.camera_param {
                lens.angle_to_pixeldist_poly = vec![1.0; 7];
            }
        };
        assert!(refused(&many, [8, 8]).contains("7 coefficients; at most 6"));
        assert!(camera(None, [8, 8]).unwrap_err().to_string().contains("is missing"));
    }
}
