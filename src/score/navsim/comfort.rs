//! Comfort, as nuPlan and NAVSIM compute it, including their defects.
//!
//! Source: NAVSIM 0a380a9 `pdm_comfort_metrics.py`. The acceleration of the rear axle is moved to
//! the centre of the box by + d (ω² + dω/dt) along the car and by nothing across it, where d is the
//! distance of the two. A rigid body has
//! - d ω² along it and + d dω/dt across it: the published lateral acceleration is always that of
//!   the rear axle.

use crate::record::EgoSample;
use crate::savgol::savgol;

/// Bounds of nuPlan; open.
pub mod bounds {
    /// Least and most longitudinal acceleration, in m/s².
    pub const LONGITUDINAL_MPS2: [f64; 2] = [-4.05, 2.40];
    /// Lateral acceleration, in m/s².
    pub const LATERAL_MPS2: f64 = 4.89;
    /// Largest magnitude of the jerk, in m/s³.
    pub const JERK_MPS3: f64 = 8.37;
    /// Longitudinal jerk, in m/s³.
    pub const LONGITUDINAL_JERK_MPS3: f64 = 4.13;
    /// Yaw acceleration, in rad/s².
    pub const YAW_ACCELERATION_RADPS2: f64 = 1.93;
    /// Yaw rate, in rad/s.
    pub const YAW_RATE_RADPS: f64 = 0.95;
    /// Root mean squares between successive plans: acceleration, jerk, yaw rate, yaw acceleration;
    /// closed.
    pub const EXTENDED: [f64; 4] = [0.7, 0.5, 0.1, 0.1];
}

/// Filtered signals of a drive, each rounded to 8 decimals.
#[derive(Clone, Debug, PartialEq)]
pub struct ComfortSignals {
    /// Longitudinal acceleration, in m/s².
    pub longitudinal_mps2: Vec<f64>,
    /// Lateral acceleration, in m/s².
    pub lateral_mps2: Vec<f64>,
    /// Length of the acceleration, in m/s².
    pub acceleration_mps2: Vec<f64>,
    /// Jerk of that length, in m/s³.
    pub jerk_mps3: Vec<f64>,
    /// Longitudinal jerk, in m/s³.
    pub longitudinal_jerk_mps3: Vec<f64>,
    /// Yaw acceleration from cubics, in rad/s².
    pub yaw_acceleration_radps2: Vec<f64>,
    /// Yaw rate, in rad/s.
    pub yaw_rate_radps: Vec<f64>,
    /// Yaw acceleration from parabolas, which the extended comfort takes, in rad/s².
    pub yaw_acceleration_parabola_radps2: Vec<f64>,
}

/// Differences between two successive plans.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExtendedComfort {
    /// Root mean squares: acceleration, jerk, yaw rate, yaw acceleration.
    pub rms: [f64; 4],
    /// Whether all are within [`bounds::EXTENDED`].
    pub is_within: bool,
}

/// The signals of samples `step_s` seconds apart; `center_x_m` is from the rear axle to the centre
/// of the box. `None` for fewer than 5 samples, which no filter of them fits.
pub fn comfort_signals(ego: &[EgoSample], step_s: f64, center_x_m: f64) -> Option<ComfortSignals> {
    let n = ego.len();
    if n < 5 {
        return None;
    }
    let collect = |value: &dyn Fn(&EgoSample) -> f64| ego.iter().map(value).collect::<Vec<f64>>();
    let longitudinal = collect(&|ego| {
        let rate = ego.yaw_rate_radps;
        ego.acceleration_mps2.x
            + center_x_m * rate * rate
            + center_x_m * ego.yaw_acceleration_radps2
    });
    let lateral = collect(&|ego| ego.acceleration_mps2.y);
    let length = collect(&|ego| ego.acceleration_mps2.length());

    // The published windows are 8 and 15; shorter drives take all samples.
    let smooth = |values: &[f64]| rounded(savgol(values, n.min(8), 2, 0, 1.0));
    let slope = |values: &[f64]| rounded(savgol(values, n.min(15), 2, 1, step_s));
    // Headings must not jump at ±π before they are differentiated.
    let yaw = unwrapped(ego.iter().map(|ego| ego.yaw_rad));
    let of_yaw = |order, derivative| rounded(savgol(&yaw, 5, order, derivative, step_s));
    // Jerks are slopes of signals that are smoothed already.
    let acceleration_mps2 = smooth(&length);
    let longitudinal_mps2 = smooth(&longitudinal);
    Some(ComfortSignals {
        jerk_mps3: slope(&acceleration_mps2),
        longitudinal_jerk_mps3: slope(&longitudinal_mps2),
        longitudinal_mps2,
        lateral_mps2: smooth(&lateral),
        acceleration_mps2,
        yaw_acceleration_radps2: of_yaw(3, 2),
        yaw_rate_radps: of_yaw(2, 1),
        yaw_acceleration_parabola_radps2: of_yaw(2, 2),
    })
}

/// Whether each signal is within its bounds: longitudinal and lateral acceleration, jerk,
/// longitudinal jerk, yaw acceleration, yaw rate.
pub fn is_within(signals: &ComfortSignals) -> [bool; 6] {
    let inside = |values: &[f64], [low, high]: [f64; 2]| {
        values.iter().all(|&value| low < value && value < high)
    };
    let even = |values: &[f64], most: f64| inside(values, [-most, most]);
    [
        inside(&signals.longitudinal_mps2, bounds::LONGITUDINAL_MPS2),
        even(&signals.lateral_mps2, bounds::LATERAL_MPS2),
        even(&signals.jerk_mps3, bounds::JERK_MPS3),
        even(&signals.longitudinal_jerk_mps3, bounds::LONGITUDINAL_JERK_MPS3),
        even(&signals.yaw_acceleration_radps2, bounds::YAW_ACCELERATION_RADPS2),
        even(&signals.yaw_rate_radps, bounds::YAW_RATE_RADPS),
    ]
}

/// EC: how much two successive plans of equal length differ.
pub fn extended_comfort(one: &ComfortSignals, two: &ComfortSignals) -> ExtendedComfort {
    let rms = |one: &[f64], two: &[f64]| {
        let squares: f64 = one.iter().zip(two).map(|(a, b)| (a - b).powi(2)).sum();
        (squares / one.len() as f64).sqrt()
    };
    let rms = [
        rms(&one.acceleration_mps2, &two.acceleration_mps2),
        rms(&one.jerk_mps3, &two.jerk_mps3),
        rms(&one.yaw_rate_radps, &two.yaw_rate_radps),
        rms(&one.yaw_acceleration_parabola_radps2, &two.yaw_acceleration_parabola_radps2),
    ];
    // Closed, unlike the bounds of history comfort.
    let is_within = rms.iter().zip(bounds::EXTENDED).all(|(&rms, most)| rms <= most);
    ExtendedComfort { rms, is_within }
}

/// Rounded to 8 decimals, as published: an acceleration of exactly the bound is found to be on it.
fn rounded(values: Vec<f64>) -> Vec<f64> {
    values.into_iter().map(|value| (value * 1e8).round_ties_even() / 1e8).collect()
}

/// Angles without jumps of 2π.
fn unwrapped(angles: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut turns = 0.0;
    let mut before: Option<f64> = None;
    let unwrap = |angle: f64| {
        if let Some(before) = before {
            turns += ((angle - before) / std::f64::consts::TAU).round_ties_even();
        }
        before = Some(angle);
        angle - std::f64::consts::TAU * turns
    };
    angles.map(unwrap).collect()
}
