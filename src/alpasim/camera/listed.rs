//! Cameras of rigs, as `get_available_cameras` lists them.

use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::json::{Intrinsics, WindshieldFields};
use wildcity_scene::geometry::camera::{
    FThetaReference, Lens, ShutterDirection, WindshieldReference,
};
use wildcity_scene::rig::RigCamera;

use super::logical_id;
use super::polynomial::fitted;
use crate::scene::pose_to_wire;
use crate::wire::sensorsim as wire;

/// A camera of a rig, as `get_available_cameras` lists it.
pub fn available(camera: &RigCamera) -> wire::AvailableCamera {
    let RigCamera { name, camera: intrinsics, rig_from_camera, shutter, .. } = camera;
    // A rig has no entry for a global shutter, and AlpaSim has a value for it.
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
        external_distortion: Intrinsics::from_camera(intrinsics).windshield.map(windshield_to_wire),
    };
    wire::AvailableCamera {
        intrinsics: Some(spec),
        // AlpaSim calls it `rig_to_camera`, but its value is rig_from_camera: the runtime
        // multiplies the ego's pose with it from the right.
        rig_to_camera: Some(pose_to_wire(rig_from_camera)),
        logical_id: logical_id(name),
    }
}

fn param(camera: &Camera) -> wire::CameraParam {
    let pinhole = camera.pinhole;
    match &camera.lens {
        Lens::Pinhole => wire::CameraParam::OpencvPinhole(wire::OpenCvPinholeCameraParam {
            principal_point_x: pinhole.cx,
            principal_point_y: pinhole.cy,
            focal_length_x: pinhole.fx,
            focal_length_y: pinhole.fy,
            // A pinhole is OpenCV's model without distortion. The lists have their full lengths, as
            // those of a lens with distortion.
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
            // The field is required: without a given angle, it is the one up to which the
            // polynomial rises.
            max_angle: lens.max_angle_rad().unwrap_or_else(|| lens.limit_rad()),
        }),
        Lens::FTheta(lens) => {
            // The fit covers what the lens can see: angles to `end_rad`, which are radii to
            // `end_px`.
            let end_rad = lens.limit_rad();
            let end_px = lens.radius_px(end_rad);
            let [linear_c, linear_d, linear_e] = lens.linear_cde();
            // AlpaSim's rectifier and scorers read only the polynomial from angles, whichever is
            // exact.
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
                // AlpaSim measures from the centre of the first pixel.
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

fn windshield_to_wire(fields: WindshieldFields) -> wire::ExternalDistortion {
    let WindshieldFields { reference, horizontal, vertical } = fields;
    let model = match reference {
        // Only the polynomials of the reference direction are sent; those of the other one stay
        // empty.
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
