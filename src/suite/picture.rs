//! The picture of a fault: a recorded frame, rendered again.

use std::collections::BTreeMap;
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
    /// Time of the episode, in microseconds.
    pub time_us: i64,
    /// Name of the camera.
    pub camera: String,
    pub jpeg: Vec<u8>,
}

/// Pictures of the episodes that a comparison shows, before and now, by scenario, values and seed;
/// or why there is none.
pub type ComparedPictures = BTreeMap<String, [Result<Picture, String>; 2]>;

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
        .filter_map(|episode| {
            match picture(episode, fault_us(episode), episodes, &cache, backend) {
                Ok(picture) => Some(picture),
                Err(error) => {
                    tracing::warn!(episode = episode.name, "no picture of the fault: {error}");
                    None
                }
            }
        })
        .collect()
}

/// The time of the fault that an episode is shown by; the last one without a fault.
pub(crate) fn fault_us(episode: &EpisodeEntry) -> i64 {
    worst_fault(episode).map_or(i64::MAX, |fault| fault.time_us)
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

/// Rank of a fault: the smaller it is, the worse.
fn severity(fault: &FaultLine) -> u8 {
    match fault.fault.as_str() {
        "progress" => 2,
        "off_road" => 1,
        _ => 0,
    }
}

/// The first frame of an episode at or after a time, by its first camera.
pub(crate) fn picture(
    episode: &EpisodeEntry,
    from_us: i64,
    episodes: &Path,
    cache: &Cache,
    backend: &dyn Backend,
) -> Result<Picture, String> {
    let path = episodes.join(&episode.record);
    let mut recording = RecordedEpisode::read(&path).map_err(|error| error.to_string())?;
    // A request to look again shows a time that was shown before.
    let shown = |frame: &wildcity_session::FrameRecord| {
        frame.request != FrameRequest::Observe && !frame.images.is_empty()
    };
    let frames = &recording.frames;
    let later = frames.iter().position(|frame| shown(frame) && frame.time_us >= from_us);
    // What is after the last frame is shown by the last one.
    let last = || frames.iter().rposition(shown);
    let at = later.or_else(last).ok_or("its record has no images")?;
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
    let time_us = recording.frames[at].time_us;
    let mut found: Option<Picture> = None;
    let report = recording.replay(cache, backend, ReplayUntil::End, &mut |replayed| {
        let Replayed::Image(image) = replayed else { return Ok(()) };
        // The first camera only; the others of the frame are rendered and dropped.
        if found.is_none() {
            let size = &image.camera.camera;
            let jpeg = jpeg(image.rgb8, size.width_px, size.height_px, session::JPEG_QUALITY)?;
            let camera = image.camera.name.clone();
            found = Some(Picture { episode: episode.name.clone(), step, time_us, camera, jpeg });
        }
        Ok(())
    });
    report.map_err(|error| error.to_string())?;
    found.ok_or("its frame could not be rendered again".to_owned())
}
