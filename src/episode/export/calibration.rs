//! Lenses as Foxglove's calibrations describe them, and the error of such a description.
//!
//! Foxglove supports only OpenCV's models. Any other lens is approximated by the nearest one:
//! f-theta gets OpenCV's fisheye with the focal length and the four coefficients that fit best.
//! Windshields and thin prisms are left out. The lens itself is in `/wildcity/episode`.

use glam::{DMat4, DVec2, DVec3, DVec4};

use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{FTheta, Lens};
use wildcity_scene::rig::RigCamera;

use super::convert::{camera_frame, timestamp};
use super::messages as foxglove;

/// Places of an image, along each side, where a calibration is compared with the lens.
// Odd, so that the middle of the image is a place too; 33 x 33 = 1,089 places.
const GRID: u32 = 33;

/// Angles at which an f-theta lens is fitted.
// 40 for each of the five unknowns: the sums of the fit are then close to integrals over the angle.
const FITTED_ANGLES: u32 = 200;

pub(super) struct Calibration {
    pub(super) message: foxglove::CameraCalibration,
    /// How far it is off the lens at most, in pixels, within the field of the lens.
    pub(super) error_px: f64,
}

/// A lens as OpenCV has it.
#[derive(Clone, Copy)]
struct Nearest {
    model: Model,
    focal_px: DVec2,
}

/// OpenCV's models of a lens.
#[derive(Clone, Copy)]
enum Model {
    Pinhole,
    /// k1 to k6, p1 and p2.
    Rational([f64; 6], [f64; 2]),
    /// Coefficients k1 to k4 of `cv::fisheye`.
    Fisheye([f64; 4]),
}

impl Calibration {
    pub(super) fn new(index: usize, camera: &RigCamera, time_us: i64) -> Self {
        let camera = &camera.camera;
        let nearest = Nearest::to(camera);
        let (name, d) = nearest.model.in_foxglove();
        let DVec2 { x: fx, y: fy } = nearest.focal_px;
        // Foxglove and OpenCV count pixels from the middle of the first one, this project from its
        // corner.
        let cx = camera.pinhole.cx - 0.5;
        let cy = camera.pinhole.cy - 0.5;
        let message = foxglove::CameraCalibration {
            timestamp: Some(timestamp(time_us)),
            width: camera.width_px,
            height: camera.height_px,
            distortion_model: name.to_owned(),
            d,
            // Row by row: K has the intrinsics, R is the identity, since the images are not
            // rectified, and P is K with a column of zeros.
            k: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            frame_id: camera_frame(index),
        };
        Self { message, error_px: nearest.error_px(camera) }
    }
}

/// How far a pinhole is off a camera's lens at most, in pixels.
pub(super) fn pinhole_error_px(camera: &RigCamera) -> f64 {
    let camera = &camera.camera;
    let focal_px = DVec2::new(camera.pinhole.fx, camera.pinhole.fy);
    Nearest { model: Model::Pinhole, focal_px }.error_px(camera)
}

impl Nearest {
    fn to(camera: &Camera) -> Self {
        let focal_px = DVec2::new(camera.pinhole.fx, camera.pinhole.fy);
        let model = match &camera.lens {
            Lens::Pinhole => Model::Pinhole,
            Lens::OpenCv(lens) => Model::Rational(lens.k(), lens.p()),
            Lens::Fisheye(lens) => Model::Fisheye(lens.k()),
            Lens::FTheta(lens) => {
                // Outside of the image there is no pixel, and beyond the limit the lens has no ray.
                // Neither may have an influence on the fit.
                return Self::fitted(lens, camera.corner_rad().min(lens.limit_rad()));
            }
        };
        Self { model, focal_px }
    }

    /// OpenCV's fisheye `r(θ) = f (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹)` that is nearest to an
    /// f-theta lens up to an angle, by least squares. Angles are in units of the largest, so that
    /// all powers are at most 1.
    fn fitted(lens: &FTheta, most_rad: f64) -> Self {
        // With s = θ / θmax and p = (s³, s⁵, s⁷, s⁹), the sum of (r - a s - b·p)² is least where
        // Σs² a + m·b = Σ s r and m a + N b = Σ r p, with m = Σ s p and N = Σ p pᵀ.
        // The normal equations of the linear coefficient, and of the four others.
        let mut linear = 0.0;
        let mut linear_right = 0.0;
        let [mut mixed, mut right] = [DVec4::ZERO; 2];
        let mut normal = DMat4::ZERO;
        for k in 1..=FITTED_ANGLES {
            let share = f64::from(k) / f64::from(FITTED_ANGLES);
            let radius_px = lens.radius_px(share * most_rad);
            let powers = DVec4::from_array([3, 5, 7, 9].map(|power| share.powi(power)));
            linear += share * share;
            linear_right += share * radius_px;
            mixed += share * powers;
            right += radius_px * powers;
            normal +=
                DMat4::from_cols_array_2d(&powers.to_array().map(|x| (x * powers).to_array()));
        }
        // glam has no 5 x 5 matrix. b = N⁻¹ (Σ r p - a m) from the second equation, put into the
        // first, gives `first`, which is a.
        let inverse = normal.inverse();
        let first =
            (linear_right - mixed.dot(inverse * right)) / (linear - mixed.dot(inverse * mixed));
        // The focal length stands outside of the parentheses of the model, so that b is divided by
        // a.
        let others = inverse * (right - first * mixed) / first;
        let [k1, k2, k3, k4] = others.to_array();
        // From s back to θ: the coefficient of θ³ is divided by θmax², and so on.
        let k = [(k1, 2), (k2, 4), (k3, 6), (k4, 8)].map(|(k, power)| k / most_rad.powi(power));
        let focal_px = first / most_rad;
        // The linear terms of an f-theta lens scale x by c, as a second focal length does. The
        // shear of d and e has no counterpart.
        let wider = lens.linear_cde()[0];
        Self { model: Model::Fisheye(k), focal_px: DVec2::new(wider * focal_px, focal_px) }
    }

    /// How far it is off a camera at most, over places all over its image.
    fn error_px(&self, camera: &Camera) -> f64 {
        let center_px = DVec2::new(camera.pinhole.cx, camera.pinhole.cy);
        let share = |k: u32| f64::from(k) / f64::from(GRID - 1);
        let places = (0..GRID * GRID).map(|k| {
            let share = DVec2::new(share(k % GRID), share(k / GRID));
            share * camera.size_px()
        });
        // A place from which no ray leaves the lens is not compared.
        let off_px = places.filter_map(|at_px| {
            let direction = camera.unproject(at_px)?;
            let projected_px = center_px + self.focal_px * self.model.plane(direction);
            Some(projected_px.distance(at_px))
        });
        // NaN, the result of a failed fit, must not count as a small error.
        off_px.fold(0.0, |most: f64, off| if off <= most { most } else { off.min(f64::INFINITY) })
    }
}

impl Model {
    /// Its name in Foxglove, and its coefficients in that order.
    fn in_foxglove(self) -> (&'static str, Vec<f64>) {
        match self {
            // The name of ROS for a lens with five coefficients. All of them are 0 in a pinhole.
            Self::Pinhole => ("plumb_bob", vec![0.0; 5]),
            Self::Rational([k1, k2, k3, k4, k5, k6], [p1, p2]) => {
                // The order of OpenCV puts the tangential p1 and p2 between k2 and k3.
                ("rational_polynomial", vec![k1, k2, p1, p2, k3, k4, k5, k6])
            }
            Self::Fisheye(k) => ("kannala_brandt", k.to_vec()),
        }
    }

    /// Where a direction lands on the plane at distance 1.
    fn plane(self, direction: DVec3) -> DVec2 {
        // At 90° and more off the axis the slope is infinite or points the other way. Only the
        // fisheye is defined there, and it does not use the slope.
        let slope = direction.truncate() / direction.z;
        match self {
            Self::Pinhole => slope,
            Self::Rational([k1, k2, k3, k4, k5, k6], [p1, p2]) => {
                let r2 = slope.length_squared();
                let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                let DVec2 { x, y } = slope;
                // Tangential distortion, of a lens that is tilted against the sensor.
                let aside = DVec2::new(
                    2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                );
                slope * (above / below) + aside
            }
            Self::Fisheye([k1, k2, k3, k4]) => {
                let off_axis = direction.truncate();
                let angle = off_axis.length().atan2(direction.z);
                let a2 = angle * angle;
                let radius = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
                // On the axis there is no direction aside; the radius is 0 there anyway.
                off_axis.normalize_or_zero() * radius
            }
        }
    }
}
