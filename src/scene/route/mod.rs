//! Stations of a recorded drive: arc length at each keyframe, and quantities that follow only from
//! the keyframes.
//!
//! The *station* of a keyframe is its distance along the polyline through the keyframes, in metres:
//! `s_0 = 0` and `s_k = s_{k-1} + |p_k - p_{k-1}|`.

mod box_index;
mod clock;
mod section;
mod sub_trajectory;

use std::ops::Range;

use super::Trajectory;
use super::trajectory::{Keyframe, TrajectoryError};

pub use box_index::BoxIndex;
pub use clock::{Association, TimePair, associate};
pub use section::{MAX_SECTION_POSES, RoutePose, RouteSection};
pub use sub_trajectory::{MAX_SUB_TRAJECTORIES, SubTrajectory, length_label, sub_trajectories};

/// Distance between keyframes of a route, in metres.
pub const KEYFRAME_SPACING_M: f64 = 0.5;
/// Length of a chunk of a route, in metres.
pub const ROUTE_CHUNK_LENGTH_M: f64 = 5_000.0;
/// Lengths of sub-trajectories, in metres.
pub const SUB_TRAJECTORY_LENGTHS_M: [f64; 6] = [50.0, 250.0, 500.0, 1_000.0, 2_500.0, 5_000.0];

/// A recorded drive with the station of each keyframe.
///
/// ```
/// use glam::DVec3;
/// use wildcity_scene::Trajectory;
/// use wildcity_scene::geometry::Pose;
/// use wildcity_scene::route::Route;
/// use wildcity_scene::trajectory::Keyframe;
///
/// let keyframe = |i: i64| Keyframe {
///     time_us: i * 100_000,
///     world_from_rig: Pose { position_m: i as f64 * DVec3::X, ..Pose::IDENTITY },
/// };
/// let drive = Trajectory { name: "log".into(), keyframes: (0..=100).map(keyframe).collect() };
/// let route = Route::new(&drive)?;
/// assert_eq!(route.length_m(), 100.0);
/// assert_eq!(route.at(12.5).time_us, 1_250_000);
/// # Ok::<(), wildcity_scene::route::RouteError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Route<'a> {
    trajectory: &'a Trajectory,
    stations_m: Vec<f64>,
}

/// A part of a route of [`ROUTE_CHUNK_LENGTH_M`].
#[derive(Clone, Debug, PartialEq)]
pub struct RouteChunk {
    /// `floor(s_k / 5000)` of its keyframes' stations.
    pub number: u64,
    /// Indices of its keyframes.
    pub keyframes: Range<usize>,
    /// Stations of its first and last keyframe, in metres.
    pub stations_m: [f64; 2],
}

/// Why a computation on a route was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RouteError {
    /// The drive, or a trajectory derived from it, is invalid.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// A length, a stride or a tolerance is out of range.
    #[error("{field} is {value:?}; {must}")]
    Value {
        field: &'static str,
        value: f64,
        /// The values that are accepted.
        must: &'static str,
    },
    /// A time before the first or after the last keyframe.
    #[error(
        "time {time_us} µs is not within trajectory {name:?}, {from_us} to {to_us} µs: poses are \
         interpolated, not extrapolated"
    )]
    Outside {
        name: String,
        /// The refused time, in microseconds.
        time_us: i64,
        /// The first keyframe's time, in microseconds.
        from_us: i64,
        /// The last keyframe's time, in microseconds.
        to_us: i64,
    },
    /// The times of a clock do not increase strictly.
    #[error("{clock}[{index}] is {time_us} µs, not after the one before it ({before_us} µs)")]
    Order {
        /// The clock: `first` or `second`.
        clock: &'static str,
        /// Index of the time.
        index: usize,
        /// That time, in microseconds.
        time_us: i64,
        /// The time of the previous keyframe, in microseconds.
        before_us: i64,
    },
}

impl<'a> Route<'a> {
    /// Computes the stations of a drive's keyframes.
    ///
    /// # Errors
    /// As [`Trajectory::check`].
    pub fn new(trajectory: &'a Trajectory) -> Result<Self, RouteError> {
        trajectory.check()?;
        let mut station_m = 0.0;
        // A running sum: n keyframes cost n distances, and stations never decrease, because
        // distances are not negative.
        let steps = trajectory.keyframes.windows(2).map(|pair| {
            station_m += distance_m(&pair[0], &pair[1]);
            station_m
        });
        let stations_m = std::iter::once(0.0).chain(steps).collect();
        Ok(Self { trajectory, stations_m })
    }

    /// Stations of the keyframes, in metres; they never decrease.
    pub fn stations_m(&self) -> &[f64] {
        &self.stations_m
    }

    /// Length of the route, in metres.
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// The interpolated pose and time at a station in metres, clamped to the ends of the route.
    /// Where the vehicle stood still, the time is that of its arrival.
    pub fn at(&self, station_m: f64) -> Keyframe {
        let keyframes = &self.trajectory.keyframes;
        // The first keyframe at or after the station. It is keyframe 0 only if the station is at or
        // before the start.
        let reached = self.stations_m.partition_point(|&s_m| s_m < station_m);
        let after = reached.min(keyframes.len() - 1);
        let Some(before) = after.checked_sub(1) else { return keyframes[0] };
        let from_m = self.stations_m[before];
        let to_m = self.stations_m[after];
        // Stations of the two differ, unless the station is beyond the end: then the quotient is
        // above 1 or infinite, and `min` takes the end.
        let t = ((station_m - from_m) / (to_m - from_m)).min(1.0);
        between(&keyframes[before], &keyframes[after], t)
    }

    /// The station at a time of the drive's clock, in microseconds, clamped to the ends of the
    /// route.
    pub fn station_at(&self, time_us: i64) -> f64 {
        let keyframes = &self.trajectory.keyframes;
        let after = keyframes.partition_point(|keyframe| keyframe.time_us < time_us);
        let Some(before) = after.checked_sub(1) else { return 0.0 };
        let Some(to) = keyframes.get(after) else { return self.length_m() };
        let from = &keyframes[before];
        // i128, since the difference of two i64 times may overflow i64.
        let span_us = |from_us: i64, to_us: i64| (i128::from(to_us) - i128::from(from_us)) as f64;
        let t = span_us(from.time_us, time_us) / span_us(from.time_us, to.time_us);
        self.stations_m[before] + t * (self.stations_m[after] - self.stations_m[before])
    }

    /// The route in chunks of 5 km, without chunks that have no keyframe.
    pub fn chunks(&self) -> Vec<RouteChunk> {
        let number = |s_m: f64| (s_m / ROUTE_CHUNK_LENGTH_M).floor() as u64;
        let mut first = 0;
        // Stations never decrease, so that keyframes of a chunk are neighbours.
        let runs = self.stations_m.chunk_by(|a, b| number(*a) == number(*b));
        runs.map(|run| {
            let keyframes = first..first + run.len();
            first = keyframes.end;
            let stations_m = [run[0], run[run.len() - 1]];
            RouteChunk { number: number(run[0]), keyframes, stations_m }
        })
        .collect()
    }

    /// The recorded keyframes that are at least `step_m` apart: the first one, and each one at this
    /// distance from the previously kept one. The distance is Euclidean and not along the route, so
    /// that position jitter of a standing vehicle does not accumulate.
    ///
    /// # Errors
    /// [`RouteError::Value`] if the step is not positive and finite.
    pub fn subsample(&self, step_m: f64) -> Result<Trajectory, RouteError> {
        positive("step_m", step_m)?;
        let mut kept: Vec<Keyframe> = Vec::new();
        for keyframe in &self.trajectory.keyframes {
            // 0.1 % less, so that keyframes at exactly this distance are kept in spite of rounding.
            // Compared with the keyframe that was kept last and not with the one before.
            if kept.last().is_none_or(|last| distance_m(last, keyframe) >= 0.999 * step_m) {
                kept.push(*keyframe);
            }
        }
        Ok(Trajectory { name: self.trajectory.name.clone(), keyframes: kept })
    }
}

/// Interpolates time and pose between two keyframes by `t` in [0, 1].
fn between(from: &Keyframe, to: &Keyframe, t: f64) -> Keyframe {
    if t >= 1.0 {
        return *to;
    }
    // i128, since the difference of two i64 times may overflow i64.
    let span_us = (i128::from(to.time_us) - i128::from(from.time_us)) as f64;
    Keyframe {
        // t span_us is within the two times; only the cast of a huge span can saturate.
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
