//! Limits and defaults of this package, with the arithmetic behind each.

/// Most that an action asks for, in m/s²: Alpamayo's, what tyres hold on a dry road.
pub const EGO_ACCELERATION_M_S2: f64 = 9.8;

/// Tightest curvature that an action asks for, in 1/m: Alpamayo's, a turning circle of 10 m.
pub const EGO_CURVATURE_1_M: f64 = 0.2;

/// Largest angle of the front wheels, in radians: the tightest curvature at a crawl, 0.2 of a wheelbase of
/// 2.85 m. A fast car, which understeers, reaches less curvature.
pub const EGO_STEERING_RAD: f64 = EGO_CURVATURE_1_M * 2.85;

/// Fastest forwards, in m/s: 216 km/h.
pub const EGO_SPEED_M_S: f64 = 60.0;

/// Fastest backwards, in m/s: 36 km/h. From 12.8 on, steering would resonate with its lag, and from 28.6
/// on a car that understeers is unstable backwards.
pub const EGO_REVERSE_M_S: f64 = 10.0;

/// Poses of a trajectory that an ego follows: 6.4 s at 10 Hz, what Alpamayo writes.
pub const PATH_POSES: usize = 64;

/// Latest time of such a trajectory, in microseconds: a minute.
pub const PATH_US: i64 = 60_000_000;

/// How often an ego that follows a trajectory is told what to do, in microseconds: ten times within the
/// lag of its steering.
pub const TRACKER_TICK_US: u64 = 10_000;

/// How far a recorded drive tells of the ground, in metres: across a street and its pavements.
pub const GROUND_NEAR_M: f64 = 25.0;

/// The least vertical part of a ground's normal: 45 degrees, steeper than any street.
pub const GROUND_UP: f64 = std::f64::consts::FRAC_1_SQRT_2;
