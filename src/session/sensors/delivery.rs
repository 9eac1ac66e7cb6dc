//! Determines which frame a camera delivers when a frame is due, and which picture it shows.

use wildcity_scene::random::Random;

use super::SensorReason;
use wildcity_options::CameraSensor;

use super::settings::arrival_us;

/// A camera of an episode, as far as its frames depend on it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameSource<'a> {
    pub(crate) sensor: &'a CameraSensor,
    pub(crate) name: &'a str,
    /// Seed of the episode.
    pub(crate) seed: u64,
    /// Time between two frames, in microseconds.
    pub(crate) period_us: i64,
    /// When the episode or its warm-up begins.
    pub(crate) begin_us: i64,
}

/// The frame that a camera delivers when a frame is due. All times are in microseconds since the
/// episode's start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Delivery {
    /// When the frame was taken that is delivered, by the camera's own clock.
    pub(crate) stamp_us: i64,
    /// When its picture was taken: earlier if the camera is frozen.
    pub(crate) taken_us: i64,
    /// Why it is not the frame that was due.
    pub(crate) missing: Option<SensorReason>,
}

impl FrameSource<'_> {
    /// Returns the frame that is delivered when the frame of `due_us`, a multiple of the period, is
    /// due: the most recent frame that has arrived. The first frame of an episode always arrives.
    pub(crate) fn at(&self, due_us: i64) -> Delivery {
        // The first multiple of the period since the beginning. `min` matters only for a frame from
        // before it.
        let first_us = (self.begin_us + (-self.begin_us).rem_euclid(self.period_us)).min(due_us);
        let earliest_us = first_us.max(due_us - arrival_us(self.sensor, self.period_us));
        let mut stamp_us = due_us;
        // Back from the frame that is due, to the newest one that has arrived. The earliest frame
        // counts as arrived without a test, so that the loop ends.
        while stamp_us > earliest_us && !self.has_arrived(stamp_us, due_us) {
            stamp_us -= self.period_us;
        }
        let missing = match (stamp_us < due_us, self.is_lost(due_us)) {
            (false, _) => None,
            (true, true) => Some(SensorReason::Dropped),
            (true, false) => Some(SensorReason::Late),
        };
        // A frozen interval may have begun before the episode.
        Delivery { stamp_us, taken_us: self.picture_us(stamp_us).max(first_us), missing }
    }

    fn has_arrived(&self, stamp_us: i64, now_us: i64) -> bool {
        // Drawn by the number of the frame: its fate is the same whenever it is asked for.
        let lag_us = match self.sensor.late {
            Some(late) if self.draw("late", stamp_us / self.period_us) < late.chance => late.by_us,
            _ => 0,
        };
        stamp_us + lag_us <= now_us && !self.is_lost(stamp_us)
    }

    fn is_lost(&self, stamp_us: i64) -> bool {
        let frame = stamp_us / self.period_us;
        self.sensor.drop.is_some_and(|chance| self.draw("drop", frame) < chance)
    }

    /// When the picture of a frame was taken: in a frozen interval, at the start of the interval.
    fn picture_us(&self, stamp_us: i64) -> i64 {
        let Some(freeze) = self.sensor.freeze else { return stamp_us };
        // Intervals lie on a grid of their length, whatever froze before.
        let interval = stamp_us.div_euclid(freeze.for_us);
        if self.draw("freeze", interval) < freeze.chance {
            interval * freeze.for_us
        } else {
            stamp_us
        }
    }

    /// A number in [0, 1), of the stream of an effect for a frame or an interval.
    fn draw(&self, effect: &str, index: i64) -> f64 {
        // A negative index, of a warm-up, becomes a large one, which is as good.
        Random::new(self.seed, &format!("{}/{effect}", self.name), index as usize).unit()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::settings::reach_us;
    use wildcity_options::{FrozenFrames, LateFrames};

    const PERIOD_US: i64 = 100_000;

    fn source(sensor: &CameraSensor) -> FrameSource<'_> {
        FrameSource { sensor, name: "front", seed: 3, period_us: PERIOD_US, begin_us: 0 }
    }

    fn deliveries(sensor: &CameraSensor) -> Vec<(i64, Delivery)> {
        (0..20_000).map(|frame| frame * PERIOD_US).map(|us| (us, source(sensor).at(us))).collect()
    }

    fn share(sensor: &CameraSensor, is_counted: impl Fn(i64, &Delivery) -> bool) -> f64 {
        let all = deliveries(sensor);
        all.iter().filter(|(due_us, one)| is_counted(*due_us, one)).count() as f64
            / all.len() as f64
    }

    #[test]
    fn lost_frames_are_as_many_as_asked_for_and_the_last_one_stands_in() {
        let sensor = CameraSensor { drop: Some(0.2), ..CameraSensor::default() };
        // Standard error: √(0.2 x 0.8 / 20,000) = 0.0028.
        let lost = share(&sensor, |_, one| one.missing == Some(SensorReason::Dropped));
        assert!((lost - 0.2).abs() < 4.0 * 0.0028, "{lost}");
        for pair in deliveries(&sensor).windows(2) {
            let [(_, before), (due_us, now)] = pair else { unreachable!() };
            let expected_us = if now.missing.is_some() { before.stamp_us } else { *due_us };
            assert_eq!((now.stamp_us, now.taken_us), (expected_us, expected_us));
        }
    }

    #[test]
    fn late_frames_show_when_they_arrive() {
        let late = LateFrames { chance: 0.3, by_us: 2 * PERIOD_US };
        let sensor = CameraSensor { late: Some(late), ..CameraSensor::default() };
        let is_late = share(&sensor, |_, one| one.missing == Some(SensorReason::Late));
        // Standard error: √(0.3 x 0.7 / 20,000) = 0.0032.
        assert!((is_late - 0.3).abs() < 4.0 * 0.0033, "{is_late}");
        let old = share(&sensor, |due_us, one| due_us - one.stamp_us == 2 * PERIOD_US);
        // If the present and the previous frame are late, the frame of two periods ago has arrived
        // in any case.
        // 0.3 x 0.3, with a standard error of √(0.09 x 0.91 / 20,000) = 0.002.
        assert!((old - 0.09).abs() < 4.0 * 0.002, "{old}");
        assert_eq!(share(&sensor, |due_us, one| due_us - one.stamp_us > 2 * PERIOD_US), 0.0);
    }

    #[test]
    fn frozen_intervals_repeat_their_first_frame() {
        let freeze = FrozenFrames { chance: 0.25, for_us: 4 * PERIOD_US };
        let sensor = CameraSensor { freeze: Some(freeze), ..CameraSensor::default() };
        // The first of four frames is its own.
        let frozen = share(&sensor, |due_us, one| one.taken_us < due_us);
        // 5,000 intervals: a standard error of 0.75 √(0.25 x 0.75 / 5,000) = 0.0046.
        assert!((frozen - 0.25 * 0.75).abs() < 0.025, "{frozen}");
        for (due_us, one) in deliveries(&sensor) {
            assert_eq!(one.stamp_us, due_us, "its clock runs");
            assert!(one.taken_us == due_us || one.taken_us == due_us / 400_000 * 400_000);
        }
    }

    #[test]
    fn the_first_frame_of_an_episode_arrives_and_nothing_is_older() {
        let sensor = CameraSensor {
            drop: Some(0.9),
            late: Some(LateFrames { chance: 1.0, by_us: PERIOD_US }),
            freeze: Some(FrozenFrames { chance: 1.0, for_us: 500_000 }),
            ..CameraSensor::default()
        };
        for seed in 0..200 {
            for begin_us in [0, -350_000] {
                let source = FrameSource { seed, begin_us, ..source(&sensor) };
                // The first multiple of 100 ms that is not before the beginning.
                let first_us = if begin_us == 0 { 0 } else { -300_000 };
                assert_eq!(source.at(first_us).missing, None);
                for due_us in (first_us..2_000_000).step_by(100_000) {
                    let Delivery { stamp_us, taken_us, .. } = source.at(due_us);
                    assert!(first_us <= taken_us && taken_us <= stamp_us && stamp_us <= due_us);
                    assert!(due_us - taken_us <= reach_us(&sensor, PERIOD_US));
                }
            }
        }
    }
}
