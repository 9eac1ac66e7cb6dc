//! The camera models of COLMAP (src/colmap/sensor/models.h): their numbers, names and parameters.
//!
//! COLMAP counts pixels as we do: the middle of the first pixel is at 0.5.

use glam::DQuat;

use wildcity_scene::geometry::camera::{Fisheye, Lens, OpenCv, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};

/// A camera model of COLMAP, by its names in text and binary files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Model {
    /// Its number in binary files.
    pub(super) id: i32,
    /// Its name in text files.
    pub(super) name: &'static str,
    /// Number of its parameters.
    pub(super) parameters: usize,
}

const fn model(id: i32, name: &'static str, parameters: usize) -> Model {
    Model { id, name, parameters }
}

/// All models of COLMAP 4. Those without parameters here are not supported.
pub(super) const MODELS: [Model; 18] = [
    model(0, "SIMPLE_PINHOLE", 3),
    model(1, "PINHOLE", 4),
    model(2, "SIMPLE_RADIAL", 4),
    model(3, "RADIAL", 5),
    model(4, "OPENCV", 8),
    model(5, "OPENCV_FISHEYE", 8),
    model(6, "FULL_OPENCV", 12),
    model(7, "FOV", 0),
    model(8, "SIMPLE_RADIAL_FISHEYE", 4),
    model(9, "RADIAL_FISHEYE", 5),
    model(10, "THIN_PRISM_FISHEYE", 0),
    model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 0),
    model(12, "SIMPLE_DIVISION", 0),
    model(13, "DIVISION", 0),
    model(14, "SIMPLE_FISHEYE", 3),
    model(15, "FISHEYE", 4),
    model(16, "EUCM", 0),
    model(17, "EQUIRECTANGULAR", 0),
];

impl Model {
    /// # Errors
    /// The model is one of COLMAP's that has no lens here.
    pub(super) fn check_supported(&self) -> Result<(), String> {
        if self.parameters == 0 { Err(self.unsupported()) } else { Ok(()) }
    }

    fn unsupported(&self) -> String {
        format!(
            "the camera model {} is not supported: `colmap image_undistorter` writes images and a model of PINHOLE \
             cameras",
            self.name
        )
    }

    /// The camera with these parameters; `size` is in pixels.
    pub(super) fn camera(&self, size: [u64; 2], parameters: &[f64]) -> Result<Camera, String> {
        let pinhole = |fx, fy, cx, cy| Pinhole { fx, fy, cx, cy };
        let opencv = |k: [f64; 6], p: [f64; 2]| Lens::opencv(OpenCv::new(k, p, [0.0; 4]));
        let fisheye = |k: [f64; 4]| Lens::Fisheye(Fisheye::new(k, None));
        let (pinhole, lens) = match (self.name, parameters) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => (pinhole(f, f, cx, cy), Lens::Pinhole),
            ("PINHOLE", &[fx, fy, cx, cy]) => (pinhole(fx, fy, cx, cy), Lens::Pinhole),
            // Radial terms are the first of OpenCV's, in the same normalized coordinates.
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => {
                (pinhole(f, f, cx, cy), opencv([k, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]))
            }
            ("RADIAL", &[f, cx, cy, k1, k2]) => {
                (pinhole(f, f, cx, cy), opencv([k1, k2, 0.0, 0.0, 0.0, 0.0], [0.0; 2]))
            }
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
                (pinhole(fx, fy, cx, cy), opencv([k1, k2, 0.0, 0.0, 0.0, 0.0], [p1, p2]))
            }
            ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                (pinhole(fx, fy, cx, cy), opencv([k1, k2, k3, k4, k5, k6], [p1, p2]))
            }
            ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
                (pinhole(fx, fy, cx, cy), fisheye([k1, k2, k3, k4]))
            }
            ("SIMPLE_FISHEYE", &[f, cx, cy]) => (pinhole(f, f, cx, cy), fisheye([0.0; 4])),
            ("FISHEYE", &[fx, fy, cx, cy]) => (pinhole(fx, fy, cx, cy), fisheye([0.0; 4])),
            ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => {
                (pinhole(f, f, cx, cy), fisheye([k, 0.0, 0.0, 0.0]))
            }
            ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
                (pinhole(f, f, cx, cy), fisheye([k1, k2, 0.0, 0.0]))
            }
            _ => return Err(self.unsupported()),
        };
        // Clamped, not truncated: 2³² + 640 must not pass as 640. The check below refuses the
        // maximum.
        let side = |px: u64| u32::try_from(px).unwrap_or(u32::MAX);
        let [width_px, height_px] = size.map(side);
        let camera =
            Camera { width_px, height_px, pinhole, lens, windshield: None, native_size_px: None };
        camera.check().map_err(|cause| cause.to_string())?;
        Ok(camera)
    }
}

/// `world_from_camera` of COLMAP's `camera_from_world`: (w, x, y, z) and a translation.
pub(super) fn pose(q_wxyz: [f64; 4], translation: [f64; 3]) -> Result<Pose, String> {
    let [w, x, y, z] = q_wxyz;
    let length = DQuat::from_xyzw(x, y, z, w).length();
    // A length far from 1 is damage and not rounding; half and double are generous bounds.
    let is_usable = (0.5..2.0).contains(&length);
    if !is_usable {
        return Err(format!(
            "the quaternion (w, x, y, z) has length {length:?}; a rotation has 1: write the model again"
        ));
    }
    // COLMAP stores where the world is in the camera, and this program the opposite.
    let camera_from_world = Pose::checked(translation, q_wxyz.map(|q| q / length));
    Ok(camera_from_world.map_err(|cause| cause.to_string())?.inverse())
}
