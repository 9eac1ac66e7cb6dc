//! Limits and defaults of this package, with the arithmetic behind each.

/// Largest acceleration of an action, in m/s²: as in Alpamayo, about the grip of tyres on a dry road.
pub const EGO_ACCELERATION_M_S2: f64 = 9.8;

/// Largest curvature of an action, in 1/m: as in Alpamayo, a turning circle of 10 m.
pub const EGO_CURVATURE_1_M: f64 = 0.2;

/// Largest angle of the front wheels, in radians: that of the largest curvature at very low speed, 0.2 1/m
/// times a wheelbase of 2.85 m. At speed the car understeers and reaches less curvature.
pub const EGO_STEERING_RAD: f64 = EGO_CURVATURE_1_M * 2.85;

/// Largest speed forwards, in m/s: 216 km/h.
pub const EGO_SPEED_M_S: f64 = 60.0;

/// Largest speed backwards, in m/s: 36 km/h. From 12.8 m/s on, an eigenvalue would coincide with the rate of
/// the steering's lag, and from 28.6 m/s on an understeering car is unstable backwards.
pub const EGO_REVERSE_M_S: f64 = 10.0;

/// Largest number of poses of a trajectory that an ego follows: 6.4 s at 10 Hz, as Alpamayo outputs.
pub const PATH_POSES: usize = 64;

/// Latest time of such a trajectory, in microseconds: one minute.
pub const PATH_US: i64 = 60_000_000;

/// Period at which the tracker of a trajectory updates its action, in microseconds: a tenth of the steering's
/// lag.
pub const TRACKER_TICK_US: u64 = 10_000;

/// Distance up to which a recorded drive defines the ground, in metres: the width of a street with its
/// pavements.
pub const GROUND_NEAR_M: f64 = 25.0;

/// Smallest z component of a ground plane's unit normal: a slope of 45 degrees, steeper than any street.
pub const GROUND_UP: f64 = std::f64::consts::FRAC_1_SQRT_2;
