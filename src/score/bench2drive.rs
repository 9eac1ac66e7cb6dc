//! Bench2Drive's driving score, success, efficiency and smoothness, including their defects.
//!
//! Source: Thinklab-SJTU/Bench2Drive 7ec25d1, `leaderboard/utils/statistics_manager.py`,
//! `tools/efficiency_smoothness_benchmark.py`.

use glam::DVec2;

use wildcity_scene::ActorClass;

use super::navsim::bounds;
use super::record::{DriveRecord, EgoSample};
use super::savgol::savgol;
use super::scored::{Measured, Missing, Score};

/// The name of the driving score.
pub const DRIVING_SCORE: &str = "bench2drive.driving@7ec25d1";
/// The name of the success.
pub const SUCCESS: &str = "bench2drive.success@7ec25d1";
/// The name of the efficiency.
pub const EFFICIENCY: &str = "bench2drive.efficiency@7ec25d1";
/// The name of the smoothness.
pub const SMOOTHNESS: &str = "bench2drive.smoothness@7ec25d1";

/// Samples of a segment of the smoothness, 0.1 s apart.
const SEGMENT: usize = 20;
/// Window and order of its filter.
const FILTER: (usize, usize) = (7, 2);
/// Percentages beyond this are dropped from the efficiency.
pub(crate) const MOST_PERCENT: f64 = 1000.0;
/// Check points of a route at which speeds are compared.
const CHECK_POINTS: usize = 20;
/// Contacts with the same actor within this time, or this distance, are one.
const SAME_CONTACT_US: i64 = 5_000_000;
const SAME_CONTACT_M: f64 = 5.0;
/// A slower ego is not charged for a contact, in m/s.
const STANDING_MPS: f64 = 0.1;
/// Largest distance of a vehicle that counts as traffic around the ego, in metres.
const AROUND_M: f64 = 50.0;

/// Infractions, most of which reduce the driving score.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Infraction {
    /// A contact with a pedestrian.
    Pedestrian,
    /// A contact with a vehicle or a bicycle.
    Vehicle,
    /// A contact with anything else.
    Static,
    /// A red light passed.
    RedLight,
    /// A stop sign passed.
    Stop,
    /// A scenario that took too long.
    ScenarioTimeout,
    /// An emergency vehicle that was blocked.
    Yield,
    /// Too slow; does not reduce the score.
    MinSpeed,
}

impl Infraction {
    /// Factor of the driving score for each.
    pub fn factor(self) -> f64 {
        match self {
            Self::Pedestrian => 0.5,
            Self::Vehicle => 0.6,
            Self::Static => 0.65,
            Self::RedLight | Self::ScenarioTimeout | Self::Yield => 0.7,
            Self::Stop => 0.8,
            Self::MinSpeed => 1.0,
        }
    }
}

/// The driving score, 0 to 100: the share of the route in percent, times a factor for each
/// infraction, times the share that was driven within the lanes. Six decimals.
pub fn driving_score(route_percent: f64, infractions: &[Infraction], outside_percent: f64) -> f64 {
    let factor: f64 = infractions.iter().map(|infraction| infraction.factor()).product();
    let score = route_percent * factor * (1.0 - outside_percent / 100.0);
    (score * 1e6).round_ties_even() / 1e6
}

/// Success: the whole route without any infraction but a low speed.
pub fn is_success(route_percent: f64, infractions: &[Infraction], outside_percent: f64) -> bool {
    let clean = infractions.iter().all(|&infraction| infraction == Infraction::MinSpeed);
    route_percent >= 100.0 && clean && outside_percent == 0.0
}

/// Efficiency: the mean of the ego's speeds in percent of the traffic's. `None` without any up to
/// 1000 %.
pub fn efficiency(percent_of_traffic: &[f64]) -> Option<f64> {
    let kept: Vec<f64> =
        percent_of_traffic.iter().copied().filter(|&percent| percent <= MOST_PERCENT).collect();
    (!kept.is_empty()).then(|| kept.iter().sum::<f64>() / kept.len() as f64)
}

/// A sample of the smoothness, as CARLA gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Acceleration in the world, in m/s².
    pub acceleration_mps2: DVec2,
    pub forward: DVec2,
    /// Unit vector to the right.
    pub right: DVec2,
    /// Angular velocity about z, in degrees per second.
    pub angular_velocity_degps: f64,
}

/// Whether each whole segment of 20 samples is smooth; remaining samples are dropped. Fewer than 21
/// samples are one segment.
///
/// As published, the yaw acceleration is the yaw rate, and both are compared in degrees with bounds
/// in radians. `None` for fewer than 3 samples.
pub fn smooth_segments(samples: &[MotionSample]) -> Option<Vec<bool>> {
    // Three samples are the least that a parabola fits.
    if samples.len() < 3 {
        return None;
    }
    if samples.len() <= SEGMENT {
        return Some(vec![is_smooth(samples)]);
    }
    Some(samples.chunks_exact(SEGMENT).map(is_smooth).collect())
}

fn is_smooth(samples: &[MotionSample]) -> bool {
    let (window, order) = FILTER;
    // A short segment has a window of all its samples; `savgol` needs one above the order, which
    // the check for 3 samples ensures.
    let window = window.min(samples.len());
    let values =
        |value: &dyn Fn(&MotionSample) -> f64| samples.iter().map(value).collect::<Vec<_>>();
    let smoothed =
        |value: &dyn Fn(&MotionSample) -> f64| savgol(&values(value), window, order, 0, 1.0);
    let slope = |values: &[f64]| savgol(values, window, order, 1, 0.1);

    // Signals are smoothed before they are differentiated, as published.
    let longitudinal = smoothed(&|sample| sample.acceleration_mps2.dot(sample.forward));
    let lateral = smoothed(&|sample| sample.acceleration_mps2.dot(sample.right));
    let length = smoothed(&|sample| sample.acceleration_mps2.length());
    let mut turns = 0.0;
    let mut before: Option<f64> = None;
    // As published, jumps of 2π are taken out of the rate, as if it were a heading.
    let rates: Vec<f64> = samples
        .iter()
        .map(|sample| {
            let rate = sample.angular_velocity_degps;
            if let Some(before) = before {
                turns += ((rate - before) / std::f64::consts::TAU).round_ties_even();
            }
            before = Some(rate);
            rate - std::f64::consts::TAU * turns
        })
        .collect();
    let rate = savgol(&rates, window, order, 0, 1.0);
    // Every bound is open: a value on it is not smooth.
    let [least, most] = bounds::LONGITUDINAL_MPS2;
    let even = |values: &[f64], most: f64| values.iter().all(|value| value.abs() < most);
    longitudinal.iter().all(|&a| least < a && a < most)
        && even(&lateral, bounds::LATERAL_MPS2)
        && even(&slope(&length), bounds::JERK_MPS3)
        && even(&slope(&longitudinal), bounds::LONGITUDINAL_JERK_MPS3)
        && even(&rate, bounds::YAW_ACCELERATION_RADPS2)
        && even(&rate, bounds::YAW_RATE_RADPS)
}

/// The share of smooth segments.
pub fn smoothness(segments: &[bool]) -> f64 {
    segments.iter().filter(|&&smooth| smooth).count() as f64 / segments.len() as f64
}

/// The four scores of an episode.
pub fn scores(record: &DriveRecord) -> Vec<Score> {
    let route = route_percent(record);
    let infractions = infractions(record);
    let outside = outside_percent(record);
    let with_all = |score: &dyn Fn(f64, &[Infraction], f64) -> f64| -> Measured {
        Ok(score(route.clone()?, infractions.as_deref().map_err(Clone::clone)?, outside.clone()?))
    };
    let parts = [
        ("route_percent", route.as_ref().ok().copied()),
        ("outside_percent", outside.as_ref().ok().copied()),
        ("infractions", infractions.as_ref().ok().map(|found| found.len() as f64)),
    ];
    let success = with_all(&|route, infractions, outside| {
        f64::from(u8::from(is_success(route, infractions, outside)))
    });
    vec![
        Score::new(DRIVING_SCORE, with_all(&driving_score), parts),
        Score::new(SUCCESS, success, parts),
        Score::new(EFFICIENCY, episode_efficiency(record), []),
        Score::new(SMOOTHNESS, episode_smoothness(record), []),
    ]
}

fn route_percent(record: &DriveRecord) -> Measured {
    let missing = || Missing::new("needs the recorded drive");
    let reference = record.reference.as_ref().ok_or_else(missing)?;
    let stations_m = record.stations_m().ok_or_else(missing)?;
    let length_m = reference.line.length_m();
    if length_m <= 0.0 {
        return Err(Missing::new("needs a recorded drive that moves"));
    }
    // The farthest station and not the last one: driving back does not reduce the route.
    let farthest_m = stations_m.iter().fold(0.0, |most: f64, station| most.max(station.0));
    Ok((100.0 * farthest_m / length_m).min(100.0))
}

/// Contacts, each actor once per 5 s and 5 m, and only of an ego that moves. Lights, signs and
/// emergency vehicles are not in a record.
fn infractions(record: &DriveRecord) -> Result<Vec<Infraction>, Missing> {
    let tracks = record.tracks.as_ref().ok_or(Missing::new("needs the actors of a scenario"))?;
    // Per actor: the last contact, also one that was not charged, since the window starts again
    // with each.
    let mut last: Vec<Option<(i64, DVec2)>> = vec![None; tracks.len()];
    let mut found = Vec::new();
    for contact in record.contacts.iter().filter(|contact| !contact.at_start) {
        let Some(track) = tracks.get(usize::from(contact.actor)) else { continue };
        // Rounded down to a sample; a contact after the last sample takes that one.
        let sample = (contact.time_us / record.dt_us.max(1)) as usize;
        let place_m = record.ego[sample.min(record.ego.len() - 1)].origin_m;
        let before = &mut last[usize::from(contact.actor)];
        let is_same = before.is_some_and(|(time_us, at_m)| {
            contact.time_us - time_us < SAME_CONTACT_US || place_m.distance(at_m) < SAME_CONTACT_M
        });
        *before = Some((contact.time_us, place_m));
        if is_same || contact.ego_velocity_mps.length() < STANDING_MPS {
            continue;
        }
        found.push(match track.class {
            ActorClass::Pedestrian => Infraction::Pedestrian,
            ActorClass::Vehicle | ActorClass::Bicycle => Infraction::Vehicle,
            ActorClass::Object => Infraction::Static,
        });
    }
    let of_twin = record.static_contacts.iter().flatten();
    let moving = of_twin.filter(|contact| contact.impact_mps >= STANDING_MPS);
    // Contacts with the twin have no actor and no window: each is the beginning of one contact.
    found.extend(moving.map(|_| Infraction::Static));
    Ok(found)
}

/// The share of the driven distance that was outside of the lanes of the route.
fn outside_percent(record: &DriveRecord) -> Measured {
    let map = record.map.as_ref().ok_or(Missing::new("needs a map of the lanes"))?;
    let mut way_m = 0.0;
    let mut outside_m = 0.0;
    for pair in record.ego.windows(2) {
        let step_m = pair[0].origin_m.distance(pair[1].origin_m);
        way_m += step_m;
        if map.is_off_route(pair[1].origin_m) {
            outside_m += step_m;
        }
    }
    // A standing ego was never outside by any distance.
    Ok(if way_m > 0.0 { 100.0 * outside_m / way_m } else { 0.0 })
}

/// Speeds between the check points of the route, against vehicles within 50 m of the ego.
fn episode_efficiency(record: &DriveRecord) -> Measured {
    let tracks = record.tracks.as_ref().ok_or(Missing::new("needs the actors of a scenario"))?;
    let stations_m = record.stations_m().ok_or(Missing::new("needs the recorded drive"))?;
    let length_m = record.reference.as_ref().map_or(0.0, |drive| drive.line.length_m());
    let mut percents = Vec::new();
    let mut ego_mps = Vec::new();
    let mut traffic_mps = Vec::new();
    // Check point 0 is the start, where nothing has been driven yet.
    let mut next = 1;
    for (step, (sample, (station_m, _))) in record.ego.iter().zip(&stations_m).enumerate() {
        ego_mps.push(sample.speed_mps());
        for track in tracks.iter().filter(|track| track.class == ActorClass::Vehicle) {
            let Some(there) = track.samples.get(step).copied().flatten() else { continue };
            if there.footprint.center_m.distance(sample.origin_m) <= AROUND_M {
                traffic_mps.push(there.velocity_mps.length());
            }
        }
        let check_point_m = next as f64 * length_m / CHECK_POINTS as f64;
        // At most one check point per step; a longer jump is caught up with in the next steps.
        if *station_m >= check_point_m && next <= CHECK_POINTS {
            let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
            let traffic = mean(&traffic_mps);
            // Standing traffic has no speed to compare with: the part is left out.
            if traffic > 0.0 {
                percents.push(100.0 * mean(&ego_mps) / traffic);
            }
            ego_mps.clear();
            traffic_mps.clear();
            next += 1;
        }
    }
    efficiency(&percents).ok_or(Missing::new("needs moving vehicles around the ego"))
}

fn episode_smoothness(record: &DriveRecord) -> Measured {
    if !record.is_driven {
        return Err(Missing::new("needs an ego that was driven and not teleported"));
    }
    // The bounds and the filter assume 10 Hz.
    if record.dt_us != 100_000 {
        return Err(Missing::new("needs steps of 0.1 s"));
    }
    let samples: Vec<MotionSample> = record.ego.iter().map(MotionSample::from_sample).collect();
    let segments = smooth_segments(&samples).ok_or(Missing::new("needs 3 samples"))?;
    Ok(smoothness(&segments))
}

impl MotionSample {
    fn from_sample(ego: &EgoSample) -> Self {
        let forward = DVec2::from_angle(ego.yaw_rad);
        Self {
            // From the car's axes to the world's, because CARLA gives world accelerations.
            acceleration_mps2: forward.rotate(ego.acceleration_mps2),
            forward,
            right: -forward.perp(),
            angular_velocity_degps: ego.yaw_rate_radps.to_degrees(),
        }
    }
}
