//! Which images of a record are rendered again.

use anyhow::Context as _;

use wildcity_episode::driven_indices;
use wildcity_session::{FrameRecord, FrameRequest, RecordedEpisode};

/// Index of the camera with a name.
pub(super) fn camera_index(recording: &RecordedEpisode, wanted: &str) -> anyhow::Result<usize> {
    let cameras = &recording.header.rig.cameras;
    cameras.iter().position(|camera| camera.name == wanted).with_context(|| {
        let known: Vec<&str> = cameras.iter().map(|camera| &*camera.name).collect();
        format!("--camera {wanted}: the episode has {}", known.join(", "))
    })
}

/// Removes the images of other cameras from a frame, and all images of a frame that only observed
/// poses.
pub(super) fn keep_cameras(frame: &mut FrameRecord, kept_cameras: &[usize], rig_cameras: usize) {
    let is_driven = matches!(frame.request, FrameRequest::Reset | FrameRequest::Step);
    // In the order of the poses and of the cameras that are due at each: every entry has to be
    // taken in turn, kept or not.
    let mut images = std::mem::take(&mut frame.images).into_iter();
    let mut repairs = std::mem::take(&mut frame.repairs).into_iter();
    let mut cameras = Vec::new();
    for pose in 0..frame.poses.len() {
        let mut of_pose = Vec::new();
        for rendered in frame.due_cameras(pose, rig_cameras) {
            let image = images.next();
            let repair = repairs.next();
            if kept_cameras.contains(&rendered) && is_driven {
                of_pose.push(rendered);
                frame.images.extend(image);
                frame.repairs.extend(repair);
            }
        }
        cameras.push(of_pose);
    }
    frame.cameras = cameras;
}

/// Indices of the frames that the ego drove last.
pub(super) fn driven(frames: &[FrameRecord]) -> Vec<usize> {
    let moves =
        |frame: &FrameRecord| frame.request != FrameRequest::Observe && !frame.poses.is_empty();
    driven_indices(frames.iter().map(|frame| moves(frame).then_some(frame.step)))
}
