//! Cameras and shutters, to and from AlpaSim's messages.
//!
//! # Principal points
//! AlpaSim counts that of an f-theta camera from the centre of the first pixel, 0.5 less than here. Those of OpenCV's
//! models are counted from the corner, as here.

use wildcity_render::{Readout, RollingShutter, View};
use wildcity_scene::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use wildcity_scene::geometry::camera::{
    FThetaReference, Lens, ShutterDirection, WindshieldReference,
};
use wildcity_scene::geometry::{Camera, CameraError};
use wildcity_scene::rig::RigCamera;

use crate::limits;
use crate::scene::{LocalFrame, SceneError, pose_to_wire};
use crate::wire::sensorsim as wire;

/// Prefix of the logical ids of cameras.
const PREFIX: &str = "camera_";

/// Points at which an approximate inverse polynomial is fitted.
const FIT_POINTS: usize = 256;

/// Why a request for an image was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraSpecError {
    /// A field is missing, or has the wrong number of values.
    #[error("{field}: {must}")]
    Field {
        /// The field.
        field: &'static str,
        /// What must hold.
        must: String,
    },
    /// The numbers are no camera.
    #[error("camera_intrinsics: {0}")]
    Camera(#[from] CameraError),
    /// A pose is missing or invalid.
    #[error(transparent)]
    Pose(#[from] SceneError),
}

/// The logical id of a camera.
pub fn logical_id(name: &str) -> String {
    format!("{PREFIX}{name}")
}

/// The name of a camera from its logical id.
pub fn camera_name(logical_id: &str) -> Option<&str> {
    logical_id.strip_prefix(PREFIX)
}

/// The camera of a request, at the size that the request asks for.
///
/// # Errors
/// Names the first field that cannot be used.
pub fn camera(
    spec: Option<&wire::CameraSpec>,
    size_px: [u32; 2],
) -> Result<Camera, CameraSpecError> {
    let spec = spec.ok_or_else(|| field("camera_intrinsics", "is missing"))?;
    let native_px = [spec.resolution_w, spec.resolution_h];
    let mut intrinsics = match &spec.camera_param {
        None => return Err(field("camera_intrinsics.camera_param", "is missing")),
        Some(wire::CameraParam::Ftheta(lens)) => ftheta(lens)?,
        Some(wire::CameraParam::OpencvPinhole(lens)) => opencv(lens)?,
        Some(wire::CameraParam::OpencvFisheye(lens)) => fisheye(lens)?,
    };
    intrinsics.size_px = native_px;
    intrinsics.windshield = spec.external_distortion.as_ref().map(windshield).transpose()?;
    let camera = intrinsics.camera()?;
    camera.check()?;
    if size_px == native_px {
        return Ok(camera);
    }
    let [width_px, height_px] = size_px.map(u64::from);
    Ok(camera.scaled(width_px, height_px)?)
}

/// The view of a request: the camera where its exposure ends, and its motion with a rolling shutter.
///
/// # Errors
/// Names the first field that cannot be used.
pub fn view(request: &wire::RgbRenderRequest, frame: &LocalFrame) -> Result<View, CameraSpecError> {
    let size_px = [request.resolution_w, request.resolution_h];
    let camera = camera(request.camera_intrinsics.as_ref(), size_px)?;
    if request.frame_start_us > request.frame_end_us {
        let must =
            format!("{} is after frame_end_us {}", request.frame_start_us, request.frame_end_us);
        return Err(CameraSpecError::Field { field: "frame_start_us", must });
    }
    let pair = request.sensor_pose.ok_or(SceneError::Missing { field: "sensor_pose" })?;
    let end = frame.world_from("sensor_pose.end_pose", pair.end_pose.as_ref())?;
    let shutter = request.camera_intrinsics.as_ref().map(wire::CameraSpec::shutter_type);
    let Some(direction) = shutter.and_then(direction) else {
        return Ok(View::new(camera, end));
    };
    let first = frame.world_from("sensor_pose.start_pose", pair.start_pose.as_ref())?;
    // A camera at rest has no motion to render, as in a session, but sees objects move.
    let moves = first != end;
    let rolling_shutter =
        moves.then_some(RollingShutter { direction, world_from_camera_first: first });
    // The poses of a request's objects are those at the start and the end of its own exposure.
    let readout = Some(Readout { direction, share: 1.0 });
    Ok(View { camera, world_from_camera: end, rolling_shutter, readout })
}

/// A camera of a rig, as `get_available_cameras` lists it.
pub fn available(camera: &RigCamera) -> wire::AvailableCamera {
    let RigCamera { name, camera: intrinsics, rig_from_camera, shutter, .. } = camera;
    let shutter_type = match shutter.map(|shutter| shutter.direction) {
        None => wire::ShutterType::Global,
        Some(ShutterDirection::TopToBottom) => wire::ShutterType::RollingTopToBottom,
        Some(ShutterDirection::BottomToTop) => wire::ShutterType::RollingBottomToTop,
        Some(ShutterDirection::LeftToRight) => wire::ShutterType::RollingLeftToRight,
        Some(ShutterDirection::RightToLeft) => wire::ShutterType::RollingRightToLeft,
    };
    let spec = wire::CameraSpec {
        temporary_camera_spec: String::new(),
        camera_param: Some(param(intrinsics)),
        logical_id: logical_id(name),
        resolution_h: intrinsics.height_px,
        resolution_w: intrinsics.width_px,
        shutter_type: shutter_type.into(),
        external_distortion: Intrinsics::of(intrinsics).windshield.map(windshield_to_wire),
    };
    wire::AvailableCamera {
        intrinsics: Some(spec),
        // Called `rig_to_camera` there, and rig_from_camera by its value: the runtime multiplies it to the
        // ego's pose from the right.
        rig_to_camera: Some(pose_to_wire(rig_from_camera)),
        logical_id: logical_id(name),
    }
}

/// The rig's cameras, then those of a preset with names that the rig does not have.
pub fn with_preset(own: &[RigCamera], preset: Vec<RigCamera>) -> Vec<RigCamera> {
    let is_free = |camera: &RigCamera| own.iter().all(|other| other.name != camera.name);
    own.iter().cloned().chain(preset.into_iter().filter(is_free)).collect()
}

/// The quality of a JPEG: the request's percentage, or the default for 0.
pub fn jpeg_quality(image_quality: f32) -> u8 {
    match image_quality {
        quality if quality >= 1.0 => quality.round().min(100.0) as u8,
        _ => limits::JPEG_QUALITY,
    }
}

fn ftheta(lens: &wire::FthetaCameraParam) -> Result<Intrinsics, CameraSpecError> {
    let reference = match lens.reference_poly() {
        wire::PolynomialType::PixeldistToAngle => FThetaReference::PixelToAngle,
        wire::PolynomialType::AngleToPixeldist => FThetaReference::AngleToPixel,
        wire::PolynomialType::Unknown if lens.angle_to_pixeldist_poly.is_empty() => {
            FThetaReference::PixelToAngle
        }
        wire::PolynomialType::Unknown => FThetaReference::AngleToPixel,
    };
    let polynomial = match reference {
        FThetaReference::AngleToPixel => &lens.angle_to_pixeldist_poly,
        FThetaReference::PixelToAngle => &lens.pixeldist_to_angle_poly,
    };
    // Linear terms that are absent or all zero are those of a lens without them.
    let linear_cde = match lens.linear_cde {
        Some(wire::LinearCde { linear_c, linear_d, linear_e })
            if [linear_c, linear_d, linear_e] != [0.0; 3] =>
        {
            [linear_c, linear_d, linear_e]
        }
        _ => [1.0, 0.0, 0.0],
    };
    let lens_fields = LensFields::Ftheta {
        reference,
        polynomial: padded("ftheta_param polynomial", polynomial)?,
        linear_cde,
        max_angle: lens.max_angle,
    };
    Ok(Intrinsics {
        size_px: [0, 0],
        focal_px: [None, None],
        center_px: [lens.principal_point_x + 0.5, lens.principal_point_y + 0.5],
        lens: Some(lens_fields),
        windshield: None,
        native_size_px: None,
    })
}

fn opencv(lens: &wire::OpenCvPinholeCameraParam) -> Result<Intrinsics, CameraSpecError> {
    let k = padded("opencv_pinhole_param.radial_coeffs", &lens.radial_coeffs)?;
    let p = padded("opencv_pinhole_param.tangential_coeffs", &lens.tangential_coeffs)?;
    let s = padded("opencv_pinhole_param.thin_prism_coeffs", &lens.thin_prism_coeffs)?;
    Ok(Intrinsics {
        size_px: [0, 0],
        focal_px: [Some(lens.focal_length_x), Some(lens.focal_length_y)],
        center_px: [lens.principal_point_x, lens.principal_point_y],
        lens: Some(LensFields::Opencv { k, p, s }),
        windshield: None,
        native_size_px: None,
    })
}

fn fisheye(lens: &wire::OpenCvFisheyeCameraParam) -> Result<Intrinsics, CameraSpecError> {
    let k = padded("opencv_fisheye_param.radial_coeffs", &lens.radial_coeffs)?;
    let max_angle = Some(lens.max_angle).filter(|&angle| angle != 0.0);
    Ok(Intrinsics {
        size_px: [0, 0],
        focal_px: [Some(lens.focal_length_x), Some(lens.focal_length_y)],
        center_px: [lens.principal_point_x, lens.principal_point_y],
        lens: Some(LensFields::Fisheye { k, max_angle }),
        windshield: None,
        native_size_px: None,
    })
}

fn windshield(distortion: &wire::ExternalDistortion) -> Result<WindshieldFields, CameraSpecError> {
    let wire::ExternalDistortion::BivariateWindshield(model) = distortion;
    let fields = match model.reference_poly() {
        wire::ReferencePolynomial::Forward => WindshieldFields {
            reference: WindshieldReference::Forward,
            horizontal: model.horizontal_poly.clone(),
            vertical: model.vertical_poly.clone(),
        },
        wire::ReferencePolynomial::Backward => WindshieldFields {
            reference: WindshieldReference::Backward,
            horizontal: model.horizontal_poly_inverse.clone(),
            vertical: model.vertical_poly_inverse.clone(),
        },
    };
    Ok(fields)
}

fn windshield_to_wire(fields: WindshieldFields) -> wire::ExternalDistortion {
    let WindshieldFields { reference, horizontal, vertical } = fields;
    let model = match reference {
        WindshieldReference::Forward => wire::BivariateWindshieldModelParameters {
            reference_poly: wire::ReferencePolynomial::Forward.into(),
            horizontal_poly: horizontal,
            vertical_poly: vertical,
            ..Default::default()
        },
        WindshieldReference::Backward => wire::BivariateWindshieldModelParameters {
            reference_poly: wire::ReferencePolynomial::Backward.into(),
            horizontal_poly_inverse: horizontal,
            vertical_poly_inverse: vertical,
            ..Default::default()
        },
    };
    wire::ExternalDistortion::BivariateWindshield(model)
}

fn param(camera: &Camera) -> wire::CameraParam {
    let pinhole = camera.pinhole;
    match &camera.lens {
        Lens::Pinhole => wire::CameraParam::OpencvPinhole(wire::OpenCvPinholeCameraParam {
            principal_point_x: pinhole.cx,
            principal_point_y: pinhole.cy,
            focal_length_x: pinhole.fx,
            focal_length_y: pinhole.fy,
            radial_coeffs: vec![0.0; 6],
            tangential_coeffs: vec![0.0; 2],
            thin_prism_coeffs: vec![0.0; 4],
        }),
        Lens::OpenCv(lens) => wire::CameraParam::OpencvPinhole(wire::OpenCvPinholeCameraParam {
            principal_point_x: pinhole.cx,
            principal_point_y: pinhole.cy,
            focal_length_x: pinhole.fx,
            focal_length_y: pinhole.fy,
            radial_coeffs: lens.k().to_vec(),
            tangential_coeffs: lens.p().to_vec(),
            thin_prism_coeffs: lens.s().to_vec(),
        }),
        Lens::Fisheye(lens) => wire::CameraParam::OpencvFisheye(wire::OpenCvFisheyeCameraParam {
            principal_point_x: pinhole.cx,
            principal_point_y: pinhole.cy,
            focal_length_x: pinhole.fx,
            focal_length_y: pinhole.fy,
            radial_coeffs: lens.k().to_vec(),
            max_angle: lens.max_angle_rad().unwrap_or_else(|| lens.limit_rad()),
        }),
        Lens::FTheta(lens) => {
            let end_rad = lens.limit_rad();
            let end_px = lens.radius_px(end_rad);
            let [linear_c, linear_d, linear_e] = lens.linear_cde();
            // AlpaSim's rectifier and scorers read only the polynomial from angles, whichever is exact.
            let (reference, forward, backward) = match lens.reference() {
                FThetaReference::AngleToPixel => (
                    wire::PolynomialType::AngleToPixeldist,
                    lens.polynomial(),
                    fitted(end_px, &|px| lens.angle_rad(px)),
                ),
                FThetaReference::PixelToAngle => (
                    wire::PolynomialType::PixeldistToAngle,
                    fitted(end_rad, &|rad| lens.radius_px(rad)),
                    lens.polynomial(),
                ),
            };
            wire::CameraParam::Ftheta(wire::FthetaCameraParam {
                principal_point_x: pinhole.cx - 0.5,
                principal_point_y: pinhole.cy - 0.5,
                reference_poly: reference.into(),
                pixeldist_to_angle_poly: backward.to_vec(),
                angle_to_pixeldist_poly: forward.to_vec(),
                max_angle: lens.max_angle_rad(),
                linear_cde: Some(wire::LinearCde { linear_c, linear_d, linear_e }),
            })
        }
    }
}

/// Coefficients of powers 0 to 5 of the polynomial through 0 that is nearest to `of` on [0, `end`], by least
/// squares. The variable is scaled to [0, 1], so that the normal equations are well-conditioned enough.
fn fitted(end: f64, of: &dyn Fn(f64) -> f64) -> [f64; 6] {
    const TERMS: usize = 5;
    let mut normal = [[0.0; TERMS + 1]; TERMS];
    for point in 1..=FIT_POINTS {
        let t = point as f64 / FIT_POINTS as f64;
        let value = of(t * end);
        let powers: [f64; TERMS] = std::array::from_fn(|k| t.powi(k as i32 + 1));
        for (row, &power) in normal.iter_mut().zip(&powers) {
            for (entry, &other) in row.iter_mut().zip(&powers) {
                *entry += power * other;
            }
            row[TERMS] += power * value;
        }
    }
    let solution = solved(normal);
    let mut coefficients = [0.0; 6];
    for (power, value) in (1..).zip(solution) {
        coefficients[power] = value / end.powi(power as i32);
    }
    coefficients
}

/// Solves five linear equations by elimination with pivots; each row is followed by its right side.
fn solved(mut rows: [[f64; 6]; 5]) -> [f64; 5] {
    for column in 0..5 {
        let pivot = (column..5)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))
            .unwrap_or(column);
        rows.swap(column, pivot);
        let pivot_row = rows[column];
        for row in rows.iter_mut().skip(column + 1) {
            let factor = row[column] / pivot_row[column];
            for (entry, &other) in row.iter_mut().zip(&pivot_row) {
                *entry -= factor * other;
            }
        }
    }
    let mut solution = [0.0; 5];
    for column in (0..5).rev() {
        let known: f64 = (column + 1..5).map(|k| rows[column][k] * solution[k]).sum();
        solution[column] = (rows[column][5] - known) / rows[column][column];
    }
    solution
}

/// The direction of a rolling shutter; `None` for a global one.
fn direction(shutter: wire::ShutterType) -> Option<ShutterDirection> {
    match shutter {
        wire::ShutterType::Unknown | wire::ShutterType::Global => None,
        wire::ShutterType::RollingTopToBottom => Some(ShutterDirection::TopToBottom),
        wire::ShutterType::RollingLeftToRight => Some(ShutterDirection::LeftToRight),
        wire::ShutterType::RollingBottomToTop => Some(ShutterDirection::BottomToTop),
        wire::ShutterType::RollingRightToLeft => Some(ShutterDirection::RightToLeft),
    }
}

/// Coefficients, with zeros for those that were not sent.
fn padded<const N: usize>(
    name: &'static str,
    coefficients: &[f64],
) -> Result<[f64; N], CameraSpecError> {
    let beyond = coefficients.iter().skip(N).any(|&c| c != 0.0);
    if beyond {
        let must = format!("has {} coefficients; at most {N} are accepted", coefficients.len());
        return Err(CameraSpecError::Field { field: name, must });
    }
    let mut filled = [0.0; N];
    for (to, &from) in filled.iter_mut().zip(coefficients) {
        *to = from;
    }
    Ok(filled)
}

fn field(field: &'static str, must: &str) -> CameraSpecError {
    CameraSpecError::Field { field, must: must.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::Rig;

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

    /// The polynomial that the reference does not give is its inverse to a tenth of a pixel.
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
                polynomial.iter().rev().fold(0.0, |sum, coefficient| sum * x + coefficient)
            };
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
        let many = |spec: &mut wire::CameraSpec| {
            if let Some(wire::CameraParam::Ftheta(lens)) = &mut spec.camera_param {
                lens.angle_to_pixeldist_poly = vec![1.0; 7];
            }
        };
        assert!(refused(&many, [8, 8]).contains("7 coefficients; at most 6"));
        assert!(camera(None, [8, 8]).unwrap_err().to_string().contains("is missing"));
    }
}
