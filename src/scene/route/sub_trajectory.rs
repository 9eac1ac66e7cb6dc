//! Sub-trajectories: parts of a drive with a common length, in the drive's world frame.

use super::{Route, RouteError, positive};
use crate::Trajectory;

/// A part of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct SubTrajectory {
    /// Stations of its start and end on the drive, in metres.
    pub stations_m: [f64; 2],
    /// Time of its start on the drive's clock, in microseconds. The sub-trajectory's own times
    /// start at 0.
    pub from_us: i64,
    /// The drive's keyframes between the ends and interpolated poses at both ends, in the drive's
    /// world. The name is that of the drive with length and number, such as `log-250m-0003` or
    /// `log-2.5km-0000`.
    pub trajectory: Trajectory,
}

/// Largest number of sub-trajectories of a drive: one per metre of 100 km.
pub const MAX_SUB_TRAJECTORIES: usize = 100_000;

/// Sub-trajectories of length `length_m`, one starting every `stride_m` from the start of a drive.
/// A shorter rest at its end is omitted. With `stride_m == length_m` they do not overlap, and each
/// begins where the previous one ends.
///
/// # Errors
/// [`RouteError::Value`] if a length is not positive and finite, or the stride makes more than
/// [`MAX_SUB_TRAJECTORIES`] pieces; for a piece [`RouteError::Trajectory`] if its name becomes too
/// long.
pub fn sub_trajectories<'a>(
    route: &'a Route<'_>,
    length_m: f64,
    stride_m: f64,
) -> Result<impl Iterator<Item = Result<SubTrajectory, RouteError>> + use<'a>, RouteError> {
    positive("length_m", length_m)?;
    positive("stride_m", stride_m)?;
    // A tolerance of one micrometre: a drive of 100 m has two pieces of 50 m in spite of rounding.
    let left_m = route.length_m() + 1e-6 - length_m;
    let count = if left_m < 0.0 { 0.0 } else { 1.0 + (left_m / stride_m).floor() };
    if count > MAX_SUB_TRAJECTORIES as f64 {
        let must = "a stride divides a drive into at most 100000 pieces";
        return Err(RouteError::Value { field: "stride_m", value: stride_m, must });
    }
    // A product and not a running sum, so that rounding does not accumulate over 100,000 pieces.
    let station_m = move |number: usize| number as f64 * stride_m;
    let at = move |number| piece(route, number, [station_m(number), station_m(number) + length_m]);
    Ok((0..count as usize).map(at))
}

fn piece(
    route: &Route<'_>,
    number: usize,
    stations_m: [f64; 2],
) -> Result<SubTrajectory, RouteError> {
    let [from_m, to_m] = stations_m;
    // Interpolated ends: a piece has exactly the wanted length, wherever the keyframes are.
    let [first, last] = stations_m.map(|station_m| route.at(station_m));
    // Keyframes strictly between the ends in space, and also in time: the two may differ where the
    // vehicle stood still, or where an end was rounded to a microsecond.
    let places = route.trajectory.keyframes.iter().zip(&route.stations_m);
    let inner = places
        .skip(route.stations_m.partition_point(|&s_m| s_m <= from_m))
        .take_while(|(_, s_m)| **s_m < to_m)
        .map(|(keyframe, _)| *keyframe)
        .filter(|keyframe| first.time_us < keyframe.time_us && keyframe.time_us < last.time_us);
    let mut keyframes = vec![first];
    keyframes.extend(inner);
    keyframes.push(last);
    for keyframe in &mut keyframes {
        keyframe.time_us = keyframe.time_us.saturating_sub(first.time_us);
    }
    let name = format!("{}-{}-{number:04}", route.trajectory.name, length_label(to_m - from_m));
    let trajectory = Trajectory { name, keyframes };
    // Ends that fall on one microsecond make times that do not increase: the check refuses such a
    // piece.
    trajectory.check()?;
    Ok(SubTrajectory { stations_m, from_us: first.time_us, trajectory })
}

/// A length as in names of sub-trajectories, rounded to a millimetre (below 1 km) or a metre:
/// `50m`, `2.5km`.
pub fn length_label(length_m: f64) -> String {
    let millimetre_m = |value: f64| (1e3 * value).round() / 1e3;
    if length_m < 1_000.0 {
        format!("{}m", millimetre_m(length_m))
    } else {
        format!("{}km", millimetre_m(1e-3 * length_m))
    }
}
