//! Which frames are rendered: those that an observation shows, and no others.
//!
//! A camera takes a frame at every multiple of its period. The agent decides at every multiple of
//! its own period, and then gets the last frames of each camera. Frames that no decision gets are
//! not rendered. All times are in microseconds since the episode's start.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use wildcity_scene::rig::RigCamera;

use crate::error::SessionError;
use crate::limits;

/// When the cameras take frames, and when the agent decides.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Schedule {
    /// How many last frames of each camera a decision shows.
    frames: usize,
    /// Time between two frames of each camera.
    periods_us: Vec<i64>,
    /// Time between two decisions.
    decision_us: i64,
}

impl Schedule {
    /// The schedule of some cameras, in the order of the images. A camera that `periods_us` does
    /// not name takes a frame with every step of `dt_us`; without `decision_us`, the agent decides
    /// at every step.
    ///
    /// # Errors
    /// Names the first value that is out of range or no multiple of a step, or the first camera
    /// that the rig does not have.
    pub(crate) fn new(
        cameras: &[RigCamera],
        dt_us: i64,
        frames: Option<u64>,
        periods_us: &BTreeMap<String, i64>,
        decision_us: Option<i64>,
    ) -> Result<Self, SessionError> {
        let frames = frames.unwrap_or(1);
        let most = limits::BUNDLE_FRAMES as u64;
        if !(1..=most).contains(&frames) {
            let must = format!("{frames}; 1 to {most} are accepted");
            return Err(SessionError::OutOfRange { field: "outputs.frames", must });
        }
        let decision_us = decision_us.unwrap_or(dt_us);
        check_period("decision_us", decision_us, dt_us)?;
        // In the order of names, so that of several mistakes always the same one is named.
        for (name, &period_us) in periods_us {
            if !cameras.iter().any(|camera| camera.name == *name) {
                let known = cameras.iter().map(|camera| camera.name.clone()).collect();
                let field = format!("outputs.period_us.{name}");
                return Err(SessionError::UnknownCamera { field, name: name.clone(), known });
            }
            check_period(&format!("outputs.period_us.{name}"), period_us, dt_us)?;
        }
        let period_us = |camera: &RigCamera| periods_us.get(&camera.name).copied().unwrap_or(dt_us);
        let periods_us = cameras.iter().map(period_us).collect();
        Ok(Self { frames: frames as usize, periods_us, decision_us })
    }

    /// One frame of each camera with every step, and a decision at every step.
    pub(crate) fn every_step(cameras: usize, dt_us: i64) -> Self {
        Self { frames: 1, periods_us: vec![dt_us; cameras], decision_us: dt_us }
    }

    /// Checks a schedule that was read from a file.
    ///
    /// # Errors
    /// Names the first value that is out of range.
    pub(crate) fn check(&self, cameras: usize, dt_us: i64) -> Result<(), SessionError> {
        let field = "outputs.frames";
        if self.periods_us.len() != cameras || !(1..=limits::BUNDLE_FRAMES).contains(&self.frames) {
            let periods = self.periods_us.len();
            let must = format!("{}, with {periods} periods of {cameras} cameras", self.frames);
            return Err(SessionError::OutOfRange { field, must });
        }
        check_period("decision_us", self.decision_us, dt_us)?;
        self.periods_us
            .iter()
            .try_for_each(|&period_us| check_period("outputs.period_us", period_us, dt_us))
    }

    /// How many last frames of each camera a decision shows.
    pub(crate) fn frames(&self) -> usize {
        self.frames
    }

    /// Time between two frames of a camera.
    pub(crate) fn period_us(&self, camera: usize) -> i64 {
        self.periods_us[camera]
    }

    /// Time between two decisions.
    pub(crate) fn decision_us(&self) -> i64 {
        self.decision_us
    }

    /// Whether the agent decides at a time.
    pub(crate) fn is_decision(&self, time_us: i64) -> bool {
        // Times of a warm-up are negative, so that the remainder is the Euclidean one here and
        // below.
        time_us.rem_euclid(self.decision_us) == 0
    }

    /// When the frames of a camera were taken that the decision at `decision_us` shows, newest
    /// first.
    pub(crate) fn shown_times(&self, camera: usize, decision_us: i64) -> impl Iterator<Item = i64> {
        let period_us = self.periods_us[camera];
        // Rounded down at negative times as well.
        let newest = decision_us.div_euclid(period_us);
        (0..self.frames as i64).map(move |back| (newest - back) * period_us)
    }

    /// When the frames of a camera were taken, up to `time_us`, that the next decision shows,
    /// newest first. A decision at `time_us` itself is the next one.
    pub(crate) fn due(&self, camera: usize, time_us: i64) -> impl Iterator<Item = i64> {
        // What is missing to the next multiple: 0 at a multiple itself.
        let next_us = time_us + (-time_us).rem_euclid(self.decision_us);
        self.shown_times(camera, next_us).filter(move |&taken_us| taken_us <= time_us)
    }

    /// Whether the first decision at `time_us` or after it shows the frame of a camera that was
    /// taken at `taken_us`. If it does not, no later one does.
    pub(crate) fn is_shown_from(&self, camera: usize, taken_us: i64, time_us: i64) -> bool {
        // Times are whole microseconds: from a time on is after the microsecond before it.
        self.is_shown_after(camera, taken_us, time_us - 1)
    }

    /// Whether the first decision after `time_us` shows the frame of a camera that was taken at
    /// `taken_us`. If it does not, no later one does.
    pub(crate) fn is_shown_after(&self, camera: usize, taken_us: i64, time_us: i64) -> bool {
        let next_us = (time_us.div_euclid(self.decision_us) + 1) * self.decision_us;
        self.shown_times(camera, next_us).any(|shown_us| shown_us == taken_us)
    }
}

/// Checks that a period is a whole number of steps and within its limits.
fn check_period(field: &str, value_us: i64, dt_us: i64) -> Result<(), SessionError> {
    let limits_us = dt_us..=limits::BUNDLE_PERIOD_US.max(dt_us);
    // A negative multiple passes the first test, and fails the second.
    if value_us % dt_us == 0 && limits_us.contains(&value_us) {
        return Ok(());
    }
    let most_us = limits::BUNDLE_PERIOD_US;
    let must = format!("{value_us} µs; whole steps of {dt_us} µs up to {most_us} µs are accepted");
    Err(SessionError::CameraOption { field: field.to_owned(), must })
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_scene::Rig;

    fn schedule(frames: u64, rear_us: i64, decision_us: i64) -> Schedule {
        let cameras = Rig::preset("vehicle6").unwrap().cameras;
        let periods_us = BTreeMap::from([("rear".to_owned(), rear_us)]);
        Schedule::new(&cameras, 100_000, Some(frames), &periods_us, Some(decision_us)).unwrap()
    }

    const FRONT: usize = 0;
    const REAR: usize = 5;

    impl Schedule {
        /// Whether a camera's frame of a time is rendered at that time.
        fn is_rendered(&self, camera: usize, time_us: i64) -> bool {
            self.due(camera, time_us).any(|due_us| due_us == time_us)
        }
    }

    #[test]
    fn four_of_ten_frames_are_rendered_for_an_agent_that_decides_once_a_second() {
        let schedule = schedule(4, 100_000, 1_000_000);
        // Decisions are at 0, 10 and 20, and each one shows its frame and the three before it.
        let rendered: Vec<i64> =
            (0..=20).filter(|&k| schedule.is_rendered(FRONT, k * 100_000)).collect();
        assert_eq!(rendered, [0, 7, 8, 9, 10, 17, 18, 19, 20]);
        assert!(
            schedule.is_shown_after(FRONT, 700_000, 900_000)
                && schedule.is_shown_after(FRONT, 900_000, 900_000)
        );
        assert!(
            !schedule.is_shown_after(FRONT, 1_000_000, 1_000_000),
            "the next decision is a second off"
        );
    }

    #[test]
    fn with_a_decision_at_every_step_every_frame_is_rendered_and_none_kept() {
        let schedule = schedule(1, 100_000, 100_000);
        for time_us in (0..10).map(|k| k * 100_000) {
            assert!(schedule.is_decision(time_us) && schedule.is_rendered(REAR, time_us));
            assert!(!schedule.is_shown_after(REAR, time_us, time_us));
        }
    }

    /// Every frame that a decision shows was rendered when it was taken, and kept from then on.
    #[test]
    fn every_shown_frame_was_rendered_and_kept() {
        // Periods that divide each other, and such that do not.
        for (frames, rear_us, decision_us) in
            [(1, 300_000, 100_000), (4, 200_000, 500_000), (3, 700_000, 300_000)]
        {
            let schedule = schedule(frames, rear_us, decision_us);
            for now_us in (0..100).map(|k| k * 100_000).filter(|&t| schedule.is_decision(t)) {
                for shown_us in schedule.shown_times(REAR, now_us) {
                    assert!(schedule.is_rendered(REAR, shown_us), "{shown_us} for {now_us}");
                    // At every step between the two, the frame has to be kept.
                    let mut between = (shown_us..now_us).step_by(100_000);
                    assert!(
                        between.all(|t| schedule.is_shown_after(REAR, shown_us, t)),
                        "{shown_us}, {now_us}"
                    );
                }
            }
        }
    }

    #[test]
    fn periods_of_other_than_whole_steps_are_refused() {
        let cameras = Rig::preset("vehicle6").unwrap().cameras;
        let new = |frames, camera: &str, period_us, decision_us| {
            let periods_us = BTreeMap::from([(camera.to_owned(), period_us)]);
            let new =
                Schedule::new(&cameras, 100_000, Some(frames), &periods_us, Some(decision_us));
            new.err().map(|error| error.to_string()).unwrap_or_default()
        };
        assert_eq!(new(16, "rear", 100_000, 100_000), "");
        assert!(new(17, "rear", 100_000, 100_000).starts_with("outputs.frames is 17"));
        assert!(new(0, "rear", 100_000, 100_000).starts_with("outputs.frames is 0"));
        // No multiple of a step, shorter than a step, and negative.
        assert!(new(1, "rear", 150_000, 100_000).starts_with("outputs.period_us.rear is 150000"));
        assert!(new(1, "rear", 0, 100_000).starts_with("outputs.period_us.rear is 0"));
        assert!(new(1, "rear", 100_000, -100_000).starts_with("decision_us is -100000"));
        assert!(new(1, "roof", 100_000, 100_000).contains("no camera \"roof\""));
    }
}
