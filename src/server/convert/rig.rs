//! Rigs of requests.

use crate::fault::Fault;
use wildcity_protocol::message;
use wildcity_scene::geometry::camera::json::Intrinsics;
use wildcity_scene::rig::{Rig, RigCamera, check_overlays};

use super::camera::{appearance_of, lens_of, shutter_of, windshield_of};
use super::field::{name_of, pose_of};

/// A rig from the wire, checked.
pub(super) fn rig_of(rig: message::Rig) -> Result<Rig, Fault> {
    let fault = |cause| Fault::Rig { field: "rig.cameras".to_owned(), cause };
    let mut cameras = Vec::new();
    // Reads at most one camera more than the maximum, which is enough for the check to refuse the rig.
    for (index, camera) in rig.cameras.into_iter().take(Rig::MAX_CAMERAS + 1).enumerate() {
        cameras.push(camera_of(&format!("rig.cameras[{index}]"), camera)?);
        // Checked before the next overlay is decompressed.
        check_overlays(&cameras).map_err(fault)?;
    }
    let rig = Rig { name: name_of("rig.name", rig.name)?, cameras };
    rig.check().map_err(fault)?;
    Ok(rig)
}

/// A camera from the wire, checked; `field` names it in faults.
fn camera_of(field: &str, camera: message::RigCamera) -> Result<RigCamera, Fault> {
    let message::RigCamera { name, width, height, fx, fy, cx, cy, camera_to_rig, .. } = camera;
    let name = name_of(&format!("{field}.name"), name)?;
    let rig_from_camera = pose_of(&format!("{field}.camera_to_rig"), &camera_to_rig)?;
    let size_px = [width, height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    let intrinsics = Intrinsics {
        size_px,
        focal_px: [fx, fy],
        center_px: [cx, cy],
        lens: camera.lens.map(lens_of),
        windshield: camera.windshield.map(windshield_of),
        native_size_px: camera.native_size,
    };
    let fault = |cause| Fault::Camera { field: field.to_owned(), cause };
    let checked = intrinsics.camera().and_then(|camera| camera.check().map(|()| camera));
    let shutter = camera.shutter.map(shutter_of).transpose().map_err(fault)?;
    let checked = checked.map_err(fault)?;
    let appearance = appearance_of(camera.exposure, camera.overlay.as_deref(), size_px);
    let appearance = appearance.and_then(|read| read.check(size_px).map(|()| read));
    let appearance = appearance.map_err(|cause| Fault::Appearance {
        field: format!("{field}.{}", cause.field()),
        cause,
    })?;
    Ok(RigCamera { name, camera: checked, rig_from_camera, shutter, appearance })
}
