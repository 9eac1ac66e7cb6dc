//! The data of an episode that scores use: only numbers.

use glam::DVec2;

use wildcity_scene::ActorClass;
use wildcity_sim::contact::{Contact, Footprint};

use super::map::LaneMap;
use super::plan::Plan;
use super::polyline::Polyline;

/// The reason without a recorded drive, and without a route in its place.
pub const NO_REFERENCE: &str = "there is no recorded drive to follow";
/// The reason without a map.
pub const NO_MAP: &str = "the scenario has no map";

/// The size of the ego, and where its reference point is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoShape {
    /// Length of its box, in metres.
    pub length_m: f64,
    /// Width of its box, in metres.
    pub width_m: f64,
    /// From the rear axle forward to the centre of the box, in metres.
    pub center_x_m: f64,
}

/// The ego at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EgoSample {
    /// Its rear axle, in metres.
    pub origin_m: DVec2,
    /// Its heading, in radians, counter-clockwise from x.
    pub yaw_rad: f64,
    /// Velocity of the rear axle in the car's axes (x forward, y left), in m/s.
    pub velocity_mps: DVec2,
    /// Acceleration of the rear axle in the car's axes, in m/s².
    pub acceleration_mps2: DVec2,
    /// Yaw rate, in rad/s.
    pub yaw_rate_radps: f64,
    /// Yaw acceleration, in rad/s².
    pub yaw_acceleration_radps2: f64,
}

/// An actor at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackSample {
    pub footprint: Footprint,
    /// Its velocity in the world, in m/s.
    pub velocity_mps: DVec2,
}

/// An actor over an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    pub name: String,
    pub class: ActorClass,
    /// One for each sample of the ego; `None` while it is absent.
    pub samples: Vec<Option<TrackSample>>,
}

/// A contact with the twin's Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StaticContact {
    /// When it began, in microseconds.
    pub time_us: i64,
    /// The ego's speed, in m/s.
    pub impact_mps: f64,
}

/// The recorded drive that the ego should follow, from where the episode starts.
#[derive(Clone, Debug, PartialEq)]
pub struct ReferenceDrive {
    /// Its line; station 0 is the start of the episode.
    pub line: Polyline,
    /// Times of its points, in microseconds since the start of the episode; rising.
    pub times_us: Vec<i64>,
}

/// An episode, as scores see it. Samples are at 0, `dt_us`, 2 `dt_us` ..
#[derive(Clone, Debug, PartialEq)]
pub struct DriveRecord {
    /// Time between two samples, in microseconds.
    pub dt_us: i64,
    /// The size of the ego; `None` if the record does not have it.
    pub shape: Option<EgoShape>,
    /// The ego, sample by sample; at least one.
    pub ego: Vec<EgoSample>,
    /// Whether the ego's velocities are meaningful; false if it was teleported.
    pub is_driven: bool,
    /// The actors; `None` for an episode without a scenario, whose record has no surroundings.
    pub tracks: Option<Vec<Track>>,
    /// The agent's plans, in order of their decisions; none if it sent actions or poses.
    pub plans: Vec<Plan>,
    /// Contacts with actors, in order.
    pub contacts: Vec<Contact>,
    /// Contacts with the twin; `None` if they were not tested.
    pub static_contacts: Option<Vec<StaticContact>>,
    pub reference: Option<ReferenceDrive>,
    /// Why there is no `reference`, where there is none: [`NO_REFERENCE`] or another reason.
    pub no_reference: &'static str,
    /// The time that the scenario gives, in microseconds; `None` if it gives none.
    pub limit_us: Option<i64>,
    pub map: Option<LaneMap>,
    /// Why there is no `map`, where there is none: [`NO_MAP`] or another reason.
    pub no_map: &'static str,
    /// Progress that is required to pass, 0 to 1.
    pub least_progress: f64,
    /// When the ego first left the area that the twin was trained on, in microseconds.
    pub off_model_us: Option<i64>,
}

impl EgoShape {
    /// The ego's box at a sample.
    pub fn footprint(&self, sample: &EgoSample) -> Footprint {
        let center_m = sample.origin_m + self.center_x_m * DVec2::from_angle(sample.yaw_rad);
        Footprint::new(center_m, sample.yaw_rad, self.length_m, self.width_m)
    }
}

impl EgoSample {
    /// Its speed, in m/s.
    pub fn speed_mps(&self) -> f64 {
        self.velocity_mps.length()
    }

    /// Its velocity in the world, in m/s.
    pub fn world_velocity_mps(&self) -> DVec2 {
        DVec2::from_angle(self.yaw_rad).rotate(self.velocity_mps)
    }
}

impl ReferenceDrive {
    /// The station at a time, in metres; constant beyond both ends.
    pub fn station_at_m(&self, time_us: i64) -> f64 {
        let stations_m = self.line.stations_m();
        let after = self.times_us.partition_point(|&at_us| at_us < time_us);
        if after == 0 {
            return stations_m[0];
        }
        let Some(&after_us) = self.times_us.get(after) else { return self.line.length_m() };
        let before_us = self.times_us[after - 1];
        let t = (time_us - before_us) as f64 / (after_us - before_us) as f64;
        stations_m[after - 1] + t * (stations_m[after] - stations_m[after - 1])
    }
}

impl DriveRecord {
    /// The time of the last sample, in microseconds.
    pub fn end_us(&self) -> i64 {
        self.dt_us * (self.ego.len() as i64 - 1)
    }

    /// Distance that the recorded drive covered in the time of the scenario, in metres.
    pub fn recorded_way_m(&self) -> Option<f64> {
        let reference = self.reference.as_ref()?;
        // The longer of the scenario's time and the episode's: an episode that ends early is
        // compared with the whole drive.
        Some(reference.station_at_m(self.limit_us.unwrap_or(self.end_us()).max(self.end_us())))
    }

    /// The station of the ego along the recorded drive at each sample, in metres, and its distance
    /// from it. The search covers 5 m behind and 50 m ahead of the previous station, so that a
    /// route which crosses itself is followed in order.
    pub fn stations_m(&self) -> Option<Vec<(f64, f64)>> {
        let line = &self.reference.as_ref()?.line;
        // The search moves with the ego. A jump of more than 50 m between two samples is not
        // followed.
        let mut station_m = 0.0;
        let project = |sample: &EgoSample| {
            let found = line.project_between(sample.origin_m, station_m - 5.0, station_m + 50.0);
            station_m = found.station_m;
            (found.station_m, found.distance_m)
        };
        Some(self.ego.iter().map(project).collect())
    }
}
