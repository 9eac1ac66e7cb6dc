//! Finds the state of a recorded episode after one of its steps: executes its commands again, and
//! lists the frames that later observations show.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use wildcity_scene::RenderProfile;
use wildcity_sim::{DriveBoxes, Ground};
use wildcity_twin::residency::Resident;

use super::branch_error::BranchError;
use super::ego_replay::EgoReplay;
use super::format::{EpisodeHeader, FrameRecord, FrameRequest, RecordedOrigin};
use super::recorded_episode::RecordedEpisode;
use crate::engine::turns::Turn;
use crate::episode::Episode;
use crate::error::SessionError;
use crate::observe::layout::{ObservationLayout, RigCapture};

/// A recorded episode up to the step after which it is continued.
#[derive(Debug)]
pub struct Continuation {
    record: RecordedEpisode,
    origin: RecordedOrigin,
    versions: BTreeMap<u64, Arc<Resident>>,
    /// As long as the record is in memory.
    _turn: Turn,
}

/// The state of a recorded episode after one of its steps.
pub(crate) struct DrivenEpisode {
    pub(crate) episode: Episode,
    pub(crate) version: Arc<Resident>,
    pub(crate) profile: RenderProfile,
    /// The frames that later observations show again, in the order in which they were taken.
    pub(crate) kept: Vec<KeptFrames>,
}

/// Frames that were rendered with one answer.
pub(crate) struct KeptFrames {
    /// The state after that answer.
    pub(crate) episode: Episode,
    pub(crate) version: Arc<Resident>,
    pub(crate) profile: RenderProfile,
    pub(crate) frames: Vec<KeptFrame>,
}

/// A frame of one camera in that answer.
pub(crate) struct KeptFrame {
    /// Index of the camera.
    pub(crate) camera: usize,
    /// Contains only this camera.
    pub(crate) capture: RigCapture,
    /// The recorded hash of the image, in hex.
    pub(crate) hash: String,
}

impl Continuation {
    /// Reads the record. Blocks.
    pub(crate) fn read(
        path: &Path,
        origin: RecordedOrigin,
        turn: Turn,
    ) -> Result<Self, SessionError> {
        let RecordedOrigin { step, ref episode } = origin;
        // The most likely mistake has an error of its own: a wrong name.
        if !path.is_file() {
            return Err(SessionError::UnknownEpisode { name: episode.clone() });
        }
        let mut record = RecordedEpisode::read_until(path, step).map_err(BranchError::Read)?;
        let first = record.header.first_state().step();
        let last = record.frames.last().map_or(first, |frame| frame.step);
        if !(first..=last).contains(&step) {
            let must = format!("{step}; the record has steps {first} to {last}");
            return Err(SessionError::OutOfRange { field: "from.step", must });
        }
        // What came after the step is not part of the branch.
        record.frames.retain(|frame| frame.step <= step);
        let frames = record.frames.len();
        // A switch without a frame after it shows nothing, and its version need not exist.
        record.versions.retain(|(frames_before, _)| *frames_before < frames);
        Ok(Self { record, origin, versions: BTreeMap::new(), _turn: turn })
    }

    pub(crate) fn header(&self) -> &EpisodeHeader {
        &self.record.header
    }

    /// The episode and the step.
    pub(crate) fn origin(&self) -> &RecordedOrigin {
        &self.origin
    }

    /// Name of the twin.
    pub fn twin(&self) -> &str {
        &self.record.header.twin
    }

    /// Numbers of the versions that it shows.
    pub(crate) fn versions(&self) -> Vec<u64> {
        let switched = self.record.versions.iter().map(|(_, to)| to.version);
        let mut numbers: Vec<u64> =
            std::iter::once(self.record.header.version).chain(switched).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    /// Adds one of its versions.
    ///
    /// # Errors
    /// The version is not the recorded one.
    pub(crate) fn add_version(&mut self, resident: Arc<Resident>) -> Result<(), SessionError> {
        let number = resident.version.number;
        let header = (&self.record.header.version, &self.record.header.version_hash);
        let switched = self.record.versions.iter().map(|(_, to)| (&to.version, &to.version_hash));
        // The header and a switch back may name the same version; the hash of each must match.
        for (&version, recorded) in std::iter::once(header).chain(switched) {
            if version == number && *recorded != resident.version.hash {
                let recorded = recorded.clone();
                let now = resident.version.hash.clone();
                return Err(BranchError::Version { version, recorded, now }.into());
            }
        }
        self.versions.insert(number, resident);
        Ok(())
    }

    /// Drives the recorded commands. Blocks.
    ///
    /// # Errors
    /// The commands lead to other poses, or their observations need other frames.
    pub(crate) fn drive(self, layout: &ObservationLayout) -> Result<DrivenEpisode, SessionError> {
        let RecordedEpisode { header, frames, versions, .. } = &self.record;
        let version_of = |number: u64| {
            let unknown = || BranchError::Diverged(format!("version {number} was not opened"));
            self.versions.get(&number).cloned().ok_or_else(unknown)
        };
        let mut version = version_of(header.version)?;
        let mut profile = header.profile;
        let mut switches = versions.iter().peekable();
        let mut ego = EgoReplay::new(header);
        let mut kept: Vec<KeptFrames> = Vec::new();
        let mut boxes: BTreeMap<u64, DriveBoxes> = BTreeMap::new();
        for (index, frame) in frames.iter().enumerate() {
            // All switches that stand before this frame in the file: the last one counts.
            while let Some((_, to)) = switches.next_if(|(frames_before, _)| *frames_before <= index)
            {
                version = version_of(to.version)?;
                profile = to.profile;
            }
            // Poses of `observe` move no ego and enter no history.
            if frame.request == FrameRequest::Observe {
                continue;
            }
            let drives = &version.version.manifest.trajectories;
            let boxes =
                boxes.entry(version.version.number).or_insert_with(|| DriveBoxes::new(drives));
            let ground = Ground::from_drives(drives).with_boxes(boxes);
            if let Some(diverged) = ego.drive(frame, index + 2, &ground)? {
                return Err(BranchError::Diverged(diverged.to_string()).into());
            }
            let episode = ego.episode().clone();
            let time_us = episode.time_us();
            let taken = frames_taken(layout, &episode, &kept, frame)?;
            kept.push(KeptFrames { episode, version: version.clone(), profile, frames: taken });
            // At each step, so that only the states of the last bundle are in memory.
            drop_unneeded(layout, &mut kept, time_us);
        }
        let mut episode = ego.into_episode();
        // The ego may have left the area only after the step of the branch.
        if self.record.off_model_step.is_some_and(|left| left <= self.origin.step) {
            episode.leave_model();
        }
        // A plan of several steps may pass over the one that was asked for.
        let reached = episode.step();
        let step = self.origin.step;
        if reached != step {
            let reason = format!("its steps lead to step {reached} and not to {step}");
            return Err(BranchError::Diverged(reason).into());
        }
        Ok(DrivenEpisode { episode, version, profile, kept })
    }
}

/// The frames that were rendered with a recorded answer and that later observations show.
fn frames_taken(
    layout: &ObservationLayout,
    episode: &Episode,
    kept: &[KeptFrames],
    frame: &FrameRecord,
) -> Result<Vec<KeptFrame>, BranchError> {
    let is_kept = |camera: usize, time_us: i64| {
        let mut all = kept.iter().flat_map(|frames| &frames.frames);
        all.any(|one| one.capture.due_us == time_us && one.camera == camera)
    };
    // Hashes are pose by pose and camera by camera, so that a single iterator over all captures
    // stays with them.
    let mut hashes = frame.images.iter();
    let mut taken = Vec::new();
    for (pose, capture) in layout.captures_beside(episode, &is_kept).iter().enumerate() {
        let cameras = frame.due_cameras(pose, layout.cameras().len());
        if frame.poses.get(pose) != Some(&capture.world_from_rig) || cameras != capture.cameras {
            let step = frame.step;
            let reason = match frame.request {
                FrameRequest::Restore => format!(
                    "it is itself a branch of step {step}, and its bundles have frames from before: \
                     continue the episode that it is a branch of"
                ),
                _ => format!(
                    "step {step}: its observation needs other frames than the recorded ones"
                ),
            };
            return Err(BranchError::Diverged(reason));
        }
        // `zip` asks the cameras first, so that it takes no hash too many.
        for (&camera, hash) in cameras.iter().zip(&mut hashes) {
            if layout.is_shown_later(capture, camera) {
                let capture = RigCapture { cameras: vec![camera], shown: false, ..capture.clone() };
                taken.push(KeptFrame { camera, capture, hash: hash.clone() });
            }
        }
    }
    Ok(taken)
}

/// Drops the frames that no observation at a time or after it shows.
fn drop_unneeded(layout: &ObservationLayout, kept: &mut Vec<KeptFrames>, time_us: i64) {
    let schedule = layout.schedule();
    for frames in kept.iter_mut() {
        let is_needed =
            |one: &KeptFrame| schedule.is_shown_from(one.camera, one.capture.due_us, time_us);
        frames.frames.retain(is_needed);
    }
    kept.retain(|frames| !frames.frames.is_empty());
}
