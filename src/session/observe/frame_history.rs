//! Frames of an episode that later observations show again.

use std::sync::Arc;

use super::schedule::Schedule;
use super::trust::Trust;
use crate::engine::answer_budget::{AnswerBudget, BudgetShare};
use crate::error::SessionError;
use crate::repair::status::ImageRepair;
use crate::sensors::ImageSensor;

/// The frames that coming decisions will show, in the order in which they were taken. Copies share
/// the frames' bytes.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameHistory(Vec<Arc<KeptFrame>>);

/// A frame of a camera, encoded.
#[derive(Debug)]
pub(crate) struct PastFrame {
    /// Index of the camera.
    pub(crate) camera: usize,
    /// When it was due, in microseconds since the episode's start.
    pub(crate) due_us: i64,
    /// When it was taken, by the camera's clock.
    pub(crate) time_us: i64,
    /// BLAKE3 of its pixels.
    pub(crate) hash: blake3::Hash,
    /// Its trust, if the session's images come with one.
    pub(crate) trust: Option<Trust>,
    /// Result of the repair, if the session asked for repair.
    pub(crate) repair: Option<ImageRepair>,
    /// Effects of the camera on the image, if it has any.
    pub(crate) sensor: Option<ImageSensor>,
    /// As it travels: a JPEG or PNG file, or raw pixels.
    pub(crate) bytes: Vec<u8>,
}

#[derive(Debug)]
struct KeptFrame {
    frame: PastFrame,
    _share: BudgetShare,
}

impl FrameHistory {
    /// Adds a frame. Its bytes count against the budget until no history holds it.
    pub(crate) fn add(
        &mut self,
        budget: &AnswerBudget,
        frame: PastFrame,
    ) -> Result<(), SessionError> {
        // Before the frame is added, so that a refusal leaves the history as it was.
        let share = budget.reserve(frame.bytes.len() as u64)?;
        self.0.push(Arc::new(KeptFrame { frame, _share: share }));
        Ok(())
    }

    /// The frame of a camera that was due at a time, in microseconds.
    pub(crate) fn find(&self, camera: usize, due_us: i64) -> Option<&PastFrame> {
        // At most 16 frames of each camera, so that a search is as fast as a map.
        let frames = self.0.iter().map(|kept| &kept.frame);
        frames.into_iter().find(|frame| frame.camera == camera && frame.due_us == due_us)
    }

    /// The frames that were due before a time, in microseconds.
    pub(crate) fn before(&self, time_us: i64) -> Self {
        Self(self.0.iter().filter(|kept| kept.frame.due_us < time_us).cloned().collect())
    }

    /// Adds the frames of another history that this one lacks.
    #[must_use]
    pub(crate) fn or(mut self, other: &Self) -> Self {
        for kept in &other.0 {
            if self.find(kept.frame.camera, kept.frame.due_us).is_none() {
                self.0.push(kept.clone());
            }
        }
        self
    }

    /// Drops the frames that no decision at or after a time, in microseconds, will show. Frames
    /// that the present observation shows stay, because a snapshot of the present shows them again.
    pub(crate) fn drop_unneeded(&mut self, schedule: &Schedule, time_us: i64) {
        self.0.retain(|kept| schedule.is_shown_from(kept.frame.camera, kept.frame.due_us, time_us));
    }
}
