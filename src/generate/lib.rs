//! The demo twin, a few hundred metres of a street, and cities of such streets, made from a seed.
//!
//! Surfaces are tiled with flat Gaussians (`surface.rs`) whose colours carry the light of one sun
//! (`light.rs`). World: ENU in metres, z up, the road at z = 0, the street running east from the
//! origin. The same settings give the same bytes: nothing depends on a clock or on the order of
//! threads, and each object has its own stream of random numbers (`random.rs`).
//!
//! Large surfaces have few cells. What has an edge in a picture, such as a letter, the frame of a
//! window, a seam of a car or a crack of the road, is a stroke on them: one thin Gaussian.
//!
//! The 426,000 Gaussians of the default settings, and their spacing at a
//! [`StreetSettings::density`] of 1 (at the default of 0.8, spacings are 12 % wider):
//!
//! | what | thousands | spacing |
//! |---|---|---|
//! | road, parking, kerbs, pavements | 65 | 3 cm at lines, asphalt 38 x 50 cm, slabs 90 cm |
//! | houses | 177 | panes 22 to 40 cm, walls 16 to 75 cm, 2.5 times that where there is no lane |
//! | 65 parked cars | 90 | 3 to 21 cm |
//! | 44 trees | 52 | leaves of 6 cm |
//! | yards behind the houses, with 20 trees | 25 | 1.2 to 2 m, leaves of 12 cm |
//! | lamps, lights, signs, bins, planters | 12 | 4 to 40 cm |
//! | skyline, land | 6 | 4.5 m, wider with the distance |
//!
//! Behind them is a sky of its own ([`SKY`]). Every Gaussian of a street has a class; the models of
//! actors have none, since an actor says what it is.

mod actors;
mod backdrop;
mod buildings;
mod canyon;
mod car_details;
mod car_kinds;
mod cars;
mod city;
mod cyclist;
mod facade;
mod furniture;
mod ground_floor;
mod letters;
mod light;
mod map;
mod pedestrian;
mod plants;
mod random;
mod road;
mod route;
mod spoil;
mod street;
mod surface;
mod yards;

pub use actors::{ACTOR_REVISION, ActorModel, actor_models};
pub use canyon::canyon;
pub use city::{Cell, City, city, city_drive, city_map};
use serde::{Deserialize, Serialize};
pub use spoil::Spoil;

use wildcity_scene::{Gaussians, Trajectory};
use wildcity_sim::map::MapFile;

/// Counts the generator's changes: a demo twin of another revision is built again.
pub const REVISION: u32 = 5;

/// The sky over the streets, as safetensors: a clear day with the sun where their light comes from.
/// Made by `scenes/sky.py`; world axes.
pub const SKY: &[u8] = include_bytes!("../../scenes/sky.safetensors");

/// The settings of a street.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreetSettings {
    /// Seed of everything that is random.
    pub seed: u64,
    /// Length of the street that is driven, in metres: 100 to 1,000.
    pub length_m: f64,
    /// Station at which a side street crosses, in metres from the start: at least 40 from both
    /// ends.
    pub crossing_m: f64,
    /// Number of Gaussians as a multiple of that at the spacings in the source, 0.1 to 4. Spacings
    /// are divided by its square root.
    pub density: f64,
}

/// A street, ready to be stored as a twin.
#[derive(Clone, Debug, PartialEq)]
pub struct Street {
    /// Raw Gaussians of SH degree 1, in world axes.
    pub gaussians: Gaussians,
    /// The drive along the right lane: a keyframe every 0.5 m at 10 m/s, the rig's origin on the
    /// road.
    pub trajectory: Trajectory,
}

/// The settings of a city.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CitySettings {
    /// Seed of everything that is random.
    pub seed: u64,
    /// Length of the route, in whole metres, 100 to 100,000.
    pub length_m: f64,
    /// Millions of Gaussians per kilometre, 1 to 15: within a tenth of that on average.
    pub millions_per_km: f64,
    /// Speed of the recorded drive, in m/s: 0.1 to 100.
    pub speed_m_s: f64,
}

/// Why a street or a city cannot be generated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GenerateError {
    /// A setting is out of range.
    #[error("setting {field} is {value:?}; {must}")]
    Setting {
        field: &'static str,
        value: f64,
        /// The values that are accepted.
        must: &'static str,
    },
}

/// Makes the street: 426,000 Gaussians at the default settings, in a fraction of a second.
///
/// # Errors
/// Names the first setting out of range.
pub fn street(settings: &StreetSettings) -> Result<Street, GenerateError> {
    settings.check()?;
    Ok(street::build(settings))
}

/// The map of the street: its lanes, parking bays, pavements, crosswalks and intersection.
///
/// # Errors
/// Names the first setting out of range.
pub fn street_map(settings: &StreetSettings) -> Result<MapFile, GenerateError> {
    settings.check()?;
    // No Gaussian is made: the map needs only the plan's numbers.
    let route = route::Route::new(settings.length_m);
    Ok(map::build_map(&[map::MappedStreet { route: &route, crossing_m: settings.crossing_m }]))
}

impl Default for StreetSettings {
    /// The demo twin: `scenes/demo.json`.
    fn default() -> Self {
        serde_json::from_str(include_str!("../../scenes/demo.json"))
            .expect("scenes/demo.json is part of the program, and a test reads it")
    }
}

impl StreetSettings {
    /// # Errors
    /// Names the first setting out of range.
    pub fn check(&self) -> Result<(), GenerateError> {
        let Self { length_m, crossing_m, density, .. } = *self;
        let holds = [
            (
                "length_m",
                length_m,
                (100.0..=1000.0).contains(&length_m),
                "a street is from 100 to 1000 m long",
            ),
            (
                "crossing_m",
                crossing_m,
                // Room for the junction, the zebra crossings and a house on either side.
                crossing_m >= 40.0 && crossing_m <= length_m - 40.0,
                "the crossing is at least 40 m from both ends",
            ),
            ("density", density, (0.1..=4.0).contains(&density), "density is from 0.1 to 4"),
        ];
        first_refused(holds)
    }
}

impl CitySettings {
    /// # Errors
    /// Names the first setting out of range.
    pub fn check(&self) -> Result<(), GenerateError> {
        let Self { length_m, millions_per_km, speed_m_s, .. } = *self;
        first_refused([
            (
                "length_m",
                length_m,
                (100.0..=100_000.0).contains(&length_m) && length_m.fract() == 0.0,
                "a city's route is from 100 to 100000 m long, in whole metres",
            ),
            (
                "millions_per_km",
                millions_per_km,
                (1.0..=15.0).contains(&millions_per_km),
                "a city has from 1 to 15 million Gaussians per km",
            ),
            (
                "speed_m_s",
                speed_m_s,
                (0.1..=100.0).contains(&speed_m_s),
                "the drive is at 0.1 to 100 m/s",
            ),
        ])
    }

    /// Approximate number of Gaussians.
    pub fn gaussians(&self) -> u64 {
        (self.millions_per_km * 1e3 * self.length_m) as u64
    }

    /// The [`StreetSettings::density`] that gives this number of Gaussians.
    fn spacing_density(&self) -> f64 {
        // Pairs of (counted millions of Gaussians per km, density). They are not proportional,
        // because the numbers of leaves and windows do not depend on the density.
        let counted = [(1.097, 0.631), (2.061, 2.0), (4.017, 5.0), (8.130, 12.0)];
        // The segment around the number; beyond the ends of the list the outer segments go on.
        let above = counted.iter().rposition(|(millions, _)| *millions <= self.millions_per_km);
        let from = above.unwrap_or(0).min(counted.len() - 2);
        let (low, low_density) = counted[from];
        let (high, high_density) = counted[from + 1];
        let t = (self.millions_per_km - low) / (high - low);
        low_density + t * (high_density - low_density)
    }
}

fn first_refused<const N: usize>(
    holds: [(&'static str, f64, bool, &'static str); N],
) -> Result<(), GenerateError> {
    match holds.into_iter().find(|(_, _, holds, _)| !holds) {
        Some((field, value, _, must)) => Err(GenerateError::Setting { field, value, must }),
        None => Ok(()),
    }
}
