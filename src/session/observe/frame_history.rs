//! Frames of an episode that later observations show again.

use std::sync::Arc;

use super::schedule::Schedule;
use super::trust::Trust;
use crate::engine::{AnswerBudget, BudgetShare};
use crate::error::SessionError;

/// What cameras took and a decision still looks at, in the order in which it was taken. What is
/// common to two albums is in memory once.
#[derive(Clone, Debug, Default)]
pub(crate) struct FrameHistory(Vec<Arc<PastFrame>>);

/// A frame of a camera.
#[derive(Debug)]
pub(crate) struct PastFrame {
    /// Index of the camera.
    pub(crate) camera: usize,
    /// When it was taken, in microseconds since the episode's start.
    pub(crate) time_us: i64,
    /// BLAKE3 of its pixels.
    pub(crate) hash: blake3::Hash,
    /// How far it may be believed, if that was asked for.
    pub(crate) trust: Option<Trust>,
    /// As it travels: a file, or its pixels.
    pub(crate) bytes: Vec<u8>,
    /// Its part of the budget for answers.
    _hold: BudgetShare,
}

impl FrameHistory {
    /// Puts a frame in, which counts against the budget for answers from now on.
    pub(crate) fn add(
        &mut self,
        answers: &AnswerBudget,
        (camera, time_us): (usize, i64),
        (hash, trust): (blake3::Hash, Option<Trust>),
        bytes: Vec<u8>,
    ) -> Result<(), SessionError> {
        let _hold = answers.hold(bytes.len() as u64)?;
        self.0.push(Arc::new(PastFrame { camera, time_us, hash, trust, bytes, _hold }));
        Ok(())
    }

    /// The frame of a camera of a time, in microseconds.
    pub(crate) fn find(&self, camera: usize, time_us: i64) -> Option<&Arc<PastFrame>> {
        self.0.iter().find(|shown| (shown.camera, shown.time_us) == (camera, time_us))
    }

    /// Throws out what no decision after a time looks at.
    pub(crate) fn forget(&mut self, schedule: &Schedule, time_us: i64) {
        self.0.retain(|shown| schedule.kept(shown.camera, shown.time_us, time_us));
    }
}
