//! Cameras and views of requests.

use wildcity_render::{RollingShutter, View};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use wildcity_scene::geometry::camera::{FThetaReference, ShutterDirection, WindshieldReference};

use super::CameraSpecError;
use crate::scene::{LocalFrame, SceneError};
use crate::wire::sensorsim as wire;

/// The camera of a request, at the size that the request asks for.
///
/// # Errors
/// Names the first field that cannot be used.
pub fn camera(
    spec: Option<&wire::CameraSpec>,
    size_px: [u32; 2],
) -> Result<Camera, CameraSpecError> {
    let spec = spec.ok_or_else(|| field("camera_intrinsics", "is missing"))?;
    // The intrinsics are those of the native size. A request may ask for another one, to which the
    // camera is scaled afterwards.
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
    // Before scaling, so that an error names the numbers that the client sent.
    camera.check()?;
    if size_px == native_px {
        return Ok(camera);
    }
    // A size of 0 is refused here, with the name of the side.
    let [width_px, height_px] = size_px.map(u64::from);
    Ok(camera.scaled(width_px, height_px)?)
}

/// The view of a request: the camera where its exposure ends, and its motion with a rolling
/// shutter.
///
/// # Errors
/// Names the first field that cannot be used.
pub fn view(request: &wire::RgbRenderRequest, frame: &LocalFrame) -> Result<View, CameraSpecError> {
    let size_px = [request.resolution_w, request.resolution_h];
    let camera = camera(request.camera_intrinsics.as_ref(), size_px)?;
    // The times themselves are not needed: the poses at both ends are in the request.
    if request.frame_start_us > request.frame_end_us {
        let must =
            format!("{} is after frame_end_us {}", request.frame_start_us, request.frame_end_us);
        return Err(CameraSpecError::Field { field: "frame_start_us", must });
    }
    let pair = request.sensor_pose.ok_or(SceneError::Missing { field: "sensor_pose" })?;
    let end = frame.world_from("sensor_pose.end_pose", pair.end_pose.as_ref())?;
    let shutter = request.camera_intrinsics.as_ref().map(wire::CameraSpec::shutter_type);
    // A global shutter has one pose. The pose at the start is not read, and may be missing.
    let Some(direction) = shutter.and_then(direction) else {
        return Ok(View::new(camera, end));
    };
    let first = frame.world_from("sensor_pose.start_pose", pair.start_pose.as_ref())?;
    // A camera at rest has no motion to render, as in a session, but objects move in its image.
    let moves = first != end;
    let rolling_shutter =
        moves.then_some(RollingShutter { direction, world_from_camera_first: first });
    // A request has the poses of its objects at the start and the end of its own exposure.
    Ok(View { camera, world_from_camera: end, rolling_shutter, readout: Some(direction) })
}

fn ftheta(lens: &wire::FthetaCameraParam) -> Result<Intrinsics, CameraSpecError> {
    let reference = match lens.reference_poly() {
        wire::PolynomialType::PixeldistToAngle => FThetaReference::PixelToAngle,
        wire::PolynomialType::AngleToPixeldist => FThetaReference::AngleToPixel,
        // A client that does not say which polynomial is exact has sent at least one of them.
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
        // From the centre of the first pixel to its corner.
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
    // 0 is what protobuf has for a field that was not sent.
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
    // Zeros beyond the model's length change nothing, so they are accepted. NaN is not 0, and is
    // refused.
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
