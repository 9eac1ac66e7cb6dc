//! `log.json`: where a log comes from, its clock, its world, and its LiDAR mounts.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use serde::{Deserialize, Serialize};

use wildcity_scene::geo::GeoAnchor;
use wildcity_scene::geometry::Pose;
use wildcity_scene::rig::is_name;

use crate::error::FieldError;
use crate::limits;

/// The contents of `log.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// `wildcity.log/1`.
    pub format: String,
    /// Name of the log, `[a-z0-9._-]+`; its drive in a twin has this name, too.
    pub name: String,
    /// The recording that the log was made of.
    pub source: Source,
    pub clock: Clock,
    #[serde(default)]
    pub world: World,
    /// The LiDARs, by the names that sweeps use.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lidars: Vec<LidarMount>,
    /// What the source has and the log has not, a sentence for each kind of thing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<String>,
}

/// The recording that a log was made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// The kind, such as `nuscenes` or `rosbag2`.
    pub kind: String,
    /// Which recording of that kind, such as a scene's token or the name of a bag.
    pub id: String,
    /// Its licence, as a name or a sentence.
    pub licence: String,
    /// The program that made the log, with its version.
    pub converter: String,
}

/// The clock of a log.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Clock {
    /// The log's time 0 on the source's clock, in microseconds.
    pub epoch_us: i64,
    /// What was added to the times of a sensor with a clock of its own, in microseconds, by the
    /// sensor's name. It is as recorded, not estimated.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub offsets_us: BTreeMap<String, i64>,
}

/// The world in which the poses of a log are: right-handed, z up, in metres.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct World {
    /// The log's origin in the world of the source, in metres: what was subtracted.
    #[serde(default)]
    pub origin_m: [f64; 3],
    /// The place of the log's origin on the earth, as in a twin's manifest, if it is known.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schemars(with = "Option<AnchorSchema>"))]
    pub geo: Option<GeoAnchor>,
}

/// The place of a LiDAR on the rig.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct LidarMount {
    /// Name within the log, `[a-z0-9._-]+`.
    pub name: String,
    /// Pose of the LiDAR's axes on the rig.
    #[cfg_attr(feature = "schema", schemars(with = "wildcity_options::Pose"))]
    pub rig_from_lidar: Pose,
}

impl Header {
    /// The format that this build reads and writes.
    pub const FORMAT: &str = "wildcity.log/1";

    /// A header without LiDARs, at time 0 of the source and in its world.
    pub fn new(name: impl Into<String>, source: Source) -> Self {
        Self {
            format: Self::FORMAT.to_owned(),
            name: name.into(),
            source,
            clock: Clock::default(),
            world: World::default(),
            lidars: Vec::new(),
            left_out: Vec::new(),
        }
    }

    /// Checks format, names and anchor.
    pub(crate) fn check(&self) -> Result<(), FieldError> {
        if self.format != Self::FORMAT {
            let format = &self.format;
            let reason = format!("{format:?} is not {:?}, which this build reads", Self::FORMAT);
            return Err(FieldError::new("format", reason));
        }
        check_name("name", &self.name)?;
        if !DVec3::from_array(self.world.origin_m).is_finite() {
            return Err(FieldError::new("world.origin_m", "give three finite numbers"));
        }
        if let Some(geo) = &self.world.geo {
            geo.check().map_err(|error| FieldError::new("world.geo", error.to_string()))?;
        }
        self.check_lidars()
    }

    fn check_lidars(&self) -> Result<(), FieldError> {
        let count = self.lidars.len();
        if count > limits::LIDARS {
            let reason = format!("{count} LiDARs; at most {} are accepted", limits::LIDARS);
            return Err(FieldError::new("lidars", reason));
        }
        let mut names = BTreeSet::new();
        for (index, lidar) in self.lidars.iter().enumerate() {
            let field = format!("lidars[{index}].name");
            check_name(&field, &lidar.name)?;
            if !names.insert(&lidar.name) {
                let reason = format!("{:?} is there twice; give each LiDAR its own", lidar.name);
                return Err(FieldError::new(field, reason));
            }
        }
        Ok(())
    }
}

/// Checks a name of a log, a camera or a LiDAR.
pub(crate) fn check_name(field: &str, name: &str) -> Result<(), FieldError> {
    if is_name(name) {
        return Ok(());
    }
    let reason = format!("{name:?} is no name: 1 to 64 of a-z 0-9 . _ -, not beginning with .");
    Err(FieldError::new(field, reason))
}

/// The anchor in the schema: the type itself is of a package without schemas.
#[cfg(feature = "schema")]
#[derive(schemars::JsonSchema)]
#[schemars(rename = "GeoAnchor", untagged)]
#[expect(dead_code, reason = "only its schema is used")]
enum AnchorSchema {
    /// The world is the tangent plane at a point of WGS84: x east, y north, z up.
    Origin {
        latitude_deg: f64,
        longitude_deg: f64,
        #[serde(default)]
        altitude_m: f64,
    },
    /// The world is a part of a UTM zone.
    Projected {
        /// `EPSG:32601` to `EPSG:32660` or `EPSG:32701` to `EPSG:32760`.
        projection: String,
        easting_m: f64,
        northing_m: f64,
        #[serde(default)]
        altitude_m: f64,
    },
}
