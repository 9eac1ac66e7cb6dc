//! Rigs of requests.

use crate::fault::Fault;
use wildcity_protocol::message;
use wildcity_scene::appearance::AppearanceError;
use wildcity_scene::geometry::camera::json::Intrinsics;
use wildcity_scene::rig::{Rig, RigCamera, RigError, check_overlays};

use super::camera::{convert_appearance, convert_lens, convert_shutter, convert_windshield};
use super::field::{check_name, convert_pose};

/// A rig from the wire, checked.
pub(super) fn convert_rig(rig: message::Rig) -> Result<Rig, Fault> {
    // Reads no camera of a rig that has too many.
    let count = rig.cameras.len();
    if count > Rig::MAX_CAMERAS {
        let cause = RigError::Count { rig: rig.name, count, limit: Rig::MAX_CAMERAS };
        return Err(Fault::Rig { field: "rig.cameras".to_owned(), cause });
    }
    let fault = |field: String| move |cause| Fault::Rig { field, cause };
    let mut cameras: Vec<RigCamera> = Vec::new();
    for (index, camera) in rig.cameras.into_iter().enumerate() {
        let field = format!("rig.cameras[{index}]");
        let camera = convert_rig_camera(&field, camera)?;
        if cameras.iter().any(|other| other.name == camera.name) {
            let cause = RigError::Duplicate { name: camera.name };
            return Err(Fault::Rig { field: format!("{field}.name"), cause });
        }
        cameras.push(camera);
        // Checked before the next overlay is decompressed.
        check_overlays(&cameras).map_err(fault(format!("{field}.overlay")))?;
    }
    let rig = Rig { name: check_name("rig.name", rig.name)?, cameras };
    rig.check().map_err(fault("rig.cameras".to_owned()))?;
    Ok(rig)
}

/// A camera from the wire, checked; `field` names it in faults.
fn convert_rig_camera(field: &str, camera: message::RigCamera) -> Result<RigCamera, Fault> {
    let message::RigCamera { name, width, height, fx, fy, cx, cy, camera_to_rig, .. } = camera;
    let name = check_name(&format!("{field}.name"), name)?;
    let rig_from_camera = convert_pose(&format!("{field}.camera_to_rig"), &camera_to_rig)?;
    // Larger sizes become u32::MAX, which the check of the camera refuses.
    let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    let intrinsics = Intrinsics {
        size_px,
        focal_px: [fx, fy],
        center_px: [cx, cy],
        lens: camera.lens.map(convert_lens),
        windshield: camera.windshield.map(convert_windshield),
        native_size_px: camera.native_size,
    };
    let fault = |cause| Fault::Camera { field: field.to_owned(), cause };
    // The overlay is decompressed after this check, which bounds its size by that of the image.
    let checked = intrinsics.camera().and_then(|camera| camera.check().map(|()| camera));
    let shutter = camera.shutter.map(convert_shutter).transpose().map_err(fault)?;
    let checked = checked.map_err(fault)?;
    let has_gain = camera.exposure.as_ref().is_some_and(|exposure| exposure.gain.is_some());
    let appearance = convert_appearance(camera.exposure, camera.overlay.as_deref(), size_px);
    let appearance = appearance.and_then(|read| read.check(size_px).map(|()| read));
    let appearance = appearance.map_err(|cause| Fault::Appearance {
        field: match &cause {
            // A gain stands for a matrix.
            AppearanceError::Exposure { field: "matrix", .. } if has_gain => {
                format!("{field}.exposure.gain")
            }
            AppearanceError::Exposure { field: part, .. } => format!("{field}.exposure.{part}"),
            cause => format!("{field}.{}", cause.field()),
        },
        cause,
    })?;
    Ok(RigCamera { name, camera: checked, rig_from_camera, shutter, appearance })
}
