//! Lenses, windshields, shutters and exposures, to and from the wire.

use wildcity_protocol::camera as wire;
use wildcity_scene::appearance::{Appearance, AppearanceError, Exposure};
use wildcity_scene::geometry::camera::json::{Intrinsics, LensFields, WindshieldFields};
use wildcity_scene::geometry::camera::{
    Camera, CameraError, FThetaReference, Shutter, ShutterDirection, WindshieldReference,
};

/// A lens from the wire.
pub(super) fn convert_lens(lens: wire::Lens) -> LensFields {
    match lens {
        wire::Lens::Opencv { k, p, s } => LensFields::Opencv { k, p, s },
        wire::Lens::Fisheye { k, max_angle } => LensFields::Fisheye { k, max_angle },
        wire::Lens::Ftheta { reference, polynomial, linear_cde, max_angle } => {
            let reference = match reference {
                wire::FthetaReference::AngleToPixel => FThetaReference::AngleToPixel,
                wire::FthetaReference::PixelToAngle => FThetaReference::PixelToAngle,
            };
            LensFields::Ftheta { reference, polynomial, linear_cde, max_angle }
        }
    }
}

/// A windshield from the wire.
pub(super) fn convert_windshield(windshield: wire::Windshield) -> WindshieldFields {
    let wire::Windshield { reference, horizontal, vertical } = windshield;
    let reference = match reference {
        wire::WindshieldReference::Forward => WindshieldReference::Forward,
        wire::WindshieldReference::Backward => WindshieldReference::Backward,
    };
    WindshieldFields { reference, horizontal, vertical }
}

/// The exposure and the overlay of a camera from the wire; `size_px` is the width and height of its
/// image.
pub(super) fn convert_appearance(
    exposure: Option<wire::Exposure>,
    overlay: Option<&str>,
    size_px: [u32; 2],
) -> Result<Appearance, AppearanceError> {
    let exposure =
        exposure.map(|wire::Exposure { matrix, gain, offset }| Exposure::new(matrix, gain, offset));
    Appearance::new(exposure.transpose()?, overlay, size_px)
}

/// Converts an exposure to the wire.
pub(super) fn exposure_to(Exposure { matrix, offset }: Exposure) -> wire::Exposure {
    // A gain was made a matrix as it was read, so answers always have the matrix.
    wire::Exposure { matrix: Some(matrix), gain: None, offset }
}

/// A shutter from the wire.
pub(super) fn convert_shutter(shutter: wire::Shutter) -> Result<Shutter, CameraError> {
    let wire::Shutter { direction, duration_us } = shutter;
    let direction = match direction {
        wire::ShutterDirection::TopToBottom => ShutterDirection::TopToBottom,
        wire::ShutterDirection::BottomToTop => ShutterDirection::BottomToTop,
        wire::ShutterDirection::LeftToRight => ShutterDirection::LeftToRight,
        wire::ShutterDirection::RightToLeft => ShutterDirection::RightToLeft,
    };
    let shutter = Shutter { direction, duration_us };
    shutter.check().map(|()| shutter)
}

/// Converts the lens and the windshield of a camera to the wire; a pinhole has neither.
pub(super) fn lens_and_windshield_to(
    camera: &Camera,
) -> (Option<wire::Lens>, Option<wire::Windshield>) {
    let Intrinsics { lens, windshield, .. } = Intrinsics::from_camera(camera);
    (lens.map(lens_to), windshield.map(windshield_to))
}

/// Converts a shutter to the wire.
pub(super) fn shutter_to(shutter: Shutter) -> wire::Shutter {
    let Shutter { direction, duration_us } = shutter;
    let direction = match direction {
        ShutterDirection::TopToBottom => wire::ShutterDirection::TopToBottom,
        ShutterDirection::BottomToTop => wire::ShutterDirection::BottomToTop,
        ShutterDirection::LeftToRight => wire::ShutterDirection::LeftToRight,
        ShutterDirection::RightToLeft => wire::ShutterDirection::RightToLeft,
    };
    wire::Shutter { direction, duration_us }
}

fn lens_to(lens: LensFields) -> wire::Lens {
    match lens {
        LensFields::Opencv { k, p, s } => wire::Lens::Opencv { k, p, s },
        LensFields::Fisheye { k, max_angle } => wire::Lens::Fisheye { k, max_angle },
        LensFields::Ftheta { reference, polynomial, linear_cde, max_angle } => {
            let reference = match reference {
                FThetaReference::AngleToPixel => wire::FthetaReference::AngleToPixel,
                FThetaReference::PixelToAngle => wire::FthetaReference::PixelToAngle,
            };
            wire::Lens::Ftheta { reference, polynomial, linear_cde, max_angle }
        }
    }
}

fn windshield_to(windshield: WindshieldFields) -> wire::Windshield {
    let WindshieldFields { reference, horizontal, vertical } = windshield;
    let reference = match reference {
        WindshieldReference::Forward => wire::WindshieldReference::Forward,
        WindshieldReference::Backward => wire::WindshieldReference::Backward,
    };
    wire::Windshield { reference, horizontal, vertical }
}
