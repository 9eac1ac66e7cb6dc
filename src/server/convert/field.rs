//! Names and poses in fields of requests.

use wildcity_protocol::message;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::is_name;

use crate::fault::Fault;

/// A name, or a fault that names the field.
pub(super) fn check_name(field: &str, name: String) -> Result<String, Fault> {
    if is_name(&name) { Ok(name) } else { Err(Fault::InvalidName { field: field.into(), name }) }
}

/// A pose, or a fault that names the field.
pub(super) fn convert_pose(field: &str, pose: &message::Pose) -> Result<Pose, Fault> {
    Pose::checked(pose.xyz, pose.q).map_err(|cause| Fault::Pose { field: field.into(), cause })
}

/// The poses of a list. At most `limit` + 1 poses are read, which is enough for the receiver to
/// refuse the list; the rest of a long list is skipped.
pub(super) fn convert_poses(
    field: &str,
    poses: &[message::Pose],
    limit: usize,
) -> Result<Vec<Pose>, Fault> {
    let poses = poses.iter().take(limit + 1).enumerate();
    poses.map(|(index, pose)| convert_pose(&format!("{field}[{index}]"), pose)).collect()
}
