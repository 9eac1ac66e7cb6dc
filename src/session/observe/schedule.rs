//! Which frames are drawn: those that an observation shows, and no others.
//!
//! A camera takes a frame at every multiple of its period, an agent decides at every multiple of
//! its own, and looks at the last frames of each camera then. What lies between is never drawn.

use std::collections::BTreeMap;

use crate::limits;
use wildcity_scene::rig::RigCamera;

use crate::error::SessionError;

/// When the cameras take frames, and when the agent looks at them; times since the episode's start.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Schedule {
    /// Last frames of each camera that a decision looks at.
    frames: usize,
    /// Time between two frames of each camera, in microseconds.
    periods_us: Vec<i64>,
    /// Time between two decisions, in microseconds.
    decision_us: i64,
}

impl Schedule {
    /// Of cameras that are wanted in this order. A camera that `periods_us` does not name takes a
    /// frame with every step of `dt_us`, and an agent decides as often unless it says otherwise.
    ///
    /// # Errors
    /// Names the first value that is out of range or no multiple of a step, or the first camera that
    /// there is not.
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
        check_steps("decision_us", decision_us, dt_us)?;
        for (name, &period_us) in periods_us {
            if !cameras.iter().any(|camera| camera.name == *name) {
                let known = cameras.iter().map(|camera| camera.name.clone()).collect();
                let (field, name) = (format!("outputs.period_us.{name}"), name.clone());
                return Err(SessionError::UnknownCamera { field, name, known });
            }
            check_steps("outputs.period_us", period_us, dt_us)?;
        }
        let period_us = |camera: &RigCamera| periods_us.get(&camera.name).copied().unwrap_or(dt_us);
        let periods_us = cameras.iter().map(period_us).collect();
        Ok(Self { frames: frames as usize, periods_us, decision_us })
    }

    /// Last frames of each camera that a decision looks at.
    pub(crate) fn frames(&self) -> usize {
        self.frames
    }

    /// Time between two frames of a camera, in microseconds.
    pub(crate) fn period_us(&self, camera: usize) -> i64 {
        self.periods_us[camera]
    }

    /// Time between two decisions, in microseconds.
    pub(crate) fn decision_us(&self) -> i64 {
        self.decision_us
    }

    /// Whether the agent decides at a time, in microseconds.
    pub(crate) fn decides(&self, time_us: i64) -> bool {
        time_us.rem_euclid(self.decision_us) == 0
    }

    /// When the frames of a camera were taken that are looked at in a decision, newest first.
    pub(crate) fn seen(&self, camera: usize, decision_us: i64) -> impl Iterator<Item = i64> {
        let period_us = self.periods_us[camera];
        let newest = decision_us.div_euclid(period_us);
        (0..self.frames as i64).map(move |back| (newest - back) * period_us)
    }

    /// When the frames of a camera are taken that the next decision looks at, the one at this very
    /// time if there is one; those of later times left out, newest first.
    pub(crate) fn wanted(&self, camera: usize, time_us: i64) -> impl Iterator<Item = i64> {
        let next_us = time_us + (-time_us).rem_euclid(self.decision_us);
        self.seen(camera, next_us).filter(move |&taken_us| taken_us <= time_us)
    }

    /// Whether a frame is looked at by a decision later than a time.
    pub(crate) fn kept(&self, camera: usize, taken_us: i64, time_us: i64) -> bool {
        let next_us = (time_us.div_euclid(self.decision_us) + 1) * self.decision_us;
        self.seen(camera, next_us).any(|seen_us| seen_us == taken_us)
    }
}

fn check_steps(field: &'static str, value_us: i64, dt_us: i64) -> Result<(), SessionError> {
    if value_us % dt_us == 0 && (dt_us..=limits::BUNDLE_PERIOD_US.max(dt_us)).contains(&value_us) {
        return Ok(());
    }
    let most_us = limits::BUNDLE_PERIOD_US;
    let must = format!("{value_us} µs; whole steps of {dt_us} µs up to {most_us} µs are accepted");
    Err(SessionError::OutOfRange { field, must })
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
        /// Whether a camera's frame of a time is drawn then.
        fn taken(&self, camera: usize, time_us: i64) -> bool {
            self.wanted(camera, time_us).any(|wanted_us| wanted_us == time_us)
        }
    }

    #[test]
    fn four_of_ten_frames_are_drawn_for_an_agent_that_decides_once_a_second() {
        let schedule = schedule(4, 100_000, 1_000_000);
        let drawn: Vec<i64> = (0..=20).filter(|&k| schedule.taken(FRONT, k * 100_000)).collect();
        assert_eq!(drawn, [0, 7, 8, 9, 10, 17, 18, 19, 20]);
        assert!(schedule.kept(FRONT, 700_000, 900_000) && schedule.kept(FRONT, 900_000, 900_000));
        assert!(!schedule.kept(FRONT, 1_000_000, 1_000_000), "the next decision is a second off");
    }

    #[test]
    fn what_every_step_shows_is_drawn_and_none_of_it_kept() {
        let schedule = schedule(1, 100_000, 100_000);
        for time_us in (0..10).map(|k| k * 100_000) {
            assert!(schedule.decides(time_us) && schedule.taken(REAR, time_us));
            assert!(!schedule.kept(REAR, time_us, time_us));
        }
    }

    /// Whatever a decision looks at was drawn when it was taken, and kept from then on.
    #[test]
    fn what_is_looked_at_was_drawn_and_kept() {
        for (frames, rear_us, decision_us) in
            [(1, 300_000, 100_000), (4, 200_000, 500_000), (3, 700_000, 300_000)]
        {
            let schedule = schedule(frames, rear_us, decision_us);
            for now_us in (0..100).map(|k| k * 100_000).filter(|&t| schedule.decides(t)) {
                for seen_us in schedule.seen(REAR, now_us) {
                    assert!(schedule.taken(REAR, seen_us), "{seen_us} for {now_us}");
                    let mut between = (seen_us..now_us).step_by(100_000);
                    assert!(
                        between.all(|t| schedule.kept(REAR, seen_us, t)),
                        "{seen_us}, {now_us}"
                    );
                }
            }
        }
    }

    #[test]
    fn what_is_no_whole_step_is_refused() {
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
        assert!(new(1, "rear", 150_000, 100_000).starts_with("outputs.period_us is 150000"));
        assert!(new(1, "rear", 0, 100_000).starts_with("outputs.period_us is 0"));
        assert!(new(1, "rear", 100_000, -100_000).starts_with("decision_us is -100000"));
        assert!(new(1, "roof", 100_000, 100_000).contains("no camera \"roof\""));
    }
}
