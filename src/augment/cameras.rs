//! Cameras of a data set: pinholes in place of lenses, and the camera models of transforms.json and
//! COLMAP.

use glam::DVec2;

use wildcity_scene::geometry::camera::{Lens, Pinhole};
use wildcity_scene::geometry::{Camera, Pose};

use crate::AugmentError;
use crate::limits::MOST_SLOPE;

/// Steps in which the edge of a lens' field is searched.
const STEPS: u32 = 256;

/// A camera of the rig, as a data set has it.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingCamera {
    /// Name within the rig.
    pub name: String,
    /// Size, intrinsics and lens of its images.
    pub camera: Camera,
    /// Pose of the camera on the rig.
    pub rig_from_camera: Pose,
}

/// A camera model that both transforms.json and COLMAP support.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraModel {
    /// fx, fy, cx, cy.
    Pinhole,
    /// A pinhole with k1, k2, p1, p2.
    OpenCv,
    /// fx, fy, cx, cy and k1 to k4 of the angle.
    OpenCvFisheye,
}

impl CameraModel {
    /// The model that all cameras have. Pinholes among OpenCV lenses have coefficients of 0.
    ///
    /// # Errors
    /// A lens has no such model, or the models differ.
    pub fn from_cameras(cameras: &[TrainingCamera]) -> Result<Self, AugmentError> {
        let mut common: Option<Self> = None;
        for TrainingCamera { name, camera, .. } in cameras {
            let own = Self::from_camera(name, camera)?;
            // One file has one model: two models that OpenCV's covers become that one.
            common = Some(match (common, own) {
                (None, own) => own,
                (Some(common), own) if common == own => own,
                (Some(Self::Pinhole | Self::OpenCv), Self::Pinhole | Self::OpenCv) => Self::OpenCv,
                (Some(common), own) => {
                    let camera = name.clone();
                    let model = own.name();
                    let other = common.name();
                    return Err(AugmentError::MixedLenses { camera, model, other });
                }
            });
        }
        Ok(common.unwrap_or(Self::Pinhole))
    }

    fn from_camera(name: &str, camera: &Camera) -> Result<Self, AugmentError> {
        let refused = |lens| Err(AugmentError::Lens { camera: name.to_owned(), lens });
        if camera.windshield.is_some() {
            return refused("a windshield");
        }
        match &camera.lens {
            Lens::Pinhole => Ok(Self::Pinhole),
            Lens::OpenCv(lens) => {
                // The rational denominator and the thin prism have no place in the format.
                let more = lens.k()[2..].iter().chain(&lens.s()).any(|value| *value != 0.0);
                if more {
                    return refused("OpenCV coefficients beyond k1, k2, p1 and p2");
                }
                Ok(Self::OpenCv)
            }
            Lens::Fisheye(_) => Ok(Self::OpenCvFisheye),
            Lens::FTheta(_) => refused("an f-theta lens"),
        }
    }

    /// Its name in both formats.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pinhole => "PINHOLE",
            Self::OpenCv => "OPENCV",
            Self::OpenCvFisheye => "OPENCV_FISHEYE",
        }
    }

    /// Its number in COLMAP's binary files (`src/colmap/sensor/models.h`).
    pub(crate) fn colmap_id(self) -> i32 {
        match self {
            Self::Pinhole => 1,
            Self::OpenCv => 4,
            Self::OpenCvFisheye => 5,
        }
    }

    /// The coefficients after fx, fy, cx, cy, by their names in transforms.json, in COLMAP's order.
    pub(crate) fn coefficients(self, camera: &Camera) -> Vec<(&'static str, f64)> {
        match (self, &camera.lens) {
            (Self::Pinhole, _) => Vec::new(),
            (Self::OpenCv, Lens::OpenCv(lens)) => {
                let [k1, k2, ..] = lens.k();
                let [p1, p2] = lens.p();
                vec![("k1", k1), ("k2", k2), ("p1", p1), ("p2", p2)]
            }
            (Self::OpenCvFisheye, Lens::Fisheye(lens)) => {
                ["k1", "k2", "k3", "k4"].into_iter().zip(lens.k()).collect()
            }
            // A pinhole among lenses. The lists' lengths are fixed: COLMAP counts on them.
            (Self::OpenCv, _) => ["k1", "k2", "p1", "p2"].map(|name| (name, 0.0)).to_vec(),
            (Self::OpenCvFisheye, _) => ["k1", "k2", "k3", "k4"].map(|name| (name, 0.0)).to_vec(),
        }
    }
}

/// A pinhole of the field of a lens, with an image of the same size: its sides are where the field
/// of the lens ends on the row and the column of the principal point, but at most 50° off the axis.
/// Pixels need not be square.
///
/// A pinhole without a windshield is returned unchanged.
pub fn without_lens(camera: &Camera) -> Camera {
    if camera.is_pinhole() {
        return *camera;
    }
    let size_px = camera.size_px();
    // A principal point outside of the image has no row or column in it.
    let center_px = DVec2::new(camera.pinhole.cx, camera.pinhole.cy).clamp(DVec2::ZERO, size_px);
    let slopes = |side_px: DVec2| {
        let at_px = |step: u32| side_px.lerp(center_px, f64::from(step) / f64::from(STEPS));
        // From the image's edge inwards: the first pixel within the lens' field is where it ends.
        let ray = (0..STEPS).find_map(|step| camera.unproject(at_px(step)));
        // Behind the camera plane the slope is undefined.
        let ray = ray.filter(|ray| ray.z > 0.0);
        ray.map(|ray| ray.truncate() / ray.z)
    };
    let slope = |side_px: DVec2, axis: usize, sign: f64| {
        // No ray in front of the camera: the field is wider than the largest slope.
        let slope = slopes(side_px).map_or(MOST_SLOPE, |slopes| sign * slopes[axis]);
        slope.clamp(-MOST_SLOPE, MOST_SLOPE)
    };
    let left = slope(DVec2::new(0.0, center_px.y), 0, -1.0);
    let right = slope(DVec2::new(size_px.x, center_px.y), 0, 1.0);
    let up = slope(DVec2::new(center_px.x, 0.0), 1, -1.0);
    let down = slope(DVec2::new(center_px.x, size_px.y), 1, 1.0);
    // Slopes to both sides add up to the width over the focal length.
    let fx = size_px.x / (left + right);
    let fy = size_px.y / (up + down);
    let pinhole = Pinhole { fx, fy, cx: fx * left, cy: fy * up };
    Camera::from_pinhole(camera.width_px, camera.height_px, pinhole)
}

#[cfg(test)]
mod tests {
    use wildcity_scene::geometry::camera::{Fisheye, OpenCv};

    use super::*;

    fn camera(lens: Lens) -> Camera {
        let pinhole = Pinhole { fx: 300.0, fy: 310.0, cx: 210.0, cy: 140.0 };
        Camera { lens, ..Camera::from_pinhole(400, 300, pinhole) }
    }

    fn named(name: &str, lens: Lens) -> TrainingCamera {
        let rig_from_camera = Pose::IDENTITY;
        TrainingCamera { name: name.to_owned(), camera: camera(lens), rig_from_camera }
    }

    fn opencv(k: [f64; 6]) -> Lens {
        Lens::OpenCv(OpenCv::new(k, [0.001, -0.002], [0.0; 4]))
    }

    fn fisheye() -> Lens {
        Lens::Fisheye(Fisheye::new([0.01, 0.0, 0.0, 0.0], None))
    }

    #[test]
    fn a_pinhole_shows_the_field_of_its_lens_up_to_50_degrees() {
        assert_eq!(without_lens(&camera(Lens::Pinhole)), camera(Lens::Pinhole));
        let lens = camera(opencv([-0.1, 0.01, 0.0, 0.0, 0.0, 0.0]));
        let pinhole = without_lens(&lens);
        assert!(pinhole.is_pinhole() && pinhole.check().is_ok());
        // The edges of the image on the row and the column of the principal point.
        for (at_px, axis) in [([0.0, 140.0], 0), ([400.0, 140.0], 0), ([210.0, 300.0], 1)] {
            let edge = lens.unproject(at_px.into()).unwrap();
            let seen_px = pinhole.project(edge).unwrap();
            assert!((seen_px[axis] - at_px[axis]).abs() < 1e-9, "{at_px:?} {seen_px}");
        }
        let mut wide = camera(fisheye());
        // Across, 200/190 rad are 60 degrees, which the limit cuts to 50; down, 0.5 rad are kept.
        wide.pinhole = Pinhole { fx: 190.0, fy: 300.0, cx: 200.0, cy: 150.0 };
        let pinhole = without_lens(&wide).pinhole;
        let across_rad = 2.0 * (200.0 / pinhole.fx).atan();
        assert!((across_rad.to_degrees() - 100.0).abs() < 1e-9, "{across_rad}");
        assert!((150.0 / pinhole.fy).atan() < 0.51, "{pinhole:?}");
    }

    #[test]
    fn a_file_has_one_model_and_others_are_refused_by_name() {
        let model = |cameras: &[TrainingCamera]| CameraModel::from_cameras(cameras);
        let plain = named("front", Lens::Pinhole);
        let bent = named("left", opencv([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]));
        assert_eq!(model(std::slice::from_ref(&plain)).unwrap(), CameraModel::Pinhole);
        assert_eq!(model(&[plain.clone(), bent.clone()]).unwrap(), CameraModel::OpenCv);
        assert_eq!(model(&[named("a", fisheye())]).unwrap(), CameraModel::OpenCvFisheye);
        let said = model(&[bent, named("rear", fisheye())]).unwrap_err().to_string();
        assert!(said.contains("\"rear\" is OPENCV_FISHEYE, and others are OPENCV"), "{said}");
        let said = model(&[named("top", opencv([0.1, 0.0, 0.2, 0.0, 0.0, 0.0]))]).unwrap_err();
        assert!(said.to_string().contains("camera \"top\" has OpenCV coefficients"), "{said}");
    }
}
