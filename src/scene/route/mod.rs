//! Routes: what follows from a recorded drive's keyframes unmatched.
//!
//! Distances are along the keyframes, `s_0 = 0` and `s_k = s_{k-1} + |p_k - p_{k-1}|`, in metres.

mod box_index;
mod clock;
mod sub_trajectory;

use std::ops::Range;

use super::Trajectory;
use super::trajectory::{Keyframe, TrajectoryError};

pub use box_index::BoxIndex;
pub use clock::{Association, TimePair, associate};
pub use sub_trajectory::{MAX_SUB_TRAJECTORIES, SubTrajectory, length_label, sub_trajectories};

/// Distance between keyframes of a route, in metres.
pub const KEYFRAME_SPACING_M: f64 = 0.5;
/// Length of a chunk of a route, in metres.
pub const ROUTE_CHUNK_LENGTH_M: f64 = 5_000.0;
/// Lengths of sub-trajectories, in metres.
pub const SUB_TRAJECTORY_LENGTHS_M: [f64; 6] = [50.0, 250.0, 500.0, 1_000.0, 2_500.0, 5_000.0];

/// A recorded drive and how far along it each keyframe lies.
#[derive(Clone, Debug)]
pub struct Route<'a> {
    trajectory: &'a Trajectory,
    stations_m: Vec<f64>,
}

/// A stretch of 5 km of a route.
#[derive(Clone, Debug, PartialEq)]
pub struct RouteChunk {
    /// `c_k = floor(s_k / 5000)` of its keyframes.
    pub number: u64,
    /// Its keyframes.
    pub keyframes: Range<usize>,
    /// Stations of its first and last keyframe, in metres.
    pub stations_m: [f64; 2],
}

/// Why a route tool refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RouteError {
    /// The drive itself cannot be used, or what would be made of it.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// A length, a stride or a tolerance.
    #[error("{field} is {value:?}; {must}")]
    Value {
        /// Which.
        field: &'static str,
        /// The refused value.
        value: f64,
        /// What must hold instead.
        must: &'static str,
    },
    /// Nothing is extrapolated.
    #[error(
        "time {time_us} µs is not within trajectory {name:?}, {from_us} to {to_us} µs: poses are \
         interpolated, not extrapolated"
    )]
    Outside {
        /// The trajectory.
        name: String,
        /// The refused time, in microseconds.
        time_us: i64,
        /// The first keyframe's time, in microseconds.
        from_us: i64,
        /// The last keyframe's time, in microseconds.
        to_us: i64,
    },
    /// Times of one clock must increase strictly.
    #[error("{clock}[{index}] is {time_us} µs, not after the one before it ({before_us} µs)")]
    Order {
        /// Which clock.
        clock: &'static str,
        /// Which of its times.
        index: usize,
        /// That time, in microseconds.
        time_us: i64,
        /// The time before it, in microseconds.
        before_us: i64,
    },
}

impl<'a> Route<'a> {
    /// Measures a drive.
    ///
    /// # Errors
    /// As [`Trajectory::check`].
    pub fn new(trajectory: &'a Trajectory) -> Result<Self, RouteError> {
        trajectory.check()?;
        let mut station_m = 0.0;
        let steps = trajectory.keyframes.windows(2).map(|pair| {
            station_m += distance_m(&pair[0], &pair[1]);
            station_m
        });
        let stations_m = std::iter::once(0.0).chain(steps).collect();
        Ok(Self { trajectory, stations_m })
    }

    /// How far along each keyframe lies, in metres: never falling.
    pub fn stations_m(&self) -> &[f64] {
        &self.stations_m
    }

    /// From the first keyframe to the last one, in metres.
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// Where the drive was at a station, clamped to its ends, in metres, and when. Where it stood
    /// still, the moment it got there.
    pub fn at(&self, station_m: f64) -> Keyframe {
        let keyframes = &self.trajectory.keyframes;
        // The first keyframe that is not before the station; it is not the first of all then, unless
        // the station is at or before the start.
        let after = self.stations_m.partition_point(|&s_m| s_m < station_m);
        let after = after.min(keyframes.len() - 1);
        let Some(before) = after.checked_sub(1) else { return keyframes[0] };
        let (from_m, to_m) = (self.stations_m[before], self.stations_m[after]);
        let t = ((station_m - from_m) / (to_m - from_m)).min(1.0);
        between(&keyframes[before], &keyframes[after], t)
    }

    /// The drive in chunks of 5 km, those without a keyframe left out.
    pub fn chunks(&self) -> Vec<RouteChunk> {
        let number = |s_m: f64| (s_m / ROUTE_CHUNK_LENGTH_M).floor() as u64;
        let mut first = 0;
        let runs = self.stations_m.chunk_by(|a, b| number(*a) == number(*b));
        runs.map(|run| {
            let keyframes = first..first + run.len();
            first = keyframes.end;
            let stations_m = [run[0], run[run.len() - 1]];
            RouteChunk { number: number(run[0]), keyframes, stations_m }
        })
        .collect()
    }

    /// The recorded poses that are at least `step_m` apart: the first one, and each one so far from
    /// the one kept before it. As the crow flies, so that a position that jitters where the vehicle
    /// stands still does not add up.
    ///
    /// # Errors
    /// [`RouteError::Value`] if the step is not positive and finite.
    pub fn subsample(&self, step_m: f64) -> Result<Trajectory, RouteError> {
        positive("step_m", step_m)?;
        let mut kept: Vec<Keyframe> = Vec::new();
        for keyframe in &self.trajectory.keyframes {
            // A thousandth less, so that keyframes of just that distance are kept whatever rounding
            // did to them.
            if kept.last().is_none_or(|last| distance_m(last, keyframe) >= 0.999 * step_m) {
                kept.push(*keyframe);
            }
        }
        Ok(Trajectory { name: self.trajectory.name.clone(), keyframes: kept })
    }
}

/// The moment a fraction `t` in [0, 1] of the way from one keyframe to another one.
fn between(from: &Keyframe, to: &Keyframe, t: f64) -> Keyframe {
    if t >= 1.0 {
        return *to;
    }
    // i128: the clocks of two logs may lie on both ends of i64.
    let span_us = (i128::from(to.time_us) - i128::from(from.time_us)) as f64;
    Keyframe {
        time_us: from.time_us.saturating_add((t * span_us).round() as i64),
        world_from_rig: from.world_from_rig.interpolate(&to.world_from_rig, t),
    }
}

fn distance_m(from: &Keyframe, to: &Keyframe) -> f64 {
    from.world_from_rig.position_m.distance(to.world_from_rig.position_m)
}

fn positive(field: &'static str, value: f64) -> Result<(), RouteError> {
    if value > 0.0 && value.is_finite() {
        return Ok(());
    }
    Err(RouteError::Value { field, value, must: "a length is more than 0 m, and finite" })
}
