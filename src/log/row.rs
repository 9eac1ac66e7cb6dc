//! The rows of the tables.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use wildcity_scene::ActorClass;
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::views::{MOST_STOPS, refused_stops};

use crate::error::FieldError;
use crate::header::check_name;
use crate::limits;

/// A row of a table.
pub trait Row: DeserializeOwned + Serialize {
    /// Name of the table's file.
    const FILE: &str;

    /// When it was recorded, in microseconds on the log's clock.
    fn time_us(&self) -> i64;

    /// What has at most one row at a time: a camera, a LiDAR, a track. Without it, the table has.
    fn key(&self) -> Option<&str> {
        None
    }

    /// Checks the values of the row.
    ///
    /// # Errors
    /// Names the first field that cannot be used.
    fn check(&self) -> Result<(), FieldError> {
        Ok(())
    }
}

/// A pose of the rig: a row of `poses.jsonl`.
impl Row for Keyframe {
    const FILE: &str = "poses.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }
}

/// An image: a row of `images.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ImageRow {
    /// When its last row was exposed, in microseconds on the log's clock.
    pub time_us: i64,
    /// Name of its camera in `rig.json`.
    pub camera: String,
    /// The JPEG or PNG as it was recorded: relative to the log's folder, or absolute.
    pub file: String,
    /// A PNG of the image's size: pixels darker than half do not count.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<String>,
    /// A PNG of the image's size: pixels brighter than half show the ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ground_mask: Option<String>,
    /// A PNG of the image's size: pixels brighter than half show the sky.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sky_mask: Option<String>,
    /// Its exposure in stops against the others of the log, if that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_stops: Option<f64>,
    /// How long each of its rows was exposed, in microseconds, if that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_us: Option<i64>,
    /// Whether it is held out: no scene is trained on it, and evaluations compare with it.
    #[serde(default, skip_serializing_if = "is_false")]
    pub held_out: bool,
}

/// A sweep of a LiDAR: a row of `lidar.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct SweepRow {
    /// When it began, in microseconds on the log's clock.
    pub time_us: i64,
    /// When it ended: no point is later.
    pub until_us: i64,
    /// Name of its LiDAR in `log.json`.
    pub lidar: String,
    /// The safetensors file of its points: relative to the log's folder, or absolute.
    pub file: String,
    /// The time to which the source has moved all points already; without it, each point is where
    /// the LiDAR saw it at its own time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compensated_to_us: Option<i64>,
}

/// A box around an object at one time: a row of `tracks.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TrackRow {
    /// When the object was there, in microseconds on the log's clock.
    pub time_us: i64,
    /// The object's id within the log.
    pub track: String,
    /// By which scenarios choose an asset for the object.
    #[cfg_attr(feature = "schema", schemars(with = "ClassSchema"))]
    pub class: ActorClass,
    /// Length, width and height, in metres.
    pub size: [f64; 3],
    /// Pose of the box's middle in the world: x points forward, z up.
    #[cfg_attr(feature = "schema", schemars(with = "wildcity_options::Pose"))]
    pub world_from_box: Pose,
    /// Velocity in the world, in m/s, if the source has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity: Option<[f64; 3]>,
}

/// A measurement of an inertial unit: a row of `imu.jsonl`, in the rig's axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ImuRow {
    /// When it was measured, in microseconds on the log's clock.
    pub time_us: i64,
    /// Angular velocity about the rig's axes, in rad/s.
    pub angular_velocity_rad_per_s: [f64; 3],
    /// Acceleration with that of gravity: (0, 0, 9.81) for a rig at rest, in m/s².
    pub acceleration_m_per_s2: [f64; 3],
}

/// A satellite fix: a row of `gps.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct GpsRow {
    /// When it was measured, in microseconds on the log's clock.
    pub time_us: i64,
    /// Latitude of WGS84, in degrees, positive to the north.
    pub latitude_deg: f64,
    /// Longitude of WGS84, in degrees, positive to the east.
    pub longitude_deg: f64,
    /// Height above the ellipsoid, in metres.
    pub altitude_m: f64,
}

impl Row for ImageRow {
    const FILE: &str = "images.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }

    fn key(&self) -> Option<&str> {
        Some(&self.camera)
    }

    fn check(&self) -> Result<(), FieldError> {
        check_name("camera", &self.camera)?;
        check_file("file", &self.file)?;
        let masks = [
            ("mask", &self.mask),
            ("ground_mask", &self.ground_mask),
            ("sky_mask", &self.sky_mask),
        ];
        for (field, file) in masks {
            file.as_deref().map_or(Ok(()), |file| check_file(field, file))?;
        }
        if let Some(stops) = refused_stops(self.exposure_stops) {
            let reason = format!("{stops:?}; give -{MOST_STOPS} to {MOST_STOPS}");
            return Err(FieldError::new("exposure_stops", reason));
        }
        match self.exposure_us {
            Some(us) if !(1..=limits::EXPOSURE_US).contains(&us) => {
                let reason = format!("{us}; give 1 to {} microseconds", limits::EXPOSURE_US);
                Err(FieldError::new("exposure_us", reason))
            }
            _ => Ok(()),
        }
    }
}

impl Row for SweepRow {
    const FILE: &str = "lidar.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }

    fn key(&self) -> Option<&str> {
        Some(&self.lidar)
    }

    fn check(&self) -> Result<(), FieldError> {
        check_name("lidar", &self.lidar)?;
        check_file("file", &self.file)?;
        if self.until_us < self.time_us {
            let reason = format!("{} is before time_us, {}", self.until_us, self.time_us);
            return Err(FieldError::new("until_us", reason));
        }
        Ok(())
    }
}

impl Row for TrackRow {
    const FILE: &str = "tracks.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }

    fn key(&self) -> Option<&str> {
        Some(&self.track)
    }

    fn check(&self) -> Result<(), FieldError> {
        if self.track.is_empty() {
            return Err(FieldError::new("track", "an id has at least one character"));
        }
        // NaN compares as false with both bounds, and so is refused, too.
        let is_side = |side: &f64| *side > 0.0 && *side <= limits::BOX_M;
        if let Some(side) = self.size.iter().find(|side| !is_side(side)) {
            let reason = format!("{side:?}; a side is more than 0 and at most {} m", limits::BOX_M);
            return Err(FieldError::new("size", reason));
        }
        check_finite("velocity", self.velocity.as_ref().map_or(&[], |velocity| &velocity[..]))
    }
}

impl Row for ImuRow {
    const FILE: &str = "imu.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }

    fn check(&self) -> Result<(), FieldError> {
        check_finite("angular_velocity_rad_per_s", &self.angular_velocity_rad_per_s)?;
        check_finite("acceleration_m_per_s2", &self.acceleration_m_per_s2)
    }
}

impl Row for GpsRow {
    const FILE: &str = "gps.jsonl";

    fn time_us(&self) -> i64 {
        self.time_us
    }

    fn check(&self) -> Result<(), FieldError> {
        check_angle("latitude_deg", self.latitude_deg, 90.0)?;
        check_angle("longitude_deg", self.longitude_deg, 180.0)?;
        check_finite("altitude_m", &[self.altitude_m])
    }
}

fn is_false(value: &bool) -> bool {
    !value
}

fn check_file(field: &str, file: &str) -> Result<(), FieldError> {
    if file.is_empty() {
        return Err(FieldError::new(field, "the name of a file has at least one character"));
    }
    Ok(())
}

fn check_finite(field: &str, values: &[f64]) -> Result<(), FieldError> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(FieldError::new(field, format!("{value:?}; give finite numbers"))),
        None => Ok(()),
    }
}

fn check_angle(field: &str, degrees: f64, most: f64) -> Result<(), FieldError> {
    // NaN is not at most anything, so it is refused with the numbers beyond the range.
    if degrees.abs() <= most {
        return Ok(());
    }
    Err(FieldError::new(field, format!("{degrees:?}; give degrees from -{most} to {most}")))
}

/// The classes in the schema: the type itself is of a package without schemas.
#[cfg(feature = "schema")]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "ActorClass", rename_all = "snake_case")]
#[expect(dead_code, reason = "only its schema is used")]
enum ClassSchema {
    Vehicle,
    Pedestrian,
    Bicycle,
    Object,
}
