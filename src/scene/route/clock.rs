//! Association of the timestamps of two clocks, and poses at times between keyframes.

use super::{Route, RouteError, between};
use crate::geometry::Pose;

/// The result of [`associate`].
#[derive(Clone, Debug, PartialEq)]
pub struct Association {
    /// Associated times, in order of time.
    pub pairs: Vec<TimePair>,
    /// Indices of times of the first clock without a partner.
    pub unmatched: Vec<usize>,
}

/// A time of each of two clocks that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimePair {
    /// Index in the first clock's times.
    pub first: usize,
    /// Index in the second clock's times.
    pub second: usize,
    /// Second minus first, in microseconds.
    pub residual_us: i64,
}

/// Associates the times of two clocks, both strictly increasing, in microseconds. Two times are
/// associated if each is the nearest to the other and they differ by at most `tolerance_us`. So no
/// time is used twice, and pairs do not cross. Of two equally near times the earlier one counts.
///
/// # Errors
/// [`RouteError::Order`] names the first time that is out of order; [`RouteError::Value`] if the
/// tolerance is negative.
pub fn associate(
    first_us: &[i64],
    second_us: &[i64],
    tolerance_us: i64,
) -> Result<Association, RouteError> {
    check_order("first", first_us)?;
    check_order("second", second_us)?;
    if tolerance_us < 0 {
        let field = "tolerance_us";
        let value = tolerance_us as f64;
        return Err(RouteError::Value { field, value, must: "a tolerance is 0 µs or more" });
    }
    let mut pairs = Vec::new();
    let mut unmatched = Vec::new();
    for (first, &time_us) in first_us.iter().enumerate() {
        // The nearest of the nearest must be the time itself: otherwise two times would share a
        // partner.
        let mutual = nearest(second_us, time_us)
            .filter(|&second| nearest(first_us, second_us[second]) == Some(first))
            // Unsigned differences: two i64 may be farther apart than i64 reaches.
            .filter(|&second| time_us.abs_diff(second_us[second]) <= tolerance_us.unsigned_abs());
        match mutual {
            Some(second) => {
                // The difference is within the tolerance, so it fits i64.
                let residual_us = second_us[second].saturating_sub(time_us);
                pairs.push(TimePair { first, second, residual_us });
            }
            None => unmatched.push(first),
        }
    }
    Ok(Association { pairs, unmatched })
}

impl Route<'_> {
    /// The pose at a time in microseconds, interpolated between the keyframes before and after it:
    /// position linearly, rotation spherically.
    ///
    /// # Errors
    /// [`RouteError::Outside`] before the first keyframe or after the last one.
    pub fn pose_at(&self, time_us: i64) -> Result<Pose, RouteError> {
        let keyframes = &self.trajectory.keyframes;
        let from_us = keyframes[0].time_us;
        let to_us = keyframes[keyframes.len() - 1].time_us;
        if !(from_us..=to_us).contains(&time_us) {
            let name = self.trajectory.name.clone();
            return Err(RouteError::Outside { name, time_us, from_us, to_us });
        }
        // The first keyframe at or after the time; it exists, because the time is within the drive.
        let after = keyframes.partition_point(|keyframe| keyframe.time_us < time_us);
        let to = &keyframes[after];
        let Some(from) = after.checked_sub(1).map(|before| &keyframes[before]) else {
            return Ok(to.world_from_rig);
        };
        let since_us = |earlier_us: i64, later_us: i64| later_us.abs_diff(earlier_us) as f64;
        // Keyframe times increase strictly, so that the denominator is not 0.
        let t = since_us(from.time_us, time_us) / since_us(from.time_us, to.time_us);
        Ok(between(from, to, t).world_from_rig)
    }
}

/// The index of the nearest time; of two equally near ones the earlier.
fn nearest(times_us: &[i64], time_us: i64) -> Option<usize> {
    let after = times_us.partition_point(|&other_us| other_us < time_us);
    // Only the neighbours of the insertion place can be nearest. `min_by_key` takes the first of
    // equal ones: the earlier.
    let candidates = [after.checked_sub(1), (after < times_us.len()).then_some(after)];
    candidates.into_iter().flatten().min_by_key(|&place| times_us[place].abs_diff(time_us))
}

fn check_order(clock: &'static str, times_us: &[i64]) -> Result<(), RouteError> {
    match times_us.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(before) => Err(RouteError::Order {
            clock,
            index: before + 1,
            time_us: times_us[before + 1],
            before_us: times_us[before],
        }),
        None => Ok(()),
    }
}
