//! The picture of a fault: a recorded frame, rendered again.

use std::path::Path;

use wildcity_episode::FaultLine;
use wildcity_render::Backend;
use wildcity_session::{
    FrameRequest, RecordedEpisode, ReplayUntil, Replayed, jpeg, limits as session,
};
use wildcity_twin::residency::Cache;
use wildcity_twin::store::Catalog;

use crate::entry::{EpisodeEntry, Status};
use crate::limits;
use crate::result::SuiteResult;

/// A picture for the report.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Name of the episode.
    pub episode: String,
    pub step: u64,
    /// Name of the camera.
    pub camera: String,
    pub jpeg: Vec<u8>,
}

/// The pictures of the worst episodes of a run: of the step of their worst fault, by their first
/// camera. An episode that cannot be rendered again has no picture, which the report mentions.
pub fn pictures(
    result: &SuiteResult,
    episodes: &Path,
    catalog: &Catalog,
    backend: &dyn Backend,
) -> Vec<Picture> {
    let cache = Cache::new(catalog.clone());
    let worst = result.worst();
    worst
        .into_iter()
        .filter_map(|episode| match picture(episode, episodes, &cache, backend) {
            Ok(picture) => picture,
            Err(error) => {
                tracing::warn!(episode = episode.name, "no picture of the fault: {error}");
                None
            }
        })
        .collect()
}

impl SuiteResult {
    /// The failed episodes: those with a contact first, then those off the road, then those that
    /// only lack progress, and of these those with the earliest fault first. Without duplicates,
    /// which would show the same pictures.
    pub(crate) fn worst(&self) -> Vec<&EpisodeEntry> {
        // Duplicates are left out before the list is cut, so that they take no place in it.
        let distinct = self.episodes.iter().filter(|episode| episode.duplicate_of.is_none());
        let mut worst: Vec<&EpisodeEntry> =
            distinct.filter(|episode| episode.status == Status::Failed).collect();
        // Faults by severity, then by time, then by name, so that the order is total.
        worst.sort_by_key(|episode| {
            let worst = worst_fault(episode);
            (worst.map(severity), worst.map_or(i64::MAX, |fault| fault.time_us), &episode.name)
        });
        worst.truncate(limits::WORST);
        worst
    }
}

/// The fault that an episode is shown by: a contact that follows a step off the road says more than
/// that step.
fn worst_fault(episode: &EpisodeEntry) -> Option<&FaultLine> {
    // The first of equally severe ones, since faults are in order of their times.
    episode.faults.iter().min_by_key(|fault| severity(fault))
}

/// Smaller is worse.
fn severity(fault: &FaultLine) -> u8 {
    match fault.fault.as_str() {
        "progress" => 2,
        "off_road" => 1,
        _ => 0,
    }
}

fn picture(
    episode: &EpisodeEntry,
    episodes: &Path,
    cache: &Cache,
    backend: &dyn Backend,
) -> Result<Option<Picture>, String> {
    let path = episodes.join(&episode.record);
    let mut recording = RecordedEpisode::read(&path).map_err(|error| error.to_string())?;
    let fault_us = worst_fault(episode).map_or(i64::MAX, |fault| fault.time_us);
    // A request to look again shows a time that was shown before.
    let shown = |frame: &wildcity_session::FrameRecord| {
        frame.request != FrameRequest::Observe && !frame.images.is_empty()
    };
    // The first frame at or after the fault.
    let at = recording.frames.iter().position(|frame| shown(frame) && frame.time_us >= fault_us);
    // A fault after the last frame is shown by the last one.
    let Some(at) = at.or_else(|| recording.frames.iter().rposition(shown)) else { return Ok(None) };
    // The earlier steps are executed, so that the ego has its pose, but not rendered.
    recording.frames.truncate(at + 1);
    // The record ends early now, and its end would contradict that.
    recording.end = None;
    for frame in recording.frames.iter_mut().take(at) {
        // One empty list for each pose, so that the frame keeps its steps but asks for no image.
        frame.cameras = vec![Vec::new(); frame.poses.len()];
        frame.images.clear();
    }
    recording.leave_out_sweeps();
    let step = recording.frames[at].step;
    let mut found: Option<Picture> = None;
    let report = recording.replay(cache, backend, ReplayUntil::End, &mut |replayed| {
        let Replayed::Image(image) = replayed else { return Ok(()) };
        // The first camera only; the others of the frame are rendered and dropped.
        if found.is_none() {
            let size = &image.camera.camera;
            let jpeg = jpeg(image.rgb8, size.width_px, size.height_px, session::JPEG_QUALITY)?;
            let camera = image.camera.name.clone();
            found = Some(Picture { episode: episode.name.clone(), step, camera, jpeg });
        }
        Ok(())
    });
    report.map_err(|error| error.to_string())?;
    Ok(found)
}
