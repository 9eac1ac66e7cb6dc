//! Compares values of a record other than poses and images with those that a replay computes.

use super::format::{FrameRecord, FrameRequest};
use super::replay_report::WrongValue;
use crate::episode::{Episode, EpisodeSummary};

/// The first value of a frame that is not the replayed episode's.
pub(super) fn wrong_in_frame(
    frame: &FrameRecord,
    episode: &Episode,
    rig_cameras: usize,
    line: usize,
) -> Option<WrongValue> {
    unequal(line, "step", &frame.step, &episode.step())
        .or_else(|| unequal(line, "time_us", &frame.time_us, &episode.time_us()))
        .or_else(|| wrong_frame_hash(frame, rig_cameras, line))
}

/// The hash of the shown images must be that of their recorded hashes, which the replay compares
/// with the pixels.
fn wrong_frame_hash(frame: &FrameRecord, rig_cameras: usize, line: usize) -> Option<WrongValue> {
    fn hash_images<'a>(images: impl IntoIterator<Item = &'a String>) -> String {
        let mut hasher = blake3::Hasher::new();
        for image in images {
            // An invalid hash counts as 0, which differs from every hash of pixels.
            let bytes = blake3::Hash::from_hex(image).map_or([0; 32], |hash| *hash.as_bytes());
            hasher.update(&bytes);
        }
        hasher.finalize().to_hex().to_string()
    }
    let shown = match frame.request {
        FrameRequest::Observe => hash_images(&frame.images),
        FrameRequest::Reset | FrameRequest::Step | FrameRequest::Restore => {
            // The images of the poses that are due now, in order of the cameras; the others are
            // earlier frames of a bundle. Without sensor effects only the last pose is due.
            let mut images = frame.images.iter();
            let mut shown: Vec<(usize, &String)> = Vec::new();
            for pose in 0..frame.poses.len() {
                let is_last = pose + 1 == frame.poses.len();
                let of_pose = frame.due_cameras(pose, rig_cameras).into_iter().zip(&mut images);
                let is_due = frame.due_us.get(pose) == Some(&frame.time_us);
                // Collected before the filter, which would otherwise leave the images of other
                // poses in the iterator.
                let of_pose: Vec<_> = of_pose.collect();
                shown.extend(of_pose.into_iter().filter(|_| is_last || is_due));
            }
            shown.sort_by_key(|(camera, _)| *camera);
            hash_images(shown.into_iter().map(|(_, image)| image).chain(&frame.sweeps))
        }
    };
    // Observations between two decisions show no images, even if a later observation shows images
    // that were rendered then.
    let nothing = hash_images(&[]);
    let is_known = frame.frame_hash == shown
        || (frame.request != FrameRequest::Observe && frame.frame_hash == nothing);
    if is_known {
        return None;
    }
    unequal(line, "frame_hash", &frame.frame_hash, &shown)
}

/// The first value of the last line that differs from the replayed episode's. Its trust comes with
/// images and is not computed again, but the outcome must follow from it.
pub(super) fn wrong_in_end(
    end: &EpisodeSummary,
    episode: &Episode,
    line: usize,
) -> Option<WrongValue> {
    let now = episode.summary_with(end.outcome, end.least_trust);
    let outcomes = [end.outcome, now.outcome].map(|outcome| format!("{outcome:?}"));
    unequal(line, "steps", &end.steps, &now.steps)
        .or_else(|| unequal(line, "time_us", &end.time_us, &now.time_us))
        .or_else(|| unequal(line, "distance_m", &end.distance_m, &now.distance_m))
        .or_else(|| unequal(line, "outcome", &outcomes[0], &outcomes[1]))
}

fn unequal<T: PartialEq + std::fmt::Display>(
    line: usize,
    field: &'static str,
    recorded: &T,
    now: &T,
) -> Option<WrongValue> {
    let wrong = || WrongValue { line, field, recorded: recorded.to_string(), now: now.to_string() };
    (recorded != now).then(wrong)
}
